"""Rows of benchmarks: resumable files of JSON lines, worker processes, processes with limits."""

from __future__ import annotations

import json
import multiprocessing
import os
import pickle
import platform
import resource
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from soup_nlp.errors import ConfigError, DataError, SolverError, SoupError
from soup_nlp.storage.store import plain
from soup_nlp.storage.versions import code_version, versions

Row = dict[str, Any]
Say = Callable[[int, int, Row], None]

GRACE = 5.0
"""Seconds beyond its time limit before a process is killed."""
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


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
                yield name, _failure(reason)
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
            result = _failure(f"{type(wrong).__name__}: {wrong}") if wrong else future.result()
            yield futures[future], result
            future.release()


def _failure(reason: str) -> Row:
    return {"ok": False, "error": reason, "seconds": 0.0, "cpu_seconds": 0.0}


@dataclass(frozen=True)
class Ended:
    """How a process ended.

    Attributes:
        how: "returned", "raised", "killed: time", "killed: memory" or "crashed: SIGNAL".
        value: What the function returned, or its exception in one line.
        seconds: Wall time of the process.
        cpu_seconds: CPU time of it and its children.
        peak_bytes: Largest resident size of it or a child; 0 where it could not say.
    """

    how: str
    value: Any
    seconds: float
    cpu_seconds: float
    peak_bytes: int


def isolated(
    work: Callable[[], Any],
    folder: Path,
    seconds: float,
    memory: int | None = None,
    *,
    fresh: bool = False,
) -> Ended:
    """Call a function in a process of its own; a crash is an answer as well.

    Args:
        work: Takes nothing; its value must pickle.
        folder: For the value and the output; must exist.
        seconds: Wall time limit.
        memory: Bytes that a forked process may have more than this one has now; None for no limit.
        fresh: Start a new interpreter, so that the peak memory is that of the work alone; the work
            must pickle. Else the process is forked and sees everything of this one.

    Raises:
        SolverError: the system cannot fork.
    """
    method = "spawn" if fresh else "fork"
    if method not in multiprocessing.get_all_start_methods():
        raise SolverError(
            "comparing needs a system that forks processes", found=sys.platform, expected="POSIX"
        )
    target = folder / "value.pickle"
    target.unlink(missing_ok=True)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    begin = time.perf_counter()
    context: Any = multiprocessing.get_context(method)
    process = context.Process(target=_child, args=(work, target, memory))
    process.start()
    process.join(seconds + GRACE)
    late = process.is_alive()
    if late:
        process.kill()
        process.join()
    spent = time.perf_counter() - begin
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    code = process.exitcode or 0
    process.close()
    try:
        how, value, peak = pickle.loads(target.read_bytes())
    except (OSError, EOFError, pickle.UnpicklingError):
        how, value, peak = "crashed: no answer", None, 0
        if late:
            how = "killed: time"
        elif code < 0:
            how = f"crashed: {signal.Signals(-code).name}"
        elif code:
            how = f"crashed: exit code {code}"
    return Ended(how, value, spent, cpu, peak)


def alone(work: Callable[[], Row], folder: Path, seconds: float = 7200.0) -> Row:
    """The row of `attempt(work)` in a new interpreter with one thread.

    "peak_bytes" is the largest resident size of the process, unless the work says it itself.
    """
    kept = {name: os.environ.get(name) for name in THREADS}
    os.environ.update(dict.fromkeys(THREADS, "1"))
    try:
        ended = isolated(partial(attempt, work), folder, seconds, fresh=True)
    finally:
        for name, value in kept.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
    if ended.how == "returned":
        return {"peak_bytes": ended.peak_bytes, **ended.value}
    late = ended.how == "killed: time"
    return _failure(f"no answer after {seconds:g} s" if late else f"{ended.how} {ended.value}")


def _child(work: Callable[[], Any], target: Path, memory: int | None) -> None:
    # what the work prints belongs beside its files
    with target.with_name("output.log").open("wb") as log:
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
    if memory is not None:
        limit = _virtual_bytes() + memory
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    # a Ctrl-C belongs to the parent, which ends this process
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        answer = ("returned", work())
    except MemoryError:
        answer = ("killed: memory", None)
    except BaseException as error:
        memory_gone = "bad_alloc" in str(error)
        answer = ("killed: memory", None) if memory_gone else ("raised", _reason(error))
    peak = max(
        resource.getrusage(who).ru_maxrss
        for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
    )
    part = target.with_suffix(".part")
    part.write_bytes(pickle.dumps((*answer, peak * 1024)))
    part.rename(target)


def _reason(error: BaseException) -> str:
    """An exception in one line."""
    if isinstance(error, SoupError):
        found = "" if error.found is None else f", found {error.found}"
        return f"{type(error).__name__}: {error.what}{found}"
    # the last line of a library's message is its cause
    text = "".join(traceback.format_exception_only(error)).strip().splitlines()
    return text[-1] if text else type(error).__name__


def _virtual_bytes() -> int:
    """Address space of this process now; 0 where the system does not say."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
    except (OSError, ValueError):
        return 0
    return pages * resource.getpagesize()


def processor() -> str:
    """Name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(x.partition(":")[2].strip() for x in lines if x.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def machine() -> dict[str, str]:
    """Processor, cores, memory, system and versions, as text."""
    memory = 0.0
    if "SC_PHYS_PAGES" in os.sysconf_names:
        memory = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30
    return {
        "processor": processor(),
        "cores": str(os.cpu_count()),
        "memory": f"{memory:.0f} GB" if memory else "unknown",
        "system": f"{platform.system()} {platform.machine()}",
        **versions(),
        "code": code_version(),
    }
