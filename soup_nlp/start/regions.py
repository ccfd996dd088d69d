"""Which regions of the image bend: one rigid motion against a motion of each superpixel.

Both hypotheses are measured alike, by the residual of the same flow in units of its noise, and
each motion of its own has a price (minimum description length). A region bends if no single rigid
motion explains its flow, and rigid ones may lie beside it in the same image.
"""

from __future__ import annotations

import numpy as np

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.geometry.graph import Segmentation
from soup_nlp.start.choice import Choice, flow_affinity, limited_noise, smooth_choice
from soup_nlp.start.components import connected_labels
from soup_nlp.start.merge import candidates, main_motion
from soup_nlp.start.start_options import SeededStart
from soup_nlp.start.views import Views

LEAST_REGION = 0.15
"""Least share of the superpixels in a region that is tested. In smaller ones on rigid pairs errors
of the flow reach the price; the largest of these have a tenth."""
MOST_EXCESS = 4.0
"""Limit of a superpixel's excess, in units of the noise: beyond it the flow itself may be wrong."""
SURE = 0.5
"""Mean confidence from which the flow of a superpixel counts."""
OUTSIDE = 100.0
"""Price of a motion of its own outside the region that is tested."""


def bending_regions(
    views: Views,
    seg: Segmentation,
    surface: Int,
    jump: Float,
    residual: Float,
    choice: Choice,
    o: SeededStart,
) -> Mask:
    """(N,) True where the superpixel lies in a region that bends.

    The excess of a superpixel is the error of its flow under the best rigid motion of the region
    beyond that of its own affine flow, in units of the flow's noise. A surface bends if its mean
    excess is above the price of one motion per superpixel. The flow may be continuous along most of
    the outline of what bends: if more than half of a surface keeps to the rigid motion, its other
    connected parts are tested first, and where one of them bends, the rest does not.

    Args:
        views: Rays, targets and confidence of every superpixel.
        seg: Superpixels and graphs.
        surface: (N,) surface of every superpixel.
        jump: (P,) pixels by which the flow of two neighbours differs on their boundary.
        residual: (N,) mean error of the affine flow of every superpixel, pixels.
        choice: Rigid motions of the image.
        o: Price, and the jump at which a surface ends.
    """
    n = len(seg)
    noise = limited_noise(residual)
    usable = views.weight.mean(axis=1) > SURE
    near = flow_affinity(jump, o)

    def bending(region: Mask) -> Mask:
        at = np.flatnonzero(region & usable)
        if len(at) < max(o.piece_size, 1):
            return np.zeros(n, bool)
        excess = _excess(views, choice, at, residual[at], noise, o)
        cost = np.zeros((n, 2))
        cost[at, 0], cost[at, 1] = excess, o.bending_price
        cost[~region, 1] = OUTSIDE
        # a unit of noise where one of two neighbours is rigid
        free = region & (smooth_choice(cost, near, seg, 1.0) == 1)
        if 2 * free.sum() < region.sum():
            parts = _large(
                connected_labels(free[seg.pairs[:, 0]] & free[seg.pairs[:, 1]], seg), free
            )
            found = _any([bending(part) for part in parts], n)
            if found.any():
                return found
        return region & (excess.mean() > o.bending_price)

    return _any([bending(region) for region in _large(surface, np.ones(n, bool))], n)


def _any(masks: list[Mask], n: int) -> Mask:
    """(n,) True where one of the masks (n,) is."""
    return np.logical_or.reduce(masks) if masks else np.zeros(n, bool)


def _large(label: Int, mask: Mask) -> list[Mask]:
    """Superpixels of one label (N,) in a mask, where these are enough to be tested."""
    count = np.bincount(label[mask], minlength=1)
    return [mask & (label == c) for c in np.flatnonzero(count >= LEAST_REGION * len(label))]


def _excess(
    views: Views, choice: Choice, at: Int, residual: Float, noise: float, o: SeededStart
) -> Float:
    """(K,) excess of superpixels `at` under the rigid motion that fits all of them best."""
    main = main_motion(choice.label) if (choice.label >= 0).any() else -1
    R_main = choice.R[np.argmax(choice.label == main)]
    R, t = candidates(views, choice, at, R_main, noise, o)
    shared, first = np.unique(choice.label[at], return_index=True)
    own = at[first[shared >= 0]]
    R, t = np.concatenate([R, choice.R[own]]), np.concatenate([t, choice.t[own]])
    shape = len(at), len(R)
    fit = views.some(at).fit_own(
        np.broadcast_to(R, (*shape, 3, 3)), np.broadcast_to(t, (*shape, 3))
    )
    excess = np.clip((fit.penalised() - residual[:, None]) / noise, 0.0, MOST_EXCESS)
    return np.asarray(excess[:, np.argmin(excess.mean(axis=0))])
