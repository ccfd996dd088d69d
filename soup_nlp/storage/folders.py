"""Output folders: all files of a command appear at once, and no file of the user is overwritten.

A command first claims the names that it will write (`claim`). Later it writes its files into a
hidden folder in the target (`staged`). One rename marks that folder as complete; its files are then
renamed to their places, and a later call finishes what a kill interrupts (`recover`).
`storage.mark` records which files the program made.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from soup_nlp.errors import DataError
from soup_nlp.storage.atomic import PathLike
from soup_nlp.storage.mark import (
    MARK,
    digest_of,
    files_in,
    is_foreign,
    made_files,
    release,
    subject_of,
    write_mark,
)
from soup_nlp.storage.system import deferred_signals, is_other_process

_STAGE = f"{MARK}-"
"""First part of the names of temporary folders; the number of their process follows."""
_COMMIT = f"{_STAGE}commit"
"""Folder of complete new files that are being moved to their places."""

_made: list[Path] = []
"""Folders that `claim` has made in this process."""
_open: set[Path] = set()
"""Temporary folders that this process is filling."""


def default_folder(name: str, subject: str) -> Path:
    """`out/NAME`, or the first of `out/NAME-2`, ... that holds no result of something else."""
    k = 1
    while True:
        folder = Path("out") / (name if k == 1 else f"{name}-{k}")
        if subject_of(folder) in ("", subject):
            return folder
        k += 1


def remove_empty() -> None:
    """Remove the folders that `claim` has made and into which nothing was written."""
    while _made:
        with suppress(OSError):
            os.rmdir(_made.pop())


def claim(
    folder: PathLike, names: Iterable[str], overwrite: bool = False, subject: str = ""
) -> Path:
    """Make an output folder, check that these files may be written into it, and return it.

    Moves that a killed process has begun are finished, and its temporary folders are removed.

    Args:
        folder: The output folder.
        names: Files that will be written.
        overwrite: Treat existing files of these names as files of the program, and replace the
            result of another subject.
        subject: What the files will be the result of.

    Raises:
        DataError: the folder cannot be written, holds a file of the user with one of the names, or
            is the result of another subject.
    """
    with _named_errors(folder):
        target = _resolved(folder)
        with deferred_signals():
            fresh = [p for p in (target, *target.parents) if not os.path.lexists(p)]
            target.mkdir(parents=True, exist_ok=True)
            _made.extend(reversed(fresh))
            recover(target)
            # fails where nothing can be written
            _remove(_new_folder(target, _STAGE))
        before = subject_of(target)
        if subject and before not in ("", subject) and not overwrite:
            raise DataError(
                "output folder holds the result of something else",
                where=folder,
                found=before,
                expected=subject,
                hint="choose another --out, or --overwrite",
            )
        release(target, names, overwrite)
    return Path(folder)


@contextmanager
def staged(
    folder: PathLike, whole: bool = False, overwrite: bool = False, subject: str = ""
) -> Iterator[Path]:
    """An empty folder whose files are moved into `folder` when the block ends without exception.

    On an exception `folder` does not change.

    Args:
        folder: The output folder.
        whole: The new files are a complete result: files of an earlier result are removed.
        overwrite: Overwrite files that the program did not make.
        subject: What the files are the result of; nothing leaves what the folder says.

    Raises:
        DataError: a file cannot be written, or a file of the user has the name of a new one.
    """
    with _named_errors(folder):
        target = _resolved(folder)
        with deferred_signals():
            target.mkdir(parents=True, exist_ok=True)
            recover(target)
            stage = _new_folder(target, _STAGE)
        try:
            yield stage
            with deferred_signals():
                new = {name: digest_of(stage / name) for name in files_in(stage)}
                release(target, new, overwrite)
                old = {k: v for k, v in made_files(target).items() if not is_foreign(target, k)}
                write_mark(stage, new if whole else old | new, subject or subject_of(target))
                for name in old.keys() & new.keys():
                    # a file of the program may have been removed
                    with suppress(FileNotFoundError):
                        shutil.copymode(target / name, stage / name)
                _sync(stage)
                os.rename(stage, target / _COMMIT)
                _move_in(target)
        except DataError as error:
            # name the final path instead of the temporary one
            if not isinstance(error.where, Path) or not error.where.is_relative_to(stage):
                raise
            place = target / error.where.relative_to(stage)
            raise DataError(error.what, where=place, found=error.found, hint=error.hint) from error
        finally:
            _remove(stage)


@contextmanager
def scratch() -> Iterator[Path]:
    """A folder for temporary files, removed at the end, or by a later call if this one is killed.

    Raises:
        DataError: the folder cannot be made.
    """
    root, prefix = Path(tempfile.gettempdir()), f"soup_nlp-{os.getuid()}-"
    try:
        with deferred_signals():
            _sweep(root, prefix)
            folder = _new_folder(root, prefix)
    except OSError as error:
        raise DataError(
            "no temporary folder can be made", where=root, found=error.strerror, hint="set TMPDIR"
        ) from error
    try:
        yield folder
    finally:
        _remove(folder)


def recover(folder: Path) -> None:
    """Finish moving new files into a folder and remove temporary folders, if a kill left them."""
    _move_in(folder)
    _sweep(folder, _STAGE)


def _new_folder(parent: Path, prefix: str) -> Path:
    """A new temporary folder, whose name has the number of this process."""
    folder = Path(tempfile.mkdtemp(prefix=f"{prefix}{os.getpid()}-", dir=parent))
    _open.add(folder)
    return folder


def _remove(folder: Path) -> None:
    with deferred_signals():
        shutil.rmtree(folder, ignore_errors=True)
        _open.discard(folder)


def _sweep(parent: Path, prefix: str) -> None:
    """Remove temporary folders whose process has ended."""
    for path in parent.glob(f"{prefix}*"):
        number = path.name.removeprefix(prefix).split("-")[0]
        if number.isdecimal() and path not in _open and not is_other_process(int(number)):
            shutil.rmtree(path, ignore_errors=True)


def _move_in(target: Path) -> None:
    """Move complete new files to their places and remove old ones; may be repeated."""
    commit = target / _COMMIT
    if commit.is_symlink() or not commit.is_dir():
        return
    # the mark is moved last: without it, every file was moved
    if (commit / MARK).exists():
        for name in made_files(target).keys() - made_files(commit).keys():
            if os.path.lexists(target / name) and not is_foreign(target, name):
                (target / name).unlink(missing_ok=True)
                with suppress(OSError):
                    # removes empty folders only
                    os.removedirs((target / name).parent)
        # another process may be finishing the same moves
        with suppress(FileNotFoundError):
            for name in [*files_in(commit), MARK]:
                (target / name).parent.mkdir(parents=True, exist_ok=True)
                os.replace(commit / name, target / name)
    shutil.rmtree(commit, ignore_errors=True)


def _sync(folder: Path) -> None:
    """Wait until the files are on disk; some systems report a full disk only here."""
    for name in [*files_in(folder), MARK]:
        with (folder / name).open("rb") as file:
            os.fsync(file.fileno())


@contextmanager
def _named_errors(folder: PathLike) -> Iterator[None]:
    """Turn errors of the operating system into a DataError that names the output folder."""
    try:
        yield
    except OSError as error:
        raise DataError(
            "output folder cannot be written",
            where=folder,
            found=error.strerror or error,
            hint="choose another --out, or make room where the disk is full",
        ) from error


def _resolved(folder: PathLike) -> Path:
    try:
        return Path(folder).resolve()
    except (RuntimeError, ValueError) as error:
        # a cyclic link, a NUL character
        raise OSError(str(error)) from error
