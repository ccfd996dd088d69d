"""What a method for dynamic scenes has to beat: one rigid motion, and one constant depth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from soup_nlp.data.pair import Flow, Pair
from soup_nlp.errors import DataError
from soup_nlp.geometry.camera import pixel_grid, rays
from soup_nlp.start import epipolar

Float = NDArray[np.float64]

MIN_CORRESPONDENCES = 8
"""Fewest pixels with flow for which a motion is looked for."""

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

    def filled(self) -> Float:
        """(H, W) depth with each unknown pixel given the depth of the nearest known one."""
        return fill_nearest(self.depth)

    def __str__(self) -> str:
        return (
            f"RigidBaseline({self.inlier_fraction:.1%} of the flow explained, "
            f"{self.coverage:.1%} of the pixels have a depth)"
        )


def rigid_depth(
    pair: Pair,
    flow: Flow | None = None,
    *,
    threshold: float = 1.0,
    samples: int = 8000,
    seed: int = 0,
) -> RigidBaseline:
    """Depth under one rigid motion for the whole image, triangulated pixel by pixel.

    The essential matrix comes from a subsample drawn with probability proportional to confidence
    (RANSAC, then a robust refinement of the Sampson distance), with each frame's own camera. It is
    looked for at the inlier distance and at a tenth of it, and the motion with the smaller Cauchy
    cost is kept: in small images a component that moves can hide within one pixel of a motion that
    is right for nothing. Each pixel with confidence is then triangulated by itself; nothing is
    smoothed, so far points with little parallax can have wild depths; only those beyond `FAR`
    times the median are dropped. Look at the median relative error beside the mean.

    Args:
        pair: Cameras, and the size of the image.
        flow: Flow from reference to next; None takes the pair's own.
        threshold: Inlier distance, pixels of the geometric mean focal length of the frames.
        samples: At most this many pixels for the motion.
        seed: Of the subsample and of RANSAC.

    Raises:
        DataError: there is no flow, it does not fit the pair or has too few usable pixels, an
            option is out of range, or no motion can be found (no parallax).
    """
    flow = pair.flow if flow is None else flow
    if flow is None:
        raise DataError(
            "rigid baseline needs a flow", where=pair.name, hint="give one, or use pair.with_flow"
        )
    if flow.confidence.shape != pair.size:
        raise DataError(
            "flow and reference image differ in size",
            where=flow.source,
            found=flow.confidence.shape,
            expected=f"{pair.size} (height, width)",
        )
    if not (threshold > 0 and samples >= MIN_CORRESPONDENCES):
        raise DataError(
            "option of the rigid baseline is out of range",
            where="threshold, samples",
            found=(threshold, samples),
            expected=f"threshold > 0 pixels, samples >= {MIN_CORRESPONDENCES}",
        )
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
    if count > samples:
        # weighted sampling without replacement (Efraimidis and Spirakis): the largest of u^(1/w)
        key = np.log1p(-np.random.default_rng(seed).random(count)) / weight
        pick = np.sort(np.argpartition(-key, samples)[:samples])
        drawn = np.ones(samples)  # the draw has done the weighting
    else:
        drawn = weight
    motion = _best_motion(r[pick], q[pick], drawn, focal, threshold, seed)
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
    near = np.abs(epipolar.sampson(motion.essential(), r, q, focal)) < threshold
    return RigidBaseline(
        R=motion.R,
        t=motion.t,
        depth=depth,
        inlier_fraction=float(np.sum(weight * near) / np.sum(weight)),
        coverage=float(np.count_nonzero(front) / depth.size),
    )


def _best_motion(
    r: Float, q: Float, weight: Float, focal: float, threshold: float, seed: int
) -> epipolar.Motion | None:
    """The motion of rays r, q (M, 3) with the smallest Cauchy cost, or None where there is none."""
    best, lowest = None, np.inf
    for distance in (threshold, TIGHT * threshold):
        motion = epipolar.estimate(r, q, weight, focal, distance, seed)
        if motion is None or not (np.isfinite(motion.R).all() and np.isfinite(motion.t).all()):
            continue
        off = epipolar.sampson(motion.essential(), r, q, focal) / (TIGHT * threshold)
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


def constant_depth(shape: tuple[int, int]) -> Float:
    """(H, W) of ones: the depth of a method that knows nothing but the global scale.

    Raises:
        DataError: the shape is not two positive numbers.
    """
    if len(shape) != 2 or min(shape) < 1:
        raise DataError(
            "constant depth needs the size of an image", found=shape, expected="(height, width)"
        )
    return np.ones(shape)
