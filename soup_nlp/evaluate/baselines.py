"""A baseline that methods for dynamic scenes have to beat: one rigid motion for all pixels."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import distance_transform_edt

from soup_nlp.arrays import Float
from soup_nlp.data.pair import Pair
from soup_nlp.geometry.camera import pixel_grid, rays
from soup_nlp.start import epipolar

MIN_CORRESPONDENCES = 8
"""Fewest pixels with flow for which a motion is estimated."""

SAMPLES = 8000
"""Largest number of pixels for the motion."""

INLIER = 1.0
"""Largest Sampson distance of an inlier, pixels of the geometric mean focal length."""

TIGHT = 0.1
"""The motion is also estimated with this fraction of the inlier distance."""

FAR = 100.0
"""Depths beyond this multiple of the median depth count as unknown: there is no parallax left.
True depths of driving and indoor pairs reach 14 times their median."""


def rigid_depth(pair: Pair, seed: int = 0) -> Float | None:
    """Depth under one rigid motion for the whole image, triangulated pixel by pixel.

    The essential matrix comes from a subsample drawn with probability proportional to confidence
    (RANSAC, then a robust refinement of the Sampson distance), with each frame's own camera. It is
    estimated at the inlier distance and at a tenth of it, and the motion with the smaller Cauchy
    cost is kept: in small images a moving component can lie within one pixel of a wrong motion.
    Each pixel with confidence is then triangulated by itself without smoothing, so far points with
    little parallax can have wild depths; only those beyond `FAR` times the median are dropped.

    Returns:
        (H, W) z of the reference frame in lengths of the translation; NaN where the flow has no
        confidence, the triangulated point is not in front of both cameras, or it is too far. None
        where there are too few pixels with flow, or no motion fits for lack of parallax.
    """
    if pair.flow is None or np.count_nonzero(pair.flow.confidence) < MIN_CORRESPONDENCES:
        return None
    used = pair.flow.confidence > 0
    at = pixel_grid(*pair.size)[used]
    r, q = rays(pair.K_ref, at), rays(pair.K_next, at + pair.flow.uv[used])
    weight = pair.flow.confidence[used].astype(np.float64)
    K, L = pair.K_ref, pair.K_next
    focal = float(np.prod([K[0, 0], K[1, 1], L[0, 0], L[1, 1]]) ** 0.25)
    pick = np.arange(len(weight))
    if len(weight) > SAMPLES:
        # weighted sampling without replacement (Efraimidis and Spirakis): the largest of u^(1/w)
        key = np.log1p(-np.random.default_rng(seed).random(len(weight))) / weight
        pick = np.sort(np.argpartition(-key, SAMPLES)[:SAMPLES])
        weight = np.ones(len(weight))  # the draw has done the weighting
    motion = _best_motion(r[pick], q[pick], weight[pick], focal, seed)
    if motion is None:
        return None
    z, z_next = epipolar.triangulate(motion, r, q)
    front = np.isfinite(z) & np.isfinite(z_next) & (z > 0) & (z_next > 0)
    if front.any():
        front &= z <= FAR * np.median(z[front])
    depth = np.full(pair.size, np.nan)
    depth[used] = np.where(front, z, np.nan)
    return depth


def _best_motion(
    r: Float, q: Float, weight: Float, focal: float, seed: int
) -> epipolar.Motion | None:
    """The motion of rays r, q (M, 3) with the smallest Cauchy cost, or None where there is none."""
    best, lowest = None, np.inf
    for distance in (INLIER, TIGHT * INLIER):
        motion = epipolar.estimate(epipolar.Matches(r, q, weight, focal), distance, seed)
        if motion is None or not (np.isfinite(motion.R).all() and np.isfinite(motion.t).all()):
            continue
        off = epipolar.sampson(motion.essential(), r, q, focal) / (TIGHT * INLIER)
        cost = float(np.sum(weight * np.log1p(off * off)))
        if cost < lowest:
            best, lowest = motion, cost
    return best


def fill_nearest(depth: Float) -> Float:
    """(H, W) copy in which each non-finite pixel has the value of the nearest finite one."""
    unknown = ~np.isfinite(depth)
    index = distance_transform_edt(unknown, return_distances=False, return_indices=True)
    return np.asarray(depth[tuple(index)])
