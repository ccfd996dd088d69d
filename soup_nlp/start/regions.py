"""Which surfaces bend: those of which no single rigid motion explains most of the flow.

The flow is continuous within a surface. Of a rigid surface one motion
explains the flow of most superpixels, whatever else moves there; of a bending one no motion does.
The test does not depend on the number of superpixels or of rigid components.
"""

from __future__ import annotations

import numpy as np

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.geometry.graph import Segmentation
from soup_nlp.start.bending import reference_noise, systematic_error
from soup_nlp.start.choice import Choice, dominant
from soup_nlp.start.epipolar import Motion
from soup_nlp.start.merge import candidates
from soup_nlp.start.start_options import SeededStart
from soup_nlp.start.views import Views

NOISES = 0.4
"""Median excess of the error up to which a surface is rigid, beside the systematic error, in units
of the noise."""
LEAST_SHARE = 0.06
"""Least share of the superpixels that makes a surface: a smaller one joins a neighbour, because a
few superpixels with a wrong flow look like a bending one."""


def surface_motions(
    views: Views, seg: Segmentation, surface: Int, residual: Float, usable: Mask, o: SeededStart
) -> tuple[list[Motion], Mask]:
    """The best rigid motion of each surface that does not bend, and which surfaces bend.

    A surface bends if under every rigid motion the median excess of its superpixels' error over the
    residual of an affine flow of their own is above the flow's systematic error plus `NOISES` times
    its noise.

    Args:
        views: Rays, targets and confidence of every superpixel.
        seg: Superpixels and graphs.
        surface: (N,) surface of every superpixel.
        residual: (N,) mean error of the affine flow of every superpixel, pixels.
        usable: (N,) True where the flow counts.
        o: Numbers, inlier distance and seed.

    Returns:
        The motions that many pixels share and those of the surfaces, and (N,) True where the
        surface bends.
    """
    noise = reference_noise(residual)
    most = systematic_error(noise) + NOISES * noise
    motions = dominant(views, o)
    choice = nearest(views, motions)
    surface = joined(surface, usable, seg)
    bends = np.zeros(len(seg), bool)
    for c in np.unique(surface[usable]):
        at = np.flatnonzero(usable & (surface == c))
        R, t = candidates(views, choice, at, motions[0].R, noise, o)
        tried = [*map(Motion, R, t)]
        excess = np.median(views.some(at).fit(tried).cost - residual[at, None], axis=0)
        best = int(np.argmin(excess))
        bends[surface == c] = excess[best] > most
        if not bends[at[0]]:
            motions.append(tried[best])
    return motions, bends


def nearest(views: Views, motions: list[Motion]) -> Choice:
    """The motion of a list with the smallest error for every superpixel."""
    fit = views.fit(motions)
    label = np.argmin(fit.penalised(), axis=1)
    R, t = (np.stack([getattr(m, name) for m in motions])[label] for name in ("R", "t"))
    return Choice(R, t, fit.pick((np.arange(len(label)), label)), label)


def joined(surface: Int, usable: Mask, seg: Segmentation) -> Int:
    """(N,) surfaces, the ones with too few usable superpixels joined to a neighbour.

    The smallest joins the one with which it has the longest outline, until each has `LEAST_SHARE`.
    """
    surface, (i, k) = surface.copy(), seg.pairs.T
    length = seg.boundary_length.astype(float)
    alone: set[int] = set()
    while True:
        count = np.bincount(surface, usable)
        small = [
            c for c in np.unique(surface) if count[c] < LEAST_SHARE * len(seg) and c not in alone
        ]
        if not small:
            return surface
        c = min(small, key=lambda c: (count[c], c))
        beside = np.where(surface[i] == c, surface[k], surface[i])
        outline = ((surface[i] == c) != (surface[k] == c)) * length
        if not outline.any():
            alone.add(c)
            continue
        surface[surface == c] = np.argmax(np.bincount(beside, outline))
