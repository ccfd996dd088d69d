"""Reading of images, and checks that the readers of all formats and arrays share.

Every reader raises `DataError` for a file that is missing, empty, truncated or of another kind.
"""

import contextlib
import io
import os
import re
import tempfile
import threading
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, TiffImagePlugin, UnidentifiedImageError

from soup_nlp.arrays import Mask
from soup_nlp.errors import DataError, printable, repr_of
from soup_nlp.schema.section import MAX_PIXELS, check_image_size
from soup_nlp.storage.files import PathLike, read_bytes

ImageLike: TypeAlias = Any
"""An array (H, W), (H, W, C) or (C, H, W) with 1, 3 or 4 channels, of 8 bits or of floats from 0 to
1, a file, or a PIL image."""
OUTER = (0.5, 99.5)
"""Percentiles of the values of 16-bit pictures that become black and white."""

RAW = (
    ".dng", ".nef", ".nrw", ".cr2", ".cr3", ".crw", ".arw", ".srf", ".sr2", ".raf", ".rw2", ".rwl",
    ".orf", ".pef", ".srw", ".3fr", ".fff", ".iiq", ".kdc", ".dcr", ".mrw", ".x3f", ".erf", ".gpr",
)  # fmt: skip
"""Suffixes of raw photos."""
_PICTURES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX", "CMYK", "YCbCr", "LAB", "HSV")
"""Modes of PIL images of 8 bits or fewer a channel."""
COMB, COMBED = 10, 0.01
"""Difference of rows, grey levels, that counts as a comb; least share of interlaced frames."""
_RAW_TAGS = {"DNGVersion": 50706, "SubIFDs": 330}
_DAMAGE = re.compile(
    r"(?:corrupt|premature|inconsistent|invalid sos).*|(?<=TIFF_Error ).*", re.IGNORECASE
)
_STDERR = threading.Lock()


class DataWarning(UserWarning):
    """An input can be used, but it may not be what the user expects."""


def warn(where: object, text: str) -> None:
    """Warn of an input, from the place that called the caller."""
    warnings.warn(f"{where}: {text}", DataWarning, stacklevel=3)


def is_path(value: object) -> bool:
    """Whether the argument is the path of a file."""
    return isinstance(value, str | os.PathLike)


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


def check_body(count: int, expected: int, path: PathLike, what: str) -> None:
    """Raise DataError unless a file body has the number of bytes given by its header."""
    if count != expected:
        problem = "is truncated" if count < expected else "has bytes left over"
        raise DataError(
            f"{what} {problem}",
            where=path,
            found=f"{count} bytes after the header",
            expected=f"{expected} bytes",
            hint="copy or download the file again",
        )


def decode(path: PathLike, what: str) -> NDArray[Any]:
    """Decode an image file as stored to grey, BGR or BGRA: OpenCV, or else Pillow, to 8 bits."""
    content = read_bytes(path, what)
    _refuse_raw(content, path, what)
    size, pages = (1, 1), 1
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(io.BytesIO(content)) as header:
            size = header.size
            # phones store a second picture behind a JPEG, for other screens
            pages = 1 if header.format == "MPO" else getattr(header, "n_frames", 1)
    except Image.DecompressionBombError as error:
        raise DataError(
            f"{what} has an impossible size",
            where=path,
            found=error,
            expected=f"at most {MAX_PIXELS} pixels",
        ) from None
    except Exception:  # OpenCV may read formats that Pillow does not
        pages = 1
    # a small file can have many pixels of one colour
    check_image_size(*size, what, path)
    if pages > 1:
        warn(path, f"holds {pages} pages or frames; the first one is used")
    image, said = _decode_by_opencv(content)
    if said:
        warn(path, f"is damaged, so that parts of it may be wrong ({said}); copy it again")
    return _decode_by_pillow(content, path, what) if image is None else image


def _refuse_raw(content: bytes, path: PathLike, what: str) -> None:
    """Raise DataError for a raw photo, of which decoders read the thumbnail."""
    found = "its suffix" if Path(path).suffix.lower() in RAW else ""
    found = "the mark of Canon" if content[8:10] == b"CR" and content[:1] in b"IM" else found
    # a small file may be large, and Pillow does not read its size
    found = "the mark of Radiance HDR" if content.startswith(b"#?") else found
    with contextlib.suppress(Exception):  # of other files, or damaged
        directory = TiffImagePlugin.ImageFileDirectory_v2(content[:8])
        stream = io.BytesIO(content)
        stream.seek(directory.next)
        directory.load(stream)
        tags = [name for name, tag in _RAW_TAGS.items() if tag in directory]
        # NewSubfileType: a reduced picture of another one in the file
        tags += ["NewSubfileType"] if int(directory.get(254, 0)) & 1 else []
        found = f"TIFF tag {tags[0]}" if tags else found
    if found:
        raise DataError(
            f"{what} is a raw or HDR photo, or holds further pictures behind a thumbnail",
            where=path,
            found=found,
            expected="one developed picture of 8 or 16 bits",
            hint="develop it first, for example by RawTherapee, darktable or rawpy, and save it as"
            " 16-bit TIFF or PNG",
        )


def _decode_by_opencv(content: bytes) -> tuple[NDArray[Any] | None, str]:
    """Image as stored, None if OpenCV cannot decode it, and damage, which it prints to stderr."""
    image, said = None, b""
    file: Any = io.BytesIO()
    with _STDERR, contextlib.ExitStack() as stack:
        with contextlib.suppress(OSError):  # there may be no standard error, or no folder for files
            file = stack.enter_context(tempfile.TemporaryFile())
            saved = os.dup(2)
            stack.callback(os.close, saved)
            stack.callback(os.dup2, saved, 2)
            os.dup2(file.fileno(), 2)
        with contextlib.suppress(cv2.error):
            image = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
        file.seek(0)
        said = file.read()
    damage = _DAMAGE.search(said.decode(errors="replace"))
    return None if image is None else np.asarray(image), damage.group()[:100] if damage else ""


def _decode_by_pillow(content: bytes, path: PathLike, what: str) -> NDArray[np.uint8]:
    """Decode an image file to BGR, or raise DataError with the reason of the decoder."""
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(io.BytesIO(content)) as image:
            return np.asarray(image.convert("RGB"))[:, :, ::-1]
    except UnidentifiedImageError:
        heic = content[4:8] == b"ftyp" and content[8:12] != b"avif"
        problem = f"{'a HEIC picture or a video, ' if heic else ''}{len(content)} bytes that start"
        problem, hint = f"{problem} with {content[:12]!r}", "convert it to PNG or JPEG first"
    except Exception as error:  # decoders raise many types
        problem, hint = str(error), "copy or download the file again: it may be damaged"
    raise DataError(
        f"{what} is truncated" if "truncated" in problem.lower() else f"{what} cannot be decoded",
        where=path,
        found=problem,
        expected="an image file that OpenCV or Pillow reads (PNG, JPEG, TIFF, WebP, AVIF ...)",
        hint=hint,
    )


def decode_png16(path: PathLike, channels: int, what: str) -> NDArray[np.uint16]:
    """Decode a 16-bit PNG: (H, W) for one channel, (H, W, 3) in BGR order for three."""
    image = decode(path, what)
    count = 1 if image.ndim == 2 else image.shape[2]
    if image.dtype != np.uint16 or count != channels:
        raise DataError(
            f"{what} is not of the expected kind",
            where=path,
            found=f"{image.dtype} with {count} channel(s)",
            expected=f"16-bit PNG with {channels} channel(s)",
            hint="an 8-bit or colour-coded picture of the data does not hold the values",
        )
    return image


def exif_tags(path: PathLike) -> dict[int, Any]:
    """EXIF tags of an image file, about picture and camera; empty, or a warning, without."""
    content = read_bytes(path, "image")
    try:
        with warnings.catch_warnings(action="ignore"), Image.open(io.BytesIO(content)) as image:
            exif = image.getexif()
            return {**exif.get_ifd(ExifTags.IFD.Exif), **exif}
    except UnidentifiedImageError:  # OpenCV may read formats that Pillow does not
        return {}
    except Exception as error:  # readers of metadata raise many types
        warn(path, f"its EXIF is malformed and is ignored ({type(error).__name__}: {error})")
        return {}


def read_image(
    path: PathLike, white: int | None = None, *, turn: bool = False
) -> NDArray[np.uint8]:
    """Read one picture, see `read_images`."""
    return read_images([path], white, turn=turn)[0]


def read_images(
    paths: Sequence[PathLike], white: int | None = None, *, turn: bool = False
) -> list[NDArray[np.uint8]]:
    """Read the pictures of one scene as (H, W, 3) 8-bit RGB; grey is repeated, alpha dropped.

    Args:
        paths: Image files of 8 or 16 bits, grey, RGB or RGBA.
        white: Value of a 16-bit image that becomes 255, such as 4095 for 12-bit images. Without it
            the values of all pictures between the percentiles `OUTER`, 8-bit ones beside them times
            257, become 0 to 255, with a warning.
        turn: Rotate the images by their EXIF orientation, as viewers do. A rotation is refused
            otherwise, since the camera may be that of either orientation.
    """
    images = [_colours(path, turn) for path in paths]
    depths = {image.dtype for image in images}
    if len(depths) > 1 and white is None:
        # one stretch for all
        images = [np.uint16(257) * x if x.dtype == np.uint8 else x for x in images]
    deep = [image for image in images if image.dtype == np.uint16]
    low, high = 0.0, float(white or 0)
    if deep and white is None:
        # a million values of each determine the percentiles
        values = np.concatenate([x.ravel()[:: x.size // 10**6 + 1] for x in deep])
        low, high = np.percentile(values, OUTER)
        least, most = min(x.min() for x in deep), max(x.max() for x in deep)
        beside = " beside 8 bit, which are taken times 257" if len(depths) > 1 else ""
        warn(
            ", ".join(map(str, paths)),
            f"16 bit{beside}, values {least} to {most}; {low:.0f} to {high:.0f} become black to"
            " white; the key white of the input (4095 for 12 bits) sets 0 to white",
        )
    scale = 255.0 / max(high - low, 1.0)
    for k, image in enumerate(images):
        if image.dtype != np.uint8:
            image = np.clip(np.rint((image - low) * scale), 0, 255).astype(np.uint8)
        if interlaced(image):
            warn(paths[k], "looks interlaced; separate its fields, for example by ffmpeg's yadif")
        images[k] = image
    return images


def image_of(source: ImageLike, where: str) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 RGB of an array, a file or a PIL image; grey is repeated, alpha dropped."""
    if is_path(source):
        return read_image(Path(source))
    if isinstance(source, Image.Image) and source.mode in _PICTURES:
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


def _colours(path: PathLike, turn: bool) -> NDArray[Any]:
    image = decode(path, "image")
    orientation = exif_tags(path).get(ExifTags.Base.Orientation, 1)
    orientation = orientation if orientation in range(1, 9) else 1
    if orientation != 1 and not turn:
        raise DataError(
            "image is stored turned, and its camera is given",
            where=path,
            found=f"EXIF orientation {orientation}",
            expected="pixels stored upright: the camera's axes are unclear otherwise",
            hint="save it upright (Pillow: ImageOps.exif_transpose), or leave the intrinsics out:"
            " soup-nlp then turns it",
        )
    image = image if image.ndim == 3 else image[:, :, None]
    channels = image.shape[2]
    if channels not in (1, 3, 4) or image.dtype not in (np.uint8, np.uint16):
        raise DataError(
            "image is neither 8-bit nor 16-bit grey, RGB or RGBA",
            where=path,
            found=f"{image.dtype} with {channels} channel(s)",
            hint="convert it to an 8-bit PNG first",
        )
    # OpenCV turns TIFF files itself
    if read_bytes(path, "image")[:3] not in (b"II*", b"II+", b"MM\0"):
        image = image.swapaxes(0, 1) if orientation >= 5 else image
        image = image[:: -1 if orientation in (3, 4, 7, 8) else 1]
        image = image[:, :: -1 if orientation in (2, 3, 6, 7) else 1]
    rgb = np.repeat(image, 3, axis=2) if channels == 1 else image[:, :, 2::-1]
    return np.ascontiguousarray(rgb)


def interlaced(image: NDArray[Any]) -> bool:
    """Whether the rows of an image (H, W, 3) alternate between two moments.

    Rows that differ from both neighbours in one direction, combs, are then 2.5 times or more as
    many as those of every second row; in 95 other pictures at most 1.05 times.
    """
    if len(image) < 5:
        return False
    grey = image[:, :: image.shape[0] * image.shape[1] // 10**6 + 1].mean(axis=2)
    combs = []
    for step in (1, 2):
        up, down = (grey[step:-step] - other for other in (grey[: -2 * step], grey[2 * step :]))
        combs.append(((np.minimum(abs(up), abs(down)) > COMB) & (up * down > 0)).mean())
    return bool(combs[0] > max(COMBED, 1.5 * combs[1]))


def read_mask(path: PathLike) -> Mask:
    """Read a black-and-white picture as (H, W) bool, True above half of the range."""
    return np.asarray(read_image(path, white=65535)[:, :, 0] > 127)
