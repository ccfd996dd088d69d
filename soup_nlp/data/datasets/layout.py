"""Shared parts of the kinds of input: base class, folder of a dataset, pair of images."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import Field

from soup_nlp.arrays import Float
from soup_nlp.data.formats.camera_files import undistorted
from soup_nlp.data.formats.cameras import check_cameras, estimated_cameras
from soup_nlp.data.formats.images import read_images
from soup_nlp.data.pair import Pair, Truth
from soup_nlp.errors import DataError
from soup_nlp.schema.section import Positive, Section
from soup_nlp.storage.files import PathLike, as_path, is_file, is_folder

T = TypeVar("T")
Resolve = Callable[[str], Path]
"""Full path of a name in the problem file."""
White = Annotated[int, Field(ge=1, le=65535)]


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
    white: White | None = None
    """Value of 16-bit images that is white, 4095 where they hold 12 bits; null for the values that
    occur."""
    cropped: bool = False
    """The images are parts of larger ones: the principal point may be anywhere."""


class Folder:
    """The folder of a dataset, or the folder `below` in it; `layout` names the expected files."""

    def __init__(self, path: PathLike, layout: str, below: str = "") -> None:
        self.path, self.layout = as_path(path, "dataset folder"), layout
        if not is_folder(self.path):
            raise DataError(
                "dataset folder is missing",
                where=path,
                found="a file" if is_file(path) else "nothing",
                expected=f"a folder with {layout}",
            )
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
        folder = path.parent
        while not is_folder(folder) and folder != folder.parent:
            folder = folder.parent
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
    fov: float | None = None,
    focal_sigma: float = 0.0,
    cropped: bool = False,
    distortion: Sequence[Float] = (),
) -> Pair:
    """The pair of two image files; its truth is None if no part of it is known.

    Args:
        images: Reference and next image.
        cameras: (3, 3) intrinsics of both frames, pixels; None is estimated (`estimated_cameras`).
            If both are None, images are rotated by their EXIF orientation.
        truth: Truth from its files.
        white: Value of white in 16-bit images, see `read_images`.
        fov: Horizontal field of view, degrees, if the cameras are not known.
        focal_sigma: Standard deviation of the log focal length of `fov`.
        cropped: The images are parts of larger ones, see `check_cameras`.
        distortion: Coefficients (n,) of both lenses, removed from the images, see `undistorted`.
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
