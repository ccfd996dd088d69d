"""How far an estimated scene flow is from the truth: the end-point error in 3D."""

from __future__ import annotations

from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from soup_nlp.errors import DataError

Mask = NDArray[np.bool_]


def scene_flow_epe(
    estimate: ArrayLike, truth: ArrayLike, *, scale: float = 1.0, mask: ArrayLike | None = None
) -> dict[str, float | int]:
    """End-point error of a scene flow: mean and median length of s * estimate - truth.

    Args:
        estimate: (..., 3) X' - X; NaN where unknown.
        truth: (..., 3) true X' - X, same shape; NaN where unknown.
        scale: The factor s; use `DepthMetrics.scale` so that depth and motion share one scale.
        mask: (...) bool; False leaves a pixel out.

    Returns:
        mean, median, mean_truth_length (unit of the truth), coverage, n_pixels. The errors are
        NaN when nothing can be compared.

    Raises:
        DataError: shapes do not fit, or no pixel has a true scene flow.
    """
    est, gt = np.asarray(estimate, np.float64), np.asarray(truth, np.float64)
    if est.shape != gt.shape or gt.ndim < 1 or gt.shape[-1] != 3:
        raise DataError(
            "estimated and true scene flow do not fit",
            where="scene_flow_epe",
            found=f"estimate {est.shape}, truth {gt.shape}",
            expected="the same shape (..., 3)",
        )
    true = np.isfinite(gt).all(axis=-1)
    if mask is not None:
        keep = np.asarray(mask, bool)
        if keep.shape != true.shape:
            raise DataError(
                "mask and scene flow differ in shape",
                where="mask",
                found=keep.shape,
                expected=true.shape,
            )
        true &= keep
    total = int(np.count_nonzero(true))
    if total == 0:
        raise DataError("no pixel has a true scene flow", where="scene_flow_epe")
    both = cast(Mask, true & np.isfinite(est).all(axis=-1))
    n = int(np.count_nonzero(both))
    error = np.linalg.norm(scale * est[both] - gt[both], axis=-1)
    length = np.linalg.norm(gt[both], axis=-1)
    return {
        "mean": float(np.mean(error)) if n else float("nan"),
        "median": float(np.median(error)) if n else float("nan"),
        "mean_truth_length": float(np.mean(length)) if n else float("nan"),
        "coverage": n / total,
        "n_pixels": n,
    }
