"""Frames of a sequence: image files, a video, a rendered scene."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from decimal import Decimal
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
from PIL import Image

from soup_nlp.errors import DataError
from soup_nlp.report.figures import write_png
from soup_nlp.sequence.key_frames import continues
from soup_nlp.storage.files import as_path, require_file
from soup_nlp.storage.folders import staged

Raw = dict[str, Any]

IMAGES = (
    *(".png", ".jpg", ".jpeg", ".tif", ".tiff", ".ppm", ".pgm", ".bmp", ".webp", ".avif"),
    # these are found, so that the message can say that they must be converted
    *(".heic", ".heif"),
)
VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v")
DEPTHS = (".png", ".npy", ".pfm", ".dpt")
"""Suffixes of depth maps."""
PROBED = 3
"""Number of pairs in which points are tracked before a folder is solved."""
LAYOUT = "frame_*"
"""Pattern of the images in a folder that also holds other images, such as depth."""


@dataclass(frozen=True)
class Frames:
    """A sequence of frames.

    Attributes:
        names: Path or description of every frame.
        pair: Section `input` of the problem of two frames, by their numbers.
    """

    names: tuple[str, ...]
    pair: Callable[[int, int], Raw]

    def __len__(self) -> int:
        return len(self.names)


def file_frames(
    paths: Sequence[Path],
    camera: Raw,
    depths: Sequence[Path] = (),
    depth_scale: float | None = None,
) -> Frames:
    """Image files of one camera as frames.

    Args:
        paths: Images in order.
        camera: Key `intrinsics` or `fov` of an input of files.
        depths: True depth of every frame, for evaluation only; empty if unknown.
        depth_scale: Values per unit of length of a 16-bit .png depth.
    """

    def pair(first: int, second: int) -> Raw:
        out = {"kind": "files", "ref": str(paths[first]), "next": str(paths[second]), **camera}
        if depths:
            truth = {"depth": str(depths[first]), "depth_next": str(depths[second])}
            out.update(truth, depth_scale=depth_scale)
        return out

    return Frames(tuple(map(str, paths)), pair)


def scene_frames(scene: str, count: int) -> Frames:
    """Frames of a rendered scene, whose camera and bodies repeat their first motion."""

    def pair(first: int, second: int) -> Raw:
        if second != first + 1:
            raise DataError(
                "frames of a scene are solved one after the other", found=second - first
            )
        return {"kind": "scene", "frame": first, "scene": scene}

    return Frames(tuple(f"{scene}: frame {k}" for k in range(count)), pair)


def find_images(source: Path) -> list[Path]:
    """Images of a folder or of a pattern such as `clip/*.jpg`, in the order of their numbers.

    In a folder with images named frame_*, only these are used. Hidden files are no images, and
    neither are masks such as x.jpg.png beside x.jpg.

    Raises:
        DataError: there are fewer than two.
    """
    source = as_path(source, "frames")
    root = source
    if source.is_dir():
        found = [p for p in source.glob(LAYOUT) if p.suffix.lower() in IMAGES]
        found = found or [p for p in source.iterdir() if p.suffix.lower() in IMAGES]
    else:
        root = next(folder for folder in source.parents if folder.is_dir())
        found = []
        with suppress(ValueError):  # of a pattern such as a**
            found = [p for p in root.glob(str(source.relative_to(root))) if p.is_file()]
    # hidden by its own name, or by that of a folder that the pattern matched
    found = [
        p for p in found if not any(part.startswith(".") for part in p.parts[len(root.parts) :])
    ]
    names = {*found}
    found = [p for p in found if not any(q in names for q in _shorter(p))]
    if len(found) < 2:
        raise DataError(
            "a sequence needs two images at least",
            where=source,
            found=len(found),
            expected="a folder of images, a pattern in quotes, a video, or scene:NAME",
        )
    return sorted(found, key=lambda path: [_by_number(part) for part in path.parts])


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


def depth_files(folder: Path) -> list[Path]:
    """Depth maps of a folder, in the order of their numbers: those named depth_*, or all.

    Raises:
        DataError: there is none.
    """
    folder = as_path(folder, "folder of depth maps")
    every = [p for p in folder.glob("*") if p.suffix.lower() in DEPTHS]
    found = [p for p in every if p.name.startswith("depth_")] or every
    if not found:
        raise DataError(
            "folder holds no depth maps", where=folder, expected="one for every frame of the chain"
        )
    return sorted(found, key=lambda path: _by_number(path.name))


def check_sequence(images: list[Path]) -> None:
    """Check that the pictures of a folder are frames of one sequence.

    Raises:
        DataError: they differ in size, or no picture continues the one before it.
    """
    sizes: dict[tuple[int, int], Path] = {}
    for path in images:
        with suppress(OSError), Image.open(require_file(path, "image")) as image:
            sizes.setdefault(image.size, path)
    if len(sizes) > 1:
        raise DataError(
            "pictures of the folder differ in size: are they one sequence?",
            where=images[0].parent,
            found=", ".join(f"{p.name} {w}x{h}" for (w, h), p in list(sizes.items())[:4]),
            expected="frames of one camera",
            hint="name the frames by a pattern such as 'clip/frame_*.png'",
        )
    first = images[: PROBED + 1]
    if not any(continues(a, b) for a, b in pairwise(first)):
        raise DataError(
            "no picture of the folder continues the one before it: are they one sequence?",
            where=images[0].parent,
            found=", ".join(path.name for path in first),
            expected="consecutive frames, of which points can be tracked",
            hint="name the images one by one to solve them all the same",
        )


def video_frames(path: Path, folder: Path, stride: int = 1, most: int | None = None) -> list[Path]:
    """Write every `stride`-th frame of a video as PNG into a folder; returns their paths.

    Raises:
        DataError: the video cannot be read, or the folder holds other files of these names.
    """
    path = require_file(path, "video")
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
            raise DataError(
                "video has fewer than two readable frames", where=path, found=len(names)
            )
    return [folder / name for name in names]


def _shorter(path: Path) -> list[Path]:
    """x.jpg, x for x.jpg.png: names of the picture that this one may be the mask of."""
    words = path.name.split(".")
    return [path.with_name(".".join(words[:k])) for k in range(1, len(words))]


def _by_number(name: str) -> list[Any]:
    """Sort key that orders numbers and decimals by value: 9, 9.5, 10."""
    words = re.split(r"(\d+(?:\.\d+)?)", name)
    return [(1, Decimal(word), "") if k % 2 else (0, 0, word) for k, word in enumerate(words)]
