"""Alignment of superpixel borders with discontinuities of the flow, and with steps of a depth.

SLIC follows colours only. A superpixel that covers two motions cannot fit both: the pixels of its
smaller part have an unavoidable re-projection error and the depth of the other part. Such pixels
are moved to the neighbouring superpixel with their flow. The flow of a superpixel is an affine fit.
"""

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median

from soup_nlp.arrays import Float, Int
from soup_nlp.data.pair import Flow
from soup_nlp.geometry.superpixels import LEAST_PIECE, Labels, split_components

SCALE_PX = 0.25
"""Smallest residual that a fit may treat as an outlier, pixels."""
ROUNDS, SWEEPS = 3, 12
"""Re-weighted fits of an affine flow, and sweeps after each of two fits, in each of which a border
moves at most one pixel."""
LEAST_STEP = 0.05
"""Least reduction of the residual of log depth for which a pixel changes its superpixel."""


def follow_flow(labels: NDArray[np.integer], flow: Flow, margin_px: float = 1.0) -> Labels:
    """Move borders of superpixels, labels (H, W), to discontinuities of the flow.

    In every sweep a border pixel changes to the neighbour whose affine flow (see `AffineFlow`) is
    nearest to the flow of the pixel, if it is nearer than that of its superpixel by more than the
    margin. Pixels without confidence do not change. Each new label 0..N'-1 is connected
    (4-neighbourhood) and not empty; N' may differ from N.
    """
    current = labels.astype(np.int64)
    count = int(current.max()) + 1
    for sweep in range(2 * SWEEPS):
        if sweep % SWEEPS == 0:
            fit = AffineFlow(flow, current)
            near = np.ones(current.shape, bool)
        framed = np.pad(current, 1, mode="edge")
        sides = (framed[:-2, 1:-1], framed[2:, 1:-1], framed[1:-1, :-2], framed[1:-1, 2:])
        # only pixels near a change of the last sweep can change
        border = near & (flow.confidence > 0) & np.any([side != current for side in sides], axis=0)
        v, u = np.nonzero(border)
        owner, uv = current[v, u], flow.uv[v, u].astype(np.float64)
        best, least = owner.copy(), fit.residual(owner, u, v, uv) - margin_px
        for side in sides:
            other = side[v, u]
            residual = fit.residual(other, u, v, uv)
            better = (residual < least) & (other != owner)
            best[better], least[better] = other[better], residual[better]
        moved = best != owner
        current[v[moved], u[moved]] = best[moved]
        near[:] = False
        near[v[moved], u[moved]] = True
        near = cv2.dilate(near.astype(np.uint8), np.ones((3, 3))) > 0
    return split_components(current.astype(np.int32), int(LEAST_PIECE * current.size / count))


def follow_depth(labels: NDArray[np.integer], log_depth: Float) -> Labels:
    """Move borders of superpixels to steps of a log depth (H, W), NaN where borders stay.

    A plane across a step has the depth of one side alone. Log depth in units of `LEAST_STEP`
    takes the place of the flow of `follow_flow`.
    """
    finite = np.isfinite(log_depth)
    units = np.where(finite, log_depth, 0.0) / LEAST_STEP
    both = np.stack([units, np.zeros_like(units)], axis=-1)
    return follow_flow(labels, Flow(both.astype(np.float32), finite.astype(np.float32), "depth"))


class AffineFlow:
    """Affine flows fitted to superpixels (H, W), which approximate those of small rigid planes.

    Least squares are re-weighted by the confidence times Cauchy's `1 / (1 + (r / s)^2)`. s is the
    larger of `SCALE_PX` and 1.48 times the weighted mean absolute residual of the superpixel. The
    first weights follow from the distance to its median flow, since plain least squares would fit a
    slope across two motions without outliers.

    Attributes:
        coefficients: (N, 3, 2) of (1, (u - u0) / size, (v - v0) / size) -> flow, pixels.
        centre: (N, 2) u0, v0.
        size: (N,) square root of the number of pixels with positive confidence.
        fitted: (N,) False for superpixels with fewer than six such pixels, too few for a fit.
        weight: (P,) last weights of all such pixels.
    """

    def __init__(self, flow: Flow, labels: NDArray[np.integer]) -> None:
        v, u = np.nonzero(flow.confidence > 0)
        which, n = labels[v, u].astype(np.int64), int(labels.max()) + 1
        base = flow.confidence[v, u].astype(np.float64)
        total = np.maximum(np.bincount(which, base, n), 1e-30)
        self.centre = np.stack([np.bincount(which, base * x, n) / total for x in (u, v)], axis=1)
        pixels = np.bincount(which, minlength=n)
        # coordinates are normalised by the size of the superpixel
        self.size, self.fitted = np.sqrt(np.maximum(pixels, 1)), pixels >= 6
        self.coefficients, self.weight = np.zeros((n, 3, 2)), base
        if not len(which):
            return
        X = self.basis(which, u, v)
        Y = flow.uv[v, u].astype(np.float64)

        def medians(values: Float) -> Float:
            return np.asarray(median(values, which, np.arange(n)))

        def weights(r: Float, spread: Float) -> Float:
            return 1.0 / (1.0 + (r / np.maximum(spread, SCALE_PX)[which]) ** 2)

        r = np.linalg.norm(Y - np.stack([medians(y) for y in Y.T], axis=1)[which], axis=1)
        self.weight = weights(r, 1.48 * medians(r))
        for _ in range(ROUNDS):
            w = base * self.weight
            self.coefficients = _weighted(which, X, Y, w, n)
            r = np.linalg.norm(Y - np.einsum("pa,pac->pc", X, self.coefficients[which]), axis=1)
            mass = np.maximum(np.bincount(which, w, n), 1e-30)
            self.weight = weights(r, 1.48 * np.bincount(which, w * r, n) / mass)

    def basis(self, which: Int, u: Int, v: Int) -> Float:
        """(P, 3) the three functions at pixels of superpixels `which` (P,)."""
        du, dv = u - self.centre[which, 0], v - self.centre[which, 1]
        return np.stack([np.ones(len(which)), du / self.size[which], dv / self.size[which]], axis=1)

    def residual(self, which: Int, u: Int, v: Int, uv: Float) -> Float:
        """(P,) distance of flows (P, 2) from those fitted to superpixels `which` (P,), pixels."""
        predicted = np.einsum("pa,pac->pc", self.basis(which, u, v), self.coefficients[which])
        return np.where(self.fitted[which], np.linalg.norm(uv - predicted, axis=1), np.inf)


def _weighted(which: Int, X: Float, Y: Float, w: Float, n: int) -> Float:
    """(N, 3, 2) weighted affine fits."""
    A, right = np.empty((n, 3, 3)), np.empty((n, 3, 2))
    x, y = np.ascontiguousarray(X.T), np.ascontiguousarray(Y.T)
    for a in range(3):
        weighted = w * x[a]
        for b in range(a, 3):
            A[:, a, b] = A[:, b, a] = np.bincount(which, weighted * x[b], n)
        for c in range(2):
            right[:, a, c] = np.bincount(which, weighted * y[c], n)
    # a small ridge makes the slopes of superpixels with few pixels 0
    A += np.eye(3) * (1e-6 * A[:, 0, 0] + 1e-12)[:, None, None]
    return np.asarray(np.linalg.solve(A, right), np.float64)
