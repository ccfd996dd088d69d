"""What a run found and how sure that is: the printed verdict, and summary.json."""

import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from soup_nlp.evaluation.confidence import KINDS
from soup_nlp.evaluation.metrics import DepthMetrics, skill
from soup_nlp.evaluation.scoring import SURE
from soup_nlp.geometry.constraints import constraints
from soup_nlp.pipeline.record import Run
from soup_nlp.report.findings import certainty_lines, drawn_line, found_words, hints
from soup_nlp.report.result import PAGE
from soup_nlp.storage.versions import versions

STATUS = {
    "Solve_Succeeded": "converged to the tolerance",
    "Solved_To_Acceptable_Level": "converged to Ipopt's acceptable level",
    "Constraints_Violated": "not converged: the answer breaks its constraints",
    "Skipped": "refined from the start, no NLP",
    "Interrupted": "interrupted, best iterate kept",
}
CAUSES = {
    "Maximum_Iterations_Exceeded": "iteration limit",
    "Time_Limit": "limit of CPU time",
    "Infeasible_Problem_Detected": "no feasible point nearby",
    "Error_In_Step_Computation": "no further step is found",
    "Search_Direction_Becomes_Too_Small": "steps are of rounding size",
    "Restoration_Failed": "feasibility could not be restored",
}
"""Words for other statuses, whose best iterate is kept."""
TITLES = {
    **{name: f"surest {share:.0%}" for name, share in SURE.items()},
    "nlp": "NLP alone",
    "rigid": "one rigid motion",
    "constant": "constant depth",
    "solution_next": "next frame",
    "static": "what stands still",
    "moving": "what moves",
}
"""Rows of the table of scores; the others have their own names."""
RULES = {"none": "no scale", "affine": "one scale and shift each, of least squares"}
"""Words for rules of the scale of scores."""


def verdict(
    run: Run, folder: Path, files: Sequence[str], limit: float | None = None, details: bool = True
) -> str:
    """Facts, files, next command and exit code; see `facts`."""
    # the commands can be pasted into a shell
    quoted = shlex.quote(str(folder))
    code, why = exit_code(run, limit)
    ends = {
        "files": [f"{folder}/: {', '.join(files)}"],
        "look": [f"soup-nlp view {quoted}"] if PAGE in files else [],
        "next": [f"soup-nlp check {quoted}"],
        "exit code": [f"{code}: {why}"],
    }
    return f"{facts(run, limit, details)}\n{sectioned(ends)}"


def exit_code(run: Run, mre_at_most: float | None) -> tuple[int, str]:
    """Exit code of a solve and its reason; `mre_at_most` is the largest MRE that is expected."""
    refined = run.refined is not None and run.refined.status == "interrupted"
    if refined or run.solution.status == "Interrupted":
        return 1, "interrupted; the best iterate is written"
    if not run.solved:
        return 1, f"the NLP did not converge ({run.solution.status}); the best iterate is written"
    if not run.good:
        return 1, drawn_line(certainty(run))
    if missed(run, mre_at_most):
        return 1, f"the MRE is above the expected {mre_at_most:g}"
    return 0, "solved, and at most half of the image is drawn"


def facts(run: Run, limit: float | None = None, details: bool = True) -> str:
    """What was found, how sure it is, what to try, accuracy and times.

    `limit` is the largest MRE that the problem file expects; `details` adds what concerns the flow
    and the solver: iterations, energies, residuals.
    """
    whole = {k: v for k, v in run.seconds.items() if not k.startswith("nlp_")}
    inner = {k[4:]: v for k, v in run.seconds.items() if k.startswith("nlp_")}
    status, expected = run.solution.status, list[str]()
    cause = f"not converged: {CAUSES.get(status, status)}, best iterate kept"
    if limit is not None and "solution" in run.metrics:
        expected = [f"MRE at most {limit:g}: {'missed' if missed(run, limit) else 'met'}"]
    sections = {
        "status": [f"{STATUS.get(status, cause)} ({status})"],
        "found": found_words(run),
        "certainty": certainty_lines(certainty(run)),
        "try": hints(run),
        "accuracy": accuracy(run.metrics),
        "expected": expected,
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
        f"{'' if k else title:<12}{line}"
        for title, lines in sections.items()
        for k, line in enumerate(lines)
    )


def _details(run: Run) -> dict[str, list[str]]:
    """Sections on the flow and the solver: iterations, exact energies by term, residuals."""
    s, r, flow, solver = run.solution, run.refined, run.pair.flow, list[str]()
    assert flow is not None
    if s.stages:
        every = sum(stage.iterations for stage in s.stages)
        solver.append(
            f"constrained NLP: {s.stages[-1].iterations} iterations of {every}, delivered:"
            f" {run.delivered}; E {_numbers(s.ends, '.5g')}"
        )
    if r is not None and r.rounds:
        last, begin, end = r.rounds[-1], r.energy_begin["total"], r.energy["total"]
        what = "E + E_photo" if "photo" in r.energy else "E"
        solver.append(
            f"refinement: {len(r.rounds)} rounds ({r.status}), {what} {begin:.5g} -> {end:.5g};"
            f" the last choice is at most"
            f" {max(last.gap, 0) / last.mrf_energy:.2%} above the best among its particles"
        )
    energies = {"start": s.energy_start, "NLP": s.energy, "solution": run.energy}
    return {
        "flow": [f"usable at {flow.usable:.0%} of the pixels, noise {run.start.noise:.2f} px"],
        "solver": solver,
        "energy": [f"{name:<9} {_numbers(e, '.5g')}" for name, e in energies.items()],
        "residuals": [_numbers(run.residuals, ".1e")],
    }


def _numbers(values: Mapping[str, float], form: str) -> str:
    return "  ".join(f"{k} {v:{form}}" for k, v in values.items())


def accuracy(metrics: Mapping[str, DepthMetrics]) -> list[str]:
    """Scale rule and cap of the scores, then their table; empty without scores.

    The next frame is listed where only that one has a truth, without skill.
    """
    if not metrics:
        return []
    first, constant = next(iter(metrics.values())), metrics.get("constant")
    cap = "no depth cap" if first.cap is None else f"depth cap {first.cap:g}"
    rule = RULES.get(first.scale_rule, f"one global {first.scale_rule} scale each")
    frame, worst = ("next", np.nan) if constant is None else ("reference", constant.mre)
    heads = f"{'MRE':>8}{'median':>9}{'RMSE':>10}{'d<1.25':>9}{'skill':>8}{'coverage':>10}"
    lines = [f"depth of the {frame} frame, {rule}, {cap}", f"{'':<17}{heads}"]
    order = ["solution", "static", "moving", *SURE, "nlp", "start", "rigid", "constant"]
    order += ["solution_next"] * (constant is None)
    for name in order:
        if (m := metrics.get(name)) is not None:
            gain = skill(m.mre, worst)
            lines.append(
                f"{TITLES.get(name, name):<17}{m.mre:>8.4f}{m.median_relative:>9.4f}"
                f"{m.rmse:>10.4g}{m.delta1:>9.1%}"
                f"{'' if np.isnan(gain) else f'{gain:.3f}':>8}{m.coverage:>10.1%}"
            )
    return lines


def missed(run: Run, limit: float | None) -> bool:
    """Whether the MRE, if there is one, is larger than a limit; NaN misses every one."""
    score = run.metrics.get("solution")
    return limit is not None and score is not None and not score.mre <= limit


def summary(run: Run) -> dict[str, Any]:
    """Contents of summary.json; the keys are stable."""
    s, r, full, truth = run.solution, run.refined, run.full, run.pair.truth
    constant = run.metrics["constant"].mre if "constant" in run.metrics else np.nan
    facing = run.problem.formulation.min_facing
    return {
        "name": run.problem.name,
        "problem_hash": run.problem.digest(),
        "status": s.status,
        "converged": s.converged,
        "delivered": run.delivered,
        "energy_by_stage": {**s.ends, **({} if r is None else {"refinement": run.energy["total"]})},
        "energy": {"start": s.energy_start, "nlp": s.energy, "solution": run.energy},
        "residuals": run.residuals,
        "nlp_residuals": constraints(s.soup, run.data.rim_ray, facing).largest,
        "answer_residuals": constraints(run.answer, run.data.rim_ray, facing).largest,
        "refinement": None
        if r is None
        else {
            "status": r.status,
            "seconds": r.seconds,
            "contradicted": r.contradicted,
            "start": r.energy_start,
            "begin": r.energy_begin,
            "end": r.energy,
            "rounds": [{**vars(one), "gap": one.gap} for one in r.rounds],
        },
        "metrics": {
            # the constant depth is scored on the reference frame only
            k: vars(m) | ({} if k == "solution_next" else {"skill": skill(m.mre, constant)})
            for k, m in run.metrics.items()
        },
        "truth_unit": None if truth is None else truth.unit,
        "components": {"count": len(run.components)},
        "expected": run.problem.expected.model_dump(),
        "seconds": run.seconds,
        "iterations": {stage.name: stage.iterations for stage in s.stages},
        "sizes": {
            "superpixels": len(run.segmentation),
            "knn_edges": len(run.segmentation.edges),
            "neighbour_pairs": len(run.segmentation.pairs),
            "width": run.pair.size[1],
            "height": run.pair.size[0],
            **s.nlp,
        },
        "full_size": None
        if full is None
        else {
            "width": full.depth_ref.shape[1],
            "height": full.depth_ref.shape[0],
            "metrics": full.metrics and vars(full.metrics),
        },
        "start": {
            "motions": len(run.start.motions),
            "interpolated": int(run.start.interpolated.sum()),
            "median_error_px": float(np.median(run.start.error)),
        },
        "certainty": certainty(run),
        **({} if run.given is None else {"depth_prior": run.given.as_dict()}),
        "flow": str(run.pair.flow),
        "versions": versions(),
        "seed": run.problem.seed,
        "focal_sigma": run.pair.focal_sigma,
        "camera_error": run.confidence.evidence.camera,
    }


def certainty(run: Run) -> dict[str, float]:
    """Shares of the image by `KINDS` of its depth, and "median_sigma" of what is measured."""
    sure = run.confidence
    sigma = sure.sigma[sure.kind == KINDS.index("measured")]
    middle = float(np.median(sigma)) if sigma.size else float("nan")
    return {**{kind: sure.share(kind) for kind in KINDS}, "median_sigma": middle}
