"""Files that readers are tested with, written by hand; pictures with metadata; overrides."""

import io
import struct
import warnings
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image

from soup_nlp.config.problem import make_problem
from soup_nlp.data.formats.images import DataWarning
from soup_nlp.data.formats.map_files import MAGIC
from soup_nlp.data.pair import Pair
from soup_nlp.errors import DataError


def write_flo(path: Path, flow: np.ndarray) -> None:
    """A Middlebury .flo file; unknown flow (not finite) becomes 1e10."""
    values = np.where(np.isfinite(flow).all(axis=2, keepdims=True), flow, 1e10)
    put(path, pieh(values.astype("<f4")))


def write_dpt(path: Path, depth: np.ndarray) -> None:
    """A Sintel .dpt file."""
    put(path, pieh(depth.astype("<f4")))


def pieh(values: np.ndarray) -> bytes:
    """Content of a .flo or .dpt file."""
    return MAGIC + struct.pack("<ii", values.shape[1], values.shape[0]) + values.tobytes()


def write_cam(path: Path, K: np.ndarray) -> None:
    """A Sintel .cam file of a camera at the origin."""
    put(path, struct.pack("<f21d", 202021.25, *K.ravel(), *np.eye(3, 4).ravel()))


def write_kitti_flow(path: Path, flow: np.ndarray) -> None:
    """A KITTI flow PNG; pixels that are not finite are marked invalid."""
    valid = np.isfinite(flow).all(axis=2)
    code = np.rint(np.where(valid[..., None], flow, 0.0) * 64.0 + 2.0**15) * valid[..., None]
    bgr = np.dstack([valid, code[..., 1], code[..., 0]]).astype(np.uint16)
    put(path, cv2.imencode(".png", bgr)[1].tobytes())


def npy(values: object) -> bytes:
    """Content of a .npy file."""
    stream = io.BytesIO()
    np.save(stream, np.asarray(values))
    return stream.getvalue()


def npz(**arrays: object) -> bytes:
    """Content of a .npz file."""
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def sets(text: str) -> list[str]:
    """Overrides, separated by spaces, as words of a command line."""
    return [word for item in text.split() for word in ("--set", item)]


def write_pair(folder: Path, pair: Pair, names: Sequence[str] = ("a", "b")) -> None:
    """The images of a pair as PNG files of these names."""
    for name, image in zip(names, (pair.image_ref, pair.image_next), strict=True):
        cv2.imwrite(str(folder / f"{name}.png"), image[..., ::-1])


def put(path: Path, content: bytes) -> Path:
    """A file of these bytes, below folders that it makes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return path


def raises(match: str):
    """Expect a DataError with a message that matches."""
    return pytest.raises(DataError, match=match)


# --- photos ---------------------------------------------------------------------------------------


def texture(width: int = 96, height: int = 64, seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(0, 256, (height, width, 3)).astype(np.uint8)
    return np.asarray(cv2.GaussianBlur(noise, (0, 0), 1.5))


def grey_texture(height: int, width: int, seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=(height, width)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.5)
    return cv2.normalize(smooth, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def photo(path: Path, image: np.ndarray | None = None, turned: int = 1, **tags: float) -> Path:
    """A picture with EXIF; `tags` are those of the camera."""
    picture = Image.fromarray(texture() if image is None else image)
    exif = picture.getexif()
    exif[ExifTags.Base.Orientation] = turned
    own = {ExifTags.Base[name]: value for name, value in tags.items()}
    exif.get_ifd(ExifTags.IFD.Exif).update(own)
    picture.save(path, exif=exif)
    return path


def load(folder: Path, ref: str = "a.png", following: str = "b.png", **keys: object) -> Pair:
    source = {"kind": "files", "ref": ref, "next": following, **keys}
    return make_problem({"input": source, "base": str(folder)}).load_pair()


def said(*args: object, **keys: object) -> tuple[Pair, str]:
    """A loaded pair and its warnings, all of which are about data."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        pair = load(*args, **keys)
    assert {w.category for w in caught} <= {DataWarning}
    return pair, "\n".join(str(w.message) for w in caught)
