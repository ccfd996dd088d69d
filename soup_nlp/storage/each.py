"""Many jobs and their rows of numbers, which are stored as JSON lines.

Jobs run here, in worker processes of this machine (loky), or on a cluster (Dask).
"""

import json
import logging
import multiprocessing
import os
import re
import resource
import signal
import threading
import time
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import CancelledError
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, suppress
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from joblib.externals.loky import ProcessPoolExecutor

from soup_nlp.errors import DataError, optional
from soup_nlp.storage.files import is_file, parse_json, plain, read_bytes
from soup_nlp.storage.system import deferred_signals, end_with_parent, handling, keep_memory
from soup_nlp.storage.versions import code_version

Row = dict[str, Any]
Work = Callable[[], Row]
Say = Callable[[int, int, Row], None]

ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS",
     "OPENCV_FOR_THREADS_NUM"), "1",
)  # fmt: skip
"""Environment of a worker process; libraries read it when they are loaded."""
GRACE = 5.0
"""Seconds in which a worker that is interrupted can remove its temporary files."""


def each(
    jobs: Mapping[str, Work],
    workers: int = 1,
    *,
    cluster: str | None = None,
    fresh: bool = False,
    seconds: float | None = None,
) -> Generator[tuple[str, Row]]:
    """Names and rows of jobs, in the order in which they end.

    A job that raises, or whose process dies, is a row with `ok` false and the reason; the others go
    on. Functions travel by cloudpickle and workers do not import `__main__`, so that this works
    from a script without a guard, from stdin and in a notebook. When the iteration ends early, as
    by Ctrl-C, the workers are interrupted, and killed if they go on.

    Args:
        jobs: Functions by name.
        workers: Processes of this machine, one thread each; 1 calls the jobs in this process.
        cluster: Address of the scheduler of a Dask cluster, tcp://HOST:PORT, instead.
        fresh: A new process for every job, also with one worker.
        seconds: Wall time after which the process of a job is killed.
    """
    if cluster is not None:
        yield from _on_cluster(jobs, cluster)
    elif fresh or workers > 1:
        yield from _in_processes(jobs, min(workers, len(jobs)), fresh, seconds)
    else:
        yield from ((name, attempt(work)) for name, work in jobs.items())


def attempt(work: Work) -> Row:
    """Result of `work`, with "ok", "error", "seconds" and "cpu_seconds", as plain JSON values.

    "peak_bytes", unless the result has it, is the largest resident size meanwhile (Linux; elsewhere
    of the process so far). An exception becomes a row with `ok` false and the reason.
    """
    with suppress(OSError):
        # resets the largest resident size of this process
        Path("/proc/self/clear_refs").write_text("5")
    begin, cpu = time.perf_counter(), cpu_seconds()
    try:
        row = {"ok": True, "error": None, **work()}
        row.setdefault("peak_bytes", peak_bytes())
    except Exception as error:
        row = failure(f"{type(error).__name__}: {error}")
    row["seconds"] = time.perf_counter() - begin
    row["cpu_seconds"] = cpu_seconds() - cpu
    return dict(plain(row))


def cpu_seconds() -> float:
    """CPU seconds of this process and of its children that have ended."""
    return sum(os.times()[:4])


def failure(reason: str) -> Row:
    """The row of work that failed, with the reason."""
    return {"ok": False, "error": reason, "seconds": 0.0, "cpu_seconds": 0.0}


def peak_bytes() -> int:
    """Largest resident size of this process, see `attempt`."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _prepare_worker(parent: int) -> None:
    end_with_parent(parent)
    keep_memory()
    # the parent handles Ctrl-C, and interrupts its workers
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _in_worker(work: Work) -> Row:
    with handling(signal.default_int_handler, [signal.SIGTERM]):
        return attempt(work)


def _in_processes(
    jobs: Mapping[str, Work], workers: int, fresh: bool, seconds: float | None
) -> Generator[tuple[str, Row]]:
    """Rows by threads that have a pool of one process each: if it dies, its job is known."""
    # threads may share it, as a step of it is atomic
    todo = iter([*jobs.items()])
    done = SimpleQueue[tuple[str, Row]]()
    pools, processes = dict[int, Any](), dict[int, int]()
    stop = threading.Event()

    def row_of(number: int, work: Work) -> Row:
        """The row of a job; "ended" says that the process is gone."""
        try:
            if number not in pools:
                pools[number] = ProcessPoolExecutor(
                    1, initializer=_prepare_worker, initargs=(os.getpid(),), env=ONE_THREAD
                )
                processes[number] = pools[number].submit(os.getpid).result()
            # a stop sees the process, or is seen here
            ended = None if stop.is_set() else pools[number].submit(_in_worker, work)
            return dict(ended.result(seconds)) if ended else {}
        except TimeoutError:
            return failure(f"wall time limit of {seconds:g} s reached") | {"ended": True}
        except BrokenProcessPool as error:
            code = re.search(r"\{(?!EXIT)([A-Z]+)\(", str(error))
            what = f"the process died{f' by {code[1]}' if code else ''}"
            why = "out of memory, a time limit, or a crash of native code"
            return failure(f"{what} ({why})") | {"ended": True}
        except (Exception, KeyboardInterrupt) as error:
            # it or its row cannot be sent to another process, or the pool is stopped
            return failure(f"{type(error).__name__}: {error}")

    def end(number: int) -> None:
        processes.pop(number, None)
        if pool := pools.pop(number, None):
            pool.shutdown(kill_workers=True)

    def drive(number: int) -> None:
        for name, work in todo:
            if stop.is_set():
                break
            row = row_of(number, work)
            if row.pop("ended", False) or fresh:
                end(number)
            done.put((name, row))
        end(number)

    threads = [threading.Thread(target=drive, args=(k,), daemon=True) for k in range(workers)]
    try:
        for thread in threads:
            thread.start()
        for _ in jobs:
            yield done.get()
    finally:
        # a second Ctrl-C waits as well
        with deferred_signals():
            stop.set()
            for process in list(processes.values()):
                with suppress(ProcessLookupError):
                    os.kill(process, signal.SIGTERM)
            until = time.monotonic() + GRACE
            for thread in threads:
                thread.join(max(0.0, until - time.monotonic()))
            for number, thread in enumerate(threads):
                end(number)
                thread.join()


def _alone(work: Work) -> Row:
    """The row of a job in a process of its own, whose memory ends with it."""
    # Dask's workers are daemons, which multiprocessing lets have no children; these end with them
    multiprocessing.current_process()._config["daemon"] = False  # type: ignore[attr-defined]
    return next(_in_processes({"": work}, 1, True, None))[1]


def _on_cluster(jobs: Mapping[str, Work], address: str) -> Generator[tuple[str, Row]]:
    """Rows from the workers of a Dask cluster, which solves the job of a lost worker elsewhere."""
    distributed = optional("distributed", "cluster")
    # it would print the traceback of every lost connection
    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    with distributed.Client(address) as client:
        futures = {
            client.submit(_alone, work, key=f"soup-nlp {name} {os.getpid()}", pure=False): name
            for name, work in jobs.items()
        }
        for future in distributed.as_completed(list(futures)):
            try:
                row = dict(future.result())
            except CancelledError as error:
                raise DataError(
                    "the scheduler of the cluster is lost",
                    where=address,
                    hint="what was finished is kept: the same command goes on",
                ) from error
            except Exception as error:
                row = failure(f"{type(error).__name__}: {str(error).strip()}")
            yield futures[future], row


# --- rows that are kept ---------------------------------------------------------------------------


def reason(row: Mapping[str, Any]) -> str:
    """The reason of a failure on one line: first line of the error, its place and actual value."""
    # a stored row has its lines on one
    first, *details = re.split(r"\n *| {3,}", str(row.get("error") or "no reason"))
    return ", ".join([first, *(d for d in details if d.startswith(("where: ", "found: ")))])


def failed(row: Mapping[str, Any]) -> bool:
    """Whether a row holds an error instead of numbers."""
    return bool(row.get("error"))


def read_rows(path: Path) -> list[Row]:
    """Rows of a JSON-lines file in order, without lines that a crash cut off."""
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
    """Append a row and wait until it is on disk; terminate a line that a crash cut off first."""
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
    jobs: Sequence[tuple[Mapping[str, Any], Work]],
    path: Path,
    workers: int = 1,
    *,
    say: Say | None = None,
    after: Callable[[list[Row]], None] | None = None,
    **options: Any,
) -> list[Row]:
    """The row of every job, from the JSON-lines file or else measured by `each` with its options.

    A job has entries of its row, which have the same names in all jobs, and what measures the row.
    A stored row is used for a job of the same entries and code version unless the row failed. Every
    new row is appended as soon as it is measured, so that an interrupted run can be continued.
    `say` is called with (done, total, row) after every new row, and `after` with all rows so far,
    in the order of the jobs, after every new row and at the end.
    """
    code, keys = code_version(), list(jobs[0][0]) if jobs else []

    def identity(row: Mapping[str, Any]) -> str:
        return json.dumps(plain({k: row.get(k) for k in keys}), sort_keys=True)

    job_of = {identity(entries): (entries, work) for entries, work in jobs}
    stored = [r for r in read_rows(path) if r.get("code") == code and not failed(r)]
    row_of = {name: row for row in stored if (name := identity(row)) in job_of}
    todo = {name: work for name, (_, work) in job_of.items() if name not in row_of}

    def so_far() -> list[Row]:
        return [row_of[name] for name in job_of if name in row_of]

    with closing(each(todo, workers, **options)) as ended:
        for name, result in ended:
            row_of[name] = {**plain(job_of[name][0]), "code": code, **result}
            append_row(path, row_of[name])
            if say:
                say(len(row_of), len(job_of), row_of[name])
            if after:
                after(so_far())
    if after and not todo:
        after(so_far())
    return so_far()
