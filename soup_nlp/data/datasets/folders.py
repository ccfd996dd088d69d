"""Inputs from files: what all kinds share, folders of two frames, the Motorcycle pair.

Each needs the two images and the camera. The truth is None without its file, and NaN where unknown.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
import skimage
from numpy.typing import NDArray
from pydantic import Field

from soup_nlp.arrays import Float
from soup_nlp.data.formats.camera_files import read_intrinsics, undistorted
from soup_nlp.data.formats.cameras import check_cameras, estimated_cameras
from soup_nlp.data.formats.images import read_images, read_mask
from soup_nlp.data.formats.map_files import read_arrays, read_depth, read_flow
from soup_nlp.data.pair import Pair, Truth
from soup_nlp.errors import DataError
from soup_nlp.geometry.camera import intrinsics
from soup_nlp.schema.section import Positive, Section
from soup_nlp.storage.files import PathLike, as_path, is_file, is_folder
from soup_nlp.storage.folders import SUMS, read_sums

T = TypeVar("T")
Resolve = Callable[[str], Path]
"""Full path of a name in the problem file."""


class PairInput(Section, ABC):
    """Base of every kind of input."""

    @abstractmethod
    def load(self, path: Resolve) -> Pair:
        """The pair, without its flow; `path` resolves the names of files."""

    def files(self) -> list[str]:
        """Names of the files and folders that are read."""
        return [getattr(self, name) for name in ("root", "path") if name in type(self).model_fields]


class FramesInput(PairInput):
    """Base of the inputs of image files: options about the truth and the pixels."""

    depth_scale: Positive | None = None
    """Values per unit of length of a 16-bit .png depth; null for 1000, with a warning."""
    unit: str = "m"
    """Unit of the true depth."""
    white: Annotated[int, Field(ge=1, le=65535)] | None = None
    """Value of 16-bit images that is white, 4095 where they hold 12 bits; null for the values that
    occur."""
    cropped: bool = False
    """The images are parts of larger ones: the principal point may be anywhere."""


class Folder:
    """The folder of a dataset, or the folder `below` in it; `layout` names the expected files."""

    def __init__(self, path: PathLike, layout: str, below: str = "") -> None:
        self.path, self.layout = as_path(path, "dataset folder"), layout
        if not is_folder(self.path):
            found, expected = "a file" if is_file(path) else "nothing", f"a folder with {layout}"
            what = "dataset folder is missing"
            raise DataError(what, where=path, found=found, expected=expected)
        self.path = self.path / below if is_folder(self.path / below) else self.path

    def find(self, *names: str) -> Path | None:
        """The first of these files that exists; None if there is none."""
        return next((self.path / name for name in names if is_file(self.path / name)), None)

    def need(self, *names: str) -> Path:
        """The first of these files that exists; the error names the first missing folder."""
        file = self.find(*names)
        if file is not None:
            return file
        path = self.path / names[0]
        folder = next(folder for folder in path.parents if is_folder(folder))
        raise DataError(
            "file of the dataset is missing",
            where=path,
            found=f"{folder} has no {path.relative_to(folder).parts[0]}",
            expected=self.layout,
            hint="check the root folder and the frame, or rearrange the files to this layout",
        )

    def read(self, reader: Callable[..., T], *names: str, **options: Any) -> T | None:
        """Contents of the first of these files that exists; None if there is none."""
        file = self.find(*names)
        return None if file is None else reader(file, **options)


def make_pair(
    images: Sequence[Path],
    cameras: Sequence[Float | None],
    truth: Truth,
    white: int | None = None,
    *,
    cropped: bool = False,
    fov: float | None = None,
    focal_sigma: float = 0.0,
    distortion: Sequence[Float] = (),
) -> Pair:
    """The pair of two image files; its truth is None if no part of it is known.

    Intrinsics (3, 3) that are None are estimated (`estimated_cameras`) from `fov`, degrees, with
    the deviation `focal_sigma`; if both are, images are rotated by their EXIF orientation. For
    `white` see `read_images`, for `cropped` see `check_cameras`. The `distortion` (n,) of both
    lenses is removed from the images, see `undistorted`.
    """
    # a given camera may belong to the stored or to the rotated image
    pictures = read_images(images, white, turn=all(K is None for K in cameras))
    if any(K is None for K in cameras):
        estimated, guessed = estimated_cameras(images, pictures, fov)
        focal_sigma = max(focal_sigma, guessed)
    matrices = [estimated[k] if K is None else K for k, K in enumerate(cameras)]
    check_cameras(matrices, pictures, images, cropped)
    for k, coefficients in enumerate(distortion):
        pictures[k], matrices[k] = undistorted(pictures[k], matrices[k], coefficients)
    (ref, following), (K_ref, K_next) = pictures, matrices
    known = truth if truth.known() else None
    return Pair(ref, following, K_ref, K_next, truth=known, focal_sigma=focal_sigma)


# --- a folder of two frames -----------------------------------------------------------------------

LAYOUT = (
    "frame_0.png, frame_1.png, K.txt; optional K_next.txt, depth.npy|dpt|pfm|png, depth_next.*, "
    "flow.flo|png|npy, moving.png, points.npz"
)
_IMAGES = ".png .jpg .jpeg .tif .tiff .ppm .pgm .bmp"
_DEPTHS = ".npy .dpt .pfm .png"


def _names(stems: str, suffixes: str) -> list[str]:
    return [f"{stem}{suffix}" for stem in stems.split() for suffix in suffixes.split()]


class FolderInput(FramesInput):
    """A folder with two images, `K.txt` and optional truth.

    Files, of which the first existing one is used (images may also be jpg, tif, ppm, bmp):

    - `frame_0.png`, `frame_1.png`
    - `K.txt`: 3x3 intrinsics, or fx fy cx cy; `K_next.txt` if the next frame's differ
    - optional truth: `depth`, `depth_0` or `depth_ref` (.npy, .dpt, .pfm, 16-bit .png),
      `depth_next` or `depth_1`, `flow` (.flo, .npy, KITTI .png), `moving.png` (white = moves by
      itself; every connected region is one component)
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
        truth = Truth(
            depth_ref=depth,
            depth_next=depth_next,
            flow=folder.read(read_flow, *_names("flow", ".flo .npy .png")),
            components=folder.read(_read_regions, *_names("moving", _IMAGES)),
            points=folder.read(_read_points, "points.npz", unit=self.unit),
            unit=self.unit,
        )
        cameras = [K, K if K_next is None else K_next]
        return make_pair(images, cameras, truth, self.white, cropped=self.cropped)


def _refuse_result(folder: Folder) -> None:
    marked = read_sums(folder.path) is not None
    if marked or folder.find("result.h5"):
        raise DataError(
            "input folder holds a result, whose depth and flow would pass for truth",
            where=folder.path,
            found=f"{SUMS if marked else 'result.h5'} of a solve",
            expected="a folder with inputs only",
            hint="move the frames, K.txt and the truth to a folder of their own"
            + (f"; delete {SUMS} where no solve has left files" if marked else ""),
        )


def _read_regions(path: Path) -> NDArray[np.int32]:
    """Connected regions (H, W) of a mask, 0 for what is black."""
    return np.asarray(skimage.measure.label(read_mask(path), connectivity=2), np.int32)


def _read_points(path: Path, unit: str) -> Float:
    """(M, 3) sparse truth (u, v, z) from points.npz."""
    arrays = read_arrays(path, "points file")
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
    return points[np.isfinite(points).all(axis=1) & (points[:, 2] > 0)]


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
        try:
            left, right, disparity = skimage.data.stereo_motorcycle()
        except Exception as error:  # pooch, requests and OSError, by version
            raise DataError(
                "the Motorcycle pair is not available",
                where="skimage.data.stereo_motorcycle",
                found=str(error).strip().splitlines()[0] if str(error) else type(error).__name__,
                expected="the images in scikit-image's cache, or a connection to fetch them",
                hint="install pooch and call skimage.data.stereo_motorcycle() once online",
            ) from error
        focal, cx, cy, doffs, baseline = 994.978, 311.193, 254.877, 31.086, 0.193001
        valid = np.isfinite(disparity) & (disparity > 0)
        d = np.where(valid, disparity.astype(np.float64), np.nan)
        truth = Truth(
            depth_ref=focal * baseline / (d + doffs),
            flow=np.dstack([-d, np.where(valid, 0.0, np.nan)]),
            components=np.where(valid, 0, -1).astype(np.int32),
            scene_flow=np.where(valid[:, :, None], [-baseline, 0.0, 0.0], np.nan),
        )
        return Pair(
            image_ref=left,
            image_next=right,
            K_ref=intrinsics(focal, focal, cx, cy),
            K_next=intrinsics(focal, focal, cx + doffs, cy),
            truth=truth,
        )
