"""Runs of solvers as rows of a JSON lines file: resumable, verified, a crash is a row."""

from __future__ import annotations

import json
import platform
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soup_nlp.bench.solvers.isolate import isolated
from soup_nlp.bench.solvers.registry import find_solver
from soup_nlp.bench.solvers.task import Answer, Task, Trace
from soup_nlp.errors import DataError
from soup_nlp.export.verify import Limits, examine
from soup_nlp.model import oracle
from soup_nlp.storage.atomic import atomic_path
from soup_nlp.storage.store import plain as jsonable
from soup_nlp.storage.versions import code_version, versions

Float = NDArray[np.float64]
Row = dict[str, Any]

CURVE_POINTS = 40
"""Iterates of a trace whose exact energy is taken."""
KEY = ("problem", "problem_hash", "superpixels", "formulation", "start", "solver", "limits", "code")
"""What makes a row: a run with the same key is not repeated."""


def read_rows(path: Path) -> list[Row]:
    """Rows of a file; none where there is no file. A last line cut short is left out.

    Raises:
        DataError: a line that is not the last is not a row.
    """
    if not path.is_file():
        return []
    lines = path.read_text(encoding="utf-8").splitlines()
    rows = []
    for k, line in enumerate(lines):
        try:
            rows.append(json.loads(line))
        except ValueError:
            if k < len(lines) - 1:
                raise DataError("line is not a row", where=f"{path}, line {k + 1}") from None
    return rows


def key_of(row: Mapping[str, Any]) -> str:
    """Identity of a row."""
    return json.dumps([row[k] for k in KEY], sort_keys=True)


def run_row(task: Task, label: Mapping[str, Any], solver: str) -> Row:
    """Run one solver in its own process, verify what it says, and make the row.

    Args:
        task: NLP, start and limits.
        label: The first five entries of KEY.
        solver: Name, see `solvers.find_solver`.
    """
    work = find_solver(solver)
    trace = Trace(task.folder / "trace", task.nlp.nx)
    trace.path.unlink(missing_ok=True)
    limits = task.limits
    ended = isolated(lambda: work(task), task.folder, limits.seconds, limits.memory)
    row: Row = {
        **label,
        "solver": solver,
        "limits": asdict(limits),
        "code": code_version(),
        "variables": task.nlp.nx,
        "constraints": task.nlp.ng,
        "how": ended.how,
        "status": str(ended.value or ended.how),
        "claimed": False,
        "verified": False,
        "iterations": -1,
        "seconds": ended.seconds,
        "cpu_seconds": ended.cpu_seconds,
        "peak_bytes": ended.peak_bytes,
        "energy_start": oracle.energy(task.soup, task.data, task.weights)["total"],
        "versions": versions(),
        "machine": f"{platform.system()} {platform.machine()}, {_processor()}",
    }
    seconds, points = trace.read()
    row["curve"] = _curve(task, seconds, points)
    if isinstance(ended.value, Answer) and ended.value.curve is not None:
        row["curve"] = ended.value.curve
    if isinstance(ended.value, Answer):
        row |= _verified(task, ended.value, float(label["energy_limit"]))
    elif row["curve"]:
        # killed, but its iterates are there
        row |= {"energy": row["curve"][-1][1]}
    return dict(jsonable(row))


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(x.partition(":")[2].strip() for x in lines if x.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor()


def _energy(task: Task, x: Float) -> float:
    """Exact energy of a point, retracted to the constraints; infinite where it has none."""
    if not np.isfinite(x).all():
        return float("inf")
    with np.errstate(all="ignore"):
        try:
            soup = task.layout.unpack(x).retracted()
            value = oracle.energy(soup, task.data, task.weights)["total"]
        except np.linalg.LinAlgError:
            return float("inf")
    return float(value) if np.isfinite(value) else float("inf")


def _curve(task: Task, seconds: Float, points: Float) -> list[list[float]]:
    """(seconds, exact energy) of some iterates, the first and the last among them."""
    if not len(seconds):
        return []
    chosen = np.unique(np.linspace(0, len(seconds) - 1, CURVE_POINTS).round().astype(int))
    pairs = [[float(seconds[k]), _energy(task, points[k])] for k in chosen]
    return [p for p in pairs if np.isfinite(p[1])]


def _verified(task: Task, answer: Answer, energy_limit: float) -> Row:
    # a claim that comes when the time is over is none
    late = not answer.seconds <= task.limits.seconds
    row: Row = {
        "status": f"over the time limit: {answer.status}" if late else answer.status,
        "claimed": answer.claimed and answer.x is not None and not late,
        "iterations": answer.iterations,
        "seconds": answer.seconds,
    }
    if answer.x is None:
        return row
    row["energy"] = _energy(task, answer.x)
    if not np.isfinite(answer.x).all():
        return row
    residuals = examine(task.nlp, answer.x, answer.lam_g).residuals
    row |= vars(residuals)
    row["objective"] = float(task.nlp.oracle(answer.x, task.nlp.p)[0])
    good = residuals.within(task.limits) and row["energy"] <= energy_limit
    row["verified"] = bool(row["claimed"] and good)
    return row


def compare(
    tasks: Sequence[tuple[Mapping[str, Any], Callable[[Path], Task]]],
    solvers: Sequence[str],
    limits: Limits,
    path: Path,
    scratch: Path,
    say: Callable[[str], None],
) -> list[Row]:
    """Run what is not in the file yet; the file grows by a whole line per run.

    Args:
        tasks: (label, maker of the task in a scratch folder).
        solvers: Names.
        limits: Of every task.
        path: JSON lines.
        scratch: Folder for the runs' files.
        say: Called with a line per run.

    Returns:
        Every row of the file.
    """
    rows = read_rows(path)
    done = {key_of(r) for r in rows}
    code = code_version()
    for label, make in tasks:
        for solver in solvers:
            head = {**label, "solver": solver, "limits": asdict(limits), "code": code}
            if key_of(head) in done:
                continue
            done.add(key_of(head))
            # a solver may be named by its path
            folder = scratch / re.sub(r"[^\w-]+", "_", solver)
            folder.mkdir(parents=True, exist_ok=True)
            row = run_row(make(folder), label, solver)
            rows.append(row)
            with atomic_path(path) as temporary:
                text = "".join(json.dumps(r, allow_nan=False) + "\n" for r in rows)
                temporary.write_text(text, encoding="utf-8")
            say(one_line(row))
    return rows


def one_line(row: Row) -> str:
    """A row in words."""
    word = "verified" if row["verified"] else "claimed" if row["claimed"] else "-"
    energy, dual = row.get("energy"), row.get("dual")
    return (
        f"{row['problem']:<12} {row['superpixels']:>5} {row['formulation']:<28}"
        f" {row['solver']:<12} {word:<9}"
        f" E {'-' if energy is None else format(energy, '.6g'):>9}"
        f" dual {'-' if dual is None else format(dual, '.1e'):>8}"
        f" {row['seconds']:>7.1f} s  {row['status'][:60]}"
    )
