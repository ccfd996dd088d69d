"""Performance profiles (Dolan and More, 2002) and pictures of the runs."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes

from soup_nlp.arrays import Float
from soup_nlp.bench.tables import figure, grid_of_panels, save

Row = Mapping[str, Any]

MIN_SECONDS = 0.01
"""Shorter times count as this time, seconds."""


class Problem(NamedTuple):
    """Identity of a problem in a profile."""

    problem: str
    superpixels: int
    formulation: str
    problem_hash: str

    def __str__(self) -> str:
        return f"{self.problem}, N = {self.superpixels}, {self.formulation}"


def problem_key(row: Row) -> Problem:
    """The problem of a row."""
    return Problem(*(row[name] for name in Problem._fields))


def cost_table(rows: Sequence[Row], measure: str) -> tuple[list[Problem], list[str], Float]:
    """Costs (problems, solvers) of the verified runs; infinite without a verified run.

    Args:
        rows: Runs.
        measure: "time" (wall seconds), "cpu" (CPU seconds), "energy" (exact energy) or
            "objective".
    """
    problems = sorted({problem_key(r) for r in rows})
    solvers = sorted({str(r["solver"]) for r in rows})
    cost = np.full((len(problems), len(solvers)), np.inf)
    for row in rows:
        if row["verified"]:
            place = problems.index(problem_key(row)), solvers.index(str(row["solver"]))
            cost[place] = _cost(row, measure)
    return problems, solvers, cost


def _cost(row: Row, measure: str) -> float:
    if measure in ("time", "cpu"):
        return max(float(row["seconds" if measure == "time" else "cpu_seconds"]), MIN_SECONDS)
    return float(row[measure])


def profile(cost: Float) -> tuple[Float, Float]:
    """Ratios r >= 1 and the share of problems that each solver solves within r of the best.

    Args:
        cost: (problems, solvers), infinite for a failure.

    Returns:
        (k,) ratios in order, starting at 1, and (k, solvers) shares.
    """
    best = cost.min(axis=1, initial=np.inf)
    with np.errstate(invalid="ignore"):
        ratio = np.where(np.isfinite(cost), cost / best[:, None], np.inf)
    steps = np.unique(np.append(1.0, ratio[np.isfinite(ratio)]))
    return steps, (ratio[None] <= steps[:, None, None]).mean(axis=1)


def draw_profiles(path: Path, rows: Sequence[Row]) -> None:
    """Write a picture of the profiles of time and of the final exact energy."""
    picture = figure(9, 3.6)
    for axes, measure in zip(picture.subplots(1, 2), ("time", "energy")):
        problems, solvers, cost = cost_table(rows, measure)
        draw_profile(axes, measure, len(problems), solvers, *profile(cost))
    save(picture, path)


LABELS = {
    "time": "time / best time",
    "cpu": "CPU time / best CPU time",
    "energy": "relative gap of the exact energy to the best",
    "objective": "relative gap of the objective to the best",
}


MIN_GAP = 1e-4
"""Smallest end of the axis of relative gaps; smaller gaps are within the solvers' tolerance."""


def _style(number: int) -> dict[str, Any]:
    """Line style of a solver, the same in every panel: ten colours, repeated with dashes."""
    return {"color": f"C{number % 10}", "ls": ("-", "--", ":", "-.")[number // 10 % 4]}


def draw_profile(
    axes: Axes, measure: str, count: int, solvers: Sequence[str], steps: Float, share: Float
) -> None:
    """Draw a profile.

    `steps` (k,) and `share` (k, solvers) are those of `profile`, `count` is the number of problems.
    """
    timed = measure in ("time", "cpu")
    x = steps if timed else steps - 1
    last = x[-1] * 2 if x[-1] > 0 else 1e-3
    last = last if timed else max(last, MIN_GAP)
    none = []
    for j, solver in enumerate(solvers):
        if share[-1, j] > 0:
            line = [*share[:, j], share[-1, j]]
            axes.step([*x, last], line, where="post", label=solver, **_style(j))
        else:
            none.append(solver)
    if none:
        axes.plot([], [], " ", label=textwrap.fill("none by " + ", ".join(none), 30))
    if timed:
        axes.set_xscale("log")
    else:
        axes.set_xscale("symlog", linthresh=1e-6)
        axes.set_xlim(-3e-8, 1.1 * last)
    axes.set(xlabel=LABELS[measure], ylabel=f"share of {count} problems")
    axes.set_ylim(-0.02, 1.05)
    _finish(axes, 7)


def draw_curves(path: Path, rows: Sequence[Row]) -> None:
    """Write a picture of exact energy over time, a panel for each problem; dots mark the ends."""
    problems = sorted({problem_key(r) for r in rows})
    solvers = sorted({str(r["solver"]) for r in rows})
    picture, panels = grid_of_panels(len(problems), 2, 5.2, 3.4)
    for problem, axes in zip(problems, panels, strict=True):
        here = [r for r in rows if problem_key(r) == problem]
        start = min(r["energy_start"] for r in here)
        times: list[float] = []
        for row in sorted(here, key=lambda r: str(r["solver"])):
            # a run without stored iterates has its end only
            end = [[row["seconds"], row["energy"]]] if row.get("energy") is not None else []
            curve = np.array(row["curve"] or end, float).reshape(-1, 2)
            # iterates that violate the constraints may have very large energies
            curve = curve[curve[:, 1] < 3 * start]
            if len(curve):
                filled = "full" if row["verified"] else "none"
                style = _style(solvers.index(str(row["solver"])))
                axes.plot(*curve.T, lw=1, label=row["solver"], **style)
                axes.plot(*curve[-1], "o", color=style["color"], fillstyle=filled, ms=5)
                times += [t for t in curve[:, 0] if t > 0]
        axes.axhline(start, color="0.6", lw=0.8, ls=":")
        # automatic limits fail where all times are equal up to rounding
        axes.set_xlim(min(times, default=1e-3) / 1.5, max(times, default=1.0) * 1.5)
        axes.set_xscale("log")
        axes.set_title(str(problem), fontsize=8)
        axes.set(xlabel="seconds", ylabel="exact energy")
        _finish(axes, 6)
    save(picture, path)


def _finish(axes: Axes, size: int) -> None:
    """Add a grid, and a legend if a line has a label."""
    axes.grid(alpha=0.3)
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=size)
