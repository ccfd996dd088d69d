"""The page of a comparison of solvers: conclusion, tables, limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from soup_nlp.bench.solvers.profiles import PROBLEM, cost_table
from soup_nlp.bench.study import markdown, page_text, show, titled
from soup_nlp.family.write import REACHED

Row = Mapping[str, Any]

CONFIRMATIONS = ("presolve", "easy")
"""Starts that are solutions."""
FEASIBLE = 1e-5
"""Largest violation of a feasible point."""
LIMITS = (
    "Times are CPU times of one run each, set-up included, on the machine named; so is the limit.",
    "A confirmation begins at a solution (the presolve's answer, or `easy`): energies hardly move, "
    "and the comparison is of how quickly a solver proves it. The other starts are the problem.",
    "Local solvers end in local minima: an energy says where this start led, not what is best.",
    "Residuals are unscaled and may be ten times the tolerance, as every solver scales its own.",
    "Options are those of `soup_nlp/bench/solvers/plugins.py`, the package's own ones being tuned "
    "on such problems. alpaqa and sleqp differentiate an expanded graph, which costs set-up time.",
    "lm, the reference solver on the manifold, claims no optimum; its points are verified alike.",
    "SCIP is a global solver: here it shows what its time limit allows from the same start.",
)
COLUMNS = {
    "problem": ("problem", ""),
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
"""Title and format of every column of the table of runs."""


def frame_of_runs(rows: Sequence[Row]) -> pd.DataFrame:
    """A line for each run, with every column that the page needs."""
    frame = pd.DataFrame(list(rows))
    frame = frame.reindex(
        columns=list(dict.fromkeys([*frame.columns, *COLUMNS, "objective", "peak_bytes", "status"]))
    )
    frame["MB"] = frame["peak_bytes"].where(frame["peak_bytes"] > 0) / 2**20
    frame["iterations"] = frame["iterations"].where(frame["iterations"] >= 0).astype(float)
    false = np.where(frame["claimed"], "claim is FALSE", "no")
    frame["word"] = np.where(frame["verified"], "yes", false)
    frame["ended"] = [" ".join(str(s)[:50].replace("|", "/").split()) for s in frame["status"]]
    return frame


def page(frame: pd.DataFrame, family: bool = False) -> str:
    """Markdown page of all runs; `family` adds a table by start and size of the SOUP family."""
    packages = {f"{k} {v}" for versions in frame["versions"] for k, v in versions.items()}
    code = ", ".join(sorted(frame["code"].astype(str).unique()))
    note = (
        "Verified: KKT residuals and exact energy, recomputed from the solver's point, are those of"
        " an optimum, to one tolerance for all, whether or not it claims one."
    )
    begun = frame["start"].isin(CONFIRMATIONS)
    facts = [*sorted(frame["machine"].unique()), ", ".join(sorted(packages)), f"code {code}"]
    lines = ["# Solvers on the Superpixel Soup NLP", "", *conclusion(frame), ""]
    lines += ["![performance profiles](profile.png)", "", "![energy against time](curves.png)"]
    sections = {
        "By start and size": _by_start(frame) if family else [],
        "By problem": _by_problem(frame),
        "By solver": [note, "", *_by_solver(frame)],
        "By run": _by_run(frame[~begun]),
        "Confirmation: runs that begin at a solution": _by_run(frame[begun]),
        "Limits": [f"- {text}" for text in (_limits(frame), *LIMITS)],
        "Machine and versions": [f"- {text}" for text in facts],
    }
    for title, body in sections.items():
        lines += ["", f"## {title}", "", *body] if body else []
    return page_text(lines)


def _limits(frame: pd.DataFrame) -> str:
    """Sentence on the limits of the runs, whose time limits may differ."""
    limits = frame["limits"].iloc[0]
    seconds = " or ".join(f"{s:g}" for s in sorted({v["seconds"] for v in frame["limits"]}))
    return (
        f"A run has {seconds} CPU seconds, {limits['iterations']} iterations and"
        f" {limits['memory'] / 2**30:g} GiB, and is asked for a dual infeasibility of"
        f" {limits['tol']:g}."
    )


def conclusion(frame: pd.DataFrame) -> list[str]:
    """Conclusion in two sentences."""
    solved = np.isfinite(cost_table(frame, "seconds")).sum()
    some = solved[solved > 0].sort_values(ascending=False, kind="stable")
    problems = frame.groupby(PROBLEM).ngroups
    told = ", ".join(f"{name} {count}" for name, count in some.items()) or "none"
    out = [
        f"**{problems} problems, {len(solved)} solvers, {len(frame)} runs:"
        f" {int(frame['verified'].sum())} verified.** Verified problems by solver: {told}."
    ]
    claims = frame[frame["claimed"].astype(bool)]
    if len(claims):
        true = claims["verified"].astype(bool)
        false = sorted(claims.loc[~true, "solver"].unique())
        more = f"; not always those of {', '.join(false)}" if false else ""
        count = f"{int(true.sum())} of {len(claims)}"
        out.append(f"Claims of an optimum that were true: {count}{more}.")
    return out


def _by_problem(frame: pd.DataFrame) -> list[str]:
    """Exact energy that every solver reached, by problem; brackets where it is not verified."""
    shown = frame.assign(
        energy=[
            "-" if not np.isfinite(e) else f"{e:.6g}" if good else f"({e:.6g})"
            for e, good in zip(
                frame["energy"].where(frame["primal"] <= FEASIBLE).astype(float),
                frame["verified"].astype(bool),
                strict=True,
            )
        ]
    )
    # problems of one name may have different contents
    keys = [*PROBLEM, "energy_start"]
    table = shown.pivot_table(
        index=keys, columns="solver", values="energy", aggfunc="last", fill_value="-", sort=False
    )
    table = table.reset_index("energy_start").droplevel("problem_hash")
    table.index.names = ["problem", "N", "formulation"]
    text = (
        "Exact energy of the point that each solver reached, in brackets where it is feasible (to"
        f" {FEASIBLE:g}) but not verified."
    )
    return [text, "", *markdown(table.rename(columns={"energy_start": "start"}), ".6g")]


def _by_solver(frame: pd.DataFrame) -> list[str]:
    """Table of the numbers of runs, claims and verified claims of each solver."""
    lines = {}
    for solver, group in frame.groupby("solver"):
        claimed, verified = int(group["claimed"].sum()), int(group["verified"].sum())
        true = int((group["claimed"].astype(bool) & group["verified"].astype(bool)).sum())
        others = sorted(group.loc[~group["claimed"].astype(bool), "ended"].unique())
        lines[solver] = {
            "runs": str(len(group)),
            "claimed": str(claimed),
            "verified": str(verified),
            "claims that were true": f"{true} of {claimed}" if claimed else "-",
            "ended otherwise": "; ".join(others),
        }
    return markdown(pd.DataFrame.from_dict(lines, orient="index").rename_axis("solver"))


def _by_run(frame: pd.DataFrame) -> list[str]:
    """Table of every run; nothing without runs."""
    if frame.empty:
        return []
    order = frame.assign(failed=~frame["verified"].astype(bool))
    order = order.sort_values([*PROBLEM, "failed", "seconds"])
    return titled(order.set_index("problem"), {k: v for k, v in COLUMNS.items() if k != "problem"})


def reached(frame: pd.DataFrame) -> pd.Series:
    """Whether a run is verified and has reached the best known objective."""
    best = frame["best_known"].astype(float)
    near = frame["objective"].astype(float) <= best + REACHED * best.abs()
    return frame["verified"].astype(bool) & near


def by_start(frame: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Runs of the family by start and size, "hard, N = 100" and so on; `easy` is a confirmation."""
    return {
        f"{'confirmation' if start in CONFIRMATIONS else start}, N = {n}": group
        for (start, n), group in frame.groupby(["start", "superpixels"], sort=False)
    }


def _by_start(frame: pd.DataFrame) -> list[str]:
    """Table of the verified runs by start and size of the family."""

    def cell(runs: pd.DataFrame) -> str:
        good = runs[runs["verified"].astype(bool)]
        time = f", {show(float(good['cpu_seconds'].median()), '.1f')} s" if len(good) else ""
        return f"{len(good)} of {len(runs)} ({int(reached(runs).sum())}){time}"

    text = (
        "Verified runs of all, in brackets those at the best known objective (within"
        f" {REACHED:g}); median CPU seconds of the verified ones."
    )
    cells = {
        title: {solver: cell(runs) for solver, runs in group.groupby("solver")}
        for title, group in by_start(frame).items()
    }
    table = pd.DataFrame(cells).sort_index().rename_axis("solver")
    picture = ["", "![profiles by start and size](profiles.png)"]
    return [text, "", *markdown(table), *picture]


# --- records of the family -----------------------------------------------------------------------

CASADI = ("ipopt", "sqpmethod", "uno", "alpaqa", "sleqp", "bonmin", "fatrop")


def neutral(frame: pd.DataFrame) -> list[dict[str, Any]]:
    """The runs in the solver-independent form of `family.describe`."""
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
    solver: what `records/published.json` takes for the README of the set.
    """
    names = frame["name"].str.rpartition("-")[0]
    return {
        str(name): {
            "tried_by": list(group["solver"].unique()),
            "reached_by": list(group.loc[reached(group), "solver"].unique()),
            "runs": {
                str(start): {str(row["solver"]): _run(row) for _, row in runs.iterrows()}
                for start, runs in group.groupby("start", sort=False)
            },
        }
        for name, group in frame.groupby(names, sort=False)
    }


def _run(row: pd.Series) -> list[Any]:
    """Objective or None, CPU seconds, their limit, verified."""
    objective = float(row["objective"])
    value = float(f"{objective:.9g}") if np.isfinite(objective) else None
    limit = float(row["limits"]["seconds"])
    return [value, round(float(row["cpu_seconds"]), 1), limit, bool(row["verified"])]
