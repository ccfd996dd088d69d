"""Rows of benchmarks: resumable files of JSON lines, measured here, by workers or on a cluster."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from soup_nlp.errors import ConfigError, DataError
from soup_nlp.storage.store import plain
from soup_nlp.storage.versions import code_version

Row = dict[str, Any]
Say = Callable[[int, int, Row], None]


@dataclass(frozen=True)
class Job:
    """One row to be measured.

    Attributes:
        name: What identifies the row beside the code version; part of the row.
        work: Measures it; must pickle where other processes do the work.
        stale: Measure it even if it is stored.
    """

    name: Mapping[str, Any]
    work: Callable[[], Row]
    stale: bool = False


@dataclass(frozen=True)
class Where:
    """Where rows are measured.

    Attributes:
        workers: Processes of this machine; 1 measures in this process.
        dask: Address of a Dask scheduler, such as tcp://host:8786; empty for none.
    """

    workers: int = 1
    dask: str = ""


def failed(row: Mapping[str, Any]) -> bool:
    """Whether a row has an error instead of numbers."""
    return bool(row.get("error"))


def attempt(work: Callable[[], Row]) -> Row:
    """What `work` returns, with "ok", "error", "seconds" and "cpu_seconds", as plain JSON values.

    An exception becomes a row with `ok` false and the reason.
    """
    begin, cpu = time.perf_counter(), time.process_time()
    try:
        row = {"ok": True, "error": None, **work()}
    except Exception as error:
        row = {"ok": False, "error": f"{type(error).__name__}: {error}"}
    row["seconds"] = time.perf_counter() - begin
    row["cpu_seconds"] = time.process_time() - cpu
    return dict(plain(row))


def read_rows(path: Path) -> list[Row]:
    """Rows of a JSON-lines file in order; a line that a crash cut off is left out."""
    if not path.is_file():
        return []
    out = []
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            row = json.loads(line)
        except ValueError:
            continue
        if isinstance(row, dict):
            out.append(row)
    return out


def append_row(path: Path, row: Mapping[str, Any]) -> None:
    """Append a row and wait until it is on disk; a line that a crash cut off is ended first.

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
    where: Where | None = None,
    *,
    say: Say | None = None,
    after: Callable[[list[Row]], None] | None = None,
    any_code: bool = False,
) -> list[Row]:
    """The row of every job, measured where the file does not hold it yet.

    A stored row serves a job of the same name and code version unless it failed. Every new row is
    appended as soon as it is there, so that a run that was stopped goes on where it was.

    Args:
        jobs: What to measure.
        path: JSON-lines file.
        where: Processes or cluster.
        say: Called with (done, total, row) after every new row.
        after: Called with all rows that are there so far, in the order of the jobs, after every
            new row and at the end.
        any_code: Also take rows of other code versions.

    Raises:
        DataError: the file cannot be written.
        ConfigError: joblib or Dask is needed and not installed, or the cluster does not answer.
    """
    code = code_version()
    names = [_identity(job.name) for job in jobs]
    known: dict[str, Row] = {}
    stored = [r for r in read_rows(path) if any_code or r.get("code") == code]
    for job, name in zip(jobs, names, strict=True):
        own = [r for r in stored if not failed(r) and _identity(r, job.name) == name]
        if own and not job.stale:
            known[name] = own[-1]
    todo = {name: job for name, job in zip(names, jobs, strict=True) if name not in known}

    def so_far() -> list[Row]:
        return [known[name] for name in names if name in known]

    for name, result in _measured(todo, where or Where()):
        known[name] = {**plain(todo[name].name), "code": code, **plain(result)}
        append_row(path, known[name])
        if say:
            say(len(known), len(set(names)), known[name])
        if after:
            after(so_far())
    if after and not todo:
        after(so_far())
    return so_far()


def _identity(row: Mapping[str, Any], keys: Mapping[str, Any] | None = None) -> str:
    own = row if keys is None else {k: row.get(k) for k in keys}
    return json.dumps(plain(own), sort_keys=True)


def _measured(todo: Mapping[str, Job], where: Where) -> Iterator[tuple[str, Row]]:
    if where.dask:
        yield from _by_dask(todo, where.dask)
    elif where.workers > 1 and todo:
        yield from _by_joblib(todo, where.workers)
    else:
        yield from ((name, job.work()) for name, job in todo.items())


def _named(name: str, work: Callable[[], Row]) -> tuple[str, Row]:
    return name, work()


def _by_joblib(todo: Mapping[str, Job], workers: int) -> Iterator[tuple[str, Row]]:
    try:
        from joblib import Parallel, delayed, parallel_config
        from joblib.externals.loky import ProcessPoolExecutor
        from joblib.externals.loky.process_executor import BrokenProcessPool
    except ImportError as error:
        raise ConfigError(
            "parallel processes need joblib", where="--workers", hint="pip install soup-nlp[bench]"
        ) from error
    left = dict(todo)
    try:
        with parallel_config(backend="loky", n_jobs=workers, inner_max_num_threads=1):
            calls = (delayed(_named)(name, job.work) for name, job in todo.items())
            for name, row in Parallel(return_as="generator_unordered", batch_size=1)(calls):
                del left[name]
                yield name, row
    except BrokenProcessPool:
        # a process died: measure what is left one by one to find out which job it was
        for name, job in left.items():
            pool = ProcessPoolExecutor(max_workers=1)
            try:
                yield name, pool.submit(job.work).result()
            except BrokenProcessPool:
                reason = "the process died (out of memory, or a crash of native code)"
                yield name, failure(reason)
            finally:
                pool.shutdown(wait=False, kill_workers=True)


def _by_dask(todo: Mapping[str, Job], address: str) -> Iterator[tuple[str, Row]]:
    try:
        from dask.distributed import Client, as_completed
    except ImportError as error:
        raise ConfigError(
            "a cluster needs Dask", where="--dask", hint="pip install soup-nlp[dask]"
        ) from error
    try:
        client = Client(address, timeout=10)
    except (OSError, ValueError) as error:
        raise ConfigError(
            "the Dask scheduler does not answer",
            where="--dask",
            found=f"{address}: {error}",
            hint="start one with: dask scheduler, and workers with: dask worker ADDRESS",
        ) from error
    with client:
        # a worker should have one thread: Ipopt and its MUMPS share static memory
        futures = {client.submit(j.work, pure=False, retries=1): n for n, j in todo.items()}
        for future in as_completed(list(futures)):
            wrong = future.exception()
            result = failure(f"{type(wrong).__name__}: {wrong}") if wrong else future.result()
            yield futures[future], result
            future.release()


def failure(reason: str) -> Row:
    """The result of work that has no other than the reason why it failed."""
    return {"ok": False, "error": reason, "seconds": 0.0, "cpu_seconds": 0.0}
