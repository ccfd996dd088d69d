"""Solvers by name, and their runs as rows: each in a process of its own, its claim verified.

Solvers are CasADi's plug-ins, programs that read .nl, and this package.
"""

import hashlib
import os
import platform
import re
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from soup_nlp.bench.processes import isolated, processor
from soup_nlp.bench.solvers.plugins import (
    PLUGINS,
    WALL_PER_CPU,
    Answer,
    Solver,
    Task,
    clock,
    executable,
    find_program,
    plugin,
    pounce,
)
from soup_nlp.bench.study import show
from soup_nlp.errors import DataError, SolverError
from soup_nlp.export.artefact import form_label
from soup_nlp.export.verify import ENERGY_SLACK, Limits, examine
from soup_nlp.family.frozen import load_frozen
from soup_nlp.family.instances import build_instance, case_of, parse_name, problems
from soup_nlp.geometry.soup import Soup
from soup_nlp.model import oracle
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.layout import Layout
from soup_nlp.model.nlp import NLP
from soup_nlp.pipeline.record import Case
from soup_nlp.solve.solver_options import SolverOptions
from soup_nlp.solve.stages import solve_soup
from soup_nlp.storage.files import read_json
from soup_nlp.storage.rows import Job, Row, failure, measure_all, one_thread, reason
from soup_nlp.storage.versions import versions

Label = Mapping[str, Any]
Build = Callable[[], tuple[NLP, Layout, Formulation]]
Labelled = tuple[Label, Callable[[], Task]]
"""Entries of the rows of a task, and what makes the task."""

KEY = ("problem", "problem_hash", "superpixels", "formulation", "start")
"""Entries of a label that identify a task."""


# --- solvers -------------------------------------------------------------------------------------


def package(task: Task) -> Answer:
    """Solve as this package does: Ipopt's stages, then the constrained NLP."""
    m = task.limits
    options = SolverOptions(
        eps=task.form.eps,
        tol=m.tol,
        max_iter=m.iterations,
        max_seconds=0.9 * WALL_PER_CPU * m.seconds,
    )
    answer = solve_soup(task.soup, task.data, task.weights, task.form, options)
    stage, iterations = answer.stages[-1], sum(s.iterations for s in answer.stages)
    # the package solves the program in matrices, whose multipliers differ from those in tangents
    matrices = task.form.coordinates == "matrix"
    x, lam_g = (stage.x, stage.lam_g) if matrices else (answer.soup, None)
    return Answer(x, lam_g, stage.status, stage.converged, iterations)


def available() -> dict[str, Solver]:
    """Installed solvers by name."""
    # the query loads the plug-ins, and their BLAS reads its number of threads when it is loaded
    with one_thread():
        names = [name for name, row in PLUGINS.items() if ca.has_nlpsol(row.library)]
    out: dict[str, Solver] = {name: partial(plugin, name) for name in names}
    command = find_program("pounce")
    if command:
        out["pounce"] = partial(pounce, command)
        out["pounce-tuned"] = partial(pounce, command, near=True)
    out["soup-nlp"] = package
    return out


def find_solver(name: str) -> Solver:
    """The solver of a name, or the executable of that name (AMPL convention).

    Raises:
        SolverError: there is neither a solver nor an executable.
    """
    installed = available()
    if name in installed:
        return installed[name]
    # options may follow the name of the program, whose path may have spaces
    command, options = find_program(name), list[str]()
    if command is None:
        program, *options = shlex.split(name) or [""]
        command = find_program(program)
    if command is None or name in PLUGINS:
        raise SolverError(
            "solver is not here",
            where="--solvers",
            found=name,
            expected=", ".join(installed) + ", or a program that reads .nl",
        )
    return partial(executable, command, options=options)


# --- runs ----------------------------------------------------------------------------------------


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
    """Label of a case and the maker of its task; its energy limit is that of the initialisation."""
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


def run_row(make: Callable[[], Task], label: Label, solver: str, folder: Path) -> Row:
    """Run a solver in a process of its own, verify its answer, and make the row.

    An exception, of `make` for example, becomes a row with "error", which no later run takes as
    measured. `label` has the entries that identify the task, and "energy_limit"; `folder` is empty.
    """
    row: Row = {
        **label,
        "claimed": False,
        "verified": False,
        "iterations": -1,
        "versions": versions(),
        "machine": f"{platform.system()} {platform.machine()}, {processor()}",
    }
    try:
        return row | _ended(make(), float(label["energy_limit"]), solver, folder)
    except Exception as error:
        failed = failure(f"{type(error).__name__}: {error}")
        return row | failed | {"how": "raised", "status": reason(failed), "peak_bytes": 0}


def _ended(task: Task, energy_limit: float, solver: str, folder: Path) -> Row:
    """Entries of a row on how the run of a solver ended, and on its answer."""
    work, limits = partial(timed, find_solver(solver), task, folder), task.limits
    wall = WALL_PER_CPU * limits.seconds
    ended = isolated(work, folder, wall, limits.memory, cpu_seconds=limits.seconds)
    row: Row = {
        "n": task.nlp.nx,
        "m": task.nlp.ng,
        "how": ended.how,
        "status": str(ended.value or ended.how),
        "seconds": ended.cpu_seconds,
        "wall_seconds": ended.seconds,
        "cpu_seconds": ended.cpu_seconds,
        "peak_bytes": ended.peak_bytes,
        "energy_start": oracle.energy(task.soup, task.data, task.weights)["total"],
    }
    if ended.how == "returned":
        answer, seconds = ended.value
        row |= _verified(task, answer, seconds, energy_limit)
    return row


def _verified(task: Task, answer: Answer, seconds: float, energy_limit: float) -> Row:
    """Entries of a row from an answer: claim, exact energy and residuals.

    One tolerance decides what is verified, whether the solver claims an optimum or not. The exact
    energy is that of the point retracted to the constraints; infinite if it is not finite.
    """
    # a claim after the time limit does not count
    x, late = answer.x, not seconds <= task.limits.seconds
    found = x is not None
    row: Row = {
        "status": f"over the time limit: {answer.status}" if late and found else answer.status,
        "claimed": answer.claimed and found and not late,
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
    residuals = examine(task.nlp, x, answer.lam_g)
    good = residuals.within(task.limits) and row["energy"] <= energy_limit
    shown = {k: v for k, v in vars(residuals).items() if not k.startswith("lam_")}
    return {**row, **shown, "verified": bool(good and not late)}


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
        return run_row(make, label, solver, folder)

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
