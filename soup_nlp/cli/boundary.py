"""Outermost layer of every command: unexpected exceptions become bug reports in files."""

from __future__ import annotations

import errno
import os
import re
import sys
import tempfile
import traceback
import unicodedata
from collections.abc import Sequence
from contextlib import suppress

from soup_nlp.errors import ConfigError, DataError, printable
from soup_nlp.storage.versions import versions

BUG = 70
"""Exit code of a bug of the program (EX_SOFTWARE of sysexits.h)."""
BROKEN_PIPE = 141
"""Exit code after a broken pipe, as in shells."""

SYSTEM = (
    *(errno.ENAMETOOLONG, errno.ELOOP, errno.ENOTDIR, errno.EISDIR, errno.EACCES, errno.EPERM),
    *(errno.EROFS, errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EMFILE),
)
"""Errors of the operating system that are not bugs of the program."""


def print_warning(
    message: Warning | str, category: type[Warning], *_: object, **__: object
) -> None:
    """Print a warning about the input on one line; those of libraries are not printed."""
    # loaded by whoever warns, so that --help is fast
    from soup_nlp.data.formats.images import DataWarning

    if issubclass(category, DataWarning):
        print(f"warning: {message}", file=sys.stderr)


def refusal(error: Exception) -> DataError | None:
    """DataError for a lack of memory, files or disk space; None for other errors."""
    # of Python and NumPy, of native code, of OpenCV
    words = ("bad_alloc", "Insufficient memory")
    if isinstance(error, MemoryError) or any(word in str(error) for word in words):
        return DataError(
            "the machine has not enough memory for this",
            found=error,
            hint="smaller images, or fewer superpixels, neighbours or particles",
        )
    if isinstance(error, FileNotFoundError) and error.filename is None:
        return DataError("the working folder does not exist any more", hint="cd to another one")
    if isinstance(error, OSError) and error.errno in SYSTEM:
        return DataError("the system refuses a file", where=error.filename, found=error.strerror)
    return None


def report_bug(error: BaseException) -> int:
    """Write a traceback to a file and ask the user to report it; returns the exit code."""
    lines = traceback.format_exception(error)
    facts = [f"command: {sys.argv!r}", *(f"{k}: {v}" for k, v in versions().items()), ""]
    text = "\n".join(facts) + "".join(lines)
    place = "no file could be written"
    with suppress(OSError):
        handle, place = tempfile.mkstemp(prefix="soup_nlp_bug_", suffix=".txt")
        with os.fdopen(handle, "w", encoding="utf-8", errors="backslashreplace") as file:
            file.write(text)
    said = printable(f"{type(error).__name__}: {error}", 200)
    print(
        f"error: this is a bug of soup-nlp, please report it with the file below\n"
        f"  found: {said}\n  where: {place}",
        file=sys.stderr,
    )
    return BUG


def refuse_odd(words: Sequence[str]) -> None:
    """Reject empty arguments, which unset shell variables cause, and control characters.

    Raises:
        ConfigError: there is one.
    """
    for word in words:
        if not word.strip() or re.fullmatch(r"--[a-z-]+=\s*", word):
            raise ConfigError("an argument is empty", where=word or "command line", found=words)
        if any(unicodedata.category(c) == "Cc" and c not in "\n\t" for c in word):
            raise ConfigError("an argument holds control characters", found=word)


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


def drop_output() -> None:
    """Discard the rest of the output after a broken pipe."""
    with suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
