"""The printed verdict: findings, accuracy, energies, what concerns the solver, files."""

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from soup_nlp.evaluate.metrics import DepthMetrics, skill
from soup_nlp.evaluate.scoring import SURE
from soup_nlp.pipeline.record import Run
from soup_nlp.report.findings import (
    certainty_lines,
    flow_words,
    found_words,
    guess_line,
    hints,
)
from soup_nlp.report.result import PAGE
from soup_nlp.report.summary import certainty

STATUS = {
    "Solve_Succeeded": "converged to the tolerance",
    "Solved_To_Acceptable_Level": "converged to Ipopt's acceptable level",
    "Maximum_Iterations_Exceeded": "not converged: iteration limit, best iterate kept",
    "Time_Limit": "not converged: time limit, best iterate kept",
    "Constraints_Violated": "not converged: the answer breaks its constraints",
    "Skipped": "refined from the start, no NLP",
    "Interrupted": "interrupted, best iterate kept",
    "Infeasible_Problem_Detected": "not converged: no feasible point nearby, best iterate kept",
    "Error_In_Step_Computation": "not converged: no further step is found, best iterate kept",
    "Search_Direction_Becomes_Too_Small": "not converged: steps are of rounding size, best iterate"
    " kept",
    "Restoration_Failed": "not converged: feasibility could not be restored, best iterate kept",
}
TITLES = {
    **{name: f"surest {share:.0%}" for name, share in SURE.items()},
    "nlp": "NLP alone",
    "rigid": "one rigid motion",
    "constant": "constant depth",
    "solution_next": "next frame",
}
"""Rows of the table of scores; the others have their own names."""
DELIVERED = {
    "constrained NLP": "its answer, retracted to the constraints",
    "presolve": "the presolve's answer, whose exact energy is lower",
    "start": "the start",
}
OF_ANSWER = ("nlp_infeasibility", "dual_infeasibility", "complementarity")
"""Residuals of Ipopt's answer; all others are residuals of the delivered soup."""
PAD = " " * 12


def verdict(
    run: Run,
    folder: Path,
    files: Sequence[str],
    limit: float | None = None,
    details: bool = True,
) -> str:
    """Facts, files, next command and exit code; see `facts`."""
    # the commands can be pasted into a shell
    quoted = shlex.quote(str(folder))
    look = [f"look        soup-nlp view {quoted}"] if PAGE in files else []
    lines = [f"files       {folder}/: {', '.join(files)}", *look]
    lines.append(f"next        soup-nlp check {quoted}")
    code, why = exit_code(run, limit)
    return "\n".join([facts(run, limit, details), *lines, f"exit code   {code}: {why}"])


def exit_code(run: Run, mre_at_most: float | None) -> tuple[int, str]:
    """Exit code of a solve and its reason; `mre_at_most` is the largest MRE that is expected."""
    refined = run.refined is not None and run.refined.status == "interrupted"
    if refined or run.solution.status == "Interrupted":
        return 1, "interrupted; the best iterate is written"
    if not run.solved:
        return 1, f"the NLP did not converge ({run.solution.status}); the best iterate is written"
    if not run.good:
        return 1, guess_line(certainty(run))
    if mre_at_most is not None and missed(run):
        return 1, f"the MRE is above the expected {mre_at_most:g}"
    return 0, "solved, and at most half of the image is a guess"


def facts(run: Run, limit: float | None = None, details: bool = True) -> str:
    """What was found, how sure it is, what to try, accuracy and times.

    Args:
        run: The run.
        limit: Largest MRE that the problem file expects.
        details: Add what concerns the flow and the solver: iterations, energies, residuals.
    """
    shares = certainty(run)
    whole = {k: v for k, v in run.seconds.items() if not k.startswith("nlp_")}
    inner = {k[4:]: v for k, v in run.seconds.items() if k.startswith("nlp_")}
    sections = {
        "status": _status(run),
        "found": found_words(run),
        "certainty": certainty_lines(shares),
        "try": hints(run, shares),
        "accuracy": accuracy(run.metrics),
        "expected": [f"MRE at most {limit:g}: {'missed' if missed(run) else 'met'}"]
        if limit is not None and "solution" in run.metrics
        else [],
        **(_details(run) if details else {}),
        "seconds": [
            f"{sum(whole.values()):.1f}: {_numbers(whole, '.1f')}",
            *[f"of nlp: {_numbers(inner, '.1f')}"] * (details and bool(inner)),
        ],
    }
    return sectioned(sections)


def sectioned(sections: Mapping[str, Sequence[str]]) -> str:
    """Lines of sections, each after its title; empty sections are left out."""
    return "\n".join(
        (PAD if k else f"{title:<12}") + line
        for title, lines in sections.items()
        for k, line in enumerate(lines)
    )


def _details(run: Run) -> dict[str, list[str]]:
    """Sections on the flow and the solver."""
    delivered = {k: v for k, v in run.residuals.items() if k not in OF_ANSWER}
    answer = {k: v for k in OF_ANSWER if (v := run.solution.residuals.get(k)) is not None}
    return {
        "flow": flow_words(run),
        "solver": [*_minimum(run), *_refinement(run)],
        "energy": _energies(run),
        "residuals": [
            _numbers(delivered, ".1e"),
            *[f"Ipopt's answer: {_numbers(answer, '.1e')}"] * bool(answer),
        ],
    }


def _numbers(values: Mapping[str, float], form: str) -> str:
    return "  ".join(f"{k} {v:{form}}" for k, v in values.items())


def _status(run: Run) -> list[str]:
    """Status in words."""
    s = run.solution
    words = STATUS.get(s.status, f"not converged: {s.status}, best iterate kept")
    far = "the presolve ended before a minimum: solver.far_iterations limits Ipopt there"
    return [f"{words} ({s.status})", *[far] * (s.far and not s.converged)]


def _minimum(run: Run) -> list[str]:
    """Iterations of Ipopt, what it delivered, and the exact energy at the end of its stages."""
    s = run.solution
    if not s.stages:
        return []
    every = sum(stage.iterations for stage in s.stages)
    made = "refined" if run.refined else "delivered"
    outcome = "minimum found by Ipopt" if s.converged else "no minimum reached"
    stages = ", ".join(f"{k} {e:.5g}" for k, e in s.ends.items())
    return [
        f"constrained NLP {s.stages[-1].iterations} iterations of {every}; {made}:"
        f" {DELIVERED[run.delivered]}",
        f"{outcome}: E {stages}" if stages else outcome,
    ]


def _refinement(run: Run) -> list[str]:
    """How far the refinement lowers its objective, and the gap of its last choice of labels."""
    r = run.refined
    if r is None:
        return []
    if not r.rounds:
        return [f"refinement: {r.status} before its first round"]
    last, images = r.rounds[-1], "photo" in r.energy
    begin, end = r.energy_begin["total"], r.energy["total"]
    lines = [
        f"refinement {len(r.rounds)} round{'s' * (len(r.rounds) > 1)} ({r.status}):"
        f" E{' + E_photo' * images} {begin:.5g} -> {end:.5g}, {1 - end / begin:.1%} lower; the last"
        f" choice is at most {max(last.gap, 0) / last.mrf_energy:.2%} above the best among its"
        " particles"
    ]
    if images:
        lines.append(
            f"the images contradict the flow at {r.contradicted} superpixels and outweigh it there:"
            " E may rise"
        )
    return lines


def _energies(run: Run) -> list[str]:
    """Table of E by stage and term.

    Its last column is what the refinement minimised, where that is not E.
    """
    s, r = run.solution, run.refined
    given = {"start": s.energy_start, "NLP": s.energy, "solution": run.energy}
    rows = {title: dict(energy) for title, energy in given.items()}
    if r is not None and "photo" in r.energy:
        for row, energy in zip(rows.values(), (r.energy_start, r.energy_begin, r.energy)):
            row["E + E_photo"] = energy["total"]
    columns = list(rows["solution"])
    if r is None or not s.stages:
        del rows["NLP"]
    widths = [max(11, len(name) + 2) for name in columns]
    lines = [" " * 9 + "".join(f"{k:>{w}}" for k, w in zip(columns, widths))]
    for title, row in rows.items():
        cells = (f"{row[k]:>{w}.5g}" for k, w in zip(columns, widths))
        lines.append(f"{title:<9}" + "".join(cells))
    return lines


def accuracy(metrics: Mapping[str, DepthMetrics]) -> list[str]:
    """Scale rule and cap of the scores, then their table; empty without scores.

    The next frame is listed where only that one has a truth, without skill.
    """
    if not metrics:
        return []
    first = next(iter(metrics.values()))
    cap = "no depth cap" if first.cap is None else f"depth cap {first.cap:g}"
    rule = "no scale" if first.scale_rule == "none" else f"one global {first.scale_rule} scale each"
    frame = "reference" if "constant" in metrics else "next"
    lines = [f"depth of the {frame} frame, {rule}, {cap}"]
    worst = metrics["constant"].mre if "constant" in metrics else np.nan
    order = ["solution", *SURE, "nlp", "start", "rigid", "constant"]
    lines.append(f"{'':<17}{'MRE':>8}{'median':>9}{'skill':>8}{'coverage':>10}")
    for name in order if "constant" in metrics else [*order, "solution_next"]:
        if (m := metrics.get(name)) is not None:
            gain = np.nan if name == "solution_next" else skill(m.mre, worst)
            lines.append(
                f"{TITLES.get(name, name):<17}{m.mre:>8.4f}{m.median_relative:>9.4f}"
                f"{'' if np.isnan(gain) else f'{gain:.3f}':>8}{m.coverage:>10.1%}"
            )
    return lines


def missed(run: Run) -> bool:
    """Whether the MRE is larger than the problem file expects."""
    limit = run.problem.expected.mre_at_most
    # NaN misses every limit
    return (
        limit is not None and "solution" in run.metrics and not run.metrics["solution"].mre <= limit
    )
