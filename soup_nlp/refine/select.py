"""Which particles stay for the next round, and planes made to face the camera."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from soup_nlp.geometry.soup import Soup
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.refine.costs import Particles, anchor_depth

Float = NDArray[np.float64]
Int = NDArray[np.int64]

TOLERANCE = 1e-7
"""Violation of visibility that a given soup may have."""


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

    Two particles are alike when their coordinates, in pixels of the next frame, are within a
    quarter pixel; one that is alike to a cheaper one is taken only when there are no others.

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
    own = np.arange(n)
    first = Z[own, labels][:, None]
    # depth and slope have no pixel of their own: a per cent, and 0.05, count as one
    place = np.concatenate(
        [
            100 * np.log(np.maximum(Z / first, 1e-9))[..., None],
            20 * p.n,
            focal * p.R.reshape(n, size, 9) / np.sqrt(2.0),
            focal * p.T / first[..., None],
        ],
        axis=2,
    )
    rank = cost.astype(float).copy()
    alike = np.zeros((n, size), bool)
    taken = np.zeros((n, size), bool)
    taken[own, labels] = True
    out = np.empty((n, min(count, size - 1)), np.int64)
    last = labels
    for c in range(out.shape[1]):
        gap = np.abs(place - place[own, last][:, None]).max(axis=2)
        alike |= gap < 0.25
        # the infeasible last, the alike before them
        order = np.where(np.isfinite(rank), 0, 2) + alike + 4 * taken
        value = np.where(np.isfinite(rank), rank, 0.0)
        low = order.min(axis=1, keepdims=True)
        last = np.where(order == low, value, np.inf).argmin(axis=1)
        taken[own, last] = True
        out[:, c] = last
    return out


def within_reach(
    p: Particles, soup: Soup, near: Int, anchor_ray: Float, reach: float
) -> NDArray[np.bool_]:
    """(N, L) whether the depth of a particle is one that its surroundings suggest.

    Lengths are measured in the depth of their anchors, so a superpixel that runs away to a
    thousand times the depth of all around it pays next to nothing for its motion. No particle
    starts that; the current belief is always allowed, and so is whatever is nearer to the
    surroundings than it.

    Args:
        p: (N, L) particles.
        soup: Current belief.
        near: (N, K) neighbours.
        anchor_ray: (N, 3).
        reach: At most this many times the upper quartile of the neighbours' depths, at least the
            lower quartile over its square (a thing in front of its background is common).
    """
    own = soup.depth_at(anchor_ray)
    Z = anchor_depth(p, anchor_ray)
    if not near.shape[1]:
        return np.ones(Z.shape, bool)
    low, high = np.quantile(own[near], (0.25, 0.75), axis=1)
    high = np.maximum(reach * high, own) * (1 + 1e-9)
    low = np.minimum(low / reach**2, own) * (1 - 1e-9)
    inside = np.less_equal(Z, high[:, None]) & np.greater_equal(Z, low[:, None])
    return np.asarray(inside)


def upright(soup: Soup, anchor_ray: Float, visibility_ray: Float, min_facing: float) -> Soup:
    """The soup with planes that break visibility tilted about their anchors until they do not.

    The depth at the anchor stays. A plane parallel to the image satisfies every row.

    Args:
        soup: State.
        anchor_ray: (N, 3).
        visibility_ray: (N, V, 3), see `EnergyData.visibility_ray`.
        min_facing: c of `-n . v >= c`.
    """
    m = -soup.n / soup.distance[:, None]
    Z = 1.0 / np.einsum("nc,nc->n", m, anchor_ray)
    bad_depth = Z <= 0
    Z = np.where(bad_depth, np.median(Z[~bad_depth]) if (~bad_depth).any() else 1.0, Z)
    g = np.where(bad_depth[:, None], 0.0, m[:, :2] * Z[:, None])
    share = np.ones(len(soup))
    n, D = soup.n.copy(), soup.distance.copy()
    for _ in range(60):
        facing = -np.einsum("nc,nvc->nv", n, visibility_ray).max(axis=1)
        # an NLP's answer keeps its inequalities to a tolerance: it stays as it is
        bad = (facing < min_facing - TOLERANCE) | bad_depth
        bad_depth = np.zeros(len(soup), bool)
        if not bad.any():
            break
        share = np.where(bad, 0.8 * share, share)
        tilt = g * share[:, None]
        plane = np.column_stack([tilt, 1 - np.sum(tilt * anchor_ray[:, :2], axis=1)]) / Z[:, None]
        length = np.linalg.norm(plane, axis=1)
        n[bad] = (-plane / length[:, None])[bad]
        D[bad] = (1 / length)[bad]
    return Soup(np.ones(len(soup)), n, D, soup.R, soup.translation)
