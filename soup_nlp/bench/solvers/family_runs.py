"""The SOUP family in the comparison of solvers: tasks, profiles and results."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from soup_nlp.bench.solvers.page import Row, page
from soup_nlp.bench.solvers.profiles import cost_table, draw_profile, profile
from soup_nlp.bench.solvers.runner import Label, Maker, Programs, task_maker
from soup_nlp.bench.tables import figure, save, show, table
from soup_nlp.errors import DataError
from soup_nlp.export.verify import Limits
from soup_nlp.family.frozen import Frozen, load_frozen
from soup_nlp.family.instances import Instance, build_instance, case_of, parse_name, problems
from soup_nlp.pipeline.case import Case
from soup_nlp.storage.files import read_json

INDEX = "index.json"
REACHED = 1e-4
"""Relative distance up to which an objective has reached the best known one."""


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
    for scene, size, own in problems([parse_name(name) for name in best]):
        record = load_frozen(scene, size)
        case = case_of(record)
        digest = hashlib.sha256(record.text.encode()).hexdigest()[:12]
        tasks: list[tuple[Label, Maker]] = []
        for instance in own:
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
            tasks.append(
                (label, task_maker(case, partial(_programs, case, record, instance), limits))
            )
        yield tasks


def _programs(case: Case, record: Frozen, instance: Instance) -> Programs:
    """The NLP of an instance with both Hessians, its layout and formulation."""
    own = case, record, instance.formulation, instance.start
    nlp, layout, form = build_instance(*own)
    second, _, _ = build_instance(*own, hessian="gauss-newton+constraints")
    return nlp, second, layout, form


def neutral(row: Row) -> dict[str, Any]:
    """A row in the solver-independent form of `family.results`."""
    version = row["versions"].get("casadi" if row["solver"] in CASADI else "soup_nlp", "unknown")
    return {
        "solver": row["solver"],
        "version": version,
        "name": row["name"],
        "n": row["n"],
        "m": row["m"],
        "status": row["status"],
        "objective": row.get("objective"),
        "iterations": row["iterations"],
        "time": row["cpu_seconds"],
        "wall_time": row["wall_seconds"],
        "time_limit": row["limits"]["seconds"],
        "claimed": row["claimed"],
        "verified": row["verified"],
        "reached": reached(row),
        **{k: row.get(k) for k in ("primal", "dual", "complementarity")},
    }


CASADI = ("ipopt", "sqpmethod", "uno", "alpaqa", "sleqp", "bonmin", "fatrop")


def reached(row: Row) -> bool:
    """Whether a run is verified and has reached the best known objective."""
    found = row.get("objective")
    best = float(row["best_known"])
    return bool(row["verified"] and found is not None and found <= best + REACHED * abs(best))


def groups(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Rows by start and size, "easy, N = 100" and so on."""
    out: dict[str, list[Row]] = {}
    for row in rows:
        out.setdefault(f"{row['start']}, N = {row['superpixels']}", []).append(row)
    return out


def family_page(rows: Sequence[Row]) -> str:
    """The page of a comparison over the family, with a table by start and size first."""
    lines = [
        "## By start and size",
        "",
        "Verified runs of all, in brackets those at the best known objective (within"
        f" {REACHED:g}); median CPU seconds of the verified ones.",
        "",
    ]
    solvers = sorted({str(r["solver"]) for r in rows})
    parts = groups(rows)
    cells = [[s, *(_cell([r for r in own if r["solver"] == s]) for own in parts.values())]
             for s in solvers]  # fmt: skip
    lines += table(["solver", *parts], cells)
    lines += ["", "![profiles by start and size](profiles.png)", ""]
    before, mark, after = page(rows, each=False).partition("## By solver")
    return before + "\n".join(lines) + "\n" + mark + after


def _cell(rows: Sequence[Row]) -> str:
    if not rows:
        return "-"
    good = [r for r in rows if r["verified"]]
    times = sorted(float(r["cpu_seconds"]) for r in good)
    time = f", {show(times[len(times) // 2], '.1f')} s" if times else ""
    return f"{len(good)} of {len(rows)} ({sum(map(reached, rows))}){time}"


def draw_family(path: Path, rows: Sequence[Row]) -> None:
    """Write a picture of the profiles of CPU time and objective, a row for each start and size."""
    parts = groups(rows)
    picture = figure(9, 3.1 * len(parts))
    panels = picture.subplots(len(parts), 2, squeeze=False)
    for (title, own), line in zip(parts.items(), panels):
        for axes, measure in zip(line, ("cpu", "objective")):
            found, solvers, cost = cost_table(own, measure)
            draw_profile(axes, measure, len(found), solvers, *profile(cost))
            axes.set_title(title, fontsize=9)
    save(picture, path)


def summary(rows: Sequence[Row]) -> Mapping[str, Any]:
    """Solvers that tried and that reached the best known point, by problem (name without start)."""
    out: dict[str, dict[str, list[str]]] = {}
    for row in rows:
        own = out.setdefault(row["name"].rpartition("-")[0], {"tried_by": [], "reached_by": []})
        for key, there in (("tried_by", True), ("reached_by", reached(row))):
            if there and row["solver"] not in own[key]:
                own[key].append(row["solver"])
    return out
