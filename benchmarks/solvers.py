"""Profiles (Dolan and More, 2002) and records of runs of `export.compare`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.family.write import REACHED
from benchmarks.table import markdown, panels, save
from soup_nlp.storage.each import Row
from soup_nlp.storage.files import write_json

PROBLEM = ["problem", "superpixels", "formulation", "identity"]
"""Columns that identify a problem."""
LABELS = {
    "cpu": "CPU time / best CPU time",
    "objective": "relative gap of the objective to the best",
}
KEPT = (
    *("solver", "name", "n", "m", "status", "objective", "iterations", "cpu", "claimed"),
    *("verified", "primal", "dual", "complementarity"),
)
"""Fields of a run in results.json."""


def frame_of_runs(rows: list[Row]) -> pd.DataFrame:
    """A line for each run with every column that is needed; "group" is its start and size."""
    frame = pd.DataFrame(rows).reindex(columns=[*KEPT, *PROBLEM, "start", "best_known", "limits"])
    frame["verified"] = frame["verified"].eq(True)
    best = frame["best_known"].astype(float)
    near = frame["objective"].astype(float) <= best + REACHED * best.abs()
    frame["reached"] = frame["verified"] & near
    frame["group"] = frame["start"] + ", N = " + frame["superpixels"].astype(str)
    return frame


def by_start(frame: pd.DataFrame) -> str:
    """Table of verified runs by solver, and start and size."""

    def cell(runs: pd.DataFrame) -> str:
        good = runs[runs["verified"]]
        time = f", {good['cpu'].median():.1f} s" if len(good) else ""
        return f"{len(good)} of {len(runs)} ({int(runs['reached'].sum())}){time}"

    groups = frame.groupby(["solver", "group"], sort=False)
    cells = {key: cell(runs) for key, runs in groups}
    table = pd.Series(cells).unstack().rename_axis("solver")
    text = (
        "Verified runs of all, in brackets those at the best known objective (within"
        f" {REACHED:g}); median CPU seconds of the verified ones. A run from `easy` begins at a"
        " solution: it is a confirmation."
    )
    return f"## By start and size\n\n{text}\n\n{markdown(table)}\n\n![profiles](profiles.png)\n"


def cost_table(frame: pd.DataFrame, measure: str) -> pd.DataFrame:
    """Costs "cpu" or "objective" by problem and solver; infinite without a verified run."""
    cost = frame[measure].astype(float).where(frame["verified"], np.inf)
    if measure == "cpu":
        # shorter times are noise
        cost = cost.clip(lower=0.01)
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


def draw_profiles(path: Path, groups: Mapping[str, pd.DataFrame]) -> None:
    """Write a picture of profiles: a row of panels for each group of runs, one for each measure."""
    picture, axes = panels(len(groups), len(LABELS), 4.5, 3.3)
    for (title, frame), line in zip(groups.items(), axes, strict=False):
        for ax, (measure, label) in zip(line, LABELS.items(), strict=True):
            share = profile(cost_table(frame, measure))
            timed = measure == "cpu"
            x = share.index.to_numpy(float) - (0.0 if timed else 1.0)
            last = max(2 * x[-1], 0.0 if timed else 1e-4)
            for j, (solver, y) in enumerate(share.items()):
                name = str(solver) if y.iloc[-1] > 0 else f"{solver}: none"
                ax.step([*x, last], [*y, y.iloc[-1]], where="post", label=name, color=f"C{j % 10}")
            if timed:
                ax.set_xscale("log")
            else:
                ax.set_xscale("symlog", linthresh=1e-6)
            ax.set(xlabel=label, ylabel="share of the problems", ylim=(-0.02, 1.05), title=title)
            ax.grid(alpha=0.3)
            ax.legend(fontsize=6)
    save(picture, path)


def write_results(folder: Path, rows: list[Row], head: Mapping[str, Any]) -> str:
    """Write profiles.png and results.json of runs; returns the table by start."""
    frame = frame_of_runs(rows)
    draw_profiles(folder / "profiles.png", dict(list(frame.groupby("group", sort=False))))
    plain = frame[[*KEPT, "reached"]].rename(columns={"cpu": "time"}).astype(object)
    results = plain.where(plain.notna(), None).to_dict("records")
    write_json(folder / "results.json", {**head, "results": results})
    return by_start(frame)
