"""Conversion of images, cameras and flows, as callers may give them, to checked arrays.

What cannot be converted is a DataError.
"""

import os
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float, Image
from soup_nlp.data.formats.camera_files import check_intrinsics, read_intrinsics
from soup_nlp.data.formats.images import read_image
from soup_nlp.data.formats.map_files import known_depth, read_prior
from soup_nlp.errors import DataError, printable, repr_of
from soup_nlp.geometry.camera import intrinsics
from soup_nlp.schema.section import check_image_size

ImageLike: TypeAlias = Any
"""An array (H, W), (H, W, C) or (C, H, W) with 1, 3 or 4 channels, of 8 bits or of floats from 0 to
1, a file, or a PIL image."""
CameraLike: TypeAlias = Any
"""A 3x3 matrix, four numbers (fx, fy, cx, cy) in pixels, or a file with one of these."""
FlowLike: TypeAlias = Any
"""Displacements in pixels, (H, W, 2) or (2, H, W), or a file (.flo, KITTI .png, .npy)."""

_PICTURES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX", "CMYK", "YCbCr", "LAB", "HSV")
"""Modes of PIL images of 8 bits or fewer a channel."""


def is_path(value: object) -> bool:
    """Whether the argument is the path of a file."""
    return isinstance(value, str | os.PathLike)


def image_of(source: ImageLike, where: str) -> Image:
    """(H, W, 3) uint8 RGB of an array, a file or a PIL image; grey is repeated, alpha dropped."""
    if is_path(source):
        return read_image(Path(source))
    if hasattr(source, "convert") and getattr(source, "mode", None) in _PICTURES:
        source = source.convert("RGB")
    expected = "uint8 (H, W, 3) array, path or PIL image"
    image = array_of(source, "image", where, expected, kinds="fiub")
    if image.ndim == 2:
        image = image[:, :, None]
    elif image.ndim == 3 and image.shape[0] in (1, 3, 4) and image.shape[2] not in (1, 3, 4):
        image = np.moveaxis(image, 0, 2)
    if image.dtype.kind == "f" and image.size and image.min() >= 0 and image.max() <= 1:
        image = np.rint(255 * image.astype(np.float64)).astype(np.uint8)
    if image.ndim != 3 or image.shape[2] not in (1, 3, 4) or image.dtype != np.uint8:
        floats = image.dtype.kind == "f"
        raise DataError(
            "image must be 8-bit RGB, or floats from 0 to 1",
            where=where,
            found=f"{image.dtype} {np.shape(source)}",
            expected="uint8 (H, W, 3)",
            hint="image / 255, if its values are 0 to 255" if floats else None,
        )
    check_image_size(image.shape[1], image.shape[0], "image", where)
    image = np.repeat(image, 3, axis=2) if image.shape[2] == 1 else image[:, :, :3]
    return np.ascontiguousarray(image)


def camera_of(source: CameraLike, where: str) -> Float:
    """(3, 3) intrinsics from a matrix, from (fx, fy, cx, cy), or from a file."""
    if is_path(source):
        return read_intrinsics(Path(source))
    numbers = array_of(source, "intrinsics", where, "(3, 3), or fx, fy, cx, cy")
    return check_intrinsics(intrinsics(*numbers) if numbers.shape == (4,) else numbers, where)


def prior_of(source: object) -> Float:
    """(H, W) values of a depth prior or its file, NaN where they are not positive and finite."""
    if is_path(source):
        return read_prior(Path(str(source)))
    values = array_of(source, "depth prior", "prior", "numbers (H, W), or a path")
    return known_depth(values, "prior")


def array_of(
    value: object,
    what: str,
    where: str,
    expected: str,
    kinds: str = "fiu",
    axes: str = "",
    hint: str | None = None,
) -> NDArray[Any]:
    """An object as NumPy array; DataError if it is none, or of another kind of numbers or shape.

    `kinds` are the accepted kinds of NumPy's data types, a letter each; `axes` is the shape, such
    as "(H, W, 2)", any if empty. The other arguments are for the message.
    """
    try:
        array = np.asarray(value)
    except (TypeError, ValueError, RuntimeError, OverflowError):
        array = np.empty(0, object)
    sizes = axes.strip("()").split(", ") if axes else [str(size) for size in array.shape]
    fits = array.ndim == len(sizes) and all(
        str(size) == wanted for size, wanted in zip(array.shape, sizes) if wanted.isdigit()
    )
    if array.dtype.kind not in kinds or not fits:
        shown = f"{type(value).__name__} {printable(repr_of(value), 60)}"
        if array.dtype.kind in "fiub":
            shown = f"{array.dtype} {array.shape}"
        what = f"{what} is no array of its kind"
        raise DataError(what, where=where, found=shown, expected=expected, hint=hint)
    return array
