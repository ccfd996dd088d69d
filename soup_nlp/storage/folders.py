"""Output folders: all files of a command appear at once; those of the user are kept.

A command first checks the names that it will write (`claim`). Later it writes its files into a
hidden folder in the target (`staged`). One rename marks that folder as complete; its files are then
renamed to their places. After a kill, a later call finishes the renaming (`recover`). A lock on the
folder makes processes that write into the same folder wait for each other.

The hidden file MARK lists the files in a folder that the program made, with their SHA-256. A file
that is not listed, or that was changed, belongs to the user: it is never removed, and overwritten
only with `overwrite`. The mark also has the subject of the result, such as the frames that were
solved.
"""

import fcntl
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from itertools import chain, count
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from soup_nlp.errors import DataError
from soup_nlp.storage.files import PathLike, as_path, read_text
from soup_nlp.storage.system import deferred_signals, sweep, temporary_folder

MARK = ".soup_nlp"
"""Hidden file of a folder with results: `Mark` as JSON, its subject under "of"."""
_STAGE = f"{MARK}-"
"""First part of the names of temporary folders; the number of their process follows."""
_COMPLETE = f"{_STAGE}complete-"
"""The same of those whose files are being moved to their places."""


class Mark(NamedTuple):
    """SHA-256 by name of the files that the program made in a folder, and subject of the result."""

    files: dict[str, str]
    subject: str = ""


def mark_of(folder: Path) -> Mark:
    """The mark of a folder; empty if there is no valid one."""
    path = folder / MARK
    try:
        if path.is_symlink():
            return Mark({})
        mark = json.loads(read_text(path, MARK))
        # a damaged mark must not name files outside the folder
        inside = [n for n in mark["files"] if not PurePosixPath(n).is_absolute() and ".." not in n]
        return Mark({str(n): str(mark["files"][n]) for n in inside}, str(mark.get("of", "")))
    except (DataError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return Mark({})


def files_in(folder: Path) -> list[str]:
    """Names of all files below a folder, without the mark."""
    paths = [path for path in folder.rglob("*") if not path.is_dir() or path.is_symlink()]
    return sorted(p.relative_to(folder).as_posix() for p in paths if p != folder / MARK)


def digest_of(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _state(folder: Path, name: str) -> str:
    """What a folder holds under a name.

    "nothing", "made" by the program, "foreign", or "blocked": by a folder, or by a file or link
    above it.
    """
    path, above = folder / name, [folder / p for p in PurePosixPath(name).parents[:-1]]
    if any(p.is_symlink() or (p.exists() and not p.is_dir()) for p in above):
        return "blocked"
    if path.is_symlink() or path.is_file():
        made = not path.is_symlink() and mark_of(folder).files.get(name) == digest_of(path)
        return "made" if made else "foreign"
    return "blocked" if path.is_dir() else "foreign" if path.exists() else "nothing"


def default_folder(name: str, subject: str) -> Path:
    """`out/NAME`, or the first of `out/NAME-2`, ... that holds no result of another subject."""
    names = chain([name], (f"{name}-{k}" for k in count(2)))
    return next(p for n in names if mark_of(p := Path("out") / n).subject in ("", subject))


def claim(
    folder: PathLike, names: Iterable[str], overwrite: bool = False, subject: str = ""
) -> Path:
    """Check that these files may be written into an output folder, and return it.

    A missing folder is not made yet.

    Args:
        folder: The output folder.
        names: Files that will be written.
        overwrite: Allow files of the user with these names, and the result of another subject.
        subject: Subject of the new result, see `Mark`.

    Raises:
        DataError: the folder cannot be written, holds a file of the user or a folder with one of
            the names, or is the result of another subject.
    """
    with _locked(folder) as target:
        existing = next(p for p in (target, *target.parents) if os.path.lexists(p))
        # fails where nothing can be written
        tempfile.TemporaryFile(dir=existing).close()
        before = mark_of(target).subject
        states = {name: _state(target, name) for name in names}
        foreign = [name for name, state in states.items() if state in ("foreign", "blocked")]
        hint = "choose another --out, or --overwrite"
        if subject and before not in ("", subject) and not overwrite:
            what = "output folder holds the result of something else"
            raise DataError(what, where=folder, found=before, expected=subject, hint=hint)
        if foreign and not overwrite:
            raise DataError(
                "output folder holds files that would be overwritten and that this program did not"
                " make, or that were changed since",
                where=folder,
                found=", ".join(foreign),
                expected="a new or empty folder, or that of an earlier result",
                hint=hint,
            )
        for name in (name for name in foreign if states[name] == "blocked"):
            what = "cannot write over a folder, or below a file or link"
            raise DataError(what, where=target / name)
    return Path(folder)


@contextmanager
def staged(
    folder: PathLike, whole: bool = False, overwrite: bool = False, subject: str = ""
) -> Iterator[Path]:
    """An empty folder whose files are moved into `folder` when the block ends without exception.

    On an exception the files of `folder` do not change, and no new folder is left.

    Args:
        folder: The output folder.
        whole: The new files are a complete result: files of an earlier result are removed.
        overwrite: Overwrite files that the program did not make.
        subject: Subject of the new result; empty for that of the earlier result.

    Raises:
        DataError: a file cannot be written, or a file of the user has the name of a new one.
    """
    target = Path(os.path.realpath(as_path(folder, "output folder")))
    fresh = [p for p in (target, *target.parents) if not os.path.lexists(p)]
    with _named_errors(folder):
        target.mkdir(parents=True, exist_ok=True)
        recover(target)
        try:
            with temporary_folder(target, _STAGE) as stage:
                yield stage
                claim(target, files_in(stage), overwrite)
                with _locked(target), deferred_signals():
                    _commit(stage, target, whole, subject)
        except DataError as error:
            # name the final path instead of the temporary one
            if not isinstance(error.where, Path) or not error.where.is_relative_to(stage):
                raise
            final = target / error.where.relative_to(stage)
            raise DataError(error.what, where=final, found=error.found, hint=error.hint) from error
        finally:
            with suppress(OSError):
                # fails for a folder that is not empty
                for path in fresh:
                    path.rmdir()


def _commit(stage: Path, target: Path, whole: bool, subject: str) -> None:
    """Mark a temporary folder as complete and move its files to their places."""
    new, before = {name: digest_of(stage / name) for name in files_in(stage)}, mark_of(target)
    for name in before.files.keys() & new.keys():
        if _state(target, name) == "made":
            shutil.copymode(target / name, stage / name)
    # a file that was changed stays listed, so that it is known to be changed
    files = new if whole else before.files | new
    of = {"of": subject or before.subject} if subject or before.subject else {}
    mark = json.dumps({**of, "files": dict(sorted(files.items()))}, indent=1)
    (stage / MARK).write_text(mark + "\n", encoding="utf-8")
    for name in (*new, MARK):
        # wait until the file is on disk: some systems report a full disk only here
        with (stage / name).open("rb") as file:
            os.fsync(file.fileno())
    # from here on, the new files are the result
    os.replace(stage, target / stage.name.replace(_STAGE, _COMPLETE))
    _finish(target)


def recover(folder: Path) -> None:
    """Move the files of complete temporary folders to their places; remove incomplete ones.

    The incomplete folders of running processes are kept.
    """
    with _locked(folder):
        pass


@contextmanager
def _locked(folder: PathLike) -> Iterator[Path]:
    """The real path of an output folder, recovered, and locked until the block ends.

    A kill releases the lock. A missing folder is not locked, nor one in a file system that has no
    locks, where another process may be moving the same files.
    """
    target = Path(os.path.realpath(as_path(folder, "output folder")))
    with ExitStack() as stack, _named_errors(folder):
        with suppress(OSError):
            handle = os.open(target, os.O_RDONLY | os.O_DIRECTORY)
            stack.callback(os.close, handle)
            fcntl.flock(handle, fcntl.LOCK_EX)
        _finish(target)
        yield target


def _finish(folder: Path) -> None:
    """See `recover`."""
    for stage in folder.glob(f"{_COMPLETE}*"):
        if stage.is_symlink():
            continue
        # the mark is moved last: without it, every file was moved
        if (stage / MARK).is_file():
            for name in mark_of(folder).files.keys() - mark_of(stage).files.keys():
                if _state(folder, name) == "made":
                    (folder / name).unlink(missing_ok=True)
                    with suppress(OSError):
                        # removes empty folders only
                        os.removedirs((folder / name).parent)
            for name in (*files_in(stage), MARK):
                (folder / name).parent.mkdir(parents=True, exist_ok=True)
                with suppress(FileNotFoundError):
                    os.replace(stage / name, folder / name)
        shutil.rmtree(stage, ignore_errors=True)
    sweep(folder, _STAGE)


@contextmanager
def _named_errors(folder: PathLike) -> Iterator[None]:
    """Turn errors of the operating system into a DataError that names the output folder."""
    try:
        yield
    except OSError as error:
        reason, hint = error.strerror or error, "choose another --out, or make room on a full disk"
        what = "output folder cannot be written"
        raise DataError(what, where=folder, found=reason, hint=hint) from error
