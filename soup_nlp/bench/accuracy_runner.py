"""Many rows: in this process, in processes of one machine (joblib), or on a cluster (Dask).

Rows are appended to a JSON-lines file by the parent alone, each as soon as it is there, so a run
that was stopped goes on where it was. A row stands for its key, settings, input and code version; a
row that failed is tried again.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from soup_nlp.bench.accuracy import Job, Row, clean, head, measure
from soup_nlp.errors import ConfigError, DataError
from soup_nlp.storage.versions import code_version

Function = Callable[[Job], Row]
Say = Callable[[int, int, Row], None]
Name = tuple[str, str, str]


@dataclass(frozen=True)
class Where:
    """Where rows are measured.

    Attributes:
        workers: Processes of this machine; 1 measures in this process.
        dask: Address of a Dask scheduler, such as tcp://host:8786; empty for none.
    """

    workers: int = 1
    dask: str = ""


def read_rows(path: Path) -> list[Row]:
    """Rows of a JSON-lines file, the last one of every key, settings, input and code version.

    A line that was cut off by a crash is left out.
    """
    if not path.is_file():
        return []
    out: dict[tuple[Name, str], Row] = {}
    for line in path.read_text(encoding="utf-8").splitlines():
        try:
            row = json.loads(line)
            out[_name(row), row["code"]] = row
        except (ValueError, KeyError, TypeError):
            continue
    return list(out.values())


def _name(row: Row) -> Name:
    """What a row stands for, but its code version."""
    # rows of old versions do not say which input they had
    return row["key"], row["settings"], row.get("input", "unknown")


def measure_all(
    jobs: Sequence[Job],
    path: Path,
    where: Where | None = None,
    *,
    say: Say | None = None,
    any_code: bool = False,
    function: Function = measure,
) -> list[Row]:
    """The row of every job, measured where the file does not have it yet.

    A stored row serves where it has every convention of the job, and where the result folder that
    the job asks for is there; it is returned with the conventions of the job, in their order.

    Args:
        jobs: What to measure; keys are unique.
        path: JSON-lines file, appended to.
        where: Processes or cluster.
        say: Called with (done, total, row) after every new row.
        any_code: Take rows of another code version as well.
        function: What measures a job, for tests.

    Raises:
        DataError: the file cannot be written.
        ConfigError: joblib or Dask is needed and not installed, or the cluster does not answer.
    """
    where, code = where or Where(), code_version()
    known: dict[Name, Row] = {}
    for row in read_rows(path):
        if row["ok"] and (any_code or row["code"] == code):
            known[_name(row)] = row
    names = [_name(head(job)) for job in jobs]
    for job, name in zip(jobs, names, strict=True):
        if name in known and not _serves(known[name], job):
            del known[name]
    if len(set(names)) < len(names):
        twice = next(n for n in names if names.count(n) > 1)
        raise ConfigError("a row is asked for twice", found=twice[0])
    todo = [job for job, name in zip(jobs, names, strict=True) if name not in known]
    done = len(jobs) - len(todo)
    with _Appender(path) as file:
        for row in _rows(todo, function, where) if todo else ():
            row["code"] = code
            file.add(row)
            known[_name(row)] = row
            done += 1
            if say:
                say(done, len(jobs), row)
    return [_as_asked(known[name], job) for name, job in zip(names, jobs, strict=True)]


def _serves(row: Row, job: Job) -> bool:
    """Whether a stored row has all that a job asks for."""
    if job.folder is not None and not (job.folder / "summary.json").is_file():
        return False
    own, stored = job.item.presets, row["presets"]
    if not set(own) <= set(stored):
        return False
    # scene flow has the scale of the row's main convention, and an analysis may score no other
    metrics = row.get("metrics")
    other = not metrics or (own[0] in metrics and not row.get("scene_flow"))
    return bool(own[0] == stored[0] or other)


def _as_asked(row: Row, job: Job) -> Row:
    """A row with the conventions that a job asks for, in their order."""
    own, metrics = job.item.presets, row.get("metrics") or {}
    out = {**row, "presets": list(own)}
    if "metrics" in row:
        out["metrics"] = {name: metrics[name] for name in own if name in metrics}
    return out


class _Appender:
    """Whole lines at the end of a file, each on disk before the next is measured."""

    def __init__(self, path: Path) -> None:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            # what a crash cut off must not run into the next line
            cut = path.is_file() and path.stat().st_size and path.read_bytes()[-1:] != b"\n"
            self.file = path.open("a", encoding="utf-8")
            if cut:
                self.file.write("\n")
        except OSError as error:
            raise DataError("rows cannot be written", where=path, found=error.strerror) from error

    def __enter__(self) -> _Appender:
        return self

    def __exit__(self, *_: object) -> None:
        self.file.close()

    def add(self, row: Row) -> None:
        self.file.write(json.dumps(row, allow_nan=False) + "\n")
        self.file.flush()
        os.fsync(self.file.fileno())


def _rows(jobs: Sequence[Job], function: Function, where: Where) -> Iterator[Row]:
    if where.dask:
        yield from _by_dask(jobs, function, where.dask)
    elif where.workers == 1:
        yield from (function(job) for job in jobs)
    else:
        yield from _by_joblib(jobs, function, where.workers)


def _by_joblib(jobs: Sequence[Job], function: Function, workers: int) -> Iterator[Row]:
    try:
        from joblib import Parallel, delayed, parallel_config
        from joblib.externals.loky.process_executor import BrokenProcessPool
    except ImportError as error:
        raise ConfigError(
            "parallel processes need joblib", where="--workers", hint="pip install soup-nlp[bench]"
        ) from error
    left = {job.key: job for job in jobs}
    try:
        with parallel_config(backend="loky", n_jobs=workers, inner_max_num_threads=1):
            tasks = (delayed(function)(job) for job in jobs)
            for row in Parallel(return_as="generator_unordered", batch_size=1)(tasks):
                del left[row["key"]]
                yield row
    except BrokenProcessPool:
        # a process died (memory, a crash of native code): find out whose it was, one by one
        for job in left.values():
            yield _alone(job, function)


def _alone(job: Job, function: Function) -> Row:
    """The row of a job in a process of its own; that process may die."""
    from joblib.externals.loky import ProcessPoolExecutor
    from joblib.externals.loky.process_executor import BrokenProcessPool

    pool = ProcessPoolExecutor(max_workers=1)
    try:
        row: Row = pool.submit(function, job).result()
        return row
    except BrokenProcessPool:
        return _failed(job, "the process died (out of memory, or a crash of native code)")
    finally:
        pool.shutdown(wait=False, kill_workers=True)


def _by_dask(jobs: Sequence[Job], function: Function, address: str) -> Iterator[Row]:
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
        # one thread at a time in a worker: Ipopt and its MUMPS share static memory
        futures: dict[Any, Job] = {
            client.submit(function, job, pure=False, retries=1): job for job in jobs
        }
        for future in as_completed(list(futures)):
            wrong = future.exception()
            if wrong is not None:
                yield _failed(futures[future], f"{type(wrong).__name__}: {wrong}")
            else:
                yield future.result()
            future.release()


def _failed(job: Job, reason: str) -> Row:
    row: Row = clean({**head(job), "ok": False, "error": reason, "seconds": 0.0})
    return row
