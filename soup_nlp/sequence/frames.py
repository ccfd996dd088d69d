"""Frames of a sequence, of image files, a video or a rendered scene."""

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from decimal import Decimal
from functools import partial
from glob import glob
from itertools import count, islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import PIL.Image
from PIL import ImageSequence

from soup_nlp.arrays import Image
from soup_nlp.config.problem import Problem, make_problem, title
from soup_nlp.data.formats.images import RAW, ImageLike, image_of, is_path, read_image
from soup_nlp.errors import ConfigError, DataError
from soup_nlp.report.figures import write_png
from soup_nlp.storage.files import as_path, is_folder, require_file
from soup_nlp.storage.folders import claim, staged

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
FLOWS = (".flo", ".png", ".npy")
"""Suffixes of depth maps and of flows."""
OF_PAIRS = {
    ("flow", "source"): FLOWS,
    ("flow", "backward"): FLOWS,
    ("flow", "confidence"): (".npy", ".png"),
    ("depth_prior", "source"): DEPTHS,
}
"""Keys that may name a folder with a file for each pair, and the suffixes of these."""
LAYOUT = "frame_*"
"""Pattern of the images in a folder that also holds other images, such as depth."""
SCENE = "scene:"
"""Prefix of the name of a rendered scene."""

Source = str | Path | Sequence[ImageLike]
"""Folder or pattern of images, video, scene:NAME, or a list of files, arrays or PIL images."""


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
        keys: Keys of the problems of all pairs.
        overrides: Further ones, as on the command line.
    """

    names: tuple[str, ...]
    camera: Raw = field(default_factory=dict)
    depths: Sequence[Path] = ()
    depth_scale: float | None = None
    scene: str | None = None
    files: Mapping[tuple[str, str], Sequence[Path]] = field(default_factory=dict)
    keys: Raw = field(default_factory=dict)
    overrides: Sequence[str] = ()

    def __len__(self) -> int:
        return len(self.names)

    def problem(self, k: int) -> Problem:
        """The problem of the frames k and k + 1, named as its folder."""
        own = {"name": pair_name(k), "input": self.pair(k), "base": str(Path.cwd())}
        raw = {**self.keys, **own}
        for (section, key), paths in self.files.items():
            raw[section] = {**(raw.get(section) or {}), key: str(paths[k])}
        return make_problem(raw, self.overrides, where="sequence")

    def pair(self, k: int) -> Raw:
        """Section `input` of the problem of the frames k and k + 1."""
        if self.scene is not None:
            return {"kind": "scene", "frame": k, "scene": self.scene}
        out = {"kind": "files", "ref": self.names[k], "next": self.names[k + 1], **self.camera}
        if self.depths:
            truth = {"depth": str(self.depths[k]), "depth_next": str(self.depths[k + 1])}
            out.update(truth, depth_scale=self.depth_scale)
        return out


def pair_name(k: int) -> str:
    """Name of the pair of the frames k and k + 1, and of its folder."""
    return f"{k:03d}_{k + 1:03d}"


def named(frames: Source, folder: Path | None = None) -> tuple[str, str]:
    """Name of a sequence, and the subject of its output folder: what it is the result of.

    Images in memory are named after the folder.
    """
    if isinstance(frames, str) and frames.startswith(SCENE):
        return title(frames.removeprefix(SCENE)), frames
    first = frames if isinstance(frames, str | Path) else next(iter(frames), None)
    if not isinstance(first, str | Path):
        folder = Path(folder or "chain").absolute()
        return folder.name, f"sequence of images in memory for {folder}"
    path = as_path(first, "frames", home=True).absolute()
    # several images, or a pattern, are named after their folder
    if first is not frames or not path.exists():
        path = path.parent
    return title(path.stem if path.is_file() else path.name), f"sequence {path}"


def find_frames(
    source: Source, out: Path, camera: Raw, stride: int, most: int | None, depth_scale: float | None
) -> Frames:
    """The frames of a source; those of a video, and arrays, are written into the folder `out`."""
    if isinstance(source, str) and source.startswith(SCENE):
        if stride != 1 or camera:
            raise ConfigError("a rendered scene has its own camera and steps", found=source)
        scene = source.removeprefix(SCENE)
        return Frames(tuple(f"{scene}: frame {k}" for k in range(most or 10)), scene=scene)
    depths = list[Path]()
    if not isinstance(source, str | Path):
        images = _files(source, out)[::stride][:most]
    elif is_video(path := as_path(source, "frames", home=True)):
        images = video_frames(path, _written_frames(out), stride, most)
    else:
        images = find_images(path)[::stride][:most]
        depths = [] if "undistort" in camera else find_depths(images)
    if len(images) < 2:
        raise ConfigError(
            "a sequence needs two frames at least",
            where="stride" if stride != 1 else None,
            found=len(images),
            expected="more frames, or a smaller stride",
        )
    images, depths = ([p.absolute() for p in paths] for paths in (images, depths))
    beside = images[0].parent / "K.txt"
    if not camera.keys() & {"intrinsics", "fov"} and os.path.lexists(beside):
        camera = {"intrinsics": str(beside), **camera}
    check_sizes(images, turn="intrinsics" not in camera)
    return Frames(tuple(map(str, images)), camera, depths, depth_scale)


def _files(frames: Sequence[ImageLike], folder: Path) -> list[Path]:
    if all(map(is_path, frames)):
        if any(str(frame).startswith(SCENE) for frame in frames):
            raise DataError("a rendered scene is a sequence by itself", found=[*frames])
        return [as_path(frame, "image", home=True) for frame in frames]
    names, place = [f"{k:04d}.png" for k in range(len(frames))], _written_frames(folder)
    with staged(place, whole=True) as new:
        for name, frame in zip(names, frames):
            write_png(new / name, image_of(frame, f"frame {name}"))
    return [place / name for name in names]


def _written_frames(folder: Path) -> Path:
    """Folder of frames that are written for a chain; DataError if a file or link is in its way."""
    claim(folder, ["frames/-"], overwrite=True)
    return folder / "frames"


def find_images(source: Path) -> list[Path]:
    """Images, two at least, of a folder or pattern such as `clip/*.jpg`, in order of their numbers.

    In a folder with images named frame_*, only these are used. Hidden files are no images.
    """
    source = as_path(source, "frames")
    # links without a target and pipes are errors when they are read
    chosen = [path for path in _matching(source) if not path.is_dir()]
    if source.is_dir():
        images = [path for path in chosen if path.suffix.lower() in IMAGES]
        chosen = [path for path in images if path.match(LAYOUT)] or images
    # cameras write a raw photo beside the developed one
    chosen = [path for path in chosen if path.suffix.lower() not in RAW] or chosen
    if len(chosen) < 2:
        raise DataError(
            "a sequence needs two images at least",
            where=source,
            found=len(chosen),
            expected="a folder of images, a pattern in quotes, a video, or scene:NAME",
            hint=None if chosen or source.exists() else "check the name; nothing matches it",
        )
    return in_order(chosen)


def _matching(source: Path) -> list[Path]:
    """What is in a folder or matches a pattern; brackets of folders that exist are no pattern."""
    root = next(folder for folder in (source, *source.parents) if folder.is_dir())
    pattern = "*" if root == source else str(source.relative_to(root))
    # glob leaves out hidden files
    return [root / name for name in glob(pattern, root_dir=root, recursive=True)]


def find_depths(images: list[Path]) -> list[Path]:
    """Files depth_* beside images frame_*, one for each; empty if one is missing."""
    out = []
    for path in images:
        stem = path.stem.replace("frame_", "depth_")
        beside = [path.with_name(stem + suffix) for suffix in DEPTHS]
        out += [p for p in beside if p.is_file() and p != path][:1]
    return out if len(out) == len(images) else []


def numbered_files(folder: Path, kinds: Sequence[str], what: str, first: str = "") -> list[Path]:
    """Files of a folder, or of a pattern such as `flow/*.flo`, in the order of their numbers.

    `kinds` are their suffixes, `what` says in messages what they hold, and those that match the
    pattern `first` are preferred. None is a DataError.
    """
    folder = as_path(folder, f"folder of {what}", home=True)
    files = [path for path in _matching(folder) if path.suffix.lower() in kinds]
    files = [path for path in files if first and path.match(first)] or files
    if not files:
        raise DataError(f"there is no {what}", where=folder, expected=f"files {', '.join(kinds)}")
    return in_order(files)


def files_of_pairs(keys: Raw, count: int, stride: int) -> dict[tuple[str, str], list[Path]]:
    """Files of every pair, by section and key of the problem that name their folder or pattern."""
    out = {}
    for (section, key), kinds in OF_PAIRS.items():
        name = (keys.get(section) or {}).get(key)
        if not isinstance(name, str | Path) or not ("*" in str(name) or is_folder(name)):
            continue
        found = numbered_files(Path(name), kinds, f"{section}.{key}")
        if stride != 1:
            raise ConfigError("files of pairs need all frames", where="stride", expected="1")
        if len(found) < count:
            expected = f"one for each of {count} pairs"
            raise DataError("a file is missing", where=name, found=len(found), expected=expected)
        out[section, key] = [path.absolute() for path in found]
    return out


def check_sizes(images: Sequence[Path], turn: bool) -> None:
    """Read all pictures of a sequence, which must have one size; `turn` as for `read_image`."""
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
                hint="name the frames by a pattern such as 'clip/frame_*.png'",
            )


def is_video(path: Path) -> bool:
    """Whether a source of frames is to be read as a video: any file that is no image."""
    suffix = path.suffix.lower()
    return suffix in VIDEOS or (path.is_file() and suffix not in IMAGES)


def video_frames(path: Path, folder: Path, stride: int = 1, most: int | None = None) -> list[Path]:
    """Write every `stride`-th frame of a video as PNG into a folder; returns their paths."""
    # FFmpeg takes a name such as 10:05:07.mp4 for an address, and reads text as pictures of it
    path = require_file(path, "video").absolute()
    expected = "a video that FFmpeg reads, of two frames at least"
    refuse = partial(DataError, where=path, expected=expected, hint="give a folder of images")
    with path.open("rb") as file:
        start = file.read(4096)
    if b"\0" not in start:
        found = "text" if start else "nothing"
        raise refuse("file is neither an image nor a video", found=found)
    try:
        str(path).encode()
    except UnicodeEncodeError:
        # OpenCV would crash
        raise DataError("name of a video is not UTF-8", where=path, hint="rename it") from None
    images = _of_gif(path, stride) if start.startswith(b"GIF8") else _of_video(path, stride)
    names: list[str] = []
    with staged(folder, whole=True) as new:
        for image in islice(images, most):
            names.append(f"{len(names):04d}.png")
            write_png(new / names[-1], image)
        if len(names) < 2:
            raise refuse("video has fewer than two readable frames", found=len(names))
    return [folder / name for name in names]


def _of_video(path: Path, stride: int) -> Iterator[Image]:
    """Every `stride`-th frame of a video up to the first that cannot be read."""
    video = cv2.VideoCapture(str(path))
    for index in count():
        if not video.grab():
            break
        if index % stride == 0:
            good, image = video.retrieve()
            if not good:
                break
            yield np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)
    video.release()


def _of_gif(path: Path, stride: int) -> Iterator[Image]:
    """The same of a GIF by Pillow: FFmpeg ends at a frame without a duration."""
    # decoders raise many types
    with suppress(Exception), PIL.Image.open(path) as gif:
        for image in islice(ImageSequence.Iterator(gif), 0, None, stride):
            yield np.asarray(image.convert("RGB"))


def in_order(paths: Sequence[Path]) -> list[Path]:
    """Files by the numbers in their names.

    DataError if digits around a point may be a decimal (9.25, 9.5) or two numbers (0.9, 0.10) and
    the orders differ.
    """
    decimals, numbers = (
        sorted(paths, key=lambda path: [_by_number(part, digits) for part in path.parts])
        for digits in (r"(\d+(?:\.\d+)?)", r"(\d+)")
    )
    if decimals != numbers:
        raise DataError(
            "the order of the frames is not clear",
            where=paths[0].parent,
            found=f"by decimals {', '.join(p.name for p in decimals[:4])} ..., by numbers"
            f" {', '.join(p.name for p in numbers[:4])} ...",
            hint="name the files one by one, or write numbers with the same number of digits",
        )
    return numbers


def _by_number(name: str, digits: str) -> list[Any]:
    """Sort key that orders what matches `digits` by value."""
    words = re.split(digits, name)
    return [(1, Decimal(word), "") if k % 2 else (0, 0, word) for k, word in enumerate(words)]
