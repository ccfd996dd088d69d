"""The SOUP family in the comparison of solvers: its tasks, and its runs as results."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from soup_nlp.bench.solvers.page import reached
from soup_nlp.bench.solvers.runner import Label, Maker, Programs, task_maker
from soup_nlp.errors import DataError
from soup_nlp.export.verify import Limits
from soup_nlp.family.frozen import Frozen, load_frozen
from soup_nlp.family.instances import Instance, build_instance, case_of, parse_name, problems
from soup_nlp.pipeline.case import Case
from soup_nlp.storage.files import read_json

INDEX = "index.json"
CASADI = ("ipopt", "sqpmethod", "uno", "alpaqa", "sleqp", "bonmin", "fatrop")


def is_family(path: Path) -> bool:
    """Whether `soup-nlp family` wrote a folder."""
    return (path / INDEX).is_file()


def family_tasks(folder: Path, limits: Limits) -> Iterator[list[tuple[Label, Maker]]]:
    """Labels and makers of the tasks of all instances in a folder, one scene and size at a time.

    Raises:
        DataError: the index cannot be read.
    """
    try:
        entries = read_json(folder / INDEX, "index of the family")["instances"]
        best = {e["name"]: float(e["best_known"]["objective"]) for e in entries}
    except (ValueError, KeyError, TypeError) as error:
        raise DataError("index of the family cannot be read", where=folder, found=error) from error
    for scene, size, instances in problems([parse_name(name) for name in best]):
        record = load_frozen(scene, size)
        case = case_of(record)
        digest = hashlib.sha256(record.text.encode()).hexdigest()[:12]
        tasks: list[tuple[Label, Maker]] = []
        for instance in instances:
            label = {
                "problem": f"{scene} {instance.start}",
                "problem_hash": digest,
                "superpixels": size,
                "formulation": instance.formulation,
                "start": instance.start,
                "name": instance.name,
                "best_known": best[instance.name],
                "energy_limit": float("inf"),
            }
            programs = partial(_programs, case, record, instance)
            tasks.append((label, task_maker(case, programs, limits)))
        yield tasks


def _programs(case: Case, record: Frozen, instance: Instance) -> Programs:
    """The NLP of an instance with both Hessians, its layout and formulation."""
    args = case, record, instance.formulation, instance.start
    nlp, layout, form = build_instance(*args)
    second, _, _ = build_instance(*args, hessian="gauss-newton+constraints")
    return nlp, second, layout, form


def neutral(frame: pd.DataFrame) -> list[dict[str, Any]]:
    """The runs in the solver-independent form of `family.results`."""
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
