"""Pictures with metadata, and pairs of them with the warnings of their loading."""

import warnings
from pathlib import Path

import cv2
import numpy as np
from PIL import ExifTags, Image

from soup_nlp.config.problem import make_problem
from soup_nlp.data.formats.images import DataWarning
from soup_nlp.data.pair import Pair

SIZE = (96, 64)  # width, height
EXIF, IFD = ExifTags.Base, ExifTags.IFD.Exif


def texture(width: int = SIZE[0], height: int = SIZE[1], seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).integers(0, 256, (height, width, 3)).astype(np.uint8)
    return np.asarray(cv2.GaussianBlur(noise, (0, 0), 1.5))


def photo(path: Path, image: np.ndarray | None = None, turned: int = 1, **tags: float) -> Path:
    """A picture with EXIF; `tags` are those of the camera."""
    picture = Image.fromarray(texture() if image is None else image)
    exif = picture.getexif()
    exif[EXIF.Orientation] = turned
    exif.get_ifd(IFD).update({EXIF[name]: value for name, value in tags.items()})
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
