"""Images, and the byte-level helpers that every format shares."""

from __future__ import annotations

import os
import tempfile
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from soup_nlp.errors import DataError

PathLike = str | os.PathLike[str]

MAX_SIDE = 100_000
"""Largest width or height that a header may claim, pixels; more is taken for a damaged file."""

DARK = 65535 // 3
"""A 16-bit image whose largest value is below this is taken for one that may hold fewer bits."""


class DataWarning(UserWarning):
    """An input can be used, but may not be what it seems."""


def read_bytes(path: PathLike, what: str) -> bytes:
    """The content of a file.

    Args:
        path: The file.
        what: Name of the content for the message, e.g. "flow file".

    Raises:
        DataError: the file is missing, a folder, empty, or not readable.
    """
    path = Path(path)
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise DataError(
            f"{what} is missing", where=path, expected="an existing file", hint=_near(path)
        ) from None
    except OSError as error:
        raise DataError(
            f"{what} cannot be read", where=path, found=error.strerror, expected="a readable file"
        ) from error
    if not content:
        raise DataError(f"{what} is empty", where=path, found="0 bytes")
    return content


def _near(path: Path) -> str:
    """A hint that names what the folder does hold."""
    if not path.parent.is_dir():
        return f"the folder {path.parent} does not exist; check the path"
    names = sorted(p.name for p in path.parent.iterdir())
    shown = ", ".join(names[:6]) + (" ..." if len(names) > 6 else "")
    return f"check the name; the folder holds: {shown or 'nothing'}"


def read_text(path: PathLike, what: str) -> str:
    """The content of a UTF-8 text file.

    Raises:
        DataError: as `read_bytes`, or the file is not text.
    """
    try:
        return read_bytes(path, what).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise DataError(
            f"{what} is not text", where=path, found="binary content", expected="UTF-8 text"
        ) from None


def write_bytes(path: PathLike, content: bytes) -> None:
    """Write a file whole or not at all: beside its place first, then renamed onto it.

    Raises:
        DataError: the folder does not exist or is not writable.
    """
    path = Path(path)
    beside: str | None = None
    try:
        handle, beside = tempfile.mkstemp(prefix=f".{path.name}.", dir=path.parent)
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        mask = os.umask(0)
        os.umask(mask)
        os.chmod(beside, 0o666 & ~mask)
        os.replace(beside, path)
    except OSError as error:
        if beside is not None:
            Path(beside).unlink(missing_ok=True)
        raise DataError(
            "file cannot be written",
            where=path,
            found=error.strerror,
            expected="an existing, writable folder",
        ) from error


def check_size(width: int, height: int, path: PathLike) -> None:
    """Raise DataError for a width or height that no image has."""
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
        raise DataError(
            "file header claims an impossible size",
            where=path,
            found=f"{width} x {height} (width x height)",
            expected=f"1 to {MAX_SIDE} on each side",
            hint="the file is damaged or of another format",
        )


def check_body(found: int, expected: int, path: PathLike, what: str) -> None:
    """Raise DataError unless a file body has the number of bytes that its header promises."""
    if found != expected:
        problem = "is truncated" if found < expected else "has bytes left over"
        raise DataError(
            f"{what} {problem}",
            where=path,
            found=f"{found} bytes after the header",
            expected=f"{expected} bytes",
            hint="copy or download the file again",
        )


def decode(path: PathLike, what: str) -> NDArray[Any]:
    """Decode an image file without changing its depth or channels (OpenCV order: BGR, BGRA).

    Raises:
        DataError: the file is missing, truncated, or no image.
    """
    content = read_bytes(path, what)
    _check_end(content, path, what)
    try:
        image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error as error:
        raise DataError(
            f"{what} cannot be decoded", where=path, found=str(error).strip()
        ) from error
    if image is None:
        raise DataError(
            f"{what} cannot be decoded",
            where=path,
            found=f"{len(content)} bytes that start with {content[:8]!r}",
            expected="an image file that OpenCV reads (PNG, JPEG, TIFF, PPM ...)",
            hint="the file may be damaged; try to open it in an image viewer",
        )
    return np.asarray(image)


def _check_end(content: bytes, path: PathLike, what: str) -> None:
    """Raise DataError for a PNG or JPEG without its end, which OpenCV would half decode."""
    png = content.startswith(b"\x89PNG\r\n\x1a\n") and b"IEND" not in content
    jpeg = content.startswith(b"\xff\xd8") and content.rfind(b"\xff\xd9") < content.rfind(
        b"\xff\xda"
    )
    if png or jpeg:
        raise DataError(
            f"{what} is truncated",
            where=path,
            found=f"a {'PNG' if png else 'JPEG'} without its end marker",
            hint="copy or download the file again",
        )


def encode_png(path: PathLike, image: NDArray[Any]) -> None:
    """Write an array as PNG, whole or not at all (OpenCV channel order)."""
    try:
        done, content = cv2.imencode(".png", image)
    except cv2.error as error:
        raise DataError("array cannot be written as PNG", where=path, found=str(error)) from error
    if not done:
        raise DataError("array cannot be written as PNG", where=path, found=image.shape)
    write_bytes(path, content.tobytes())


def decode_png16(path: PathLike, channels: int, what: str) -> NDArray[np.uint16]:
    """Decode a 16-bit PNG with a fixed number of channels (1: (H, W), 3: (H, W, 3) in BGR order).

    Raises:
        DataError: the file is missing, damaged, not 16-bit, or has other channels.
    """
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


def load_npy(path: PathLike, what: str) -> NDArray[Any]:
    """Load a plain .npy array (no pickles).

    Raises:
        DataError: the file is missing, truncated, no .npy, or holds no real numbers.
    """
    read_bytes(path, what)
    try:
        array = np.load(Path(path), allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise DataError(
            f"{what} is not a readable .npy file", where=path, found=str(error)
        ) from error
    if not isinstance(array, np.ndarray) or array.dtype.kind not in "fiu":
        raise DataError(
            f"{what} does not hold numbers",
            where=path,
            found=getattr(array, "dtype", type(array).__name__),
            expected="one array of real numbers",
        )
    return array


def parse_numbers(text: str, path: PathLike, what: str) -> list[float]:
    """Numbers of a text, separated by blanks or commas.

    Raises:
        DataError: a word is not a number.
    """
    values = []
    for word in text.replace(",", " ").split():
        try:
            values.append(float(word))
        except ValueError:
            raise DataError(
                f"{what} holds a word that is not a number", where=path, found=repr(word)
            ) from None
    return values


def read_image(path: PathLike, white: int | None = None) -> NDArray[np.uint8]:
    """Read a picture as 8-bit RGB.

    8 and 16 bit, grey, RGB and RGBA are accepted. Grey is repeated in the three channels, alpha is
    dropped (not blended), an EXIF orientation is not applied because it would move pixels against
    the camera. 16-bit values v become round(255 v / white), clipped to 255.

    Args:
        path: Image file (PNG, JPEG, TIFF, PPM ...).
        white: Value of a 16-bit image that becomes 255: 65535 when None; 4095 for 12-bit
            pictures stored in 16 bits, which would come out nearly black otherwise.

    Returns:
        (H, W, 3) uint8 RGB image, indexed [v, u].

    Warns:
        DataWarning: no `white` is given and a 16-bit image is dark throughout.

    Raises:
        DataError: the file is missing, not decodable, or neither 8- nor 16-bit.
    """
    image = decode(path, "image")
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
        if white is None:
            _warn_dark(int(image.max()), path)
        scale = 255.0 / (65535 if white is None else white)
        image = np.minimum(np.rint(image * scale), 255).astype(np.uint8)
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


def _warn_dark(largest: int, path: PathLike) -> None:
    """Say that a 16-bit image may hold fewer bits; it may be a dark scene: nothing is guessed."""
    if 0 < largest < DARK:
        full = 2 ** largest.bit_length() - 1
        warnings.warn(
            f"{path}: 16-bit image is dark, its largest value is {largest} of 65535; if its white"
            f" is {full}, say so by the key white of the input (white: {full})",
            DataWarning,
            stacklevel=3,
        )


def read_mask(path: PathLike) -> NDArray[np.bool_]:
    """Read a black-and-white picture as (H, W) bool, True above half of the range.

    Raises:
        DataError: as `read_image`.
    """
    return np.asarray(read_image(path, white=65535)[:, :, 0] > 127)


Reader = Callable[[PathLike], NDArray[Any]]


def dispatch(path: PathLike, readers: Mapping[str, Reader], what: str) -> NDArray[Any]:
    """Read a file with the reader of its suffix.

    Raises:
        DataError: no reader has this suffix, or the reader refuses the file.
    """
    suffix = Path(path).suffix.lower()
    if suffix not in readers:
        raise DataError(
            f"{what} file has an unknown suffix",
            where=path,
            found=suffix or "no suffix",
            expected=", ".join(readers),
        )
    return readers[suffix](path)
