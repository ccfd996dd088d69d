"""Reading of images, and checks that the readers of all formats share.

Every reader raises `DataError` for a file that is missing, empty, truncated or of another kind.
"""

from __future__ import annotations

import contextlib
import io
import warnings
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image

from soup_nlp.arrays import Mask
from soup_nlp.errors import DataError
from soup_nlp.schema.limits import MAX_PIXELS, check_image_size
from soup_nlp.storage.files import PathLike, read_bytes

DARK = 65535 // 3
"""A 16-bit image with a smaller largest value may hold fewer bits."""

SHOWN = cv2.IMREAD_COLOR | cv2.IMREAD_ANYDEPTH
"""OpenCV flags that rotate an image by its EXIF orientation."""


class DataWarning(UserWarning):
    """An input can be used, but it may not be what the user expects."""


def check_body(found: int, expected: int, path: PathLike, what: str) -> None:
    """Raise DataError unless a file body has the number of bytes given by its header."""
    if found != expected:
        problem = "is truncated" if found < expected else "has bytes left over"
        raise DataError(
            f"{what} {problem}",
            where=path,
            found=f"{found} bytes after the header",
            expected=f"{expected} bytes",
            hint="copy or download the file again",
        )


def decode(path: PathLike, what: str, flags: int = cv2.IMREAD_UNCHANGED) -> NDArray[Any]:
    """Decode an image file to BGR or BGRA with flags of OpenCV; by default it keeps all bits."""
    content = read_bytes(path, what)
    png = content.startswith(b"\x89PNG\r\n\x1a\n") and b"IEND" not in content
    last_scan, end = content.rfind(b"\xff\xda"), content.rfind(b"\xff\xd9")
    if png or (content.startswith(b"\xff\xd8") and end < last_scan):
        # OpenCV would decode the first part without an error
        raise DataError(
            f"{what} is truncated",
            where=path,
            found=f"a {'PNG' if png else 'JPEG'} without its end marker",
            hint="copy or download the file again",
        )
    _check_header(content, path, what)
    image = None
    with contextlib.suppress(cv2.error):
        image = cv2.imdecode(np.frombuffer(content, np.uint8), flags)
    if image is None:
        raise DataError(
            f"{what} cannot be decoded",
            where=path,
            found=f"{len(content)} bytes that start with {content[:8]!r}",
            expected="an image file that OpenCV reads (PNG, JPEG, TIFF, PPM ...)",
            hint="the file may be damaged; try to open it in an image viewer",
        )
    return np.asarray(image)


def _check_header(content: bytes, path: PathLike, what: str) -> None:
    """Raise DataError if the size in the header of an image exceeds the limits.

    A small file can have many pixels of one colour, so the pixels are not decoded here.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            with Image.open(io.BytesIO(content)) as header:
                width, height = header.size
        except Image.DecompressionBombError as error:
            raise DataError(
                f"{what} has an impossible size",
                where=path,
                found=error,
                expected=f"at most {MAX_PIXELS} pixels",
            ) from None
        except Exception:  # OpenCV may read formats that Pillow does not
            return
    check_image_size(width, height, what, path)


def decode_png16(path: PathLike, channels: int, what: str) -> NDArray[np.uint16]:
    """Decode a 16-bit PNG: (H, W) for one channel, (H, W, 3) in BGR order for three."""
    image = decode(path, what)
    found = 1 if image.ndim == 2 else image.shape[2]
    if image.dtype != np.uint16 or found != channels:
        raise DataError(
            f"{what} is not of the expected kind",
            where=path,
            found=f"{image.dtype} with {found} channel(s)",
            expected=f"16-bit PNG with {channels} channel(s)",
            hint="an 8-bit or colour-coded picture of the data does not hold the values",
        )
    return image


def exif_orientation(path: PathLike) -> int:
    """EXIF orientation of an image file, 1 to 8; 1 (as stored) if it has none."""
    try:
        with Image.open(io.BytesIO(read_bytes(path, "image"))) as image:
            found = image.getexif().get(ExifTags.Base.Orientation, 1)
    except DataError:
        raise
    except Exception:  # OpenCV may read formats that Pillow does not
        return 1
    return found if found in range(1, 9) else 1


def read_image(
    path: PathLike, white: int | None = None, *, turn: bool = False
) -> NDArray[np.uint8]:
    """Read a picture as 8-bit RGB.

    8 and 16 bit, grey, RGB and RGBA are accepted. Grey is repeated in the three channels, and alpha
    is dropped. 16-bit values v become round(255 v / white), clipped to 255. An image with an EXIF
    rotation is rejected unless `turn` is set, since its camera may be that of either orientation.

    Args:
        path: Image file (PNG, JPEG, TIFF, PPM ...).
        white: Value of a 16-bit image that becomes 255, such as 4095 for 12-bit images; None for
            65535.
        turn: Rotate the image by its EXIF orientation, as viewers do.

    Returns:
        (H, W, 3) uint8 RGB image, indexed [v, u].

    Raises:
        DataError: the file is damaged, of another kind, or has an EXIF rotation without `turn`.

    Warns:
        DataWarning: no `white` is given and a 16-bit image is dark throughout.
    """
    orientation = exif_orientation(path)
    if orientation != 1 and not turn:
        raise DataError(
            "image is stored turned, and its camera is given",
            where=path,
            found=f"EXIF orientation {orientation}",
            expected="pixels stored upright: the camera's axes are unclear otherwise",
            hint="save it upright (Pillow: ImageOps.exif_transpose), or leave the intrinsics out:"
            " soup-nlp then turns it",
        )
    image = decode(path, "image", cv2.IMREAD_UNCHANGED if orientation == 1 else SHOWN)
    if image.ndim == 2:
        image = image[:, :, None]
    channels = image.shape[2]
    if channels not in (1, 3, 4):
        raise DataError(
            "image has an unusual number of channels",
            where=path,
            found=channels,
            expected="1 (grey), 3 (RGB) or 4 (RGBA)",
        )
    if image.dtype == np.uint16:
        image = _to_8_bit(image, white, path)
    elif image.dtype != np.uint8:
        raise DataError(
            "image is neither 8-bit nor 16-bit",
            where=path,
            found=image.dtype,
            expected="uint8 or uint16",
            hint="convert it to an 8-bit PNG first",
        )
    rgb = np.repeat(image, 3, axis=2) if channels == 1 else image[:, :, 2::-1]
    return np.ascontiguousarray(rgb)


def _to_8_bit(image: NDArray[np.uint16], white: int | None, path: PathLike) -> NDArray[np.uint8]:
    """round(255 v / white), clipped to 255; warns if `white` is None and the image is dark."""
    largest = int(image.max())
    if white is None and 0 < largest < DARK:
        # only a warning, since the scene may be dark
        full = 2 ** largest.bit_length() - 1
        warnings.warn(
            f"{path}: 16-bit image is dark, its largest value is {largest} of 65535; if its"
            f" white is {full}, say so by the key white of the input (white: {full})",
            DataWarning,
            stacklevel=3,
        )
    return np.minimum(np.rint(image * (255.0 / (white or 65535))), 255).astype(np.uint8)


def read_mask(path: PathLike) -> Mask:
    """Read a black-and-white picture as (H, W) bool, True above half of the range."""
    return np.asarray(read_image(path, white=65535)[:, :, 0] > 127)
