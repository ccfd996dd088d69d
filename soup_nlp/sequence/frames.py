"""Frames of a sequence, of image files, a video or a rendered scene; key frames by parallax."""

import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from functools import lru_cache, partial
from glob import glob
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.optimize import least_squares

from soup_nlp.arrays import Float, Image
from soup_nlp.data.formats.images import RAW, DataWarning, read_image
from soup_nlp.errors import DataError
from soup_nlp.geometry.camera import intrinsics
from soup_nlp.geometry.rotation import exp
from soup_nlp.report.figures import write_png
from soup_nlp.storage.files import as_path, require_file
from soup_nlp.storage.folders import staged

Raw = dict[str, Any]

IMAGES = (
    *(".png", ".jpg", ".jpeg", ".tif", ".tiff", ".ppm", ".pgm", ".bmp", ".webp", ".avif"),
    # these are found, so that the message can say that they must be converted
    *(".heic", ".heif", *RAW),
)
VIDEOS = (
    ".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mts", ".m2ts", ".ts", ".3gp", ".mpg",
    ".mpeg", ".wmv", ".flv", ".gif", ".mxf", ".vob",
)  # fmt: skip
"""Suffixes by which a message knows a video; any file that is no image is tried as one."""
DEPTHS = (".png", ".npy", ".npz", ".pfm", ".dpt")
"""Suffixes of depth maps."""
FLOWS = (".flo", ".png", ".npy")
"""Suffixes of flows."""
PROBED = 3
"""Number of pairs in which points are tracked before a folder is solved."""
LAYOUT = "frame_*"
"""Pattern of the images in a folder that also holds other images, such as depth."""


@dataclass(frozen=True)
class Frames:
    """A sequence of frames: image files of one camera, or a rendered scene.

    Attributes:
        names: Path or description of every frame.
        camera: Key `intrinsics` or `fov` of an input of files.
        depths: True depth of every frame, for evaluation only; empty if unknown.
        depth_scale: Values per unit of length of a 16-bit .png depth.
        scene: Name of the scene, whose camera and bodies repeat their first motion.
        files: Files of consecutive pairs by key of a problem, such as ("flow", "source").
    """

    names: tuple[str, ...]
    camera: Raw = field(default_factory=dict)
    depths: Sequence[Path] = ()
    depth_scale: float | None = None
    scene: str | None = None
    files: Mapping[tuple[str, str], Sequence[Path]] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.names)

    def problem(self, k: int, keys: Raw) -> Raw:
        """The problem of the frames k and k + 1, with keys of all problems."""
        raw = {**keys, "input": self.pair(k), "base": str(Path.cwd())}
        for (section, key), paths in self.files.items():
            raw[section] = {**(raw.get(section) or {}), key: str(paths[k])}
        return raw

    def pair(self, k: int) -> Raw:
        """Section `input` of the problem of the frames k and k + 1."""
        if self.scene is not None:
            return {"kind": "scene", "frame": k, "scene": self.scene}
        out = {"kind": "files", "ref": self.names[k], "next": self.names[k + 1], **self.camera}
        if self.depths:
            truth = {"depth": str(self.depths[k]), "depth_next": str(self.depths[k + 1])}
            out.update(truth, depth_scale=self.depth_scale)
        return out


def find_images(source: Path) -> list[Path]:
    """Images of a folder or of a pattern such as `clip/*.jpg`, in the order of their numbers.

    In a folder with images named frame_*, only these are used. Hidden files are no images, and
    neither are masks such as x.jpg.png beside x.jpg.

    Raises:
        DataError: there are fewer than two.
    """
    source = as_path(source, "frames")
    root = next(folder for folder in (source, *source.parents) if folder.is_dir())
    pattern = "*" if root == source else str(source.relative_to(root))
    # glob leaves out hidden files
    files = [root / name for name in glob(pattern, root_dir=root, recursive=True)]
    # links without a target and pipes are errors when they are read
    chosen = [path for path in files if not path.is_dir()]
    if root == source:
        images = [path for path in chosen if path.suffix.lower() in IMAGES]
        chosen = [path for path in images if path.match(LAYOUT)] or images
    # cameras write a raw photo beside the developed one
    chosen = [path for path in chosen if path.suffix.lower() not in RAW] or chosen
    names = {*chosen}
    chosen = [p for p in chosen if names.isdisjoint(_shorter(p))]
    if len(chosen) < 2:
        raise DataError(
            "a sequence needs two images at least",
            where=source,
            found=len(chosen),
            expected="a folder of images, a pattern in quotes, a video, or scene:NAME",
            hint=None if chosen or source.exists() else "check the name; nothing matches it",
        )
    return in_order(chosen)


def find_depths(images: list[Path]) -> list[Path]:
    """Files depth_* beside images frame_*, one for each; empty if one is missing."""
    out = []
    for path in images:
        stem = path.stem.replace("frame_", "depth_")
        beside = [path.with_name(stem + suffix) for suffix in DEPTHS]
        depths = [p for p in beside if p.is_file() and p != path]
        if not depths:
            return []
        out.append(depths[0])
    return out


def numbered_files(folder: Path, kinds: Sequence[str], what: str, first: str = "") -> list[Path]:
    """Files of a folder, or of a pattern such as `flow/*.flo`, in the order of their numbers.

    `kinds` are their suffixes, `what` says in messages what they hold, and those that match the
    pattern `first` are preferred.

    Raises:
        DataError: there is none.
    """
    folder = as_path(folder, f"folder of {what}", home=True)
    found = folder.glob("*") if folder.is_dir() else folder.parent.glob(folder.name)
    files = [path for path in found if path.suffix.lower() in kinds]
    files = [path for path in files if first and path.match(first)] or files
    if not files:
        raise DataError(f"there is no {what}", where=folder, expected=f"files {', '.join(kinds)}")
    return in_order(files)


def check_sizes(images: Sequence[Path], turn: bool) -> None:
    """Read all pictures of a sequence, which must have one size; `turn` as for `read_image`.

    Raises:
        DataError: one is damaged, or they differ in size.
    """
    sizes: dict[tuple[int, int], Path] = {}
    for path in images:
        height, width = read_image(path, turn=turn).shape[:2]
        sizes.setdefault((width, height), path)
        if len(sizes) > 1:
            raise DataError(
                "pictures differ in size: are they one sequence?",
                where=path,
                found=", ".join(f"{p.name} {w}x{h}" for (w, h), p in sizes.items()),
                expected="frames of one camera, all of one size",
                hint="name the frames by a pattern such as 'clip/frame_*.png', or crop them to one"
                " size; soup-nlp solve REF NEXT takes two images of different size",
            )


def check_sequence(images: list[Path]) -> None:
    """Check that the pictures of a folder are frames of one sequence.

    Raises:
        DataError: no picture continues the one before it.
    """
    first = images[: PROBED + 1]
    if not any(continues(a, b) for a, b in pairwise(first)):
        raise DataError(
            "no picture of the folder continues the one before it: are they one sequence?",
            where=images[0].parent,
            found=", ".join(path.name for path in first),
            expected="consecutive frames, of which points can be tracked",
            hint="name the images one by one to solve them all the same",
        )


def is_video(path: Path) -> bool:
    """Whether a source of frames is to be read as a video: any file that is no image."""
    suffix = path.suffix.lower()
    return suffix in VIDEOS or (path.is_file() and suffix not in IMAGES)


def video_frames(path: Path, folder: Path, stride: int = 1, most: int | None = None) -> list[Path]:
    """Write every `stride`-th frame of a video as PNG into a folder; returns their paths.

    Raises:
        DataError: the video cannot be read, or the folder holds other files of these names.
    """
    # FFmpeg takes a name such as 10:05:07.mp4 for an address, and reads text as pictures of it
    path = require_file(path, "video").absolute()
    refuse = partial(
        DataError,
        where=path,
        expected="a video that FFmpeg reads, of two frames at least",
        hint="convert it, for example by ffmpeg -i FILE video.mp4, or give a folder of images",
    )
    with path.open("rb") as file:
        if b"\0" not in file.read(4096):
            raise refuse("file is neither an image nor a video", found="text")
    try:
        str(path).encode()
    except UnicodeEncodeError:
        # OpenCV would crash
        raise DataError("name of a video is not UTF-8", where=path, hint="rename it") from None
    video = cv2.VideoCapture(str(path))
    names: list[str] = []
    index = 0
    with staged(folder, whole=True) as new:
        while most is None or len(names) < most:
            if not video.grab():
                break
            if index % stride == 0:
                good, image = video.retrieve()
                if not good:
                    break
                names.append(f"{len(names):04d}.png")
                write_png(new / names[-1], cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
            index += 1
        video.release()
        if len(names) < 2:
            raise refuse("video has fewer than two readable frames", found=len(names))
    return [folder / name for name in names]


def _shorter(path: Path) -> list[Path]:
    """x.jpg, x for x.jpg.png: names of the picture that this one may be the mask of."""
    words = path.name.split(".")
    return [path.with_name(".".join(words[:k])) for k in range(1, len(words))]


def in_order(paths: Sequence[Path]) -> list[Path]:
    """Files by the numbers in their names.

    Digits around a point are a decimal (9.25, 9.5, 10.0) or two numbers (0.8, 0.9, 0.10), the same
    for all files. A decimal has no zero at its end, and a number none before it, unless all have
    as many digits.

    Warns:
        DataWarning: both are possible, and the orders differ.
    """
    decimals, numbers = (
        sorted(paths, key=lambda path: [_by_number(part, digits) for part in path.parts])
        for digits in (r"(\d+(?:\.\d+)?)", r"(\d+)")
    )
    if decimals == numbers:
        return decimals
    varying = {
        part for parts in zip(*(p.parts for p in paths)) if len({*parts}) > 1 for part in parts
    }
    tails = [tail for part in varying for tail in re.findall(r"\d+\.(\d+)", part)]
    shortest = min(map(len, tails), default=0)
    no_decimal = any(len(tail) > 1 and tail[-1] == "0" for tail in tails)
    no_number = any(len(tail) > shortest and tail[0] == "0" for tail in tails)
    if no_decimal != no_number:
        return numbers if no_decimal else decimals
    warnings.warn(
        f"{paths[0].parent}: the order of the frames is not clear; taken as decimals:"
        f" {', '.join(path.name for path in decimals[:4])} ..., not as numbers:"
        f" {', '.join(path.name for path in numbers[:4])} ...; zeros before the numbers"
        " make it clear",
        DataWarning,
        stacklevel=3,
    )
    return decimals


def _by_number(name: str, digits: str) -> list[Any]:
    """Sort key that orders what matches `digits` by value."""
    words = re.split(digits, name)
    return [(1, Decimal(word), "") if k % 2 else (0, 0, word) for k, word in enumerate(words)]


# --- key frames -----------------------------------------------------------------------------------

KEY_PARALLAX = 0.01
"""Median parallax of consecutive key frames, relative to the larger side of the image."""
MAX_STEP = 10
"""Largest number of frames from a key frame to the next."""
SIDE = 640
"""Larger side of the images in which points are tracked, pixels."""
MIN_TRACKED = 0.3
"""Smallest share of the points that must be tracked."""
MIN_POINTS = 30
"""Smallest number of tracked points."""


def key_frames(images: Sequence[Path], K: Float, most: int | None = None) -> list[int]:
    """Indices of key frames.

    The next key frame is the first one with a parallax of `KEY_PARALLAX`, or the last one before
    points are lost or after `MAX_STEP` frames.

    Args:
        images: All frames in order.
        K: (3, 3) intrinsics, pixels.
        most: Largest number of key frames.
    """
    read = lru_cache(MAX_STEP + 1)(_small)
    chosen, last = [0], len(images) - 1
    while chosen[-1] < last and (most is None or len(chosen) < most):
        current = chosen[-1]
        image, scale = read(images[current])
        camera = np.diag([scale, scale, 1.0]) @ K
        best = current + 1
        for candidate in range(current + 1, min(current + MAX_STEP, last) + 1):
            shift = parallax(image, read(images[candidate])[0], camera)
            if shift is None:
                break
            best = candidate
            if shift >= KEY_PARALLAX:
                break
        chosen.append(best)
    return chosen


def continues(one: Path, other: Path) -> bool:
    """Whether enough points of an image can be tracked into the other one."""
    a, b = (_small(path)[0] for path in (one, other))
    camera = intrinsics(a.shape[1], a.shape[1], a.shape[1] / 2, a.shape[0] / 2)
    return parallax(a, b, camera) is not None


def parallax(one: Image, other: Image, K: Float) -> float | None:
    """Median displacement of two grey images (H, W) after removal of a camera rotation.

    It is relative to the larger side of the image; None if too few points can be tracked. K (3, 3)
    are the intrinsics, pixels.
    """
    start = cv2.goodFeaturesToTrack(one, 1000, 0.01, 7)
    if start is None:
        return None
    options = {"winSize": (21, 21), "maxLevel": 4}
    end, forward, _ = cv2.calcOpticalFlowPyrLK(one, other, start, None, **options)
    back, backward, _ = cv2.calcOpticalFlowPyrLK(other, one, end, None, **options)
    error = np.linalg.norm(start - back, axis=2).ravel()
    tracked = (forward.ravel() > 0) & (backward.ravel() > 0) & (error < 1)
    if tracked.sum() < max(MIN_POINTS, MIN_TRACKED * len(tracked)):
        return None
    p, q = (x.reshape(-1, 2)[tracked].astype(np.float64) for x in (start, end))
    rays = np.column_stack([p, np.ones(len(p))]) @ np.linalg.inv(K).T

    def residual(turn: Float) -> Float:
        seen = rays @ exp(turn).T @ K.T
        return np.asarray(seen[:, :2] / seen[:, 2:] - q)

    turn = least_squares(lambda w: residual(w).ravel(), np.zeros(3), loss="soft_l1").x
    return float(np.median(np.linalg.norm(residual(turn), axis=1))) / max(one.shape)


def _small(path: Path) -> tuple[Image, float]:
    """An image in grey, reduced to `SIDE`, and its scale."""
    image = cv2.cvtColor(read_image(path, turn=True), cv2.COLOR_RGB2GRAY)
    scale = min(1.0, SIDE / max(image.shape))
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8), scale
