"""Presets of the conventions of depth evaluation in use."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from soup_nlp.arrays import Mask
from soup_nlp.errors import DataError
from soup_nlp.evaluate.metrics import DepthMetrics, Scale, depth_metrics

Crop = tuple[float, float, float, float]

GARG_CROP: Crop = (0.40810811, 0.99189189, 0.03594771, 0.96405229)
"""Rows from and to, columns from and to, as shares of the image (Garg et al., ECCV 2016)."""


@dataclass(frozen=True)
class Preset:
    """A convention of depth evaluation.

    Attributes:
        name: As on the command line.
        scale: Rule of the one global scale.
        cap: Truth beyond this depth is left out; None for no cap.
        low: Truth at or below this depth is left out.
        crop: Part of the image that counts, as shares; None for all of it.
        clamp: Range that scaled estimates are moved into; None for none.
        text: The convention in a few words.
    """

    name: str
    scale: Scale = "median"
    cap: float | None = None
    low: float = 0.0
    crop: Crop | None = None
    clamp: tuple[float, float] | None = None
    text: str = ""

    def __str__(self) -> str:
        rule = "no scale" if self.scale == "none" else f"one {self.scale} scale"
        cap = "no cap" if self.cap is None else f"{self.low:g} < z <= {self.cap:g}"
        details = ", Garg crop" if self.crop == GARG_CROP else ", cropped" if self.crop else ""
        if self.clamp:
            details += f", estimates clamped to [{self.clamp[0]:g}, {self.clamp[1]:g}]"
        return f"{self.name}: {rule} per image, {cap}{details}"

    def mask(self, truth: ArrayLike) -> Mask:
        """Pixels of a truth (H, W) or (M,) that count; a crop needs (H, W)."""
        gt = np.asarray(truth, np.float64)
        keep = (gt > self.low) & (gt <= (np.inf if self.cap is None else self.cap))
        if self.crop is not None:
            if gt.ndim != 2:
                raise DataError("a crop needs a depth map (H, W)", where=self.name, found=gt.shape)
            top, bottom, left, right = (
                int(share * side)
                for share, side in zip(self.crop, np.repeat(gt.shape, 2), strict=True)
            )
            inside = np.zeros(gt.shape, bool)
            inside[top:bottom, left:right] = True
            keep &= inside
        return keep

    def counts(self, truth: ArrayLike) -> bool:
        """Whether any true pixel is left."""
        return bool(self.mask(truth).any())

    def score(self, estimate: ArrayLike, truth: ArrayLike) -> DepthMetrics:
        """`depth_metrics` of z against a true z, (H, W) or (M,), under this convention.

        Raises:
            DataError: shapes differ, a crop meets a vector, or no true pixel is left.
        """
        mask = self.mask(truth)
        return depth_metrics(
            estimate, truth, scale=self.scale, cap=self.cap, mask=mask, clamp=self.clamp
        )


_ALL = (
    Preset("paper", text="the paper's MRE: every true pixel, one global scale"),
    Preset("best", "mre", text="the scale that minimises the MRE itself, no cap"),
    Preset(
        "sintel70",
        cap=70.0,
        text="as two-view work on Sintel, 0 < z <= 70, but the scale is the median of z_gt / z, not"
        " median z_gt over median z",
    ),
    Preset("kitti", text="KITTI uncapped: median scale over every true pixel"),
    Preset(
        "eigen80",
        cap=80.0,
        low=1e-3,
        crop=GARG_CROP,
        clamp=(1e-3, 80.0),
        text="after Eigen's protocol on KITTI at 80 m, Garg crop, clamped estimates, but the scale"
        " is the median of z_gt / z, not median z_gt over median z",
    ),
)
PRESETS = {p.name: p for p in _ALL}
"""Conventions by name."""


def preset(name: str) -> Preset:
    """The preset of a name.

    Raises:
        DataError: the name is unknown.
    """
    if name not in PRESETS:
        raise DataError("unknown metric preset", found=repr(name), expected=", ".join(PRESETS))
    return PRESETS[name]
