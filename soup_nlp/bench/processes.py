"""A function in a process of its own with limits; the description of the machine."""

import math
import multiprocessing
import os
import platform
import resource
import signal
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import psutil

from soup_nlp.errors import SoupError
from soup_nlp.storage.rows import one_thread
from soup_nlp.storage.system import end_with_parent
from soup_nlp.storage.versions import code_version, versions

GRACE = 5.0
"""Seconds beyond its time limit before a process is killed."""


@dataclass(frozen=True)
class ProcessResult:
    """Result of a function that ran in a process of its own.

    Attributes:
        how: "returned", "raised", "killed: time", "killed: memory" or "crashed: SIGNAL".
        value: Return value of the function, its exception in one line, or what killed it.
        seconds: Wall time of the process.
        cpu_seconds: CPU time of the process and its children.
        peak_bytes: Largest resident size of the process or of a child; 0 if it is unknown.
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
    memory: int,
    cpu_seconds: float | None = None,
) -> ProcessResult:
    """Call a function in a process of its own with one thread; a crash becomes a result as well.

    A library that this process has loaded keeps its number of threads.

    Args:
        work: Function without arguments; its return value must pickle.
        folder: Existing folder for the output.
        seconds: Limit of the wall time.
        memory: Bytes that the process may have in addition to those of this one.
        cpu_seconds: Limit of the CPU time of the process and of each of its children, or None.
    """
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    begin = time.perf_counter()
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_child, args=(work, sender, folder, memory, cpu_seconds))
    with one_thread():
        process.start()
    # the end of the process is then the end of the pipe
    sender.close()
    answer = None
    try:
        late = not receiver.poll(seconds + GRACE)
        if not late:
            with suppress(EOFError, OSError):
                answer = receiver.recv()
            process.join(GRACE)
    finally:
        process.kill()
        process.join()
    spent = time.perf_counter() - begin
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    code = process.exitcode or 0
    process.close()
    if answer is None and late:
        answer = "killed: time", f"wall time limit of {seconds:g} s reached", 0
    how, value, peak = answer or (*without_answer(code, cpu, cpu_seconds), 0)
    return ProcessResult(how, value, spent, cpu, peak)


def without_answer(code: int, cpu: float, limit: float | None) -> tuple[str, str | None]:
    """How a process without an answer ended, and what killed it, in words.

    Args:
        code: Exit code, the negative number of the signal that ended it.
        cpu: CPU seconds of the process and its children.
        limit: Their limit, at which the system sends SIGXCPU, and SIGKILL if that is ignored.
    """
    if code >= 0:
        return f"crashed: exit code {code}", None
    name = next((s.name for s in signal.Signals if s == -code), f"signal {-code}")
    if limit is not None and cpu >= limit and name in ("SIGXCPU", "SIGKILL"):
        return "killed: time", f"CPU limit of {limit:g} s reached"
    perhaps = ", perhaps out of memory" if name == "SIGKILL" else ""
    return f"crashed: {name}", f"killed by {name}{perhaps}"


def _child(
    work: Callable[[], Any],
    sender: Connection,
    folder: Path,
    memory: int,
    cpu_seconds: float | None,
) -> None:
    end_with_parent()
    # the output of the work goes to a file in its folder
    with (folder / "output.log").open("wb") as log:
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
    limit = psutil.Process().memory_info().vms + memory
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    if cpu_seconds is not None:
        most = math.ceil(1.2 * cpu_seconds) + 1
        resource.setrlimit(resource.RLIMIT_CPU, (most, most + 1))
    # the parent handles Ctrl-C and ends this process
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        answer = ("returned", work())
    except MemoryError:
        answer = ("killed: memory", None)
    except BaseException as error:
        # the last line of a library's message has the cause
        text = "".join(traceback.format_exception_only(error)).strip().rpartition("\n")[2]
        if isinstance(error, SoupError):
            text = f"{type(error).__name__}: {error.what}"
            text += "" if error.found is None else f", found {error.found}"
        answer = ("killed: memory", None) if "bad_alloc" in str(error) else ("raised", text)
    scopes = resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN
    peak = max(resource.getrusage(scope).ru_maxrss for scope in scopes)
    sender.send((*answer, peak * 1024))


def processor() -> str:
    """Name of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        return next(x.partition(":")[2].strip() for x in lines if x.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


def machine() -> dict[str, str]:
    """Processor, cores, memory, system and versions, as text."""
    return {
        "processor": processor(),
        "cores": str(os.cpu_count()),
        "memory": f"{psutil.virtual_memory().total / 2**30:.0f} GB",
        "system": f"{platform.system()} {platform.machine()}",
        **versions(),
        "code": code_version(),
    }
