"""A result for other programs: images, cameras, surfaces and motions, of a run or a folder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml
from numpy.typing import NDArray

from soup_nlp.errors import DataError
from soup_nlp.evaluate.confidence import MIN_CONFIDENCE, SIGMA_PRIOR
from soup_nlp.geometry.components import Components, find_components
from soup_nlp.geometry.graph import Segmentation
from soup_nlp.geometry.soup import Reconstruction, Soup, reconstruct
from soup_nlp.geometry.surface import at_jumps, hidden, joined
from soup_nlp.report.check_arrays import require_layout
from soup_nlp.storage.files import as_path
from soup_nlp.storage.h5_files import read_attrs, read_h5
from soup_nlp.storage.store import require

if TYPE_CHECKING:
    from soup_nlp.pipeline.record import Run

Float = NDArray[np.float64]
Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]

UNIT = "soup unit (free scale: the mean distance of the planes is 1)"
"""Unit of lengths in files."""
FRAMES = ("ref", "next")
"""Names of both frames in files."""


@dataclass(frozen=True, eq=False)
class Result:
    """Both frames of a solved pair, ready for files.

    Attributes:
        name: For titles.
        images: (H, W, 3) and (H', W', 3) uint8 RGB.
        K: (3, 3) intrinsics of both frames, pixels.
        reconstruction: Dense 3D of both frames.
        components: What moves as one, and how.
        flow_confidence: (H, W) of the flow that was solved with, 0 to 1.
        metre: Lengths of the truth in a unit of the reconstruction, where a truth is known.
        metre_unit: Name of the truth's unit.
        min_confidence: Least confidence of the points in clouds and meshes.
    """

    name: str
    images: tuple[Image, Image]
    K: tuple[Float, Float]
    reconstruction: Reconstruction
    components: Components
    flow_confidence: NDArray[np.floating]
    metre: float | None = None
    metre_unit: str = "m"
    min_confidence: float = MIN_CONFIDENCE

    def __str__(self) -> str:
        h, w = self.images[0].shape[:2]
        return f"Result({self.name}, {w}x{h}, {self.reconstruction}, {self.components})"

    __repr__ = __str__

    @property
    def depths(self) -> tuple[Float, Float]:
        """z of both frames, each of its own pixels; NaN where unknown."""
        return self.reconstruction.depth_ref, self.reconstruction.depth_next

    @property
    def points(self) -> tuple[Float, Float]:
        """(H, W, 3) the points of the reference image, in the camera of both frames."""
        return self.reconstruction.points_ref, self.reconstruction.points_next

    @property
    def normals(self) -> tuple[Float, Float]:
        """(H, W, 3) normals of `points`."""
        return self.reconstruction.normals, self.reconstruction.normals_next

    @property
    def unit(self) -> str:
        """Unit of lengths in a sentence for headers of files."""
        if self.metre is None or not np.isfinite(self.metre):
            return UNIT
        return f"{UNIT}; about {self.metre:.6g} {self.metre_unit} by the truth of this pair"

    @property
    def sigma(self) -> Float | None:
        """(H, W) standard deviation of log depth of the reference frame, where it is known."""
        return self.reconstruction.sigma_ref

    @property
    def confidence(self) -> Float:
        """(H, W) 1 where depth is certain, 0 where nothing is known of it; 1 without sigma."""
        if self.sigma is None:
            return np.ones(self.flow_confidence.shape)
        return np.asarray(1.0 - self.sigma / SIGMA_PRIOR)

    @cached_property
    def surface(self) -> tuple[Mask, Mask]:
        """Where the surface goes on to the right and downwards, see `geometry.surface.joined`."""
        return joined(self.reconstruction, self.K[0], self.components.of_pixel)

    @cached_property
    def sure(self) -> Mask:
        """(H, W) pixels of clouds: seen in both frames, no guess and not at a jump of the depth."""
        known = self.confidence >= self.min_confidence
        return known & ~hidden(self.reconstruction) & ~at_jumps(*self.surface)


def result_of(run: Run) -> Result:
    """The result of a run."""
    pair, m = run.pair, run.metrics.get("solution")
    assert pair.flow is not None
    return Result(
        name=run.problem.name,
        images=(pair.image_ref, pair.image_next),
        K=(pair.K_ref, pair.K_next),
        reconstruction=run.reconstruction,
        components=run.components,
        flow_confidence=pair.flow.confidence,
        metre=None if m is None else m.scale,
        metre_unit="m" if pair.truth is None else pair.truth.unit,
        min_confidence=run.problem.output.min_confidence,
    )


def read_result(folder: Path) -> Result:
    """The result of a folder that `solve` wrote.

    Raises:
        DataError: it has no result.h5, or one that does not hold what is needed.
    """
    path = as_path(folder, "result folder") / "result.h5"
    tree, attrs = read_h5(path), read_attrs(path)
    if "image_ref" not in tree.get("input", {}):
        raise DataError(
            "result holds no images",
            where=path,
            expected="input/image_ref and input/image_next",
            hint="solve the pair again: an older version has written this result",
        )
    require_layout(tree)
    try:
        return _result(tree, attrs)
    except (KeyError, IndexError, ValueError, TypeError, yaml.YAMLError) as error:
        raise DataError("result does not hold together", where=path, found=error) from error


def _result(tree: Mapping[str, Any], attrs: Mapping[str, Any]) -> Result:
    images = [require(tree, f"input/image_{frame}") for frame in FRAMES]
    K = [require(tree, f"input/K_{frame}") for frame in FRAMES]
    soup = Soup(*(require(tree, f"solution/{key}") for key in ("lam", "n", "d", "R", "t")))
    turn = np.linalg.det(soup.R)
    if not np.isfinite(soup.distance).all() or not (np.abs(turn - 1) < 1e-3).all():
        raise ValueError("planes or rotations of the solution are none")
    parts = tree["segmentation"]
    empty = {key: np.zeros(0) for key in Segmentation.__dataclass_fields__}
    seg = Segmentation(**{**empty, **{k: v for k, v in parts.items() if k in empty}})
    start = tree["start"]
    metre = attrs.get("scale_to_truth")
    own = soup, seg, start["component"], K[0], K[1], start["borrowed"].astype(bool)
    rec = reconstruct(soup, seg.labels, K[0], K[1], (images[1].shape[0], images[1].shape[1]))
    return Result(
        name=str(attrs["name"]),
        images=(images[0], images[1]),
        K=(K[0], K[1]),
        reconstruction=replace(rec, sigma_ref=tree["depth"].get("sigma_ref")),
        components=find_components(*own),
        flow_confidence=tree["input"]["confidence"],
        metre=None if metre is None else float(metre),
        metre_unit=str(attrs.get("truth_unit", "m")),
    )
