"""Output folders: all files of a command appear at once, and no file of the user is overwritten.

A command first claims the names that it will write (`claim`). Later it writes its files into a new
folder beside the target, which replaces the target in one step (`staged`). `storage.mark` records
which files the program made.
"""

from __future__ import annotations

import fcntl
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath

from soup_nlp.errors import DataError
from soup_nlp.storage.atomic import PathLike
from soup_nlp.storage.files import is_folder
from soup_nlp.storage.mark import (
    MARK,
    adopt,
    digest_of,
    files_in,
    is_foreign,
    made_files,
    subject_of,
    write_mark,
)
from soup_nlp.storage.system import deferred_signals, exchange

_STAGE = ".soup_nlp-"
"""Part of the names of temporary folders."""
_COMMIT = f"{_STAGE}commit"
"""Folder of complete new files that are being moved to their places."""


_made: list[Path] = []
"""Folders that `claim` has made in this process."""


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
    try:
        target = Path(folder).resolve()
        with deferred_signals():
            fresh = [p for p in (target, *target.parents) if not os.path.lexists(p)]
            target.mkdir(parents=True, exist_ok=True)
            _made.extend(reversed(fresh))
            recover(target)
            _sweep(_left_behind(target))
            stage, lock = _new_stage(target)
            _drop(stage, lock)
            if made_files(target) is None:
                # an early version did not list its files
                adopt(target, [n for n in names if (target / n).is_file()])
        foreign = [name for name in names if is_foreign(target, name)]
    except (OSError, RuntimeError, ValueError) as error:
        raise _unwritable(folder, error) from error
    before = subject_of(target)
    if subject and before not in ("", subject) and not overwrite:
        raise DataError(
            "output folder holds the result of something else",
            where=folder,
            found=before,
            expected=subject,
            hint="choose another --out, or --overwrite",
        )
    if foreign and not overwrite:
        raise _clash(folder, foreign)
    if foreign:
        adopt(target, foreign)
    return Path(folder)


@contextmanager
def staged(
    folder: PathLike, whole: bool = False, overwrite: bool = False, subject: str = ""
) -> Iterator[Path]:
    """An empty folder whose files are moved into `folder` when the block ends without exception.

    On an exception `folder` does not change. If it holds only files of the program and the file
    system can exchange two folders, the new files replace the old ones in one step. Otherwise they
    are moved one after the other, and `recover` finishes what a killed process has begun.

    Args:
        folder: The output folder.
        whole: The new files are a complete result: files of an earlier result are removed.
        overwrite: Overwrite files that the program did not make.
        subject: What the files are the result of; nothing leaves what the folder says.

    Raises:
        DataError: a file cannot be written, or a file of the user has the name of a new one.
    """
    try:
        target = Path(folder).resolve()
        with deferred_signals():
            target.mkdir(parents=True, exist_ok=True)
            recover(target)
            stage, lock = _new_stage(target)
    except (OSError, RuntimeError, ValueError) as error:
        raise _unwritable(folder, error) from error
    try:
        yield stage
        with deferred_signals():
            _commit(stage, target, whole, overwrite, subject)
    except DataError as error:
        # name the final path instead of the temporary one
        if not isinstance(error.where, Path) or not error.where.is_relative_to(stage):
            raise
        place = target / error.where.relative_to(stage)
        raise DataError(error.what, where=place, found=error.found, hint=error.hint) from error
    except OSError as error:
        raise _unwritable(folder, error) from error
    finally:
        _drop(stage, lock)


@contextmanager
def scratch() -> Iterator[Path]:
    """A folder for temporary files, removed at the end, or by a later call if this one is killed.

    Raises:
        DataError: the folder cannot be made.
    """
    root = Path(tempfile.gettempdir())
    prefix = f"soup_nlp-{os.getuid()}-"
    try:
        with deferred_signals():
            _sweep(root.glob(f"{prefix}*"))
            folder = Path(tempfile.mkdtemp(prefix=prefix, dir=root))
            lock = _lock(folder)
    except OSError as error:
        raise DataError(
            "no temporary folder can be made", where=root, found=error.strerror, hint="set TMPDIR"
        ) from error
    try:
        yield folder
    finally:
        _drop(folder, lock)


def recover(folder: Path) -> None:
    """Finish moving new files into a folder, if a killed process has begun it."""
    commit = folder / _COMMIT
    if not is_folder(commit) or commit.is_symlink():
        return
    lock = os.open(commit, os.O_RDONLY)
    try:
        # another process may be moving the files
        fcntl.flock(lock, fcntl.LOCK_EX)
        if commit.is_dir():
            _move_in(commit, folder)
    finally:
        os.close(lock)


def _below(folder: Path, top: str) -> list[str]:
    """Names of a file, or of all files below a folder, as seen from its parent."""
    path = folder / top
    if path.is_symlink() or not path.is_dir():
        return [top]
    return [f"{top}/{name}" for name in files_in(path)]


def _clash(folder: PathLike, names: Iterable[str]) -> DataError:
    return DataError(
        "output folder holds files that would be overwritten and that this program did not"
        " make, or that were changed since",
        where=folder,
        found=", ".join(names),
        expected="a new or empty folder, or that of an earlier result",
        hint="choose another --out, or --overwrite",
    )


def _unwritable(folder: PathLike, error: Exception) -> DataError:
    reason = error.strerror if isinstance(error, OSError) and error.strerror else error
    return DataError(
        "output folder cannot be written",
        where=folder,
        found=reason,
        hint="choose another --out, or make room where the disk is full",
    )


def _new_stage(target: Path) -> tuple[Path, int]:
    """A new temporary folder beside the target, or in it if they cannot be exchanged."""
    name = f".{target.name[:64]}{_STAGE}"
    places = [(target.parent, name), (target, _STAGE)]
    if os.path.ismount(target) or _inside(target):
        del places[0]
    for parent, prefix in places:
        try:
            stage = Path(tempfile.mkdtemp(prefix=prefix, dir=parent))
        except OSError:
            if parent == target:
                raise
            continue
        shutil.copymode(target, stage)
        lock = _lock(stage)
        return stage, lock
    raise AssertionError("unreachable")


def _inside(target: Path) -> bool:
    """Whether the working folder of this process is in the target, which must then stay."""
    with suppress(OSError):
        return Path.cwd().is_relative_to(target)
    return True


def _lock(folder: Path) -> int:
    """Lock a folder, so that no other process treats it as left behind."""
    handle = os.open(folder, os.O_RDONLY)
    with suppress(OSError):
        # some network file systems have no locks
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    return handle


def _drop(stage: Path, lock: int) -> None:
    """Remove a temporary folder."""
    with deferred_signals():
        shutil.rmtree(stage, ignore_errors=True)
        os.close(lock)


def _left_behind(target: Path) -> list[Path]:
    """Temporary folders of a target that other processes have made."""
    own = f".{target.name[:64]}{_STAGE}"
    beside = [p for p in target.parent.iterdir() if p.name.startswith(own)]
    return beside + [p for p in target.iterdir() if p.name.startswith(_STAGE) and p.name != _COMMIT]


def _sweep(paths: Iterable[Path]) -> None:
    """Remove temporary folders whose process has ended, so that nobody locks them."""
    for path in paths:
        with suppress(OSError):
            handle = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(path, ignore_errors=True)
            finally:
                os.close(handle)


def _commit(stage: Path, target: Path, whole: bool, overwrite: bool, subject: str) -> None:
    """Move the files of a temporary folder to their places."""
    new = {name: digest_of(stage / name) for name in files_in(stage)}
    clash = [name for name in new if is_foreign(target, name)]
    if clash and not overwrite:
        raise _clash(target, clash)
    if clash:
        adopt(target, clash)
    listed = made_files(target) or {}
    tops = {PurePosixPath(name).parts[0] for name in [*new, *listed]}
    there = {path.name for path in target.iterdir()} - {MARK, stage.name}
    here = {name for top in there & tops for name in _below(target, top)}
    old = {k: v for k, v in listed.items() if k in here and not is_foreign(target, k)}
    write_mark(stage, new if whole else old | new, subject or subject_of(target))
    for name in here & new.keys():
        shutil.copymode(target / name, stage / name)
    _sync(stage)
    # whether the target holds only files of the program
    alone = there <= tops and here <= (old | new if whole else new).keys()
    if alone and stage.parent == target.parent and exchange(stage, target):
        return
    commit = target / _COMMIT
    try:
        os.rename(stage, commit)
    except OSError:
        # another file system is mounted at the target
        near = Path(tempfile.mkdtemp(prefix=_STAGE, dir=target))
        shutil.copytree(stage, near, dirs_exist_ok=True)
        _sync(near)
        os.rename(near, commit)
    _move_in(commit, target)


def _move_in(commit: Path, target: Path) -> None:
    """Move complete new files to their places and remove old ones; may be repeated."""
    new, old = made_files(commit), made_files(target)
    for name in (old or {}).keys() - (new or {}).keys():
        if os.path.lexists(target / name) and not is_foreign(target, name):
            (target / name).unlink()
            with suppress(OSError):
                # removes empty folders only
                os.removedirs((target / name).parent)
    for name in files_in(commit):
        (target / name).parent.mkdir(parents=True, exist_ok=True)
        os.replace(commit / name, target / name)
    if (commit / MARK).exists():
        os.replace(commit / MARK, target / MARK)
    shutil.rmtree(commit)


def _sync(folder: Path) -> None:
    """Wait until the files are on disk; some systems report a full disk only here."""
    for name in [*files_in(folder), MARK]:
        with (folder / name).open("rb") as file:
            os.fsync(file.fileno())
