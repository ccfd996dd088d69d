"""Alignment of superpixel borders with discontinuities of the flow.

SLIC follows colours only. A superpixel that covers two motions cannot fit both: the pixels of its
smaller part have an unavoidable re-projection error and the depth of the other part. Such pixels
are moved to the neighbouring superpixel with their flow.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from soup_nlp.data.flow.robust import AffineFlow, fit_affine, refit_affine
from soup_nlp.data.pair import Flow
from soup_nlp.geometry.superpixels import LEAST_PIECE, Labels, split_components

Ints = NDArray[np.int64]

SCALE_PX = 0.25
"""Residual, pixels, below which a fit treats a pixel as inlier."""
SWEEPS, REFIT = 24, 8
"""Number of sweeps (a border moves at most one pixel in each), and sweeps between fits."""


def follow_flow(
    labels: NDArray[np.integer],
    flow: Flow,
    margin_px: float = 1.0,
) -> Labels:
    """Move the borders of superpixels to discontinuities of the flow.

    In every sweep a border pixel changes to the neighbour whose affine flow (see `fit_affine`) is
    nearest to the flow of the pixel, if it is nearer than that of its superpixel by more than the
    margin. Pixels without confidence do not change.

    Args:
        labels: (H, W) superpixel labels 0..N-1.
        flow: Flow with confidence.
        margin_px: Smallest reduction of the residual by a change, pixels.

    Returns:
        (H, W) int32 labels 0..N'-1, each connected (4-neighbourhood) and not empty; N' may differ
        from N.

    Raises:
        DataError: sizes of labels and flow differ.
    """
    current = labels.astype(np.int64)
    count = int(current.max()) + 1
    fit, _ = fit_affine(flow, current, SCALE_PX, rounds=5)
    changed = np.zeros(count, bool)
    near = np.ones(current.shape, bool)
    for sweep in range(SWEEPS):
        if changed.any() and sweep % REFIT == 0:
            fit = refit_affine(fit, flow, current, changed, SCALE_PX, rounds=5)
            changed[:], near[:] = False, True
        framed = np.pad(current, 1, mode="edge")
        sides = (framed[:-2, 1:-1], framed[2:, 1:-1], framed[1:-1, :-2], framed[1:-1, 2:])
        # only pixels near a change of the last sweep can change
        border = near & (flow.confidence > 0) & np.any([side != current for side in sides], axis=0)
        v, u = np.nonzero(border)
        own = current[v, u]
        best = _nearest(fit, flow, own, [side[v, u] for side in sides], u, v, margin_px)
        moved = best != own
        if not moved.any():
            break
        changed[own[moved]] = changed[best[moved]] = True
        current[v[moved], u[moved]] = best[moved]
        near[:] = False
        near[v[moved], u[moved]] = True
        near = ndimage.binary_dilation(near)
    return split_components(current.astype(np.int32), int(LEAST_PIECE * current.size / count))


def _nearest(
    fit: AffineFlow,
    flow: Flow,
    own: Ints,
    sides: list[Ints],
    u: Ints,
    v: Ints,
    margin_px: float,
) -> Ints:
    """(P,) superpixel with the nearest affine flow, the present one or that of a side."""
    uv = flow.uv[v, u].astype(np.float64)
    best, least = own.copy(), fit.residual(own, u, v, uv) - margin_px
    for other in sides:
        residual = fit.residual(other, u, v, uv)
        better = (residual < least) & (other != own)
        best[better], least[better] = other[better], residual[better]
    return best
