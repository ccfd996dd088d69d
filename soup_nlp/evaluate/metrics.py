"""How far an estimated depth is from the truth, with the protocol beside the number.

A two-view reconstruction has a free global scale, so a depth error means little without the rule
that chose the scale, the depth cap and the share of the truth that has an estimate at all. Each
result here carries all three. Conventions: Eigen et al., NIPS 2014 (AbsRel, SqRel, RMSE, log-RMSE,
delta); MRE as in "Superpixel Soup" (mean relative error, the same number as AbsRel).
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from soup_nlp.errors import DataError

Float = NDArray[np.float64]
Scale = Literal["median", "mre", "lsq", "none"]


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
        scale_rule: How s was chosen: "median", "mre", "lsq" or "none".
        scale: The factor s on the estimate.
        cap: Truth beyond this depth was left out, in the unit of the truth; None for no cap.
        coverage: Share of the true pixels (after cap and mask) that have an estimate.
        n_pixels: Number of pixels that the errors are over.
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

    def as_dict(self) -> dict[str, Any]:
        """All attributes by name, in the order above: plain numbers, strings and None."""
        return asdict(self)

    def __str__(self) -> str:
        cap = "no cap" if self.cap is None else f"cap {self.cap:g}"
        return (
            f"MRE {self.mre:.4f}, median {self.median_relative:.4f}, RMSE {self.rmse:.4g}, "
            f"log-RMSE {self.log_rmse:.4f}, SqRel {self.sq_rel:.4g}, "
            f"delta<1.25 {self.delta1:.1%} "
            f"(scale {self.scale_rule} = {self.scale:.4g}, {cap}, "
            f"coverage {self.coverage:.1%}, {self.n_pixels} px)"
        )


def depth_metrics(
    estimate: ArrayLike,
    truth: ArrayLike,
    *,
    scale: Scale = "median",
    cap: float | None = None,
    mask: ArrayLike | None = None,
    clamp: tuple[float, float] | None = None,
) -> DepthMetrics:
    """Errors of an estimated depth, after one global scale s on the estimate.

    Scale rules, over the pixels that are compared:
        "median": median of z_gt / z.
        "mre": the s that minimises the MRE itself. sum |z_gt - s z| / z_gt is
            sum (z / z_gt) |z_gt / z - s|, so s is the weighted median of z_gt / z with weights
            z / z_gt.
        "lsq": the s that minimises the RMSE, sum z z_gt / sum z^2.
        "none": s = 1.

    A pixel is true where the truth is finite, positive, within the cap and in the mask; it is
    compared where the estimate is also finite and positive. Everything else about the estimate
    (a hole, a negative depth) costs coverage, not error.

    Args:
        estimate: z in any unit, any shape ((H, W) map or (M,) vector); NaN where unknown.
        truth: True z, same shape; NaN where unknown.
        scale: Scale rule.
        cap: Leave out truth deeper than this, unit of the truth; None keeps all.
        mask: Bool, same shape; False leaves a pixel out. None keeps all.
        clamp: After scaling, estimates are moved into [low, high], unit of the truth, as Eigen's
            protocol does; None leaves them as they are.

    Raises:
        DataError: shapes differ, the rule is unknown, the cap is not positive, the clamp is not
            0 < low < high, or no pixel has a truth to compare with.
    """
    if clamp is not None and not 0 < clamp[0] < clamp[1]:
        raise DataError("clamp is no range of depths", found=clamp, expected="0 < low < high")
    z, gt, coverage = _compared(estimate, truth, scale, cap, mask)
    if z.size == 0:
        nan = float("nan")
        return DepthMetrics(nan, nan, nan, nan, nan, nan, nan, nan, scale, nan, cap, 0.0, 0)
    s = _scale(z, gt, scale)
    z = s * z if clamp is None else np.clip(s * z, *clamp)
    gap = np.abs(gt - z)
    relative = gap / gt
    log = np.log(gt) - np.log(z)
    fold = np.maximum(gt / z, z / gt)
    delta = [float(np.mean(fold < 1.25**k)) for k in (1, 2, 3)]
    return DepthMetrics(
        mre=float(np.mean(relative)),
        median_relative=float(np.median(relative)),
        sq_rel=float(np.mean(gap * relative)),
        rmse=float(np.sqrt(np.mean(gap * gap))),
        log_rmse=float(np.sqrt(np.mean(log * log))),
        delta1=delta[0],
        delta2=delta[1],
        delta3=delta[2],
        scale_rule=scale,
        scale=float(s),
        cap=None if cap is None else float(cap),
        coverage=coverage,
        n_pixels=int(z.size),
    )


def _compared(
    estimate: ArrayLike, truth: ArrayLike, scale: str, cap: float | None, mask: ArrayLike | None
) -> tuple[Float, Float, float]:
    """Vectors of estimate and truth where both count, and the share of the truth they cover."""
    z, gt = np.asarray(estimate, np.float64), np.asarray(truth, np.float64)
    if z.shape != gt.shape:
        raise DataError(
            "estimated and true depth differ in shape",
            where="depth_metrics",
            found=f"estimate {z.shape}, truth {gt.shape}",
            expected="the same shape",
            hint="sample a dense estimate at sparse points with sample_at_points",
        )
    if scale not in get_args(Scale):
        raise DataError(
            "unknown scale rule", where="scale", found=repr(scale), expected=list(get_args(Scale))
        )
    if cap is not None and not cap > 0:
        raise DataError("depth cap must be positive", where="cap", found=cap, expected="> 0")
    true = np.isfinite(gt) & (gt > 0)
    if cap is not None:
        true &= gt <= cap
    if mask is not None:
        keep = np.asarray(mask, bool)
        if keep.shape != gt.shape:
            raise DataError(
                "mask and depth differ in shape", where="mask", found=keep.shape, expected=gt.shape
            )
        true &= keep
    total = int(np.count_nonzero(true))
    if total == 0:
        raise DataError(
            "no pixel has a true depth to compare with",
            where="depth_metrics",
            found=f"{int(np.isfinite(gt).sum())} finite true depths, cap {cap}",
            expected="at least one positive depth within cap and mask",
        )
    both = true & np.isfinite(z) & (z > 0)
    return z[both], gt[both], float(np.count_nonzero(both) / total)


def _scale(z: Float, gt: Float, rule: Scale) -> float:
    """Factor on z (M,) that a rule chooses for the truth gt (M,)."""
    if rule == "median":
        return float(np.median(gt / z))
    if rule == "mre":
        return weighted_median(gt / z, z / gt)
    if rule == "lsq":
        unit = z / z.max()  # so that squares of tiny or huge depths stay in range
        return float(np.dot(unit, gt) / np.dot(unit, unit) / z.max())
    return 1.0


def weighted_median(values: ArrayLike, weights: ArrayLike) -> float:
    """The smallest value x with at least half of the weight at or below it.

    It minimises sum w |v - x|; with an even split every x between two values does, and the lower
    is returned.

    Args:
        values: (M,) finite numbers.
        weights: (M,) finite, not negative, with a positive sum.

    Raises:
        DataError: empty, of different lengths, not finite, or weights that are negative or all 0.
    """
    v, w = np.ravel(np.asarray(values, np.float64)), np.ravel(np.asarray(weights, np.float64))
    good = v.size > 0 and v.shape == w.shape
    if not (good and np.isfinite(v).all() and np.isfinite(w).all() and w.min() >= 0 < w.max()):
        raise DataError(
            "weighted median needs finite values and weights",
            where="weighted_median",
            found=f"{v.size} values, {w.size} weights",
            expected="equal, positive lengths; weights >= 0 with a positive sum",
        )
    order = np.argsort(v, kind="stable")
    # a power of two keeps sums in range and ties exact
    total = np.cumsum(np.ldexp(w[order], -int(np.frexp(w.max())[1])))
    return float(v[order[int(np.searchsorted(total, 0.5 * total[-1]))]])


def constant_depth_metrics(
    truth: ArrayLike,
    *,
    scale: Scale = "median",
    cap: float | None = None,
    mask: ArrayLike | None = None,
) -> DepthMetrics:
    """`depth_metrics` of the same depth at every pixel: what knowing nothing scores.

    With scale "none" the constant is 1 in the unit of the truth.

    Args:
        truth: True z, any shape; NaN where unknown.
        scale: Scale rule.
        cap: Depth cap, unit of the truth.
        mask: Bool, same shape as the truth.

    Raises:
        DataError: as `depth_metrics`.
    """
    return depth_metrics(np.ones(np.shape(truth)), truth, scale=scale, cap=cap, mask=mask)


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

    Raises:
        DataError: the arrays have the wrong shape.
    """
    z, at = np.asarray(depth, np.float64), np.asarray(points, np.float64)
    if z.ndim != 2 or at.ndim != 2 or at.shape[1] != 3:
        raise DataError(
            "cannot sample a depth at points",
            where="sample_at_points",
            found=f"depth {z.shape}, points {at.shape}",
            expected="depth (H, W), points (M, 3) of u, v, z",
        )
    height, width = z.shape
    u, v = np.floor(at[:, 0] + 0.5), np.floor(at[:, 1] + 0.5)
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)  # NaN is outside
    out = np.full(len(at), np.nan)
    out[inside] = z[v[inside].astype(np.intp), u[inside].astype(np.intp)]
    return out, at[:, 2].copy()
