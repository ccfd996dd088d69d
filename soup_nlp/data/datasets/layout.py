"""What dataset loaders share: required files, and truth that may be absent."""

from __future__ import annotations

import json
from pathlib import Path

from soup_nlp.data.formats.images import PathLike
from soup_nlp.data.pair import Truth
from soup_nlp.errors import DataError


def need(path: PathLike, layout: str) -> Path:
    """The path, if it is a file.

    Args:
        path: A file that a loader cannot do without.
        layout: The layout that the loader expects, for the message.

    Raises:
        DataError: the file is missing; the message names the first folder that is missing too.
    """
    path = Path(path)
    if path.is_file():
        return path
    folder = path.parent
    while not folder.is_dir() and folder != folder.parent:
        folder = folder.parent
    if folder == path.parent:
        found = f"{folder} has no {path.name}"
    else:
        found = f"{folder} has no {path.relative_to(folder).parts[0]}"
    raise DataError(
        "file of the dataset is missing",
        where=path,
        found=found,
        expected=layout,
        hint="check the root folder and the frame, or rearrange the files to this layout",
    )


def need_folder(path: PathLike, layout: str) -> Path:
    """The path, if it is a folder.

    Raises:
        DataError: it is not.
    """
    path = Path(path)
    if not path.is_dir():
        raise DataError(
            "dataset folder is missing",
            where=path,
            found="a file" if path.is_file() else "nothing",
            expected=f"a folder with {layout}",
        )
    return path


MARK = ".soup_nlp"
"""Empty file by which a folder is known as one for results, from before its first file on."""


def is_result(folder: Path) -> bool:
    """Whether a folder is for results: it has the mark, or a summary that names its problem."""
    if (folder / MARK).is_file():
        return True
    try:
        summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False
    return isinstance(summary, dict) and "problem_hash" in summary


def optional(path: Path) -> Path | None:
    """The path if it is a file, else None."""
    return path if path.is_file() else None


def truth_or_none(truth: Truth) -> Truth | None:
    """The truth, or None when nothing in it is known."""
    parts = (value for name, value in vars(truth).items() if name != "unit")
    return truth if any(value is not None for value in parts) else None
