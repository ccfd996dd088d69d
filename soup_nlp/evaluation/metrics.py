"""Errors of an estimated depth and scene flow, with the evaluation protocol beside the number.

A two-view reconstruction has a free global scale, so a depth error means little without the rule
that chose the scale, the depth cap and the share of the truth that has an estimate. Errors:
Eigen et al., NIPS 2014 (AbsRel, SqRel, RMSE, log-RMSE, delta); MRE as in "Superpixel Soup" (mean
relative error, the same number as AbsRel).
"""

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from soup_nlp.arrays import Float, Mask
from soup_nlp.errors import DataError, repr_of

Scale = Literal["median", "mre", "lsq", "affine", "none"]
ERRORS = "mre", "median_relative", "sq_rel", "rmse", "log_rmse", "delta1", "delta2", "delta3"
"""Names of the errors of a depth map."""


@dataclass(frozen=True)
class Convention:
    """A convention of depth evaluation: the pixels that count, and one global scale s.

    Scale rules, over the pixels that are compared:
        "median": median of z_gt / z.
        "mre": the s that minimises the MRE itself. sum |z_gt - s z| / z_gt is
            sum (z / z_gt) |z_gt / z - s|, so s is the weighted median of z_gt / z with weights
            z / z_gt.
        "lsq": the s that minimises the RMSE, sum z z_gt / sum z^2.
        "affine": the s and the shift b that minimise the RMSE of s z + b; depths below the nearest
            true one are set to it.
        "none": s = 1.

    Attributes:
        scale: Rule of the scale.
        cap: Truth beyond this depth is left out, in the unit of the truth; None for no cap.

    Raises:
        DataError: the rule is unknown, or the cap is 0, negative, NaN or no number.
    """

    scale: Scale = "median"
    cap: float | None = None

    def __post_init__(self) -> None:
        rules = get_args(Scale)
        if not (isinstance(self.scale, str) and self.scale in rules):
            raise DataError(
                "unknown scale rule", found=repr_of(self.scale), expected=", ".join(rules)
            )
        try:
            positive = self.cap is None or float(self.cap) > 0
        except (TypeError, ValueError, OverflowError):
            positive = False
        if not positive:
            raise DataError(
                "depth cap must be positive",
                where="cap",
                found=repr_of(self.cap),
                expected="a depth in the unit of the truth, such as 70",
            )

    def mask(self, truth: ArrayLike) -> Mask:
        """Pixels of a truth (H, W) or (M,) that count."""
        gt = np.asarray(truth, np.float64)
        cap = np.inf if self.cap is None else self.cap
        return np.asarray(np.isfinite(gt) & (gt > 0) & (gt <= cap))

    def counts(self, truth: ArrayLike) -> bool:
        """Whether any true pixel is left."""
        return bool(self.mask(truth).any())


MEDIAN, UNSCALED = Convention(), Convention("none")
"""Every true pixel, with one median scale or as it is."""


@dataclass(frozen=True)
class DepthMetrics:
    """Errors of one depth map after one global scale; smaller is better except for the deltas.

    NaN everywhere (and coverage 0) when no true pixel has an estimate.

    Attributes:
        mre: Mean of |z_gt - s z| / z_gt (AbsRel).
        median_relative: Median of the same.
        sq_rel: Mean of (z_gt - s z)^2 / z_gt, in the unit of the truth.
        rmse: Root mean square of z_gt - s z, in the unit of the truth.
        log_rmse: Root mean square of ln z_gt - ln s z.
        delta1: Share of pixels with max(z_gt / s z, s z / z_gt) < 1.25.
        delta2: The same below 1.25^2.
        delta3: The same below 1.25^3.
        scale_rule: How s was chosen: "median", "mre", "lsq", "affine" or "none".
        scale: The factor s on the estimate.
        cap: Truth beyond this depth was left out, in the unit of the truth; None for no cap.
        coverage: Share of the true pixels (within the cap) that have an estimate.
        n_pixels: Number of pixels that the errors are over.
        shift: What is added to the scaled estimate, 0 except for the rule "affine".
    """

    mre: float
    median_relative: float
    sq_rel: float
    rmse: float
    log_rmse: float
    delta1: float
    delta2: float
    delta3: float
    scale_rule: Scale
    scale: float
    cap: float | None
    coverage: float
    n_pixels: int
    shift: float = 0.0

    def __str__(self) -> str:
        return (
            f"DepthMetrics(MRE {self.mre:.4f}, median {self.median_relative:.4f},"
            f" {self.scale_rule} scale {self.scale:.4g}, coverage {self.coverage:.1%})"
        )

    __repr__ = __str__


def depth_metrics(
    estimate: ArrayLike, truth: ArrayLike, convention: Convention = MEDIAN
) -> DepthMetrics:
    """Errors of an estimated depth, after one global scale s on the estimate.

    A true pixel is compared where the estimate is finite and positive. Everything else about the
    estimate (a hole, a negative depth) costs coverage, not error.

    Args:
        estimate: z in any unit, any shape ((H, W) map or (M,) vector); NaN where unknown.
        truth: True z, same shape; NaN where unknown.
        convention: Which pixels are true, and how s is chosen.

    Raises:
        DataError: shapes differ, or no pixel has a truth to compare with.
    """
    z, gt = np.asarray(estimate, np.float64), np.asarray(truth, np.float64)
    if z.shape != gt.shape:
        raise DataError(
            "estimate and truth of a depth differ in shape",
            found=f"estimate {z.shape}, truth {gt.shape}",
            hint="sample a dense estimate at sparse points with sample_at_points",
        )
    true = convention.mask(gt)
    if not true.any():
        raise DataError("no pixel has a true depth to compare with, within the cap")
    compared = true & np.isfinite(z) & (z > 0)
    coverage = np.count_nonzero(compared) / np.count_nonzero(true)
    z, gt = z[compared], gt[compared]
    s, shift = _scale_and_shift(z, gt, convention.scale) if z.size else (float("nan"), 0.0)
    aligned = s * z + shift
    if convention.scale == "affine":
        aligned = np.maximum(aligned, gt.min(initial=np.inf))
    return DepthMetrics(
        **_errors(aligned, gt),
        scale_rule=convention.scale,
        scale=s,
        cap=None if convention.cap is None else float(convention.cap),
        coverage=float(coverage),
        n_pixels=int(z.size),
        shift=shift,
    )


def _errors(z: Float, gt: Float) -> dict[str, float]:
    """Errors of scaled depths by name; NaN where there are none."""
    if not z.size:
        return dict.fromkeys(ERRORS, float("nan"))
    gap = np.abs(gt - z)
    relative = gap / gt
    log = np.log(gt) - np.log(z)
    fold = np.maximum(gt / z, z / gt)
    return {
        "mre": float(np.mean(relative)),
        "median_relative": float(np.median(relative)),
        "sq_rel": float(np.mean(gap * relative)),
        "rmse": float(np.sqrt(np.mean(gap * gap))),
        "log_rmse": float(np.sqrt(np.mean(log * log))),
        **{f"delta{k}": float(np.mean(fold < 1.25**k)) for k in (1, 2, 3)},
    }


def _scale_and_shift(z: Float, gt: Float, rule: Scale) -> tuple[float, float]:
    """Factor on z (M,), and what is added then, that a rule chooses for the truth gt (M,)."""
    unit = z.max()  # so that squares of tiny or huge depths stay in range
    if rule == "affine":
        centred = (z - z.mean()) / unit
        spread = float(centred @ centred)
        # rounding errors of a constant depth are no relief
        s = float(centred @ gt) / spread / unit if np.ptp(z) > 1e-9 * unit else 0.0
        return s, float(gt.mean() - s * z.mean())
    s = 1.0
    if rule == "median":
        s = np.median(gt / z)
    elif rule == "mre":
        order = np.argsort(gt / z, kind="stable")
        total = np.cumsum((z / gt)[order])
        s = (gt / z)[order][np.searchsorted(total, 0.5 * total[-1])]
    elif rule == "lsq":
        s = np.dot(z / unit, gt) / np.dot(z / unit, z / unit) / unit
    return float(s), 0.0


def skill(mre: float, mre_constant: float) -> float:
    """1 - mre / mre_constant: 1 is perfect, 0 no better than a constant depth, below 0 worse.

    NaN where the constant depth is already exact, or either number is not finite.
    """
    if not (np.isfinite(mre) and np.isfinite(mre_constant) and mre_constant > 0):
        return float("nan")
    return 1.0 - mre / mre_constant


def sample_at_points(depth: ArrayLike, points: ArrayLike) -> tuple[Float, Float]:
    """A dense depth at sparse true points, by the nearest pixel (no mixing across edges).

    Args:
        depth: (H, W) z; NaN where unknown.
        points: (M, 3) true (u, v, z), sub-pixel; integer = pixel centre.

    Returns:
        (estimate, truth), each (M,). The estimate is NaN where a point lies outside the image or
        is not finite, so that it costs coverage.
    """
    z, at = np.asarray(depth, np.float64), np.asarray(points, np.float64)
    height, width = z.shape
    u, v = np.floor(at[:, 0] + 0.5), np.floor(at[:, 1] + 0.5)
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)  # NaN is outside
    out = np.full(len(at), np.nan)
    out[inside] = z[v[inside].astype(np.intp), u[inside].astype(np.intp)]
    return out, at[:, 2].copy()
