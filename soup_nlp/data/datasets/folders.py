"""Inputs with truth: plain folders, TUM RGB-D and the Motorcycle pair.

Each needs the two images and the camera. The truth is None without its file, and NaN where unknown.
"""

import re
from contextlib import suppress
from pathlib import Path
from typing import Any, Literal

import numpy as np
import skimage

from soup_nlp.arrays import Float
from soup_nlp.data.datasets.layout import Folder, FramesInput, PairInput, Resolve, make_pair
from soup_nlp.data.formats.camera_files import read_intrinsics
from soup_nlp.data.formats.images import assumed, read_mask
from soup_nlp.data.formats.map_files import read_depth, read_flow, read_npz
from soup_nlp.data.pair import Pair, Truth
from soup_nlp.errors import DataError
from soup_nlp.geometry.camera import intrinsics
from soup_nlp.schema.section import Index, Positive, Whole
from soup_nlp.storage.files import read_json, read_text
from soup_nlp.storage.folders import SUMS, read_sums

LAYOUT = (
    "frame_0.png, frame_1.png, K.txt; optional K_next.txt, depth.npy|dpt|pfm|png, depth_next.*, "
    "flow.flo|png|npy, occluded.png, moving.png, points.npz"
)
_IMAGES = ".png .jpg .jpeg .tif .tiff .ppm .pgm .bmp"
_DEPTHS = ".npy .dpt .pfm .png"

TUM_SCALE = 5000.0
"""Values per metre of a TUM RGB-D depth image."""

TUM_LAYOUT = "rgb.txt, depth.txt, rgb/*.png, depth/*.png, optional K.txt or camera.txt"
_TUM_CAMERAS = {
    "freiburg1": (517.3, 516.5, 318.6, 255.3),
    "freiburg2": (520.9, 521.0, 325.1, 249.7),
    "freiburg3": (535.4, 539.2, 320.1, 247.6),
    "": (525.0, 525.0, 319.5, 239.5),
}
_TUM_SLACK = 0.02  # seconds between a colour image and its depth image


def _names(stems: str, suffixes: str) -> list[str]:
    """Names of files with one of the stems and one of the suffixes, separated by blanks."""
    return [f"{stem}{suffix}" for stem in stems.split() for suffix in suffixes.split()]


class FolderInput(FramesInput):
    """A folder with two images, `K.txt` and optional truth.

    Files, of which the first existing one is used (images may also be jpg, tif, ppm, bmp):

    - `frame_0.png`, `frame_1.png`
    - `K.txt`: 3x3 intrinsics, or fx fy cx cy; `K_next.txt` if the next frame's differ
    - optional truth: `depth`, `depth_0` or `depth_ref` (.npy, .dpt, .pfm, 16-bit .png),
      `depth_next` or `depth_1`, `flow` (.flo, .npy, KITTI .png), `occluded.png` (white = occluded),
      `moving.png` (white = moves by itself; every connected region is one component)
    - optional sparse truth `points.npz`: `uv_0` (M, 2) pixels and `xyz_mm_0` (M, 3) millimetres in
      the reference camera; z is converted to `unit` when that is "m" and kept when it is "mm".
    """

    kind: Literal["folder"]
    """Kind of input."""
    path: str
    """The folder."""

    def load(self, path: Resolve) -> Pair:
        """See `PairInput`."""
        folder = Folder(path(self.path), LAYOUT)
        _refuse_result(folder)
        images = [folder.need(*_names(stem, _IMAGES)) for stem in ("frame_0", "frame_1")]
        K = read_intrinsics(folder.need("K.txt"))
        K_next = folder.read(read_intrinsics, "K_next.txt")
        depth, depth_next = (
            folder.read(read_depth, *_names(stems, _DEPTHS), scale=self.depth_scale)
            for stems in ("depth depth_0 depth_ref", "depth_next depth_1")
        )
        moving = folder.read(read_mask, *_names("moving", _IMAGES))
        if moving is not None:
            # connected regions
            moving = skimage.measure.label(moving, connectivity=2).astype(np.int32)
        truth = Truth(
            depth_ref=depth,
            depth_next=depth_next,
            flow=folder.read(read_flow, *_names("flow", ".flo .npy .png")),
            occluded=folder.read(read_mask, *_names("occluded", _IMAGES)),
            components=moving,
            points=folder.read(_read_points, "points.npz", unit=self.unit),
            unit=self.unit,
        )
        cameras = [K, K if K_next is None else K_next]
        return make_pair(images, cameras, truth, self.white, cropped=self.cropped)


def _refuse_result(folder: Folder) -> None:
    """Raise DataError for a folder with a result."""
    marked, summary = read_sums(folder.path) is not None, {}
    with suppress(DataError):
        summary = read_json(folder.path / "summary.json", "summary.json", dict[str, Any])
    if marked or "problem_hash" in summary:
        raise DataError(
            "input folder holds a result, whose depth and flow would pass for truth",
            where=folder.path,
            found=f"{SUMS} of a solve" if marked else "summary.json of a solve",
            expected="a folder with inputs only",
            hint="move the frames, K.txt and the truth to a folder of their own"
            + (f"; delete {SUMS} where no solve has left files" if marked else ""),
        )


def _read_points(path: Path, unit: str) -> Float:
    """(M, 3) sparse truth (u, v, z) from points.npz."""
    arrays = read_npz(path, "points file")
    uv, xyz = arrays.get("uv_0", np.empty(0)), arrays.get("xyz_mm_0", np.empty(0))
    if uv.ndim != 2 or uv.shape[1] != 2 or xyz.shape != (len(uv), 3):
        raise DataError(
            "points file lacks an array or has one of the wrong shape",
            where=path,
            found=", ".join(f"{name} {a.shape}" for name, a in arrays.items()) or "no array",
            expected="uv_0 (M, 2) in pixels and xyz_mm_0 (M, 3) in millimetres",
        )
    scales = {"m": 1000.0, "mm": 1.0}
    if unit not in scales:
        raise DataError("points are in millimetres", where=path, found=unit, expected="m or mm")
    points = np.column_stack([uv, xyz[:, 2] / scales[unit]]).astype(np.float64)
    return np.asarray(points[np.isfinite(points).all(axis=1) & (points[:, 2] > 0)])


class TumInput(PairInput):
    """TUM RGB-D, official layout, depth in metres.

    `rgb.txt` and `depth.txt` list time stamps and files; a depth image belongs to a colour image
    within 20 ms. Without `K.txt` or `camera.txt` the intrinsics are those published for the sensor
    in the name of the folder (freiburg1, 2 or 3), else 525, 525, 319.5, 239.5; lens distortion is
    not removed.
    """

    kind: Literal["tum"]
    """Kind of input."""
    path: str
    """Folder of the sequence."""
    frame: Index = 0
    """Index of the reference image in rgb.txt."""
    step: Whole = 1
    """Distance of the next image."""
    depth_scale: Positive | None = None
    """Values per metre of the depth images; null for the 5000 of TUM, with a warning."""

    def load(self, path: Resolve) -> Pair:
        """See `PairInput`."""
        folder = Folder(path(self.path), TUM_LAYOUT)
        images = _tum_list(folder.need("rgb.txt"))
        depths = folder.read(_tum_list, "depth.txt") or []
        numbers = self.frame, self.frame + self.step
        if numbers[1] >= len(images):
            raise DataError(
                "frame is not in the sequence",
                where=folder.path / "rgb.txt",
                found=numbers[1],
                expected=f"0 to {len(images) - 1}",
            )
        K = folder.read(read_intrinsics, "K.txt", "camera.txt")
        K = _tum_camera(folder.path) if K is None else K
        maps = []
        for time, _ in (images[k] for k in numbers):
            near = [entry for entry in depths if abs(entry[0] - time) <= _TUM_SLACK]
            best = [name for _, name in sorted(near, key=lambda entry: abs(entry[0] - time))[:1]]
            maps.append(folder.read(read_depth, *best, scale=self.depth_scale, usual=TUM_SCALE))
        files = [folder.need(images[k][1]) for k in numbers]
        return make_pair(files, [K, K], Truth(maps[0], maps[1]))


def _tum_camera(folder: Path) -> Float:
    """Intrinsics of TUM's sensors, by the name of the folder, with a warning."""
    sensor = re.search(r"freiburg[123]", str(folder.resolve()))
    name = sensor.group() if sensor else ""
    numbers = ",".join(f"{x:g}" for x in _TUM_CAMERAS[name])
    assumed(
        folder,
        "neither K.txt nor camera.txt beside rgb.txt",
        f"the intrinsics of {name or 'the default camera of TUM RGB-D'}, {numbers}",
    )
    return intrinsics(*_TUM_CAMERAS[name])


def _tum_list(path: Path) -> list[tuple[float, str]]:
    """(time stamp in seconds, name of a file) of each line of rgb.txt or depth.txt."""
    out = []
    for number, line in enumerate(read_text(path, "file list").splitlines(), 1):
        if not line.strip() or line.startswith("#"):
            continue
        words = line.split()
        try:
            out.append((float(words[0]), words[1]))
        except (ValueError, IndexError):
            raise DataError(
                "line of a file list is not understood",
                where=f"{path}, line {number}",
                found=repr(line[:60]),
                expected="'timestamp file'",
            ) from None
    return out


class MotorcycleInput(PairInput):
    """The Middlebury 2014 Motorcycle stereo pair of scikit-image, as a pair of frames in metres.

    The rectified cameras differ in their principal points, so a disparity d means
    Z = f B / (d + doffs) with f 994.978 px, doffs 31.086 px, B 0.193001 m, and the next (right)
    camera has cx + doffs. The motion of every pixel is the translation (-B, 0, 0); the true flow
    is (-d, 0).
    """

    kind: Literal["motorcycle"]
    """Kind of input."""

    def load(self, path: Resolve) -> Pair:
        """See `PairInput`."""
        from skimage import data

        try:
            left, right, disparity = data.stereo_motorcycle()
        except Exception as error:  # pooch, requests and OSError, by version
            raise DataError(
                "the Motorcycle pair is not available",
                where="skimage.data.stereo_motorcycle",
                found=str(error).strip().splitlines()[0] if str(error) else type(error).__name__,
                expected="the images in scikit-image's cache, or a connection to fetch them",
                hint="install pooch and call skimage.data.stereo_motorcycle() once online",
            ) from error
        focal, cx, cy, doffs, baseline = 994.978, 311.193, 254.877, 31.086, 0.193001
        d = np.asarray(disparity, dtype=np.float64)
        d = np.where(np.isfinite(d) & (d > 0), d, np.nan)
        valid = np.isfinite(d)
        truth = Truth(
            depth_ref=focal * baseline / (d + doffs),
            flow=np.dstack([-d, np.where(valid, 0.0, np.nan)]),
            components=np.where(valid, 0, -1).astype(np.int32),
            scene_flow=np.where(valid[:, :, None], [-baseline, 0.0, 0.0], np.nan),
        )
        return Pair(
            image_ref=np.ascontiguousarray(left[:, :, :3]),
            image_next=np.ascontiguousarray(right[:, :, :3]),
            K_ref=intrinsics(focal, focal, cx, cy),
            K_next=intrinsics(focal, focal, cx + doffs, cy),
            truth=truth,
        )
