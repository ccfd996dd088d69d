"""Helpers of dataset loaders: required and optional files, recognition of result folders."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

from soup_nlp.data.formats.images import read_image
from soup_nlp.data.pair import Float, Pair, Truth
from soup_nlp.errors import DataError
from soup_nlp.storage.files import PathLike, as_path, is_file, is_folder, read_json
from soup_nlp.storage.mark import MARK

T = TypeVar("T")


def need(path: PathLike, layout: str) -> Path:
    """The path, if it is a file; `layout` is the expected layout for the message.

    Raises:
        DataError: the file is missing; the message names the first missing folder.
    """
    path = as_path(path)
    if is_file(path):
        return path
    folder = path.parent
    while not is_folder(folder) and folder != folder.parent:
        folder = folder.parent
    raise DataError(
        "file of the dataset is missing",
        where=path,
        found=f"{folder} has no {path.relative_to(folder).parts[0]}",
        expected=layout,
        hint="check the root folder and the frame, or rearrange the files to this layout",
    )


def need_folder(path: PathLike, layout: str) -> Path:
    """The path, if it is a folder.

    Raises:
        DataError: it is no folder.
    """
    path = as_path(path, "dataset folder")
    if not is_folder(path):
        raise DataError(
            "dataset folder is missing",
            where=path,
            found="a file" if is_file(path) else "nothing",
            expected=f"a folder with {layout}",
        )
    return path


def training_folder(root: PathLike, layout: str) -> Path:
    """The folder `training` of a dataset, or the root if it has no such folder.

    Raises:
        DataError: the root is not a folder.
    """
    root = need_folder(root, layout)
    return root / "training" if is_folder(root / "training") else root


def read_if(reader: Callable[..., T], path: Path | None, *options: object) -> T | None:
    """Contents of an optional file; None if there is no such file."""
    return reader(path, *options) if path is not None and is_file(path) else None


def make_pair(
    images: Sequence[Path],
    cameras: Sequence[Float],
    truth: Truth,
    name: str,
    white: int | None = None,
    *,
    turn: bool = False,
) -> Pair:
    """The pair of two image files; its truth is None if no part of it is known.

    Args:
        images: Reference and next image.
        cameras: (3, 3) intrinsics of both frames, pixels.
        truth: Truth from its files.
        name: Name of the pair.
        white: Value of white in a 16-bit image, see `read_image`.
        turn: Rotate images by their EXIF orientation, see `read_image`.

    Raises:
        DataError: an image is damaged, or the truth has another size.
    """
    ref, following = (read_image(path, white, turn=turn) for path in images)
    K_ref, K_next = cameras
    return Pair(ref, following, K_ref, K_next, truth=truth if truth.known() else None, name=name)


def is_result(folder: Path) -> bool:
    """Whether a folder holds a result: it has the mark, or a summary.json of a solve."""
    if is_file(folder / MARK):
        return True
    try:
        summary = read_json(folder / "summary.json", "summary.json")
    except DataError:
        return False
    return isinstance(summary, dict) and "problem_hash" in summary
