"""Output folders: all files of a command appear at once, and no file of the user is overwritten.

A command first checks the names that it will write (`claim`). Later it writes its files into a
hidden folder in the target (`staged`). One rename gives that folder its mark; its files are then
renamed to their places. After a kill, a later call finishes the renaming (`recover`).

The hidden file MARK lists the files in a folder that the program made, with their SHA-256. A file
that is not listed, or that was changed, belongs to the user. The mark also has the subject of the
result, such as the frames that were solved.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath

import psutil

from soup_nlp.errors import DataError
from soup_nlp.storage.files import PathLike, as_path, atomic_path
from soup_nlp.storage.system import deferred_signals

MARK = ".soup_nlp"
"""Hidden file of a folder with results: JSON, SHA-256 by name of every file that was made."""

SUBJECT = "of"
"""Key of the mark for the subject of the result."""


def made_files(folder: Path) -> dict[str, str]:
    """SHA-256 by name of the files that the program made in a folder; {} without a valid mark."""
    return _read(folder)[0]


def subject_of(folder: Path) -> str:
    """Subject of the result in a folder; empty if its mark has none."""
    return _read(folder)[1]


def _read(folder: Path) -> tuple[dict[str, str], str]:
    """Files and subject of the mark of a folder."""
    path = folder / MARK
    try:
        if path.is_symlink() or not path.is_file():
            return {}, ""
        mark = json.loads(path.read_text(encoding="utf-8"))
        # a damaged mark must not name files outside the folder
        inside = [n for n in mark["files"] if not PurePosixPath(n).is_absolute() and ".." not in n]
        return {str(n): str(mark["files"][n]) for n in inside}, str(mark.get(SUBJECT, ""))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return {}, ""


def files_in(folder: Path) -> list[str]:
    """Names of all files below a folder, without the mark."""
    paths = [path for path in folder.rglob("*") if not path.is_dir() or path.is_symlink()]
    return sorted(p.relative_to(folder).as_posix() for p in paths if p != folder / MARK)


def digest_of(path: Path) -> str:
    """SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def is_foreign(folder: Path, name: str) -> bool:
    """Whether a folder holds something under this name that the program did not make."""
    path = folder / name
    above = [folder / parent for parent in PurePosixPath(name).parents][:-1]
    if any(os.path.lexists(p) and (p.is_symlink() or not p.is_dir()) for p in above):
        return True
    if not os.path.lexists(path):
        return False
    if path.is_symlink() or not path.is_file():
        return True
    return made_files(folder).get(name) != digest_of(path)


def release(folder: Path, names: Iterable[str], overwrite: bool) -> None:
    """Check that files may be written; with `overwrite`, list files of the user in the mark.

    Raises:
        DataError: the folder holds files of the user with these names and `overwrite` is not set,
            or a folder of one of these names.
    """
    foreign = [name for name in names if is_foreign(folder, name)]
    if not foreign:
        return
    if not overwrite:
        raise DataError(
            "output folder holds files that would be overwritten and that this program did not"
            " make, or that were changed since",
            where=folder,
            found=", ".join(foreign),
            expected="a new or empty folder, or that of an earlier result",
            hint="choose another --out, or --overwrite",
        )
    for path in (folder / name for name in foreign):
        if path.is_symlink():
            # remove the link but not its target
            path.unlink()
        elif path.is_dir():
            raise DataError("cannot write a file over a folder", where=path)
    digests = {name: digest_of(folder / name) for name in foreign if (folder / name).is_file()}
    write_mark(folder, made_files(folder) | digests)


def write_mark(folder: Path, files: dict[str, str], subject: str = "") -> None:
    """Write the mark of a folder: SHA-256 by name of the files that the program made.

    A mark without a new `subject` keeps the earlier one.
    """
    subject = subject or subject_of(folder)
    contents = ({SUBJECT: subject} if subject else {}) | {"files": dict(sorted(files.items()))}
    with atomic_path(folder / MARK) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write(json.dumps(contents, indent=1) + "\n")
        file.flush()
        # on disk before it becomes the mark, as the files that it lists
        os.fsync(file.fileno())


_STAGE = f"{MARK}-"
"""First part of the names of temporary folders; the number of their process follows. A temporary
folder with a mark is complete: its files are being moved to their places."""

_open: set[Path] = set()
"""Temporary folders that this process is filling."""


def default_folder(name: str, subject: str) -> Path:
    """`out/NAME`, or the first of `out/NAME-2`, ... that holds no result of another subject."""
    k = 1
    while True:
        folder = Path("out") / (name if k == 1 else f"{name}-{k}")
        if subject_of(folder) in ("", subject):
            return folder
        k += 1


def claim(
    folder: PathLike, names: Iterable[str], overwrite: bool = False, subject: str = ""
) -> Path:
    """Check that these files may be written into an output folder, and return it.

    A missing folder is not made yet. Moves that a killed process has begun are finished, and its
    temporary folders are removed.

    Args:
        folder: The output folder.
        names: Files that will be written.
        overwrite: Treat existing files of these names as files of the program, and replace the
            result of another subject.
        subject: Subject of the new result, see `subject_of`.

    Raises:
        DataError: the folder cannot be written, holds a file of the user with one of the names, or
            is the result of another subject.
    """
    with _named_errors(folder):
        target = Path(os.path.realpath(as_path(folder, "output folder")))
        existing = next(p for p in (target, *target.parents) if os.path.lexists(p))
        # fails where nothing can be written
        with tempfile.TemporaryFile(dir=existing):
            recover(target)
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

    On an exception the files of `folder` do not change, and no new folder is left.

    Args:
        folder: The output folder.
        whole: The new files are a complete result: files of an earlier result are removed.
        overwrite: Overwrite files that the program did not make.
        subject: Subject of the new result; empty for that of the earlier result.

    Raises:
        DataError: a file cannot be written, or a file of the user has the name of a new one.
    """
    with _named_errors(folder):
        target = Path(os.path.realpath(as_path(folder, "output folder")))
        fresh = [p for p in (target, *target.parents) if not os.path.lexists(p)]
        target.mkdir(parents=True, exist_ok=True)
        recover(target)
        try:
            with _temporary(target, _STAGE) as stage:
                yield stage
                with deferred_signals():
                    _commit(stage, target, whole, overwrite, subject or subject_of(target))
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


@contextmanager
def scratch() -> Iterator[Path]:
    """A folder for temporary files, removed at the end, or after a kill by a later call.

    Raises:
        DataError: the folder cannot be made.
    """
    root = Path(tempfile.gettempdir())
    try:
        with _temporary(root, f"soup_nlp-{os.getuid()}-") as folder:
            yield folder
    except OSError as error:
        raise DataError(
            "no temporary folder can be made", where=root, found=error.strerror, hint="set TMPDIR"
        ) from error


def recover(folder: Path) -> None:
    """Finish moving new files into a folder and remove temporary folders, if a kill left them."""
    for stage in folder.glob(f"{_STAGE}*"):
        if (stage / MARK).is_file() and not stage.is_symlink():
            _move_in(stage, folder)
    _sweep(folder, _STAGE)


@contextmanager
def _temporary(parent: Path, prefix: str) -> Iterator[Path]:
    """A temporary folder with the number of this process in its name; with a mark, it is kept."""
    _sweep(parent, prefix)
    with deferred_signals():
        folder = Path(tempfile.mkdtemp(prefix=f"{prefix}{os.getpid()}-", dir=parent))
        _open.add(folder)
    try:
        yield folder
    finally:
        with deferred_signals():
            if not (folder / MARK).is_file():
                shutil.rmtree(folder, ignore_errors=True)
            _open.discard(folder)


def _sweep(parent: Path, prefix: str) -> None:
    """Remove temporary folders of ended processes, also if this process has the same number."""
    for path in parent.glob(f"{prefix}*"):
        number = re.match(r"(\d{1,9})-", path.name.removeprefix(prefix))
        if number is None or path in _open:
            continue
        if int(number[1]) == os.getpid() or not psutil.pid_exists(int(number[1])):
            shutil.rmtree(path, ignore_errors=True)


def _commit(stage: Path, target: Path, whole: bool, overwrite: bool, subject: str) -> None:
    """Mark the files of a temporary folder as complete and move them to their places."""
    new = {name: digest_of(stage / name) for name in files_in(stage)}
    release(target, new, overwrite)
    old = {k: v for k, v in made_files(target).items() if not is_foreign(target, k)}
    for name in old.keys() & new.keys():
        # a file of the program may have been removed
        with suppress(FileNotFoundError):
            shutil.copymode(target / name, stage / name)
    for name in new:
        # wait until the file is on disk: some systems report a full disk only here
        with (stage / name).open("rb") as file:
            os.fsync(file.fileno())
    # from here on, the new files are the result
    write_mark(stage, new if whole else old | new, subject)
    _move_in(stage, target)


def _move_in(stage: Path, target: Path) -> None:
    """Move complete new files to their places and remove old ones; may be repeated."""
    for name in made_files(target).keys() - made_files(stage).keys():
        if os.path.lexists(target / name) and not is_foreign(target, name):
            (target / name).unlink(missing_ok=True)
            with suppress(OSError):
                # removes empty folders only
                os.removedirs((target / name).parent)
    # another process may be finishing the same moves
    with suppress(FileNotFoundError):
        # the mark is moved last: without it, every file was moved
        for name in [*files_in(stage), MARK]:
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            os.replace(stage / name, target / name)
    shutil.rmtree(stage, ignore_errors=True)


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
