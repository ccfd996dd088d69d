"""The dozen lines that end a solve: what happened, how good it is, where the files are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from soup_nlp.report.metrics import DepthMetrics, skill

if TYPE_CHECKING:
    from soup_nlp.pipeline import Run

WORDS = {
    "Solve_Succeeded": "converged to the tolerance",
    "Solved_To_Acceptable_Level": "converged to Ipopt's acceptable level",
    "Maximum_Iterations_Exceeded": "not converged: iteration limit, best iterate kept",
    "Time_Limit": "not converged: time limit, best iterate kept",
    "Interrupted": "interrupted, best iterate kept",
    "Infeasible_Problem_Detected": "not converged: no feasible point nearby, best iterate kept",
    "Restoration_Failed": "not converged: feasibility could not be restored, best iterate kept",
}
TITLES = {"rigid": "one rigid motion", "constant": "constant depth"}
OF_ANSWER = ("nlp_infeasibility", "dual_infeasibility", "complementarity")
"""Residuals of Ipopt's own answer; the others are those of the delivered soup."""

PAD = " " * 12


def verdict(run: Run, folder: Path, files: Sequence[str], limit: float | None = None) -> str:
    """Status, energy, residuals, accuracy, times, files and the next command.

    Args:
        run: The run.
        folder: Where its files are.
        files: Their names.
        limit: Largest MRE that the problem file allows, if it says so.
    """
    s = run.solution
    words = WORDS.get(s.status, f"not converged: {s.status}, best iterate kept")
    every = sum(stage.iterations for stage in s.stages)
    lines = [
        f"status      {words} ({s.status})",
        f"{PAD}constrained NLP {s.stages[-1].iterations} iterations of {every}; delivered: "
        + (
            "its answer, retracted to the constraints"
            if run.delivered == "constrained NLP"
            else "the presolve's answer, whose exact energy is lower"
        ),
    ]
    names = list(s.energy)
    lines.append("energy      " + " " * 9 + "".join(f"{k:>11}" for k in names))
    for title, energy in (("start", s.energy_start), ("solution", s.energy)):
        lines.append(f"{PAD}{title:<9}" + "".join(f"{energy[k]:>11.5g}" for k in names))
    own = {k: v for k, v in s.residuals.items() if k not in OF_ANSWER}
    lines.append("residuals   " + "  ".join(f"{k} {v:.1e}" for k, v in own.items()))
    answer = "  ".join(f"{k} {s.residuals[k]:.1e}" for k in OF_ANSWER if k in s.residuals)
    lines.append(f"{PAD}Ipopt's answer: {answer}")
    if run.metrics:
        lines += [f"accuracy    {protocol(run.metrics)}"]
        lines += [PAD + line for line in accuracy(run.metrics)]
    if limit is not None and run.metrics:
        lines.append(f"expected    MRE at most {limit:g}: {'missed' if missed(run) else 'met'}")
    whole = {k: v for k, v in run.seconds.items() if not k.startswith("nlp_")}
    inner = {k[4:]: v for k, v in run.seconds.items() if k.startswith("nlp_")}
    lines += [
        f"seconds     {sum(whole.values()):.1f}: "
        + "  ".join(f"{k} {v:.1f}" for k, v in whole.items()),
        f"{PAD}of nlp: " + "  ".join(f"{k} {v:.1f}" for k, v in inner.items()),
        f"files       {folder}/: " + ", ".join(files),
        f"next        soup-nlp check {folder}",
    ]
    return "\n".join(lines)


def protocol(metrics: Mapping[str, DepthMetrics]) -> str:
    """Scale rule and cap that scores are after, in words."""
    first = next(iter(metrics.values()))
    cap = "no depth cap" if first.cap is None else f"depth cap {first.cap:g}"
    rule = "no scale" if first.scale_rule == "none" else f"one global {first.scale_rule} scale each"
    return f"depth of the reference frame, {rule}, {cap}"


def accuracy(metrics: Mapping[str, DepthMetrics]) -> list[str]:
    """A table of scores: the solution beside the start, one rigid motion and a constant depth."""
    lines = [f"{'':<17}{'MRE':>8}{'median':>9}{'skill':>8}{'coverage':>10}"]
    worst = metrics["constant"].mre
    for name in ("solution", "start", "rigid", "constant"):
        if name in metrics:
            m = metrics[name]
            lines.append(
                f"{TITLES.get(name, name):<17}{m.mre:>8.4f}{m.median_relative:>9.4f}"
                f"{skill(m.mre, worst):>8.3f}{m.coverage:>10.1%}"
            )
    return lines


def missed(run: Run) -> bool:
    """Whether a known truth is missed by more than the problem file expects."""
    limit = run.problem.expected.mre_at_most
    # an MRE that is not a number has not met anything
    return limit is not None and bool(run.metrics) and not run.metrics["solution"].mre <= limit
