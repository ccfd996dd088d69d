"""Runs of solvers as rows: each in a process of its own, with its claim verified."""

from __future__ import annotations

import hashlib
import os
import platform
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from soup_nlp.bench.processes import isolated, processor
from soup_nlp.bench.solvers.plugins import WALL_PER_CPU, Answer, Solver, Task, clock
from soup_nlp.bench.solvers.registry import find_solver
from soup_nlp.bench.study import show
from soup_nlp.errors import DataError
from soup_nlp.export.artefact import form_label
from soup_nlp.export.verify import ENERGY_SLACK, Limits, examine
from soup_nlp.family.frozen import load_frozen
from soup_nlp.family.instances import build_instance, case_of, parse_name, problems
from soup_nlp.geometry.soup import Soup
from soup_nlp.model import oracle
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.layout import MatrixLayout, TangentLayout
from soup_nlp.model.nlp import NLP
from soup_nlp.pipeline.record import Case
from soup_nlp.storage.files import read_json
from soup_nlp.storage.rows import Job, Row, measure_all
from soup_nlp.storage.versions import versions

Label = Mapping[str, Any]
Build = Callable[[], tuple[NLP, MatrixLayout | TangentLayout, Formulation]]
Labelled = tuple[Label, Callable[[], Task]]
"""Entries of the rows of a task, and what makes the task."""

KEY = ("problem", "problem_hash", "superpixels", "formulation", "start")
"""Entries of a label that identify a task."""


@lru_cache(maxsize=1)
def make_task(case: Case, build: Build, limits: Limits) -> Task:
    """The task of a case, whose `build` makes the NLP with the exact Hessian."""
    nlp, layout, form = build()
    soup = layout.unpack(nlp.x0).retracted()
    task = Task(nlp, layout, soup, case.data, case.weights, form, limits)
    # made here, so that the time of a solver does not include it
    for program in (task.nlp, task.gauss_newton):
        program.evaluated()
    return task


def problem_task(case: Case, limits: Limits, coordinates: str) -> Labelled:
    """The task of a case in its formulation."""
    form = case.formulation(coordinates=coordinates, hessian="exact", compiled=False)
    ceiling = oracle.energy(case.start.soup, case.data, case.weights)["total"]
    label = {
        "problem": case.problem.name,
        "problem_hash": case.problem.digest(),
        "superpixels": len(case),
        "formulation": form_label(form),
        "start": "proposal",
        "energy_limit": ceiling * (1 + ENERGY_SLACK),
    }
    return label, partial(make_task, case, lambda: (*case.nlp(form), form), limits)


def timed(solver: Solver, task: Task, folder: Path) -> tuple[Answer, float]:
    """Answer of a solver that works in a folder, and its CPU seconds."""
    os.chdir(folder)
    begin = clock()
    return solver(task), clock() - begin


def run_row(task: Task, label: Label, solver: str, folder: Path) -> Row:
    """Run a solver in a process of its own, verify its answer, and make the row.

    Args:
        task: The task.
        label: Entries that identify the task, and "energy_limit".
        solver: Name of the solver.
        folder: Empty scratch folder.
    """
    work, limits = partial(timed, find_solver(solver), task, folder), task.limits
    wall = WALL_PER_CPU * limits.seconds
    ended = isolated(work, folder, wall, limits.memory, cpu_seconds=limits.seconds)
    row: Row = {
        **label,
        "n": task.nlp.nx,
        "m": task.nlp.ng,
        "how": ended.how,
        "status": str(ended.value or ended.how),
        "claimed": False,
        "verified": False,
        "iterations": -1,
        "seconds": ended.cpu_seconds,
        "wall_seconds": ended.seconds,
        "cpu_seconds": ended.cpu_seconds,
        "peak_bytes": ended.peak_bytes,
        "energy_start": oracle.energy(task.soup, task.data, task.weights)["total"],
        "versions": versions(),
        "machine": f"{platform.system()} {platform.machine()}, {processor()}",
    }
    if ended.how == "returned":
        answer, seconds = ended.value
        row |= _verified(task, answer, seconds, float(label["energy_limit"]))
    return row


def _verified(task: Task, answer: Answer, seconds: float, energy_limit: float) -> Row:
    """Entries of a row from an answer: claim, exact energy and residuals.

    One tolerance decides what is verified, whether the solver claims an optimum or not. The exact
    energy is that of the point retracted to the constraints; infinite if it is not finite.
    """
    # a claim after the time limit does not count
    x, late = answer.x, not seconds <= task.limits.seconds
    row: Row = {
        "status": f"over the time limit: {answer.status}" if late else answer.status,
        "claimed": answer.claimed and x is not None and not late,
        "iterations": answer.iterations,
        "seconds": seconds,
    }
    if x is None:
        return row
    x = task.point(x) if isinstance(x, Soup) else x
    energy = np.inf
    with np.errstate(all="ignore"):
        value = task.nlp.value(x)
        with suppress(np.linalg.LinAlgError):
            soup = task.layout.unpack(x).retracted()
            energy = oracle.energy(soup, task.data, task.weights)["total"]
    finite = bool(np.isfinite(x).all())
    row["energy"] = float(energy) if finite and np.isfinite(energy) else float("inf")
    row["objective"] = value if np.isfinite(value) else None
    if not finite:
        return row
    residuals = examine(task.nlp, x, answer.lam_g).residuals
    good = residuals.within(task.limits) and row["energy"] <= energy_limit
    return {**row, **vars(residuals), "verified": bool(good and not late)}


def compare(
    tasks: Sequence[Labelled],
    solvers: Sequence[str],
    limits: Limits,
    path: Path,
    scratch: Path,
    say: Callable[[str], None],
    after: Callable[[list[Row]], None] | None = None,
) -> list[Row]:
    """Run every solver on every task; runs that the file holds already are not repeated.

    `path` is a JSON-lines file; `say` is called with a line before and after each run, `after` with
    all rows so far after each run.
    """

    def run(label: Label, make: Callable[[], Task], solver: str) -> Row:
        say(f"{label['problem']:<12} {label['superpixels']:>5} {solver:<12} runs ...")
        # the name of a solver may be a path
        folder = scratch / re.sub(r"[^\w-]+", "_", solver)
        folder.mkdir(parents=True, exist_ok=True)
        return run_row(make(), label, solver, folder)

    jobs = []
    for label, make in tasks:
        identity = {k: label[k] for k in KEY} | {"limits": asdict(limits)}
        for solver in dict.fromkeys(solvers):
            jobs.append(Job({**identity, "solver": solver}, partial(run, label, make, solver)))
    return measure_all(jobs, path, say=lambda done, total, row: say(one_line(row)), after=after)


def one_line(row: Row) -> str:
    """A row as one line of text."""
    word = "verified" if row["verified"] else "FALSE" if row["claimed"] else "-"
    return (
        f"{row['problem']:<12} {row['superpixels']:>5} {row['formulation']:<28}"
        f" {row['solver']:<12} {word:<9}"
        f" E {show(row.get('energy'), '.6g'):>9} dual {show(row.get('dual'), '.1e'):>8}"
        f" {row['seconds']:>7.1f} s  {row['status'][:60]}"
    )


# --- tasks of the family -------------------------------------------------------------------------

INDEX = "index.json"


def is_family(path: Path) -> bool:
    """Whether `soup-nlp family` wrote a folder."""
    return (path / INDEX).is_file()


def family_tasks(folder: Path, limits: Limits) -> Iterator[Labelled]:
    """The tasks of all instances in a folder.

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
            build = partial(build_instance, case, record, instance.formulation, instance.start)
            yield label, partial(make_task, case, build, limits)
