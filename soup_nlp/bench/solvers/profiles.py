"""Performance profiles of the runs (Dolan and More, 2002)."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from soup_nlp.arrays import Float
from soup_nlp.bench.study import figure, save

PROBLEM = ["problem", "superpixels", "formulation", "problem_hash"]
"""Columns that identify a problem."""
MIN_SECONDS = 0.01
"""Shorter times count as this time, seconds."""
MIN_GAP = 1e-4
"""Smallest end of the axis of relative gaps; smaller gaps are within the solvers' tolerance."""
LABELS = {
    "seconds": "time / best time",
    "cpu_seconds": "CPU time / best CPU time",
    "energy": "relative gap of the exact energy to the best",
    "objective": "relative gap of the objective to the best",
}


def cost_table(frame: pd.DataFrame, measure: str) -> pd.DataFrame:
    """Costs by problem and solver of the verified runs; infinite without a verified run.

    `measure` is a column: "seconds", "cpu_seconds", "energy" or "objective".
    """
    cost = frame[measure].astype(float).where(frame["verified"], np.inf)
    if "seconds" in measure:
        cost = cost.clip(lower=MIN_SECONDS)
    table = frame[[*PROBLEM, "solver"]].assign(cost=cost)
    return table.pivot_table(
        index=PROBLEM, columns="solver", values="cost", aggfunc="last", fill_value=np.inf
    )


def profile(cost: pd.DataFrame) -> pd.DataFrame:
    """Share of the problems that a solver solves within r of the best: a line for each r >= 1.

    Args:
        cost: Problems by solvers, infinite for a failure.
    """
    best = cost.min(axis=1)
    ratio = cost.div(best.where(np.isfinite(best), 1.0), axis=0).to_numpy()
    steps = np.unique(np.append(1.0, ratio[np.isfinite(ratio)]))
    share = (ratio[None] <= steps[:, None, None]).mean(axis=1)
    return pd.DataFrame(share, index=pd.Index(steps, name="r"), columns=cost.columns)


def draw_profiles(
    path: Path, groups: Mapping[str, pd.DataFrame], measures: tuple[str, ...]
) -> None:
    """Write a picture of profiles: a row of panels for each group of runs, one for each measure."""
    picture = figure(4.5 * len(measures), 3.3 * max(1, len(groups)))
    axes = picture.subplots(max(1, len(groups)), len(measures), squeeze=False)
    for (title, frame), line in zip(groups.items(), axes, strict=False):
        for ax, measure in zip(line, measures, strict=True):
            cost = cost_table(frame, measure)
            _draw_profile(ax, measure, len(cost), profile(cost))
            ax.set_title(title, fontsize=9)
    save(picture, path)


def _draw_profile(ax: Axes, measure: str, count: int, share: pd.DataFrame) -> None:
    """Draw a profile of `count` problems."""
    timed = "seconds" in measure
    x: Float = share.index.to_numpy(float) - (0.0 if timed else 1.0)
    last = max(2 * x[-1], 0.0 if timed else MIN_GAP)
    none = [str(s) for s in share if not share[s].iloc[-1] > 0]
    for j, solver in enumerate(share):
        if str(solver) not in none:
            y = share[solver].to_numpy()
            ax.step([*x, last], [*y, y[-1]], where="post", label=str(solver), color=f"C{j % 10}")
    if none:
        ax.plot([], [], " ", label=textwrap.fill("none by " + ", ".join(none), 30))
    if timed:
        ax.set_xscale("log")
    else:
        ax.set_xscale("symlog", linthresh=1e-6)
        ax.set_xlim(-3e-8, 1.1 * last)
    ax.set(xlabel=LABELS[measure], ylabel=f"share of {count} problems", ylim=(-0.02, 1.05))
    ax.grid(alpha=0.3)
    ax.legend(fontsize=7)
