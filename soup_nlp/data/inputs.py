"""Inputs of a problem file, each with its loader: a depth prior, and the kinds of input."""

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, Field
from pydantic_core import PydanticKnownError

from soup_nlp.arrays import Float
from soup_nlp.data.datasets.benchmarks import KittiInput, SintelInput, TumInput, VkittiInput
from soup_nlp.data.datasets.folders import (
    FolderInput,
    FramesInput,
    MotorcycleInput,
    PairInput,
    Resolve,
    make_pair,
)
from soup_nlp.data.flow.sources import is_network
from soup_nlp.data.formats.camera_files import read_camera, read_intrinsics
from soup_nlp.data.formats.map_files import prior_of, read_depth
from soup_nlp.data.network import learned_map
from soup_nlp.data.pair import Pair, Truth
from soup_nlp.data.scenes.catalogue import LAYOUTS, render_scene
from soup_nlp.errors import ConfigError, DataError
from soup_nlp.geometry.camera import intrinsics
from soup_nlp.schema.section import MAX_SIDE, Finite, Index, NonNegative, Positive, Section, Seed

SAME_SHAPE = 0.02
"""Largest relative difference of the aspect ratios of a prior and its image."""


class PriorOptions(Section):
    """A depth prior of the reference frame."""

    source: str | None = None
    """File of a depth (.npy .npz .pfm .dpt .png) or of a network (.onnx); null for no prior."""
    kind: Literal["metric", "relative", "inverse", "ordinal"] | None = None
    """What the values are: metric (depth in the unit of length), relative (depth up to scale),
    inverse (inverse depth up to scale and shift) or ordinal (numbers that only rise with depth);
    null to find out by the flow, and relative where it does not tell."""

    def require_prior(self, in_memory: bool = False) -> None:
        """Raise ConfigError for a kind without a prior, in a file or `in_memory`."""
        if self.kind is not None and self.source is None and not in_memory:
            raise ConfigError(
                "a depth prior has a kind, but no source",
                where="depth_prior",
                found=f"kind {self.kind}",
                expected="a source beside the kind, such as --depth-prior FILE, or neither",
            )

    def load(self, pair: Pair, path: Resolve) -> Pair:
        """The pair with the prior of the source, if there is one; `path` resolves its name."""
        self.require_prior(pair.depth_prior is not None)
        if self.source is None:
            return pair
        name = str(path(self.source))
        network = is_network(name)
        return pair_with_prior(pair, learned_map(name, pair.image_ref) if network else name, name)


def pair_with_prior(pair: Pair, source: object, where: str) -> Pair:
    """The pair with a depth prior, a map (h, w) or its file, resized to the reference image."""
    prior, (height, width) = prior_of(source), pair.size
    if abs(np.log(prior.shape[1] * height / (prior.shape[0] * width))) > SAME_SHAPE:
        raise DataError(
            "depth prior and reference image differ in shape",
            where=where,
            found=f"{prior.shape[1]}x{prior.shape[0]} for an image of {width}x{height}",
            expected="a map of the whole image, at any size",
        )
    if not np.isfinite(prior).any():
        raise DataError(
            "depth prior is unknown everywhere",
            where=where,
            found="only 0, NaN and infinite values",
            expected="positive numbers where it is known",
            hint="is it the right file, and of the reference image?",
        )
    if prior.shape != pair.size:
        prior = cv2.resize(prior, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
    return replace(pair, depth_prior=prior)


Camera = Annotated[list[Finite], Field(min_length=4, max_length=4)]


class FilesInput(FramesInput):
    """Two image files and their cameras; the flow file is named under `flow.source`."""

    kind: Literal["files"]
    """Kind of input."""
    ref: str
    """Reference image."""
    next: str
    """Next image."""
    intrinsics: Camera | str | None = None
    """[fx, fy, cx, cy] of the reference frame in pixels, or a file with one camera; null for `fov`,
    or else EXIF's focal length, or else 1.2 times the longer side."""
    fov: Positive | None = None
    """Horizontal field of view of the reference frame as shown, degrees, where `intrinsics` is
    null; the next frame has the same lens unless EXIF names another."""
    focal_sigma: NonNegative = 0.0
    """Standard deviation of the logarithm of the focal length of `fov`; sigma includes its effect.
    From 0.4, that of a guess, the flow also corrects the focal length."""
    intrinsics_next: Camera | str | None = None
    """Camera of the next frame, in the same forms; null for that of the reference frame."""
    depth: str | None = None
    """True depth of the reference frame, for measuring only (.dpt .npy .npz .pfm .png)."""
    depth_next: str | None = None
    """True depth of the next frame."""
    undistort: bool = False
    """Remove the distortion that the files of the cameras hold from the images (OpenCV)."""

    def load(self, path: Resolve) -> Pair:
        """See `PairInput`."""
        if self.intrinsics is not None and self.fov is not None:
            what, found = "two cameras are given", "intrinsics and fov"
            raise ConfigError(what, where="input", found=found, expected="one of them")
        no_file = not isinstance(self.intrinsics, str)
        if self.undistort and (no_file or self.depth or self.depth_next):
            raise ConfigError(
                "images cannot be undistorted",
                where="input.undistort",
                found="no file of the camera" if no_file else "true depth",
                expected="intrinsics in a file with distortion, and no true depth, which would"
                " belong to the images before",
            )
        depth, depth_next = (
            None if name is None else read_depth(path(name), self.depth_scale)
            for name in (self.depth, self.depth_next)
        )
        truth = Truth(depth, depth_next, unit=self.unit)
        cameras: list[Float | None] = []
        lenses: list[Float] = []
        for camera in (self.intrinsics, self.intrinsics_next or self.intrinsics):
            K = intrinsics(*camera) if isinstance(camera, list) else None
            if isinstance(camera, str) and self.undistort:
                K, lens = read_camera(path(camera))
                lenses.append(lens)
            elif isinstance(camera, str):
                K = read_intrinsics(path(camera))
            cameras.append(K)
        return make_pair(
            [path(self.ref), path(self.next)],
            cameras,
            truth,
            self.white,
            cropped=self.cropped,
            fov=self.fov,
            focal_sigma=self.focal_sigma,
            distortion=lenses,
        )

    def files(self) -> list[str]:
        """See `PairInput`."""
        named = (self.ref, self.next, self.intrinsics, self.intrinsics_next)
        return [x for x in (*named, self.depth, self.depth_next) if isinstance(x, str)]


def _is_scene(name: str) -> str:
    if name not in LAYOUTS:
        raise PydanticKnownError("literal_error", {"expected": ", ".join(map(repr, LAYOUTS))})
    return name


class SceneInput(PairInput):
    """A rendered dynamic scene with exact truth."""

    kind: Literal["scene"]
    """Kind of input."""
    scene: Annotated[str, AfterValidator(_is_scene)]
    """Which scene."""
    seed: Seed = 0
    """Changes layout, textures and motions."""
    width: Annotated[int, Field(ge=64, le=MAX_SIDE)] = 1024
    """Columns, pixels."""
    height: Annotated[int, Field(ge=48, le=MAX_SIDE)] = 436
    """Rows, pixels."""
    frame: Index = 0
    """First frame of the pair; camera and components continue their motion of frames 0 and 1."""

    def load(self, path: Resolve) -> Pair:
        """See `PairInput`."""
        return render_scene(self.scene, self.seed, self.width, self.height, self.frame)


class MemoryInput(PairInput):
    """A pair in memory: its hash identifies a run, but the pair cannot be loaded again."""

    kind: Literal["memory"]
    """Kind of input."""
    hash: str
    """Of the images, cameras and flow."""

    def load(self, path: Resolve) -> NoReturn:
        """Raise ConfigError: the pair was in memory only."""
        raise ConfigError(
            "pair of this problem was in memory and is not stored",
            where="input.kind",
            found=f"memory, hash {self.hash}",
            expected="an input of files, such as kind: files",
            hint="solve it from Python with soup_nlp.solve_pair, or write the images to files",
        )

    def files(self) -> list[str]:
        """Raise ConfigError, see `load`."""
        self.load(Path)


Input = Annotated[
    FilesInput
    | FolderInput
    | MotorcycleInput
    | SceneInput
    | SintelInput
    | KittiInput
    | VkittiInput
    | TumInput
    | MemoryInput,
    Field(discriminator="kind"),
]
"""Input of a problem, selected by `kind`."""


def pair_hash(pair: Pair) -> str:
    """Hash of images, cameras and, if there is one, the flow."""
    digest = hashlib.sha256()
    arrays: list[NDArray[Any]] = [pair.image_ref, pair.image_next, pair.K_ref, pair.K_next]
    if pair.flow is not None:
        arrays += [pair.flow.uv, pair.flow.confidence]
    if pair.depth_prior is not None:
        arrays.append(pair.depth_prior)
    if pair.focal_sigma > 0:
        arrays.append(np.array(pair.focal_sigma))
    for array in arrays:
        digest.update(f"{array.dtype} {array.shape}\0".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()[:16]
