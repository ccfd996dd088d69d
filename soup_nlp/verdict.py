"""The dozen lines that end a solve: what happened, how good it is, where the files are."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from soup_nlp.pipeline import Run

WORDS = {
    "Solve_Succeeded": "converged to the tolerance",
    "Solved_To_Acceptable_Level": "converged to Ipopt's acceptable level",
    "Maximum_Iterations_Exceeded": "not converged: iteration limit, best iterate kept",
    "Time_Limit": "not converged: time limit, best iterate kept",
    "Interrupted": "interrupted, best iterate kept",
}


def verdict(run: Run, folder: Path, files: list[str]) -> str:
    """Status, energy, residuals, accuracy, times, files and the next command."""
    s = run.solution
    words = WORDS.get(s.status, f"not converged: {s.status}, best iterate kept")
    last = s.stages[-1]
    lines = [
        f"status      {words} ({s.status}; {last.iterations} iterations of the constrained NLP,"
        f" {sum(x.iterations for x in s.stages)} in all)",
        "energy      " + _terms(s.energy_start, "start   "),
        "            " + _terms(s.energy, "solution"),
        "residuals   "
        + "  ".join(f"{k} {v:.1e}" for k, v in s.residuals.items() if k != "complementarity"),
    ]
    if run.metrics:
        first = next(iter(run.metrics.values()))
        cap = "no cap" if first.cap is None else f"cap {first.cap:g}"
        lines.append(f"accuracy    MRE after {first.scale_rule} scale, {cap}")
        order = [k for k in ("solution", "start", "rigid", "constant") if k in run.metrics]
        title = {"rigid": "one rigid motion", "constant": "constant depth"}
        for k in order:
            m = run.metrics[k]
            lines.append(
                f"            {title.get(k, k):<17} {m.mre:.4f}   median {m.median_relative:.4f}"
                f"   coverage {m.coverage:.1%}"
            )
    shown = {k: v for k, v in run.seconds.items() if not k.startswith("nlp_")}
    inner = {k[4:]: v for k, v in run.seconds.items() if k.startswith("nlp_")}
    lines += [
        "seconds     " + "  ".join(f"{k} {v:.1f}" for k, v in shown.items()),
        "            nlp: " + "  ".join(f"{k} {v:.1f}" for k, v in inner.items()),
        f"files       {folder}/: " + ", ".join(files),
        f"next        soup-nlp check {folder}",
    ]
    return "\n".join(lines)


def _terms(energy: object, label: str) -> str:
    assert hasattr(energy, "items")
    parts = "  ".join(f"{k} {v:.5g}" for k, v in energy.items())
    return f"{label}  {parts}"
