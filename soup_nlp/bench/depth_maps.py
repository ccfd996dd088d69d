"""Depth maps that are scored: solution, earlier stages, baselines with the same flow, floor.

The superpixel floor is the score of planes fitted to the true depth of every superpixel.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float
from soup_nlp.errors import DataError
from soup_nlp.evaluate.baselines import fill_nearest
from soup_nlp.geometry.camera import pixel_grid, rays
from soup_nlp.geometry.soup import Soup, reconstruct

if TYPE_CHECKING:
    from soup_nlp.pipeline.record import Run

Labels = NDArray[np.integer]

METHODS: Mapping[str, str] = MappingProxyType(
    {
        "solution": "what the product delivers",
        "solution_90": "the same, on the 90 % of the true pixels where sigma is least",
        "solution_70": "the same, on 70 %",
        "nlp": "the NLP alone, before refinement",
        "start": "the start: shared motions, scales by contact",
        "unorganised": "independent superpixels: each with a translation of length 1, no assembly",
        "solution_rigid": "the solution, only where one rigid motion has a depth",
        "rigid": "one rigid motion, triangulated; only where it has a depth",
        "rigid_filled": "the same, holes filled from the nearest pixel",
        "plane": "the best single plane (fitted to the whole truth)",
        "constant": "a constant depth",
        "floor": "superpixel floor: true planes in these superpixels",
    }
)
"""Descriptions of the depth maps, in the order of the tables."""

BASELINES = ("unorganised", "rigid", "rigid_filled", "plane", "constant")
"""Depth maps that the solution is compared with."""

MIN_DENSITY = 4.0
"""True pixels per superpixel that the superpixel floor needs."""

MIN_PLANE_PIXELS = 4
"""True pixels that a plane is fitted to; labels with fewer get a constant depth."""


def unorganised(soup: Soup) -> Soup:
    """The soup before assembly: the scale of every superpixel makes its translation have length 1.

    Two views determine each plane and motion up to a scale, so this is the result of independent
    superpixels. Superpixels at rest keep their scale.
    """
    length = np.linalg.norm(soup.translation, axis=1)
    tiny = 1e-9 * max(float(length.max(initial=0.0)), 1e-300)
    unit = np.where(length > tiny, length, 1.0)
    return Soup(soup.lam / unit, soup.n, soup.d, soup.R, soup.t)


def depth_maps(run: Run, fitted: bool = True) -> dict[str, Float]:
    """(H, W) depths of the reference frame by method, for a run whose pair has a truth of depth.

    "nlp" is present if the NLP was refined, the rigid ones if a motion fits, and "floor" if the
    truth is dense enough. "plane" and "floor" are fitted to all true pixels, also to those that a
    convention with a cap or a crop leaves out. They are left out if not `fitted`.
    """
    pair, seg = run.pair, run.segmentation
    labels = seg.labels
    out = {"solution": run.reconstruction.depth_ref}
    if run.nlp_reconstruction is not None:
        out["nlp"] = run.nlp_reconstruction.depth_ref
    out["start"] = run.start_reconstruction.depth_ref
    alone = reconstruct(unorganised(run.start.soup), labels, pair.K_ref, pair.K_next)
    out["unorganised"] = alone.depth_ref
    if run.rigid is not None:
        there = np.isfinite(run.rigid)
        out["solution_rigid"] = np.where(there, run.reconstruction.depth_ref, np.nan)
        out["rigid"] = run.rigid
        if np.isfinite(run.rigid).any():
            out["rigid_filled"] = fill_nearest(run.rigid)
    truth = true_depth(run)
    if truth is None:
        return out
    out["constant"] = np.ones(pair.size)
    if not fitted:
        return out
    whole = np.zeros(labels.shape, np.int32)
    out["plane"] = plane_depth(least_error_planes(whole, truth, pair.K_ref), whole, pair.K_ref)
    if np.count_nonzero(np.isfinite(truth)) >= MIN_DENSITY * len(seg):
        out["floor"] = plane_depth(
            least_error_planes(labels, truth, pair.K_ref), labels, pair.K_ref
        )
    return out


def true_depth(run: Run) -> Float | None:
    """(H, W) true depth, NaN where unknown; sparse points at their nearest pixels; None if none."""
    truth = run.pair.truth
    if truth is None:
        return None
    if truth.depth_ref is not None:
        known = np.isfinite(truth.depth_ref) & (truth.depth_ref > 0)
        return np.where(known, truth.depth_ref, np.nan) if known.any() else None
    if truth.points is None:
        return None
    sparse = points_as_map(truth.points, run.pair.size)
    return sparse if np.isfinite(sparse).any() else None


def least_error_planes(
    labels: Labels, depth: Float, K: Float, rounds: int = 20, softening: float = 1e-4
) -> Float:
    """Inverse-depth planes m, 1 / z = m . ray, with the least mean relative error per label.

    Iteratively reweighted least squares minimises sum |z - 1 / (m . r)| / z = sum |u - 1| / u with
    u = z m . r. It starts from two planes, the least-squares solutions of 1 / z - m . r and of
    u - 1. The best iterate of each label is kept, or the best constant depth if no plane is better.
    The mean relative error is not convex in m, so the result is an upper bound of the minimum.

    Args:
        labels: (H, W) label 0..N-1 of every pixel.
        depth: (H, W) true z; NaN where unknown.
        K: (3, 3) intrinsics.
        rounds: Reweighted fits from each start.
        softening: Relative error below which the weights are constant.

    Returns:
        (N, 3); NaN where a label has no true pixel.

    Raises:
        DataError: shapes differ, or no depth is known.
    """
    if labels.shape != depth.shape:
        raise DataError("labels and depth differ in size", found=labels.shape, expected=depth.shape)
    known = np.isfinite(depth) & (depth > 0)
    if not known.any():
        raise DataError("no true depth to fit planes to")
    n = int(labels.max()) + 1
    which = labels[known].astype(np.int64)
    z = depth[known].astype(np.float64)
    zr = z[:, None] * rays(K, pixel_grid(*depth.shape))[known]
    count = np.bincount(which, minlength=n)
    constant = np.column_stack([np.zeros((n, 2)), _best_constant(which, z, count)])
    best, lowest = constant.copy(), _errors(constant, which, zr, count)
    rich = count >= MIN_PLANE_PIXELS
    # equal weights of u - 1 grow with z^2: a few sky pixels outweigh all near ones
    for weight in (1.0 / (z * z), np.ones(len(z))):
        for _ in range(rounds):
            m = _solve(which, zr, weight, n, constant)
            cost = _errors(m, which, zr, count)
            better = rich & (cost < lowest)
            best[better], lowest[better] = m[better], cost[better]
            u = np.maximum(np.einsum("pc,pc->p", zr, m[which]), 0.05)
            weight = 1.0 / (u * u * np.maximum(np.abs(1 - 1 / u), softening))
    best[count == 0] = np.nan
    return best


def _best_constant(which: Labels, z: Float, count: Labels) -> Float:
    """(N,) inverse of the constant c that minimises sum |z - c| / z: a weighted median of z."""
    order = np.lexsort((z, which))
    own = which[order]
    mass = np.cumsum(1 / z[order])
    end = np.cumsum(count)
    before = np.where(end - count > 0, mass[np.maximum(end - count, 1) - 1], 0.0)
    half = 0.5 * (before + mass[np.maximum(end, 1) - 1])
    # the first pixel of every label at which half of its weight is reached
    reached = np.flatnonzero(mass >= half[own] * (1 - 1e-12))
    out = np.ones(len(count))
    label, first = np.unique(own[reached], return_index=True)
    out[label] = 1 / z[order][reached[first]]
    return out


def _solve(which: Labels, zr: Float, weight: Float, n: int, prior: Float) -> Float:
    """(N, 3) weighted least squares of m . zr = 1, with a small ridge towards a prior."""
    A = np.empty((n, 3, 3))
    for a in range(3):
        for b in range(a, 3):
            A[:, a, b] = A[:, b, a] = np.bincount(which, weight * zr[:, a] * zr[:, b], n)
    right = np.stack([np.bincount(which, weight * zr[:, a], n) for a in range(3)], axis=1)
    ridge = 1e-9 * np.trace(A, axis1=1, axis2=2) + 1e-30
    A = A + ridge[:, None, None] * np.eye(3)
    return np.linalg.solve(A, (right + ridge[:, None] * prior)[..., None])[..., 0]


def _errors(m: Float, which: Labels, zr: Float, count: Labels) -> Float:
    """(N,) mean relative error of every label; infinite if a pixel is behind the plane."""
    u = np.einsum("pc,pc->p", zr, m[which])
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.where(u > 0, np.abs(1 - 1 / u), np.inf)
        return np.asarray(np.bincount(which, error, len(m)) / count)


def plane_depth(m: Float, labels: Labels, K: Float) -> Float:
    """(H, W) depth of inverse-depth planes (N, 3); NaN where a plane is behind or unknown."""
    inverse = np.einsum("hwc,hwc->hw", m[labels], rays(K, pixel_grid(*labels.shape)))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(inverse > 0, 1 / inverse, np.nan)


def points_as_map(points: Float, shape: tuple[int, int]) -> Float:
    """Depth map of sparse truth (M, 3) of (u, v, z), each at its nearest pixel; NaN elsewhere."""
    out = np.full(shape, np.nan)
    u, v = np.floor(points[:, :2] + 0.5).astype(np.int64).T
    inside = (u >= 0) & (v >= 0) & (u < shape[1]) & (v < shape[0])
    out[v[inside], u[inside]] = points[inside, 2]
    return out
