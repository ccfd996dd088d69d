"""Which particles stay for the next round."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.geometry.soup import Soup
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.refine.costs import Particles, anchor_depth


def conditional_costs(
    labels: Int, unary: Float, edges: Int, pairwise: NDArray[np.floating]
) -> Float:
    """(N, L) energy that depends on a superpixel, by its label, all others held at `labels`.

    Args:
        labels: (N,) chosen labels.
        unary: (N, L) costs.
        edges: (E, 2).
        pairwise: (E, L, L) tables.
    """
    out = unary.copy()
    i, k = edges.T
    every = np.arange(len(edges))
    np.add.at(out, i, pairwise[every, :, labels[k]])
    np.add.at(out, k, pairwise[every, labels[i], :])
    return out


def diverse(p: Particles, labels: Int, cost: Float, count: int, data: EnergyData) -> Int:
    """(N, count) particles of low cost that differ from the chosen one and from one another.

    Two particles are near-duplicates if their coordinates, in pixels of the next frame, differ by
    less than a quarter pixel. A near-duplicate of a cheaper particle is chosen only if no other
    feasible particle is left.

    Args:
        p: (N, L) particles.
        labels: (N,) chosen ones; they are particle 0 of the next round anyway.
        cost: (N, L) conditional costs, inf where infeasible.
        count: Particles to keep of each superpixel.
        data: For anchors and focal length.
    """
    n, size = p.shape
    focal = float(data.K_next[0, 0])
    Z = anchor_depth(p, data.anchor_ray)
    every = np.arange(n)
    first = Z[every, labels][:, None]
    # depth and slope are not in pixels: 1 % of depth and 0.05 of slope count as one pixel
    coordinates = np.concatenate(
        [
            100 * np.log(np.maximum(Z / first, 1e-9))[..., None],
            20 * p.n,
            focal * p.R.reshape(n, size, 9) / np.sqrt(2.0),
            focal * p.T / first[..., None],
        ],
        axis=2,
    )
    rank = cost.astype(float).copy()
    duplicate = np.zeros((n, size), bool)
    taken = np.zeros((n, size), bool)
    taken[every, labels] = True
    out = np.empty((n, min(count, size - 1)), np.int64)
    last = labels
    for c in range(out.shape[1]):
        gap = np.abs(coordinates - coordinates[every, last][:, None]).max(axis=2)
        duplicate |= gap < 0.25
        # order of choice: feasible particles, then near-duplicates, then infeasible ones
        order = np.where(np.isfinite(rank), 0, 2) + duplicate + 4 * taken
        value = np.where(np.isfinite(rank), rank, 0.0)
        low = order.min(axis=1, keepdims=True)
        last = np.where(order == low, value, np.inf).argmin(axis=1)
        taken[every, last] = True
        out[:, c] = last
    return out


def spread_of(p: Particles, min_marginals: Float, anchor_ray: Float) -> Float:
    """(N,) standard deviation of log depth at the anchors, particles weighted by exp(-cost).

    Args:
        p: (N, L) particles.
        min_marginals: (N, L) costs, the least of a superpixel 0; infinite where not allowed.
        anchor_ray: (N, 3).
    """
    weight = np.exp(-np.asarray(min_marginals, np.float64))
    weight /= weight.sum(axis=1, keepdims=True)
    # a particle that is not allowed may lie behind the camera
    log = np.log(np.where(weight > 0, anchor_depth(p, anchor_ray), 1.0))
    mean = np.sum(weight * log, axis=1, keepdims=True)
    return np.asarray(np.sqrt(np.sum(weight * (log - mean) ** 2, axis=1)))


def within_reach(p: Particles, soup: Soup, near: Int, anchor_ray: Float, reach: float) -> Mask:
    """(N, L) whether the depth of a particle is within reach of its neighbours' depths.

    Lengths are measured in the depth of their anchors, so a superpixel at a thousand times the
    depth of its neighbours pays hardly anything for its motion. Such depths are not allowed,
    except the current belief and depths between it and those of the neighbours.

    Args:
        p: (N, L) particles.
        soup: Current belief.
        near: (N, K) neighbours.
        anchor_ray: (N, 3).
        reach: At most this many times the upper quartile of the neighbours' depths, at least the
            lower quartile over its square (an object in front of its background is common).
    """
    depth = soup.depth_at(anchor_ray)
    Z = anchor_depth(p, anchor_ray)
    if not near.shape[1]:
        return np.ones(Z.shape, bool)
    low, high = np.quantile(depth[near], (0.25, 0.75), axis=1)
    high = np.maximum(reach * high, depth) * (1 + 1e-9)
    low = np.minimum(low / reach**2, depth) * (1 - 1e-9)
    inside = np.less_equal(Z, high[:, None]) & np.greater_equal(Z, low[:, None])
    return np.asarray(inside)
