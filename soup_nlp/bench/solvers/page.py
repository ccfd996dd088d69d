"""The page of a comparison of solvers: conclusion, tables, performance profiles, limits."""

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from soup_nlp.arrays import Float
from soup_nlp.bench.processes import machine
from soup_nlp.bench.study import markdown, page_text, panels, save, show, titled
from soup_nlp.export.verify import Limits
from soup_nlp.family.instances import VERSION
from soup_nlp.family.write import REACHED
from soup_nlp.storage.files import write_json
from soup_nlp.storage.rows import Row

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
CONFIRMATION = "easy"
"""The start of the family that is a solution."""
FEASIBLE = 1e-5
"""Largest violation of a feasible point."""
LIMITS = (
    "Times are CPU times of one run each, set-up included, on the machine named; so is the limit.",
    "A confirmation begins at a solution (`easy`): energies hardly move, and"
    " the comparison is of how quickly a solver proves it. The other starts are the problem.",
    "Local solvers end in local minima: an energy says where this start led, not what is best.",
    "Residuals are unscaled and may be ten times the tolerance, as every solver scales its own.",
    "Options are those of `soup_nlp/bench/solvers/plugins.py`, the package's own ones being tuned"
    " on such problems.",
)
COLUMNS = {
    "superpixels": ("N", ""),
    "formulation": ("formulation", ""),
    "solver": ("solver", ""),
    "word": ("verified", ""),
    "energy": ("exact E", ".6g"),
    "energy_start": ("start E", ".6g"),
    "primal": ("primal", ".0e"),
    "dual": ("dual", ".0e"),
    "complementarity": ("compl.", ".0e"),
    "iterations": ("iterations", ".0f"),
    "seconds": ("seconds", ".2f"),
    "MB": ("MB", ".0f"),
    "ended": ("status", ""),
}
"""Title and format of every column of the table of runs, after the problem."""
FILES = ("README.md", "profile.png")
"""Files that are made from all runs."""
OF_FAMILY = ("profiles.png", "results.json", "reached.json")
"""Further files for runs of the family."""
FURTHER = ("objective", "peak_bytes", "status", "best_known")
"""Further columns that the page and the records need."""


def frame_of_runs(rows: Sequence[Row]) -> pd.DataFrame:
    """A line for each run, with every column that the page needs."""
    frame = pd.DataFrame(list(rows))
    frame = frame.reindex(columns=list(dict.fromkeys([*frame.columns, *COLUMNS, *FURTHER])))
    frame["MB"] = frame["peak_bytes"].where(frame["peak_bytes"] > 0) / 2**20
    frame["iterations"] = frame["iterations"].where(frame["iterations"] >= 0).astype(float)
    false = np.where(frame["claimed"], "claim is FALSE", "no")
    frame[["claimed", "verified"]] = frame[["claimed", "verified"]].astype(bool)
    frame["word"] = np.where(frame["verified"], "yes", false)
    frame["ended"] = [" ".join(str(s)[:50].replace("|", "/").split()) for s in frame["status"]]
    return frame


def page(frame: pd.DataFrame) -> str:
    """Markdown page of all runs, those of the SOUP family with a table by start and size."""
    packages = {f"{k} {v}" for versions in frame["versions"] for k, v in versions.items()}
    code = ", ".join(sorted(frame["code"].astype(str).unique()))
    limits = frame["limits"].iloc[0]
    seconds = " or ".join(f"{s:g}" for s in sorted({v["seconds"] for v in frame["limits"]}))
    limit = (
        f"A run has {seconds} CPU seconds, {limits['iterations']} iterations and"
        f" {limits['memory'] / 2**30:g} GiB, and is asked for a dual infeasibility of"
        f" {limits['tol']:g}."
    )
    begun = frame["start"] == CONFIRMATION
    facts = [*sorted(frame["machine"].unique()), ", ".join(sorted(packages)), f"code {code}"]
    sections = {
        "By start and size": _by_start(of_family(frame)),
        "By problem": _by_problem(frame),
        "By run": _by_run(frame[~begun]),
        "Confirmation: runs that begin at a solution": _by_run(frame[begun]),
        "Limits": "\n".join(f"- {text}" for text in (limit, *LIMITS)),
        "Machine and versions": "\n".join(f"- {text}" for text in facts),
    }
    head = ["# Solvers on the Superpixel Soup NLP", "\n".join(conclusion(frame))]
    parts = [part for title, body in sections.items() if body for part in (f"## {title}", body)]
    return page_text([*head, "![performance profiles](profile.png)", *parts])


def of_family(frame: pd.DataFrame) -> pd.DataFrame:
    """The runs on instances of the SOUP family, whose best known objectives are recorded."""
    return frame[frame["best_known"].notna()]


def conclusion(frame: pd.DataFrame) -> list[str]:
    """Conclusion in two sentences."""
    solved = np.isfinite(cost_table(frame, "seconds")).sum()
    successes = solved[solved > 0].sort_values(ascending=False, kind="stable")
    counts = ", ".join(f"{name} {count}" for name, count in successes.items()) or "none"
    lines = [
        f"**{frame.groupby(PROBLEM).ngroups} problems, {len(solved)} solvers, {len(frame)} runs:"
        f" {int(frame['verified'].sum())} verified.** Verified problems by solver: {counts}.",
    ]
    claims = frame[frame["claimed"]]
    if len(claims):
        false = sorted(claims.loc[~claims["verified"], "solver"].unique())
        exceptions = f"; not always those of {', '.join(false)}" if false else ""
        true = f"{int(claims['verified'].sum())} of {len(claims)}{exceptions}"
        lines.append(f"Claims of an optimum that were true: {true}.")
    return lines


def _by_problem(frame: pd.DataFrame) -> str:
    """Exact energy that every solver reached, by problem; brackets where it is not verified."""
    feasible = frame["energy"].where(frame["primal"] <= FEASIBLE).astype(float)
    texts = feasible.map(lambda e: show(e, ".6g"))
    texts = texts.where(frame["verified"] | feasible.isna(), "(" + texts + ")")
    # problems of one name may have different contents
    table = frame.assign(energy=texts).pivot_table(
        index=[*PROBLEM, "energy_start"],
        columns="solver",
        values="energy",
        aggfunc="last",
        fill_value="-",
        sort=False,
    )
    table = table.reset_index("energy_start").droplevel("problem_hash")
    table.index.names = ["problem", "N", "formulation"]
    text = (
        "Exact energy of the point that each solver reached, in brackets where it is feasible (to"
        f" {FEASIBLE:g}) but not verified. Verified: KKT residuals and exact energy, recomputed"
        " from the point, are those of an optimum, to one tolerance for all, whether or not the"
        " solver claims one.\n\n"
    )
    return text + markdown(table.rename(columns={"energy_start": "start"}), ".6g")


def _by_run(frame: pd.DataFrame) -> str:
    """Table of every run; nothing without runs."""
    ascending = [True] * len(PROBLEM) + [False, True]
    order = frame.sort_values([*PROBLEM, "verified", "seconds"], ascending=ascending)
    return titled(order.set_index("problem"), COLUMNS) if len(order) else ""


def reached(frame: pd.DataFrame) -> pd.Series:
    """Whether a run is verified and has reached the best known objective."""
    best = frame["best_known"].astype(float)
    near = frame["objective"].astype(float) <= best + REACHED * best.abs()
    return frame["verified"] & near


def by_start(frame: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Runs of the family by start and size, "hard, N = 100" and so on; `easy` is a confirmation."""
    return {
        f"{'confirmation' if start == CONFIRMATION else start}, N = {n}": group
        for (start, n), group in frame.groupby(["start", "superpixels"], sort=False)
    }


def _by_start(frame: pd.DataFrame) -> str:
    """Table of the verified runs by start and size of the family; nothing without runs."""
    if frame.empty:
        return ""

    def cell(runs: pd.DataFrame) -> str:
        good = runs[runs["verified"]]
        time = f", {good['cpu_seconds'].median():.1f} s" if len(good) else ""
        return f"{len(good)} of {len(runs)} ({int(reached(runs).sum())}){time}"

    text = (
        "Verified runs of all, in brackets those at the best known objective (within"
        f" {REACHED:g}); median CPU seconds of the verified ones.\n\n"
    )
    cells = {
        title: {solver: cell(runs) for solver, runs in group.groupby("solver")}
        for title, group in by_start(frame).items()
    }
    table = markdown(pd.DataFrame(cells).sort_index().rename_axis("solver"))
    return f"{text}{table}\n\n![profiles by start and size](profiles.png)"


# --- performance profiles (Dolan and More, 2002) ------------------------------------------------


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
    picture, axes = panels(len(groups), len(measures), 4.5, 3.3)
    for (title, frame), line in zip(groups.items(), axes, strict=False):
        for ax, measure in zip(line, measures, strict=True):
            cost = cost_table(frame, measure)
            _draw_profile(ax, measure, len(cost), profile(cost))
            ax.set_title(title, fontsize=9)
    save(picture, path)


def write_pictures(folder: Path, frame: pd.DataFrame, limits: Limits) -> None:
    """Write profile.png from all runs, and OF_FAMILY from those of the family."""
    draw_profiles(folder / "profile.png", {"": frame}, ("seconds", "energy"))
    family = of_family(frame)
    if len(family):
        draw_profiles(folder / "profiles.png", by_start(family), ("cpu_seconds", "objective"))
        head = {"set": "SOUP", "version": VERSION, "limits": asdict(limits), "machine": machine()}
        write_json(folder / "results.json", {**head, "results": neutral(family)})
        write_json(folder / "reached.json", summary(family))


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


# --- records of the family -----------------------------------------------------------------------

CASADI = ("ipopt", "sqpmethod", "uno", "bonmin", "fatrop")


def neutral(frame: pd.DataFrame) -> list[dict[str, Any]]:
    """The runs in a form that no solver is special in."""
    names = {"cpu_seconds": "time", "wall_seconds": "wall_time"}
    kept = ["solver", "name", "n", "m", "status", "objective", "iterations", "claimed", "verified"]
    kept += ["primal", "dual", "complementarity"]
    out = frame[[*kept, *names]].rename(columns=names).astype(object)
    out = out.where(out.notna(), None)
    out["reached"], out["time_limit"] = reached(frame), [v["seconds"] for v in frame["limits"]]
    out["version"] = [
        versions.get("casadi" if solver in CASADI else "soup_nlp", "unknown")
        for solver, versions in zip(frame["solver"], frame["versions"], strict=True)
    ]
    return [{str(k): v for k, v in row.items()} for row in out.to_dict("records")]


def summary(frame: pd.DataFrame) -> dict[str, dict[str, Any]]:
    """Solvers that tried and that reached the best known point, by problem (name without start).

    "runs" has objective, CPU seconds, their limit and whether the point is verified, by start and
    solver, as `records/published.json` has them for the README of the set.
    """

    def entry(row: pd.Series) -> list[Any]:
        objective = float(row["objective"])
        value = float(f"{objective:.9g}") if np.isfinite(objective) else None
        limit = float(row["limits"]["seconds"])
        return [value, round(float(row["cpu_seconds"]), 1), limit, bool(row["verified"])]

    names = frame["name"].str.rpartition("-")[0]
    return {
        str(name): {
            "tried_by": list(group["solver"].unique()),
            "reached_by": list(group.loc[reached(group), "solver"].unique()),
            "runs": {
                str(start): {str(row["solver"]): entry(row) for _, row in runs.iterrows()}
                for start, runs in group.groupby("start", sort=False)
            },
        }
        for name, group in frame.groupby(names, sort=False)
    }
