"""Rows of numbers, measured here or by worker processes and stored as JSON lines."""

import json
import multiprocessing
import os
import resource
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

from soup_nlp.errors import DataError
from soup_nlp.storage.files import is_file, parse_json, plain, read_bytes
from soup_nlp.storage.system import end_with_parent
from soup_nlp.storage.versions import code_version

Row = dict[str, Any]
Say = Callable[[int, int, Row], None]

ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS",
     "OPENCV_FOR_THREADS_NUM"), "1",
)  # fmt: skip
"""Environment of a worker process."""
DIED = "the process died (out of memory, or a crash of native code)"
"""Reason of a row whose process ended without one."""


def one_thread() -> AbstractContextManager[Any]:
    """Context in which new processes, and libraries that are loaded, use one thread.

    Libraries read their number of threads when they are loaded.
    """
    return mock.patch.dict(os.environ, ONE_THREAD)


@dataclass(frozen=True)
class Job:
    """A row to be measured.

    Attributes:
        name: Entries that identify the row together with the code version; part of the row.
        work: Measures the row; it must pickle if other processes call it.
        stale: Measure the row even if it is stored.
    """

    name: Mapping[str, Any]
    work: Callable[[], Row]
    stale: bool = False


MeasureRows = Callable[[Sequence[Job], Path], list[Row]]
"""Type of `measure_all` with its options bound."""


def reason(row: Mapping[str, Any]) -> str:
    """The reason of a failure on one line: first line of the error, its place and actual value."""
    first, *lines = str(row.get("error")).splitlines() or ["no reason"]
    details = (line.strip() for line in lines)
    return ", ".join([first, *(d for d in details if d.startswith(("where: ", "found: ")))])


def failed(row: Mapping[str, Any]) -> bool:
    """Whether a row holds an error instead of numbers."""
    return bool(row.get("error"))


def failure(reason: str) -> Row:
    """The row of work that failed, with the reason."""
    return {"ok": False, "error": reason, "seconds": 0.0, "cpu_seconds": 0.0}


def attempt(work: Callable[[], Row]) -> Row:
    """Result of `work`, with "ok", "error", "seconds" and "cpu_seconds", as plain JSON values.

    "peak_bytes", unless the result has it, is the largest resident size of the process so far. An
    exception becomes a row with `ok` false and the reason.
    """
    begin, cpu = time.perf_counter(), time.process_time()
    try:
        row = {"ok": True, "error": None, **work()}
        row.setdefault("peak_bytes", peak_bytes())
    except Exception as error:
        row = failure(f"{type(error).__name__}: {error}")
    row["seconds"] = time.perf_counter() - begin
    row["cpu_seconds"] = time.process_time() - cpu
    return dict(plain(row))


def peak_bytes() -> int:
    """Largest resident size of this process so far, bytes."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def read_rows(path: Path) -> list[Row]:
    """Rows of a JSON-lines file in order, without lines that a crash cut off.

    Raises:
        DataError: the file cannot be read or is not a regular file.
    """
    if not os.path.lexists(path) or (is_file(path) and not path.stat().st_size):
        return []
    out = []
    for line in read_bytes(path, "file of rows").decode("utf-8", errors="replace").split("\n"):
        try:
            row = parse_json(line)
        except ValueError:
            continue
        if isinstance(row, dict):
            out.append(row)
    return out


def append_row(path: Path, row: Mapping[str, Any]) -> None:
    """Append a row and wait until it is on disk; terminate a line that a crash cut off first.

    Raises:
        DataError: the file cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab+") as file:
            if file.tell():
                file.seek(-1, os.SEEK_END)
                if file.read(1) != b"\n":
                    file.write(b"\n")
            file.write((json.dumps(row, allow_nan=False) + "\n").encode())
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise DataError("rows cannot be written", where=path, found=error.strerror) from error


def measure_all(
    jobs: Sequence[Job],
    path: Path,
    workers: int = 1,
    *,
    say: Say | None = None,
    after: Callable[[list[Row]], None] | None = None,
    fresh: bool = False,
) -> list[Row]:
    """The row of every job, from the file or else measured.

    A stored row is used for a job of the same name and code version unless the row failed. Every
    new row is appended as soon as it is measured, so that an interrupted run can be continued.

    Args:
        jobs: Jobs to measure.
        path: JSON-lines file.
        workers: Processes; 1 measures in this process.
        say: Called with (done, total, row) after every new row.
        after: Called with all rows so far, in the order of the jobs, after every new row and at the
            end.
        fresh: Measure every row in a new process with one thread, so that times and peak memory
            are those of the row only.

    Raises:
        DataError: the file cannot be written.
    """
    code = code_version()
    names = [_identity(job.name) for job in jobs]
    row_of: dict[str, Row] = {}
    stored = [r for r in read_rows(path) if r.get("code") == code]
    for job, name in zip(jobs, names, strict=True):
        rows = [r for r in stored if not failed(r) and _identity(r, job.name) == name]
        if rows and not job.stale:
            row_of[name] = rows[-1]
    todo = {name: job for name, job in zip(names, jobs, strict=True) if name not in row_of}

    def so_far() -> list[Row]:
        return [row_of[name] for name in names if name in row_of]

    for name, result in _measured(todo, workers, fresh):
        row_of[name] = {**plain(todo[name].name), "code": code, **plain(result)}
        append_row(path, row_of[name])
        if say:
            say(len(row_of), len(set(names)), row_of[name])
        if after:
            after(so_far())
    if after and not todo:
        after(so_far())
    return so_far()


def _identity(row: Mapping[str, Any], keys: Mapping[str, Any] | None = None) -> str:
    named = row if keys is None else {k: row.get(k) for k in keys}
    return json.dumps(plain(named), sort_keys=True)


def _measured(todo: Mapping[str, Job], workers: int, fresh: bool) -> Iterator[tuple[str, Row]]:
    """Names and results of the jobs, in the order in which they end."""
    if not todo or not (fresh or workers > 1):
        yield from ((name, job.work()) for name, job in todo.items())
        return
    left = dict(todo)
    # a broken pool does not say which job broke it: the remaining jobs run again, one pool each
    for names in ([*todo], *([name] for name in todo)):
        again = [name for name in names if name in left]
        if not again:
            continue
        before = set(multiprocessing.active_children())
        # a fork of a process with threads may hang
        pool = ProcessPoolExecutor(
            min(workers, len(again)),
            multiprocessing.get_context("spawn"),
            end_with_parent,
            max_tasks_per_child=1 if fresh else None,
        )
        futures: dict[Future[Row], str] = {}
        try:
            # a fresh pool begins a process whenever one has ended
            with one_thread():
                with suppress(BrokenProcessPool):
                    for name in again:
                        futures[pool.submit(left[name].work)] = name
                for future in as_completed(futures):
                    try:
                        result = future.result()
                    except BrokenProcessPool:
                        if len(names) > 1:
                            continue
                        result = failure(DIED)
                    del left[futures[future]]
                    yield futures[future], result
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            for child in set(multiprocessing.active_children()) - before:
                child.kill()
