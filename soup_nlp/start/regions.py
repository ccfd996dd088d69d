"""Which regions of the image bend: rigid components against a free motion of each superpixel.

Both hypotheses explain the same flow, and both are measured by the length of their description per
superpixel, in nats: the residual in units of the flow's noise, and what it costs to say which
component a superpixel belongs to. A free motion fits any flow and costs `bending_price`.
"""

from __future__ import annotations

import numpy as np

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.geometry.graph import Segmentation
from soup_nlp.start.choice import limited_noise
from soup_nlp.start.components import connected_labels

MOST_EXCESS = 4.0
"""Limit of a superpixel's excess, in units of the noise: beyond it the flow itself may be wrong."""
FEWEST = 15
"""Least number of superpixels of a region beside the largest component that is tested."""


def bending_regions(
    seg: Segmentation,
    surface: Int,
    jump: Float,
    residual: Float,
    error: Float,
    component: Int,
    usable: Mask,
    *,
    price: float,
    discontinuity_px: float,
) -> Mask:
    """(N,) True where the superpixel lies in a region that bends.

    The description by rigid components costs the mean excess of their error over that of free
    affine flows, and the entropy of the component labels. Components that really move apart leave a
    discontinuity of the flow; by the share of their common outlines where the flow is continuous,
    the labels cost up to twice the entropy. The whole image is tested first, then every connected
    region of a surface outside the largest component.

    Args:
        seg: Superpixels and graphs.
        surface: (N,) surface of every superpixel.
        jump: (P,) pixels by which the flow of two neighbours differs on their boundary.
        residual: (N,) mean error of the affine flow of every superpixel, pixels.
        error: (N,) mean error of the flow under its rigid component, pixels.
        component: (N,) rigid component of every superpixel.
        usable: (N,) True where the flow counts.
        price: Price of a free motion, nats.
        discontinuity_px: Jump of the flow that certainly is a discontinuity, pixels.
    """
    excess = np.clip((error - residual) / limited_noise(residual), 0.0, MOST_EXCESS)
    i, k = seg.pairs.T
    length = seg.boundary_length.astype(float)
    continuous = jump < 0.5 * discontinuity_px

    def bends(region: Mask) -> bool:
        at = region & usable
        if at.sum() < FEWEST:
            return False
        share = np.bincount(component[at]) / at.sum()
        entropy = float(-np.sum(share * np.log(np.maximum(share, 1e-12))))
        seam = region[i] & region[k] & (component[i] != component[k])
        whole = float(length[seam & continuous].sum() / max(length[seam].sum(), 1.0))
        return bool(excess[at].mean() + (1 + whole) * entropy > price)

    every = np.ones(len(seg), bool)
    if bends(every):
        return every
    beside = component != np.argmax(np.bincount(component))
    joined = beside[i] & beside[k] & (surface[i] == surface[k])
    region = np.where(beside, connected_labels(joined, seg), -1)
    out = ~every
    for c in np.unique(region[beside]):
        if bends(region == c):
            out |= region == c
    return out
