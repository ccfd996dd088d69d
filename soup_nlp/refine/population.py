"""Particles of a round: shares of the kinds of proposal, steps of the walks, what stays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.geometry.soup import Soup
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.refine.anchored import Particles, anchor_depth

WALKS = ("walk_plane", "walk_motion", "walk_pivot", "walk_scale", "walk_all")
COMMON = ("common_motion",)
BORROWED = (
    "neighbour_plane",
    "neighbour_motion",
    "neighbour_both",
    "neighbour_refit",
    "own_refit",
    "dominant",
    "mean",
)
KINDS = ("current", "kept", *WALKS, *COMMON, *BORROWED)
"""Kinds of proposal by number."""
SHARES: Mapping[str, float] = {
    "walk_plane": 3,
    "walk_motion": 3,
    "walk_pivot": 2,
    "walk_scale": 3,
    "walk_all": 2,
    "common_motion": 2,
    "neighbour_plane": 3,
    "neighbour_motion": 3,
    "neighbour_both": 5,
    "neighbour_refit": 2,
    "own_refit": 1,
    "dominant": 3,
    "mean": 3,
}
"""Proposals by kind in the first round, relative."""
FEW = ("own_refit",)
"""Kinds with at most one proposal, because they are deterministic."""


@dataclass
class Spread:
    """Step sizes of the walks: log-normal, centred where accepted steps were found.

    A step of a walk is drawn as `px x N(0, 1)` in every coordinate with px log-normal, so that
    large and small steps are tried at once.

    Attributes:
        centre: By kind of walk, log of the usual step, pixels.
        width: Standard deviation of log px.
        shrink: Factor per round on walks of which nothing is accepted.
    """

    centre: dict[str, float] = field(
        default_factory=lambda: {k: float(np.log(0.5)) for k in (*WALKS, *COMMON)}
    )
    width: float = 1.2
    shrink: float = 0.7

    def draw(self, kind: str, shape: tuple[int, ...], rng: np.random.Generator) -> Float:
        """Steps in pixels."""
        return np.asarray(np.exp(self.centre[kind] + self.width * rng.standard_normal(shape)))

    def learn(self, kind: str, accepted: Float) -> None:
        """Move the centre to the accepted steps (M,), pixels or NaN; shrink it without any."""
        accepted = accepted[np.isfinite(accepted)]
        if accepted.size >= 3:
            self.centre[kind] += 0.7 * (float(np.log(accepted).mean()) - self.centre[kind])
        else:
            self.centre[kind] += float(np.log(self.shrink))


def counts(shares: Mapping[str, float], total: int, near: int) -> dict[str, int]:
    """`total` proposals split by shares, largest remainders first, within the limits of each kind.

    Args:
        shares: By kind.
        total: Number of proposals.
        near: Neighbours of a superpixel.
    """
    most = {
        k: 1 if k in FEW else near if k.startswith("neighbour") or k == "mean" else total
        for k in shares
    }
    whole = sum(shares.values())
    exact = {k: min(total * v / whole, most[k]) for k, v in shares.items()}
    out = {k: int(v) for k, v in exact.items()}
    for k in sorted(exact, key=lambda k: out[k] - exact[k]):
        if sum(out.values()) < total and out[k] < most[k]:
            out[k] += 1
    out["walk_all"] += total - sum(out.values())
    return out


def relearn(
    shares: dict[str, float], proposed: Mapping[str, int], accepted: Mapping[str, int]
) -> None:
    """Increase the shares of kinds whose proposals were accepted, decrease the others."""
    rate = {k: accepted[k] / max(1, proposed[k]) for k in shares}
    mean = sum(rate.values()) / len(rate)
    if mean > 0:
        whole = sum(SHARES[k] for k in shares) / len(shares)
        for k in shares:
            # every kind keeps half of its usual share: it may succeed in a later round
            wanted = 0.5 * SHARES[k] + 0.5 * whole * min(rate[k] / mean, 3.0)
            shares[k] += 0.5 * (wanted - shares[k])


# --- what stays ----------------------------------------------------------------------------------


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
