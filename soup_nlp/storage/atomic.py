"""Writing files atomically: a file appears whole or not at all."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from soup_nlp.errors import DataError

PathLike = str | os.PathLike[str]


@contextmanager
def atomic_path(path: PathLike) -> Iterator[Path]:
    """A temporary path that becomes `path` when the block ends without an exception.

    The temporary file is in the same folder, since a rename within one file system is atomic, and
    has the same suffix. It exists and is empty when the block starts. On an exception it is removed
    and `path` does not change. The new file has the permissions of the file that it replaces, or
    those of the umask.

    Raises:
        DataError: the folder is missing or cannot be written, `path` is a folder, or the disk is
            full.
    """
    target, temporary = Path(path), None
    try:
        handle, name = tempfile.mkstemp(
            suffix=target.suffix, prefix=f".{target.stem[:64]}.", dir=target.parent
        )
        os.close(handle)
        temporary = Path(name)
        yield temporary
        temporary.chmod(_mode(target))
        os.replace(temporary, target)
    except BaseException as error:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
        if isinstance(error, OSError):
            found = error.strerror or error
            raise DataError("file cannot be written", where=target, found=found) from error
        raise


def write_bytes(path: PathLike, data: bytes) -> None:
    """Write a file whole or not at all.

    Raises:
        DataError: the folder is missing or cannot be written.
    """
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: PathLike, text: str) -> None:
    """Write a text file in UTF-8, see `write_bytes`."""
    # names of files may contain bytes that are not UTF-8
    write_bytes(path, text.encode("utf-8", "backslashreplace"))


def _mode(target: Path) -> int:
    """Permission bits of the old file, or the default of the process."""
    with suppress(OSError):
        return target.stat().st_mode & 0o777
    mask = os.umask(0o022)
    os.umask(mask)
    return 0o666 & ~mask
