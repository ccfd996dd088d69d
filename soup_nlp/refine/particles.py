"""Particles: possible states of superpixels, the proposals around a soup, and their costs.

A proposal is written about the anchor of its superpixel: depth Z there, slope g of the relative
inverse depth (`1 / Z(r) = (1 + g . (r - r_a)) / Z`, a chart of the sphere of normals), rotation
R and translation T. Any step in (log Z, g, rotation vector, T) leads to a plane
with a unit normal and a positive distance, and a motion in SE(3). Steps are in pixels of
re-projection, so that one distribution fits every scene and every superpixel.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from soup_nlp.arrays import AnyFloat, Float, Int, Mask
from soup_nlp.geometry import rotation
from soup_nlp.geometry.plane import about_anchor, at_anchor, inverse_depth, normal_and_distance
from soup_nlp.geometry.soup import Soup
from soup_nlp.model.elements import TERMS
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.formulas import Ends, GraphName, States, reprojection

WALKS: Mapping[str, float] = {"walk_plane": 3, "walk_motion": 3, "walk_all": 2}
"""Kinds of random walks around the current belief, and their relative numbers."""
NEIGHBOURS: Mapping[str, float] = {"neighbour_plane": 3, "neighbour_motion": 4, "neighbour_both": 5}
"""Kinds that take over the plane, the motion or both of a neighbour."""
STEP, WIDTH = 0.5, 1.2
"""Median of the steps of a walk in pixels, and the standard deviation of their logarithm: large and
small steps are tried at once."""


@dataclass(frozen=True)
class Particles:
    """L possible states of each of N superpixels: plane `n . X + D = 0`, motion `X' = R X + T`.

    Attributes:
        n: (N, L, 3) unit normals that face the camera.
        D: (N, L) distances of the planes, positive.
        R: (N, L, 3, 3) rotations.
        T: (N, L, 3) translations.
    """

    n: Float
    D: Float
    R: Float
    T: Float

    @property
    def shape(self) -> tuple[int, int]:
        """(N, L)."""
        return self.D.shape[0], self.D.shape[1]

    @property
    def homographies(self) -> Float:
        """(N, L, 3, 3) `R - T n^T / D`, from rays of the reference frame to those of the next."""
        scaled = self.n / self.D[..., None]
        return np.asarray(self.R - self.T[..., :, None] * scaled[..., None, :])

    @classmethod
    def of(cls, soup: Soup) -> Particles:
        """A soup as one particle per superpixel."""
        T = soup.translation[:, None]
        return cls(soup.n[:, None], soup.distance[:, None], soup.R[:, None], T)

    def joined(self, *others: Particles) -> Particles:
        """The particles of several sets, concatenated."""
        arrays = zip(*(vars(p).values() for p in (self, *others)))
        return Particles(*(np.concatenate(a, axis=1) for a in arrays))

    def subset(self, which: Int | slice) -> Particles:
        """The particles of the superpixels `which`."""
        return Particles(*(a[which] for a in vars(self).values()))

    def soup(self, labels: Int, share: Float) -> Soup:
        """The soup of labels (N,), with sum(lam) = 1 exactly restored (`Soup.normalised`)."""
        chosen = (a[np.arange(len(labels)), labels] for a in vars(self).values())
        return Soup(np.ones(len(labels)), *chosen).normalised(share)


def from_anchor(Z: Float, g: Float, R: Float, T: Float, anchor_ray: Float) -> Particles:
    """Particles of depths (N, C) and slopes (N, C, 2) at the anchors, and of motions."""
    n, D = normal_and_distance(about_anchor(Z, g, anchor_ray[:, None]))
    return Particles(n, D, R, T)


def neighbours(edges: Int, anchor_ray: Float) -> Int:
    """(N, K) neighbours of every superpixel on a graph (E, 2), nearest anchors (N, 3) first; K is
    the smallest degree."""
    node, neighbour = np.concatenate([edges, edges[:, ::-1]]).T
    gap = np.linalg.norm(anchor_ray[node] - anchor_ray[neighbour], axis=1)
    order = np.lexsort((gap, node))
    degree = np.bincount(node, minlength=len(anchor_ray))
    start = np.cumsum(degree) - degree
    return neighbour[order][start[:, None] + np.arange(degree.min())]


def counts(shares: Mapping[str, float], total: int, near: int) -> dict[str, int]:
    """`total` proposals split by shares; random steps replace what is beyond `near` neighbours."""
    share = np.cumsum(list(shares.values()))
    ends = np.rint(total * share / share[-1]).astype(int)
    split = dict(zip(shares, np.diff(ends, prepend=0).tolist(), strict=True))
    split = {k: min(n, near) if k in NEIGHBOURS else n for k, n in split.items()}
    split["walk_all"] += total - sum(split.values())
    return split


class Proposer:
    """Makes proposals for one pair; `near` (N, K) are the neighbours of every superpixel, nearest
    first."""

    def __init__(self, data: EnergyData, near: Int, seed: int) -> None:
        self.data, self.near = data, near
        self.rng = np.random.default_rng(seed)
        self.focal = float(data.K_next[0, 0])

    def propose(self, soup: Soup, kind: str, count: int) -> Particles:
        """`count` particles of a kind around a soup; at most K of a kind of `NEIGHBOURS`."""
        if kind in WALKS:
            return self._walk(soup, kind, count)
        sources = self._random_neighbours(count)
        R, T = soup.R[sources], soup.translation[sources]
        if kind == "neighbour_motion":
            n = np.broadcast_to(soup.n[:, None], T.shape)
            D = np.broadcast_to(soup.distance[:, None], sources.shape)
            return Particles(n, D, R, T)
        Z, g = self._extrapolated(soup, sources)
        if kind == "neighbour_plane":
            # every second particle keeps the motion, the others scale it with the depth
            depth = soup.depth_at(self.data.anchor_ray)[:, None]
            scale = np.where(np.arange(sources.shape[1]) % 2, 1.0, Z / depth)
            R = np.broadcast_to(soup.R[:, None], R.shape)
            T = soup.translation[:, None] * scale[..., None]
        return from_anchor(Z, g, R, T, self.data.anchor_ray)

    def _walk(self, soup: Soup, kind: str, count: int) -> Particles:
        """Random steps of plane, motion or both."""
        n, rng, ray = len(soup), self.rng, self.data.anchor_ray
        Z, g = (v[:, None] for v in at_anchor(inverse_depth(soup.n, soup.distance), ray))
        R, T = soup.R[:, None], soup.translation[:, None]
        step = STEP * np.exp(WIDTH * rng.standard_normal((n, count)))
        per_pixel, shift = self._units(soup)
        if kind != "walk_motion":
            # a step changes depth by a factor of 4 at most
            dz = np.clip(per_pixel * step * rng.standard_normal((n, count)), -1.4, 1.4)
            slope = per_pixel / self.data.radius[:, None] * step
            Z = Z * np.exp(dz)
            g = g + slope[..., None] * rng.standard_normal((n, count, 2))
        if kind != "walk_plane":
            w = step[..., None] / self.focal * rng.standard_normal((n, count, 3))
            R = rotation.exp(w) @ R
            T = T + (shift * step)[..., None] * rng.standard_normal((n, count, 3))
        Z, g, R, T = (np.broadcast_to(v, (n, count, *v.shape[2:])) for v in (Z, g, R, T))
        return from_anchor(Z, g, R, T, ray)

    def _units(self, soup: Soup) -> tuple[Float, Float]:
        """Changes (N, 1) of log Z or g x radius, and of T, that move the image by one pixel."""
        ray = self.data.anchor_ray
        # without parallax only the other terms limit a depth: half a pixel is the least taken
        parallax = self.focal * np.linalg.norm(soup.parallax(ray), axis=1)
        z = np.maximum(soup.moved(soup.points(ray))[:, 2], 1e-9)
        return 1.0 / np.maximum(parallax, 0.5)[:, None], z[:, None] / self.focal

    def _random_neighbours(self, count: int) -> Int:
        """(N, count) different neighbours, the nearer ones preferred."""
        key = self.rng.exponential(size=self.near.shape) * (np.arange(self.near.shape[1]) + 1.0)
        order = np.argsort(key, axis=1)[:, :count]
        return np.take_along_axis(self.near, order, axis=1)

    def _extrapolated(self, soup: Soup, sources: Int) -> tuple[Float, Float]:
        """Depth and slope, at each anchor, of the planes of other superpixels (N, C)."""
        ray = self.data.anchor_ray
        depth = soup.depth_at(ray)
        m = inverse_depth(soup.n, soup.distance)[sources]
        inverse = np.einsum("ncj,nj->nc", m, ray)
        # where a plane does not meet the anchor's ray in front, its depth at its own anchor is used
        bad = inverse * depth[:, None] < 0.1
        Z = np.where(bad, depth[sources], 1.0 / np.where(bad, 1.0, inverse))
        g = np.where(bad[..., None], 0.0, m[..., :2] * Z[..., None])
        return Z, g


# --- costs ----------------------------------------------------------------------------------------
#
# E_proj of every label and the other terms of every pair of labels: the sum over chosen labels is
# the energy of the soup that they make, by the terms of the oracle.

BLOCK_BYTES = 1 << 18  # one of the half dozen buffers of a block of edges
UNARY_BYTES = 1 << 23  # one of the arrays of a block of superpixels


def feasible(p: Particles, visibility_ray: Float, min_facing: float) -> Mask:
    """(N, L) whether `-n . v >= min_facing` on every row of `EnergyData.visibility_ray`.

    SO(3), unit normals and positive scales hold for every particle by construction.
    """
    facing = -np.matmul(p.n, np.swapaxes(visibility_ray, 1, 2))
    return np.asarray((facing.min(axis=2) >= min_facing) & (p.D > 0))


def unary_costs(
    p: Particles, data: EnergyData, weights: Weights, superpixels: Int | None = None
) -> tuple[Float, Mask]:
    """(N, L) alpha1 E_proj of every particle, and whether it keeps its pixels in front of the
    camera; the particles are those of `superpixels` (N,), by default of all in order."""
    n_nodes, n_labels = p.shape
    out, ahead = np.empty(p.shape), np.empty(p.shape, bool)
    index = np.arange(n_nodes) if superpixels is None else superpixels
    step = max(1, UNARY_BYTES // (8 * 3 * n_labels * max(1, data.pixel_ray.shape[1])))
    for a in range(0, n_nodes, step):
        b = slice(a, a + step)
        out[b], ahead[b] = reprojection(p.subset(b).homographies, data, weights, index[b])
    out *= weights.proj
    return out, ahead & np.isfinite(out)


class PairCosts:
    """Pairwise costs over the union of the K-NN and the neighbour graph.

    Attributes:
        edges: (E, 2) union of `data.edges` and `data.pairs`, i < k, each pair once.
        rows: For both graphs by name, (E,) the row of each of these, -1 where there is none.
    """

    def __init__(self, data: EnergyData, weights: Weights) -> None:
        self.data, self.weights = data, weights
        n = len(data)
        graphs: dict[GraphName, Int] = {"edges": data.edges, "pairs": data.pairs}
        keys = {name: e[:, 0] * n + e[:, 1] for name, e in graphs.items()}
        key = np.union1d(*keys.values())
        self.edges: Int = np.stack([key // n, key % n], axis=1)
        self.rows = {name: np.full(len(key), -1) for name in keys}
        for name, own in keys.items():
            self.rows[name][np.searchsorted(key, own)] = np.arange(len(own))

    def tables(
        self, p: Particles, unit: float = 1.0, dtype: type | np.dtype = np.float64
    ) -> AnyFloat:
        """(E, L, L) weighted sum of all terms but E_proj, by edge and pair of labels.

        `unit` is the scene's, `sum_i c_i D_i`, where lengths are not local; float32 takes half the
        memory of float64.
        """
        data, labels = self.data, p.shape[1]
        out = np.zeros((len(self.edges), labels, labels), dtype)
        states = States(p.n, p.D, p.R, p.T, data.anchor_ray, dtype)
        step = max(1, BLOCK_BYTES // (out.itemsize * labels * labels))
        for graph, rows in self.rows.items():
            present = np.flatnonzero(rows >= 0)
            terms = [
                (term, getattr(self.weights, name) * np.abs(getattr(data, term.weight)))
                for name, term in TERMS.items()
                if term.graph == graph
            ]
            for a in range(0, len(present), step):
                at = present[a : a + step]
                ends = Ends(states, data, graph, unit, rows[at])
                for term, weight in terms:
                    if weight[rows[at]].any():
                        assert term.cost
                        out[at] += ends.column(weight) * term.cost(ends, self.weights)
        return out
