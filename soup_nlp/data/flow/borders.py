"""Borders of superpixels moved to discontinuities of the flow.

SLIC follows colours, and a superpixel across the border of two motions is a plane that fits
neither: the pixels of its smaller part have a re-projection error that no solution can avoid, and
the depth of the other side. Such pixels go to the neighbouring superpixel that has their flow.
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
"""Residual, pixels, below which a fit takes every pixel for an inlier."""
SWEEPS, REFIT = 24, 8
"""How far a border may move, pixels, and sweeps between fits."""


def follow_flow(
    labels: NDArray[np.integer],
    flow: Flow,
    margin_px: float = 1.0,
) -> Labels:
    """Move borders of superpixels, pixel by pixel, to where their affine flows meet.

    In every sweep a pixel on a border goes to the neighbour whose affine flow (fitted robustly,
    see `fit_affine`) is nearest to its own flow, if it is nearer than its superpixel's by more
    than the margin. A pixel without confidence stays.

    Args:
        labels: (H, W) superpixel labels 0..N-1.
        flow: Flow with confidence.
        margin_px: Pixels of flow that a change of sides must win.

    Returns:
        (H, W) int32 labels 0..N'-1, each connected (4-neighbourhood) and not empty; N' differs
        from N where pieces were cut off or used up.

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
        # a pixel whose surroundings are those of the last sweep stays where it stayed
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
    """(P,) superpixels of pixels (P,): their own, or that of a side with a nearer affine flow."""
    uv = flow.uv[v, u].astype(np.float64)
    best, least = own.copy(), fit.residual(own, u, v, uv) - margin_px
    for other in sides:
        residual = fit.residual(other, u, v, uv)
        better = (residual < least) & (other != own)
        best[better], least[better] = other[better], residual[better]
    return best
