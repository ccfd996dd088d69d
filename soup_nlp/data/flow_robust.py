"""Robust re-weighting of a flow inside superpixels: pixels that disagree with theirs count less."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from soup_nlp.data.pair import Flow
from soup_nlp.errors import DataError

Float = NDArray[np.float64]


def reweighted(
    flow: Flow, labels: NDArray[np.integer], scale_px: float = 0.5, rounds: int = 8
) -> Flow:
    """The same flow with confidence lowered where it departs from its superpixel's motion.

    A small plane that moves rigidly has a nearly affine flow. One is fitted to every superpixel by
    iteratively re-weighted least squares with Cauchy weights `1 / (1 + (r / s)^2)`, r the distance
    of a pixel's flow from the fit and s the larger of `scale_px` and the superpixel's own spread
    (1.48 times the weighted mean absolute residual); the last weights multiply the confidence.

    Args:
        flow: Flow with confidence.
        labels: (H, W) superpixel labels 0..N-1.
        scale_px: Residual, pixels, below which nothing is suspected.
        rounds: Re-weighted fits.

    Returns:
        Flow with the same displacements; no confidence grows, and none that was positive becomes 0.

    Raises:
        DataError: sizes differ, or the scale is not positive.
    """
    if labels.shape != flow.confidence.shape:
        raise DataError(
            "labels and flow differ in size", found=labels.shape, expected=flow.confidence.shape
        )
    if not scale_px > 0:
        raise DataError("scale of residuals must be positive", found=scale_px, expected="> 0 px")
    n = int(labels.max()) + 1
    used = flow.confidence > 0
    which = labels[used].astype(np.int64)
    v, u = (x[used].astype(np.float64) for x in np.mgrid[: labels.shape[0], : labels.shape[1]])
    base = flow.confidence[used].astype(np.float64)
    total = np.maximum(np.bincount(which, base, n), 1e-30)
    centre = [np.bincount(which, base * x, n) / total for x in (u, v)]
    # coordinates of the size of one, whatever the superpixel's
    size = np.sqrt(np.maximum(np.bincount(which, minlength=n), 1))
    X = np.stack(
        [np.ones_like(u), *((x - c[which]) / size[which] for x, c in zip((u, v), centre))], axis=1
    )
    Y = flow.uv[used].astype(np.float64)
    weight = np.ones_like(base)
    for _ in range(rounds):
        fit = _affine(which, X, Y, base * weight, n)
        r = np.linalg.norm(Y - np.einsum("pa,pac->pc", X, fit[which]), axis=1)
        mass = np.maximum(np.bincount(which, base * weight, n), 1e-30)
        spread = 1.48 * np.bincount(which, base * weight * r, n) / mass
        s = np.maximum(spread, scale_px)
        weight = 1.0 / (1.0 + (r / s[which]) ** 2)
    confidence = flow.confidence.copy()
    confidence[used] = np.maximum(base * weight, np.finfo(np.float32).tiny).astype(np.float32)
    return Flow(flow.uv, np.minimum(confidence, flow.confidence), flow.source)


def _affine(which: NDArray[np.int64], X: Float, Y: Float, w: Float, n: int) -> Float:
    """(N, 3, 2) weighted affine fits."""
    A = np.empty((n, 3, 3))
    for a in range(3):
        for b in range(a, 3):
            A[:, a, b] = A[:, b, a] = np.bincount(which, w * X[:, a] * X[:, b], n)
    right = np.stack(
        [np.bincount(which, w * X[:, a] * Y[:, c], n) for a in range(3) for c in range(2)], axis=1
    ).reshape(n, 3, 2)
    # few pixels leave the slopes at 0
    A += np.eye(3) * (1e-6 * A[:, 0, 0] + 1e-12)[:, None, None]
    return np.asarray(np.linalg.solve(A, right), np.float64)
