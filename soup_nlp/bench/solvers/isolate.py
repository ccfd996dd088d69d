"""A function in a process of its own with memory and time limits: a crash is an answer as well."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import resource
import signal
import sys
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from soup_nlp.errors import SolverError, SoupError

GRACE = 5.0
"""Seconds beyond the time limit before a process that minds its own clock is killed."""


@dataclass(frozen=True)
class Ended:
    """How a process ended.

    Attributes:
        how: "returned", "raised", "killed: time", "killed: memory" or "crashed: SIGNAL".
        value: What the function returned, or its exception in a line.
        seconds: Wall time of the process.
        cpu_seconds: CPU time of it and its children.
        peak_bytes: Largest resident size of it or a child; 0 where it could not say.
    """

    how: str
    value: Any
    seconds: float
    cpu_seconds: float
    peak_bytes: int


def isolated(work: Callable[[], Any], folder: Path, seconds: float, memory: int) -> Ended:
    """Call a function in a forked process.

    Args:
        work: Takes nothing; its value must pickle. It sees everything of this process.
        folder: For the value; must exist.
        seconds: Wall time limit.
        memory: Bytes that the process may have more than this one has now.

    Raises:
        SolverError: the system cannot fork.
    """
    if "fork" not in multiprocessing.get_all_start_methods():
        raise SolverError(
            "comparing needs a system that forks processes", found=sys.platform, expected="POSIX"
        )
    target = folder / "value.pickle"
    target.unlink(missing_ok=True)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    begin = time.perf_counter()
    process = multiprocessing.get_context("fork").Process(
        target=_child, args=(work, target, memory)
    )
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


def _child(work: Callable[[], Any], target: Path, memory: int) -> None:
    # whatever a solver prints belongs beside its files
    with target.with_name("output.log").open("wb") as log:
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
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
    """An exception in a line."""
    if isinstance(error, SoupError):
        # its first line says what, those below say where and how to go on
        found = "" if error.found is None else f", found {error.found}"
        return f"{type(error).__name__}: {error.what}{found}"
    # a library's message ends with its cause
    text = "".join(traceback.format_exception_only(error)).strip().splitlines()
    return text[-1] if text else type(error).__name__


def _virtual_bytes() -> int:
    """Address space of this process now; 0 where the system does not say."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
    except (OSError, ValueError):
        return 0
    return pages * resource.getpagesize()
