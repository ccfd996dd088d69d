"""The operating system: memory, its errors, streams, signals, processes, temporary folders."""

import ctypes
import errno
import os
import signal
import sys
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType

import psutil

from soup_nlp.errors import DataError

SIGNALS = (signal.SIGINT, signal.SIGTERM)
_LIMITS = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")
"""Files with the memory limit of a container."""
REFUSALS = (
    *(errno.ENAMETOOLONG, errno.ELOOP, errno.ENOTDIR, errno.EISDIR, errno.EACCES, errno.EPERM),
    *(errno.EROFS, errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EMFILE),
)
"""Errors of the operating system that are not bugs of the program."""


def require_memory(size: float, what: str, where: object = None, hint: str | None = None) -> None:
    """Raise DataError if fewer bytes of memory than `what` needs are usable without swapping."""
    free = [int(psutil.virtual_memory().available)]
    for name in _LIMITS:
        with suppress(OSError, ValueError):
            free.append(int(Path(name).read_text()) - int(psutil.Process().memory_info().rss))
    usable = max(0, min(free))
    if size > usable:
        raise DataError(
            f"{what} would take more memory than this machine has",
            where=where,
            found=f"about {size / 1e9:.3g} GB",
            expected=f"at most {usable / 1e9:.3g} GB, which are free",
            hint=hint,
        )


def refusal(error: Exception) -> DataError | None:
    """DataError for a lack of memory, files or disk space; None for other errors."""
    # messages of native code and of OpenCV; Python and NumPy raise MemoryError
    words = ("bad_alloc", "Insufficient memory")
    if isinstance(error, MemoryError) or any(word in str(error) for word in words):
        return DataError(
            "the machine has not enough memory for this",
            found=error,
            hint="smaller images, or fewer superpixels, neighbours or particles",
        )
    if isinstance(error, FileNotFoundError) and error.filename is None:
        return DataError("the working folder does not exist any more", hint="cd to another one")
    if isinstance(error, OSError) and error.errno in REFUSALS:
        return DataError("the system refuses a file", where=error.filename, found=error.strerror)
    return None


def prepare_streams() -> None:
    """Print characters that a stream cannot encode as escapes, and open closed streams.

    A stream that was closed before the start (`>&-`) is connected to the null device. Otherwise the
    next opened file would get its number, and native code would print into that file.
    """
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            # gets the lowest free number
            os.open(os.devnull, os.O_RDWR)
    sys.stdout = sys.stdout or os.fdopen(1, "w")
    sys.stderr = sys.stderr or os.fdopen(2, "w")
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            with suppress(OSError, ValueError):
                stream.reconfigure(errors="backslashreplace")


@contextmanager
def handling(
    handler: Callable[[int, FrameType | None], object], numbers: Iterable[int]
) -> Iterator[None]:
    """Have a function handle signals until the block ends (main thread only)."""
    main = threading.current_thread() is threading.main_thread()
    old = {number: signal.signal(number, handler) for number in numbers} if main else {}
    try:
        yield
    finally:
        for number, before in old.items():
            signal.signal(number, signal.SIG_DFL if before is None else before)


@contextmanager
def deferred_signals() -> Iterator[None]:
    """Delay Ctrl-C and SIGTERM until the block ends (main thread only)."""
    came: list[int] = []
    try:
        with handling(lambda number, frame: came.append(number), SIGNALS):
            yield
    finally:
        if came:
            signal.raise_signal(came[0])


def end_with_parent(parent: int) -> None:
    """Have the kernel end this process when its parent, a process id, is killed; Linux only."""
    if sys.platform == "linux":
        pr_set_pdeathsig = 1
        ctypes.CDLL(None).prctl(pr_set_pdeathsig, int(signal.SIGKILL))
        if os.getppid() != parent:
            # it was killed before
            os._exit(1)


def keep_memory() -> None:
    """Have glibc use memory that was freed again, instead of returning it to the system.

    Large arrays come and go; the system clears their pages anew each time. A pair takes 6 % less
    time, and 40 % less in a worker of Dask, which sets a threshold of 64 KiB.
    """
    if change := getattr(ctypes.CDLL(None), "mallopt", None):
        trim, mmap = -1, -3
        # some versions refuse more than 32 MiB
        if change(mmap, 2**30) or change(mmap, 2**25):
            change(trim, 2**30)


@contextmanager
def scratch() -> Iterator[Path]:
    """A temporary folder in the system's folder for these."""
    try:
        folder = tempfile.TemporaryDirectory(prefix="soup_nlp-", ignore_cleanup_errors=True)
    except OSError as error:
        what, where = "no temporary folder can be made", tempfile.gettempdir()
        raise DataError(what, where=where, found=error.strerror, hint="set TMPDIR") from error
    with folder as name:
        yield Path(name)
