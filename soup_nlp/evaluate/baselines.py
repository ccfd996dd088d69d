"""A baseline that methods for dynamic scenes have to beat: one rigid motion for all pixels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from soup_nlp.data.pair import Pair
from soup_nlp.errors import DataError
from soup_nlp.geometry.camera import pixel_grid, rays
from soup_nlp.start import epipolar

Float = NDArray[np.float64]

MIN_CORRESPONDENCES = 8
"""Fewest pixels with flow for which a motion is looked for."""

SAMPLES = 8000
"""Largest number of pixels for the motion."""

INLIER = 1.0
"""Largest Sampson distance of an inlier, pixels of the geometric mean focal length."""

TIGHT = 0.1
"""The motion is also looked for with this fraction of the inlier distance."""

FAR = 100.0
"""Depths beyond this multiple of the median depth count as unknown: there is no parallax left.
True depths of driving and indoor pairs reach 14 times their median."""


@dataclass(frozen=True)
class RigidBaseline:
    """A reconstruction that takes the whole image for one rigid component.

    Attributes:
        R: (3, 3) rotation, next_from_ref.
        t: (3,) translation, next_from_ref, unit length.
        depth: (H, W) z of the reference frame in lengths of the translation; NaN where the flow
            has no confidence, the triangulated point is not in front of both cameras, or it lies
            beyond `FAR` times the median depth.
        inlier_fraction: Share of the confidence on pixels that the motion explains within the
            threshold (Sampson distance).
        coverage: Share of all pixels with a depth; goes with every number made of `depth`.
    """

    R: Float
    t: Float
    depth: Float
    inlier_fraction: float
    coverage: float


def rigid_depth(pair: Pair, seed: int = 0) -> RigidBaseline:
    """Depth under one rigid motion for the whole image, triangulated pixel by pixel.

    The essential matrix comes from a subsample drawn with probability proportional to confidence
    (RANSAC, then a robust refinement of the Sampson distance), with each frame's own camera. It is
    looked for at the inlier distance and at a tenth of it, and the motion with the smaller Cauchy
    cost is kept: in small images a moving component can lie within one pixel of a wrong motion.
    Each pixel with confidence is then triangulated by itself without smoothing, so far points with
    little parallax can have wild depths; only those beyond `FAR` times the median are dropped.

    Args:
        pair: Cameras and flow.
        seed: Of the subsample and of RANSAC.

    Raises:
        DataError: there is no flow, it does not fit the image or has too few usable pixels, or no
            motion can be found (no parallax).
    """
    flow = pair.flow
    if flow is None:
        raise DataError("rigid baseline needs a flow", where=pair.name, hint="use pair.with_flow")
    used = flow.confidence > 0
    count = int(np.count_nonzero(used))
    if count < MIN_CORRESPONDENCES:
        raise DataError(
            "flow has too few usable pixels for a motion",
            where=flow.source,
            found=count,
            expected=f"at least {MIN_CORRESPONDENCES} with positive confidence",
        )
    at = pixel_grid(*pair.size)[used]
    r, q = rays(pair.K_ref, at), rays(pair.K_next, at + flow.uv[used])
    weight = flow.confidence[used].astype(np.float64)
    focal = float(
        np.prod([pair.K_ref[0, 0], pair.K_ref[1, 1], pair.K_next[0, 0], pair.K_next[1, 1]]) ** 0.25
    )
    pick = np.arange(count)
    if count > SAMPLES:
        # weighted sampling without replacement (Efraimidis and Spirakis): the largest of u^(1/w)
        key = np.log1p(-np.random.default_rng(seed).random(count)) / weight
        pick = np.sort(np.argpartition(-key, SAMPLES)[:SAMPLES])
        drawn = np.ones(SAMPLES)  # the draw has done the weighting
    else:
        drawn = weight
    motion = _best_motion(r[pick], q[pick], drawn, focal, seed)
    if motion is None:
        raise DataError(
            "no rigid motion fits the flow",
            where=f"{pair.name}, flow {flow.source}",
            expected="a flow with parallax",
            hint="a still camera in a still scene has no depth from motion",
        )
    z, z_next = epipolar.triangulate(motion, r, q)
    front = np.isfinite(z) & np.isfinite(z_next) & (z > 0) & (z_next > 0)
    if front.any():
        front &= z <= FAR * np.median(z[front])
    depth = np.full(pair.size, np.nan)
    depth[used] = np.where(front, z, np.nan)
    near = np.abs(epipolar.sampson(motion.essential(), r, q, focal)) < INLIER
    return RigidBaseline(
        R=motion.R,
        t=motion.t,
        depth=depth,
        inlier_fraction=float(np.sum(weight * near) / np.sum(weight)),
        coverage=float(np.count_nonzero(front) / depth.size),
    )


def _best_motion(
    r: Float, q: Float, weight: Float, focal: float, seed: int
) -> epipolar.Motion | None:
    """The motion of rays r, q (M, 3) with the smallest Cauchy cost, or None where there is none."""
    best, lowest = None, np.inf
    for distance in (INLIER, TIGHT * INLIER):
        motion = epipolar.estimate(r, q, weight, focal, distance, seed)
        if motion is None or not (np.isfinite(motion.R).all() and np.isfinite(motion.t).all()):
            continue
        off = epipolar.sampson(motion.essential(), r, q, focal) / (TIGHT * INLIER)
        cost = float(np.sum(weight * np.log1p(off * off)))
        if cost < lowest:
            best, lowest = motion, cost
    return best


def fill_nearest(depth: Float) -> Float:
    """(H, W) copy in which each non-finite pixel has the value of the nearest finite one.

    Args:
        depth: (H, W); not finite where unknown.

    Raises:
        DataError: not a map, or no pixel is known.
    """
    unknown = ~np.isfinite(depth)
    if depth.ndim != 2 or unknown.all():
        raise DataError(
            "nothing to fill a depth map from",
            where="fill_nearest",
            found=f"shape {depth.shape}, {int((~unknown).sum())} known pixels",
            expected="(H, W) with at least one finite depth",
        )
    if not unknown.any():
        return depth.copy()
    index = distance_transform_edt(unknown, return_distances=False, return_indices=True)
    return np.asarray(depth[tuple(index)])
