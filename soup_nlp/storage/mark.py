"""The hidden file MARK: a list of the files in a folder that the program made, with their SHA-256.

A file that is not listed, or that was changed, belongs to the user. The mark also says what the
folder is the result of.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

from soup_nlp.errors import DataError
from soup_nlp.storage.atomic import write_text

MARK = ".soup_nlp"
"""Hidden file of a folder with results: JSON, SHA-256 by name of every file that was made."""

SUBJECT = "of"
"""Key of the mark: what the folder is the result of."""


def made_files(folder: Path) -> dict[str, str]:
    """SHA-256 by name of the files that the program made in a folder; {} without a valid mark."""
    return _read(folder)[0]


def subject_of(folder: Path) -> str:
    """What a folder is the result of; nothing if its mark does not say it."""
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
    """Check that files may be written; with `overwrite`, list those of the user in the mark.

    Raises:
        DataError: the folder holds files of the user with these names and `overwrite` is not set,
            or a folder with one of them.
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
        if path.is_dir() and not path.is_symlink():
            raise DataError("cannot write a file over a folder", where=path)
        if path.is_symlink():
            # remove the link but not its target
            path.unlink()
    digests = {name: digest_of(folder / name) for name in foreign if (folder / name).is_file()}
    write_mark(folder, made_files(folder) | digests)


def write_mark(folder: Path, files: dict[str, str], subject: str = "") -> None:
    """Write the mark of a folder: SHA-256 by name of the files that the program made.

    A mark without a new `subject` keeps the earlier one.
    """
    subject = subject or subject_of(folder)
    contents = ({SUBJECT: subject} if subject else {}) | {"files": dict(sorted(files.items()))}
    write_text(folder / MARK, json.dumps(contents, indent=1) + "\n")
