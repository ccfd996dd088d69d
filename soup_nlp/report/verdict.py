"""Printed summary of a run: status, energy, accuracy, times and files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from soup_nlp.evaluate.metrics import DepthMetrics, skill
from soup_nlp.evaluate.scoring import SURE
from soup_nlp.report.certainty import certainty, certainty_lines
from soup_nlp.report.depth_words import depth_words
from soup_nlp.report.result import PAGE

if TYPE_CHECKING:
    from soup_nlp.pipeline.record import Run
    from soup_nlp.refine.records import Refined

WORDS = {
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
}
DELIVERED = {
    "constrained NLP": "its answer, retracted to the constraints",
    "presolve": "the presolve's answer, whose exact energy is lower",
    "start": "the start",
}
OF_ANSWER = ("nlp_infeasibility", "dual_infeasibility", "complementarity")
"""Residuals that are those of Ipopt's answer; the others are those of the delivered soup."""

PAD = " " * 12


def _found(run: Run) -> str:
    """Whether a minimum was found, and the exact energy at the end of each stage."""
    s = run.solution
    ends = dict(s.ends) | ({} if run.refined is None else {"refinement": run.energy["total"]})
    who = "minimum found by Ipopt" if s.converged else "no minimum reached"
    return who + (": E " + ", ".join(f"{k} {e:.5g}" for k, e in ends.items()) if ends else "")


def verdict(run: Run, folder: Path, files: Sequence[str], limit: float | None = None) -> str:
    """Facts, files and next command; `limit` is the largest MRE that the problem file expects."""
    look = [f"look        soup-nlp view {folder}"] if PAGE in files else []
    lines = [f"files       {folder}/: {', '.join(files)}", *look]
    return "\n".join([facts(run, limit), *lines, f"next        soup-nlp check {folder}"])


def facts(run: Run, limit: float | None = None) -> str:
    """Status, energy, residuals, accuracy and times; `limit` is the largest expected MRE."""
    s = run.solution
    words = WORDS.get(s.status, f"not converged: {s.status}, best iterate kept")
    lines = [f"status      {words} ({s.status})"]
    if s.far and not s.converged:
        lines.append(
            f"{PAD}the presolve ended far from a minimum: solver.far_iterations limits Ipopt there"
        )
    made = DELIVERED[run.delivered]
    if s.stages:
        every = sum(stage.iterations for stage in s.stages)
        counted = f"constrained NLP {s.stages[-1].iterations} iterations of {every}"
        lines.append(f"{PAD}{counted}; {'refined' if run.refined else 'delivered'}: {made}")
        lines.append(PAD + _found(run))
    if run.refined is not None:
        lines += [PAD + line for line in refinement(run.refined)]
    lines += energies(run)
    own = {k: v for k, v in run.residuals.items() if k not in OF_ANSWER}
    lines.append("residuals   " + "  ".join(f"{k} {v:.1e}" for k, v in own.items()))
    answer = "  ".join(f"{k} {s.residuals[k]:.1e}" for k in OF_ANSWER if k in s.residuals)
    if answer:
        lines.append(f"{PAD}Ipopt's answer: {answer}")
    shares = certainty(run)
    sections = {"depth": depth_words(run, shares), "certainty": certainty_lines(shares)}
    for title, (first, *rest) in sections.items():
        lines += [f"{title:<12}{first}", *(PAD + line for line in rest)]
    if run.metrics:
        lines += [f"accuracy    {protocol(run.metrics)}"]
        lines += [PAD + line for line in accuracy(run.metrics)]
    if limit is not None and "solution" in run.metrics:
        lines.append(f"expected    MRE at most {limit:g}: {'missed' if missed(run) else 'met'}")
    whole = {k: v for k, v in run.seconds.items() if not k.startswith("nlp_")}
    inner = {k[4:]: v for k, v in run.seconds.items() if k.startswith("nlp_")}
    lines += [
        f"seconds     {sum(whole.values()):.1f}: "
        + "  ".join(f"{k} {v:.1f}" for k, v in whole.items()),
        *([f"{PAD}of nlp: " + "  ".join(f"{k} {v:.1f}" for k, v in inner.items())] * bool(inner)),
    ]
    return "\n".join(lines)


def energies(run: Run) -> list[str]:
    """E by stage and term, and what the refinement minimised where that is not E."""
    s, r = run.solution, run.refined
    rows = {"start": s.energy_start, "NLP": s.energy, "solution": run.energy}
    if r is None or not s.stages:
        del rows["NLP"]
    names, lowered = list(s.energy), {}
    if r is not None and "photo" in r.energy:
        lowered = {"start": r.energy_start, "NLP": r.energy_begin, "solution": r.energy}
    head = "energy      " + " " * 9 + "".join(f"{k:>11}" for k in names)
    lines = [head + ("  E + E_photo" if lowered else "")]
    for title, energy in rows.items():
        line = f"{PAD}{title:<9}" + "".join(f"{energy[k]:>11.5g}" for k in names)
        lines.append(line + (f"{lowered[title]['total']:>13.5g}" if lowered else ""))
    return lines


def refinement(r: Refined) -> list[str]:
    """Result of the refinement, and the gap of its last choice."""
    if not r.rounds:
        return [f"refinement: {r.status} before its first round"]
    last = r.rounds[-1]
    fall = 1 - r.energy["total"] / r.energy_begin["total"]
    images = " + E_photo" if "photo" in r.energy else ""
    lines = [
        f"refinement {len(r.rounds)} round{'s' * (len(r.rounds) > 1)} ({r.status}): E{images}"
        f" {fall:.1%} lower; the last"
        f" choice is at most {max(last.gap, 0) / last.mrf_energy:.2%} above the best among its"
        " particles"
    ]
    if images:
        lines.append(
            f"the images contradict the flow at {r.contradicted} superpixels and outweigh it there:"
            " E may rise"
        )
    return lines


def protocol(metrics: Mapping[str, DepthMetrics]) -> str:
    """Scale rule and cap of the scores, in words."""
    first = next(iter(metrics.values()))
    cap = "no depth cap" if first.cap is None else f"depth cap {first.cap:g}"
    rule = "no scale" if first.scale_rule == "none" else f"one global {first.scale_rule} scale each"
    frame = "reference" if "constant" in metrics else "next"
    return f"depth of the {frame} frame, {rule}, {cap}"


def accuracy(metrics: Mapping[str, DepthMetrics]) -> list[str]:
    """Table of the scores of solution, start and baselines."""
    lines = [f"{'':<17}{'MRE':>8}{'median':>9}{'skill':>8}{'coverage':>10}"]
    if "constant" not in metrics:
        # only the next frame has a truth
        m = metrics["solution_next"]
        row = f"{'next frame':<17}{m.mre:>8.4f}{m.median_relative:>9.4f}{'':>8}{m.coverage:>10.1%}"
        return [*lines, row]
    worst = metrics["constant"].mre
    for name in ("solution", *SURE, "nlp", "start", "rigid", "constant"):
        if name in metrics:
            m = metrics[name]
            lines.append(
                f"{TITLES.get(name, name):<17}{m.mre:>8.4f}{m.median_relative:>9.4f}"
                f"{skill(m.mre, worst):>8.3f}{m.coverage:>10.1%}"
            )
    return lines


def missed(run: Run) -> bool:
    """Whether the MRE is larger than the problem file expects."""
    limit = run.problem.expected.mre_at_most
    # NaN misses every limit
    return (
        limit is not None and "solution" in run.metrics and not run.metrics["solution"].mre <= limit
    )
