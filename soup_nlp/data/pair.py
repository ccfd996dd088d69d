"""Input of a solve: two images, two cameras, a flow and, if known, the truth."""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import NoneType
from typing import Self

import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float, FloatMap, Image
from soup_nlp.data.formats.camera_files import CameraLike, camera_of
from soup_nlp.data.formats.cameras import estimated_cameras
from soup_nlp.data.formats.images import ImageLike, array_of, image_of, is_path, read_images
from soup_nlp.data.formats.map_files import UNKNOWN_FLOW, FlowLike, flow_layout, prior_of, read_flow
from soup_nlp.errors import DataError, expect, one_line, printable, repr_of

SHORTEST = 0.05
"""Smallest focal length relative to the side of the image (168 degrees of view)."""
LARGEST = 1e100
"""Largest number in a truth, so that sums of squares stay finite."""


def check_size(
    what: str,
    shape: tuple[int, ...],
    expected: tuple[int, ...],
    where: object,
    hint: str | None = None,
) -> None:
    """Raise DataError unless two shapes, which may have more axes, have equal (height, width)."""
    if shape[:2] != expected[:2]:
        raise DataError(
            f"{what} differ in size",
            where=where,
            found=shape,
            expected=f"{expected[:2]} (height, width)",
            hint=hint,
        )


@dataclass(frozen=True, eq=False, init=False)
class Flow:
    """A dense flow from the reference to the next image.

    It is made from an array (H, W, 2) or (2, H, W) or from a file. The default confidence is 1
    where the flow is finite, else 0.

    Attributes:
        uv: (H, W, 2) float32, displacement in pixels (u right, v down); 0 where unknown.
        confidence: (H, W) float32 in [0, 1]; pixels with 0 are not used.
        source: Origin for reports ("dis", "truth", a file name ...).

    Raises:
        DataError: the array is no flow, or the confidence has a wrong size or range.
    """

    uv: FloatMap
    confidence: FloatMap
    source: str

    def __init__(self, uv: FlowLike, confidence: object = None, source: str = "unknown") -> None:
        put = partial(object.__setattr__, self)
        named = is_path(uv) and source == "unknown"
        put("source", printable(uv if named else source))
        what, expected = "flow", "numbers (H, W, 2) or (2, H, W) in pixels, or a path"
        flow = array_of(read_flow(uv) if is_path(uv) else uv, what, self.source, expected)
        flow = flow_layout(flow, self.source)
        if flow.dtype.kind != "f" or flow.dtype.itemsize < 4:
            flow = flow.astype(np.float32)
        if confidence is None:
            confidence = known = (np.abs(flow) < UNKNOWN_FLOW).all(axis=2)
            flow = np.where(known[..., None], flow, 0)
        what, expected = "flow confidence", "numbers (H, W) from 0 to 1"
        sure = array_of(confidence, what, self.source, expected, "fiub", "(H, W)")
        check_size("flow confidence and flow", sure.shape, flow.shape, self.source)
        put("uv", flow)
        put("confidence", sure if sure.dtype.kind == "f" else sure.astype(np.float32))
        # False for NaN
        fits = (self.confidence >= 0) & (self.confidence <= 1)
        if not fits.all():
            raise DataError(
                "flow confidence is out of range",
                where=self.source,
                found=f"{int((~fits).sum())} such pixels, {self.confidence[~fits][0]} the first",
                expected="0 to 1",
                hint="0 is for pixels that are not to be used",
            )
        if not np.isfinite(self.uv[self.confidence > 0]).all():
            raise DataError(
                "flow has NaN or infinite values where its confidence is positive",
                where=self.source,
                found=f"{int((~np.isfinite(self.uv)).any(-1).sum())} such pixels",
                expected="finite displacements, or confidence 0",
                hint="mark unknown pixels as invalid in the flow file",
            )

    @property
    def usable(self) -> float:
        """Share of the pixels whose flow is used."""
        return float(np.mean(self.confidence > 0))

    def __repr__(self) -> str:
        h, w = self.confidence.shape
        return f"Flow({self.source}, {w}x{h}, {self.usable:.1%} usable)"


_PARTS = {
    "depth_ref": ("(H, W)", "fiu"),
    "depth_next": ("(H, W)", "fiu"),
    "flow": ("(H, W, 2)", "fiu"),
    "components": ("(H, W)", "iu"),
    "motions": ("(B, 4, 4)", "fiu"),
    "points": ("(M, 3)", "fiu"),
    "scene_flow": ("(H, W, 3)", "fiu"),
}
"""Shape and kinds of number of every part of a truth."""


@dataclass(frozen=True, eq=False)
class Truth:
    """Ground truth of the scene, for evaluation only; any part may be None.

    Attributes:
        depth_ref: (H, W) z of the reference frame in `unit`; NaN where unknown.
        depth_next: (H', W') z of the next frame; NaN where unknown.
        flow: (H, W, 2) true flow, pixels; NaN where unknown.
        components: (H, W) int component of the reference pixels, -1 for none.
        motions: (B, 4, 4) next_from_ref of each component, in `unit`.
        points: (M, 3) sparse truth (u, v, z) of the reference frame, sub-pixel.
        scene_flow: (H, W, 3) X' - X in each frame's own camera coordinates, NaN where unknown.
        unit: Name of the length unit ("m", "mm", "scene").
    """

    depth_ref: Float | None = None
    depth_next: Float | None = None
    flow: Float | None = None
    components: NDArray[np.int32] | None = None
    motions: Float | None = None
    points: Float | None = None
    scene_flow: Float | None = None
    unit: str = "m"

    def __post_init__(self) -> None:
        one_line(self.unit, "unit of the truth", "unit (input.unit)")
        for name, (axes, kinds) in _PARTS.items():
            value = getattr(self, name)
            if value is None:
                continue
            expected = f"{axes} array of numbers"
            where, what = f"truth.{name}", "part of the truth"
            hint = "soup_nlp.Truth(depth_ref=array); files are read by a problem's input"
            made = array_of(value, what, where, expected, kinds, axes, hint)
            # float32 cannot be compared with a limit beyond its range
            made = made.astype(np.float64) if made.dtype.kind == "f" else made
            most = np.abs(made[np.isfinite(made)]).max(initial=0)
            if most > LARGEST:
                raise DataError(
                    f"{what} has numbers whose squares overflow",
                    where=where,
                    found=f"{most:g}",
                    expected=f"at most {LARGEST:g}",
                    hint="NaN marks what is unknown",
                )
            object.__setattr__(self, name, made)

    def known(self) -> list[str]:
        """Names of the parts that are not None."""
        return [name for name, value in vars(self).items() if value is not None and name != "unit"]

    def __repr__(self) -> str:
        return f"Truth({', '.join(self.known()) or 'nothing'}; {self.unit})"


@dataclass(frozen=True, eq=False, init=False)
class Pair:
    """Two consecutive frames with cameras, flow and truth.

    Images may be arrays, files or PIL images, also grey ones. Cameras may be matrices,
    (fx, fy, cx, cy) or files; the default camera of the next frame is that of the reference frame.
    Without K_ref, the focal length follows from `fov`, the horizontal field of view in degrees, or
    from the EXIF of a file, or it is a guess. A flow may be an array or a file.

    Attributes:
        image_ref: (H, W, 3) uint8 RGB reference image, indexed [v, u].
        image_next: (H', W', 3) uint8 RGB next image.
        K_ref: (3, 3) intrinsics of the reference frame, pixels; (0, 0) is the centre of the
            top-left pixel.
        K_next: (3, 3) intrinsics of the next frame.
        flow: The flow from reference to next, or None if it is not estimated yet.
        truth: The truth, or None.
        name: Name for titles and folders.
        depth_prior: (H, W) depth of the reference frame from another method, or inverse depth or
            order (`data.inputs.PriorOptions`); NaN where unknown. An array or the name of a file.
        focal_sigma: Standard deviation of the log focal length; 0 for a known focal length. From
            0.4, that of a guess, the flow corrects the focal length.

    Raises:
        DataError: an image has a wrong shape or type, a camera is invalid, or sizes differ.
    """

    image_ref: Image
    image_next: Image
    K_ref: Float
    K_next: Float
    flow: Flow | None
    truth: Truth | None
    name: str
    depth_prior: Float | None
    focal_sigma: float

    def __init__(
        self,
        image_ref: ImageLike,
        image_next: ImageLike,
        K_ref: CameraLike = None,
        K_next: CameraLike = None,
        flow: Flow | FlowLike | None = None,
        truth: Truth | None = None,
        name: str = "pair",
        fov: float | None = None,
        depth_prior: object = None,
        focal_sigma: float = 0.0,
    ) -> None:
        put = partial(object.__setattr__, self)
        put("name", one_line(name, "name of the pair", "name"))
        truths = "soup_nlp.Truth(depth_ref=..., ...) or None"
        expect(truth, (Truth, NoneType), "truth of the pair", truths)
        put("truth", truth)
        given = {"image_ref": image_ref, "image_next": image_next}
        # files may have EXIF, and 16-bit files have one range of values
        files = [Path(image) if is_path(image) else None for image in given.values()]
        known = [path for path in files if path is not None]
        read = iter(read_images(known, turn=K_ref is None))
        for path, (what, image) in zip(files, given.items(), strict=True):
            put(what, image_of(image if path is None else next(read), what))
        images = self.image_ref, self.image_next
        if K_ref is None:
            (K_ref, estimated), focal_sigma = estimated_cameras(files, images, fov)
            K_next = estimated if K_next is None else K_next
        elif fov is not None:
            raise DataError("two cameras are given", found="K_ref and fov", expected="one of them")
        if not (isinstance(focal_sigma, int | float) and 0 <= focal_sigma < np.inf):
            raise DataError(
                "standard deviation of the log focal length is out of range",
                where="focal_sigma",
                found=repr_of(focal_sigma),
                expected="a finite number, at least 0; 0 for a known focal length",
            )
        put("focal_sigma", focal_sigma)
        cameras = {"K_ref": K_ref, "K_next": K_ref if K_next is None else K_next}
        for image, (what, camera) in zip(images, cameras.items(), strict=True):
            put(what, camera_of(camera, what))
            _check_focal(getattr(self, what), image, what)
        put("depth_prior", None if depth_prior is None else prior_of(depth_prior))
        put("flow", flow if isinstance(flow, Flow | None) else Flow(flow))
        self._check_sizes()

    def _check_sizes(self) -> None:
        size = self.image_ref.shape
        if self.depth_prior is not None:
            check_size("depth prior and reference image", self.depth_prior.shape, size, "prior")
        if self.flow is not None:
            hint = "compute the flow at the size of the image; it is not resized"
            what = "flow and reference image"
            check_size(what, self.flow.uv.shape, size, self.flow.source, hint)
        for name in self.truth.known() if self.truth else []:
            if name not in ("motions", "points"):
                next_ = name == "depth_next"
                what = f"truth and {'next' if next_ else 'reference'} image"
                expected = self.image_next.shape if next_ else size
                check_size(what, getattr(self.truth, name).shape, expected, f"truth.{name}")

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of the reference image."""
        return self.image_ref.shape[0], self.image_ref.shape[1]

    def with_flow(self, flow: Flow) -> Self:
        """The same pair with another flow."""
        return replace(self, flow=flow)

    def with_focal(self, factor: float, sigma: float) -> Self:
        """The same pair with focal lengths times a factor; `sigma` is that of their logarithm."""
        longer = np.array([[factor, factor, 1.0]] * 2 + [[1.0] * 3])
        K_ref, K_next = longer * self.K_ref, longer * self.K_next
        return replace(self, K_ref=K_ref, K_next=K_next, focal_sigma=sigma)

    def __repr__(self) -> str:
        h, w = self.size
        return f"Pair({self.name}, {w}x{h}, {self.flow or 'no flow'}, {self.truth or 'no truth'})"


def _check_focal(K: Float, image: Image, where: str) -> None:
    for focal, side, name in ((K[0, 0], image.shape[1], "fx"), (K[1, 1], image.shape[0], "fy")):
        if focal < SHORTEST * side:
            raise DataError(
                "focal length is far too short for the image",
                where=where,
                found=f"{name} {focal:g} at {side} pixels",
                expected="focal lengths in pixels, mostly 0.5 to 3 times the width",
                hint="multiply normalised intrinsics by the image's size:"
                " fx and cx by the width, fy and cy by the height",
            )
