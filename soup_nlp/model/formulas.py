"""Every term of the energy in plain NumPy, for L states of every superpixel and all L x L pairs.

It shares nothing with the symbolic model. Every function follows its equation of the paper; lengths
are measured in the depth of their anchors or with sum_i c_i D_i = 1: either makes E independent
of the free global scale. The energy of a soup has L = 1, the refinement one state a particle.
"""

from functools import cached_property
from typing import Literal, get_args

import numpy as np

from soup_nlp.arrays import AnyFloat, Float, Int, Mask
from soup_nlp.geometry.soup import Soup
from soup_nlp.model.energy_data import HINGE, EnergyData
from soup_nlp.model.energy_options import Weights

# --- superpixels and pairs of them in L states each ----------------------------------------------


class States:
    """L states of N superpixels; arrays have their components first, (c, N, L)."""

    def __init__(
        self,
        n: Float,
        D: Float,
        R: Float,
        T: Float,
        anchor_ray: Float,
        dtype: type | np.dtype = np.float64,
    ) -> None:
        """Planes `n . X + D = 0` and motions `X' = R X + T` of N x L states.

        Arrays that are subtracted for every pair of states have the type `dtype`: float64, or
        float32 for half the memory.
        """
        self.dtype, self.anchor_ray = dtype, anchor_ray
        self._plane, self._motion = (n, D), (R, T)
        self.Z = -D / np.einsum("nlc,nc->nl", n, anchor_ray)
        X = self.Z[..., None] * anchor_ray[:, None]
        Y = np.matmul(R, X[..., None])[..., 0] + T
        self.R, self.n, self.T, self.X, self.Y = (
            np.ascontiguousarray(np.moveaxis(v, -1, 0), dtype)
            for v in (R.reshape(*D.shape, 9), n, T, X, Y)
        )
        self.inverse = (1 / self.Z).astype(dtype)
        self.quarter = (0.5 * self.Z**-4.0).astype(dtype)

    def inverse_along(self, nodes: Int, ray: Float) -> Float:
        """(B, b, L) inverse depths along rays (b, B, 3)."""
        n, D = (a[nodes] for a in self._plane)
        return np.asarray(-np.einsum("ilc,ibc->bil", n, ray) / D)

    def turned(self, nodes: Int, ray: Float) -> Float:
        """(3, B, b, L) rays (b, B, 3) after the rotations."""
        return np.asarray(np.einsum("ilcd,ibd->cbil", self._motion[0][nodes], ray))

    def boundary(self, nodes: Int, ray: Float) -> tuple[AnyFloat, AnyFloat]:
        """Distances (B, b, L) along boundary rays (b, B, 3), and next-frame points (3 B, b, L)."""
        inverse = self.inverse_along(nodes, ray)
        z = 1 / np.where(np.abs(inverse) < 1e-12, 1e-12, inverse)
        points = z * self.turned(nodes, ray) + np.moveaxis(self._motion[1][nodes], 2, 0)[:, None]
        depths = z * np.linalg.norm(ray, axis=2).T[..., None]
        points = points.reshape(3 * len(z), *z.shape[1:])
        return depths.astype(self.dtype), points.astype(self.dtype)


GraphName = Literal["edges", "pairs"]
"""The K-NN graph and the graph of neighbours, fields of `EnergyData`."""


class Ends:
    """Both superpixels i, k of edges or neighbour pairs, in every pair of their states."""

    def __init__(
        self,
        states: States,
        data: EnergyData,
        graph: GraphName,
        unit: float,
        rows: Int | None = None,
    ) -> None:
        """Take rows (b,) of a graph, default all; `unit` is the scene's `sum_i c_i D_i`."""
        self.states, self.data, self.unit = states, data, unit
        every = getattr(data, graph)
        self.rows = np.arange(len(every)) if rows is None else rows
        self.i, self.k = every[self.rows].T

    def column(self, array: Float) -> AnyFloat:
        """Values of the rows, (b, 1, 1), of an array of the graph."""
        return array[self.rows].astype(self.states.dtype)[:, None, None]

    def distance(self, name: str, given: AnyFloat | float = 0.0) -> AnyFloat:
        """(b, L, L) distances between a vector of the states of both ends, by pair of labels, from
        a given (3, b, 1) difference of the two."""
        vectors = getattr(self.states, name)
        return _distance(vectors[:, self.i] - given, vectors[:, self.k])

    @cached_property
    def nearness(self) -> AnyFloat:
        """(b, L, L) power mean of the inverse depths of both anchors, close to the nearer one's."""
        a = self.states.quarter
        return np.sqrt(np.sqrt(a[self.i][:, :, None] + a[self.k][:, None, :]))

    def per_length(self, unit: Float) -> AnyFloat:
        """(b, L, L) or (b, 1, 1) one over the length unit of every row: its `edge_unit` or
        `pair_unit`, a share of the anchors' depth where lengths are local, else of the scene's."""
        if self.data.local_units:
            return self.nearness * self.column(1 / unit)
        return self.column(1 / (unit * self.unit))

    @property
    def relief(self) -> AnyFloat:
        """(b, L, L) difference of the anchors' inverse depths, relative to the nearer one's."""
        inverse = self.states.inverse
        return (inverse[self.i][:, :, None] - inverse[self.k][:, None, :]) / self.nearness

    @property
    def anchor_gap(self) -> AnyFloat:
        """(b, L, L) `|(R_i - R_k) (X_i + X_k) / 2 + T_i - T_k|`."""
        s, i, k = self.states, self.i, self.k
        # Y = R X + T, so R_i X_i / 2 + T_i = (Y_i + T_i) / 2
        sum_i, sum_k = (s.Y[:, nodes] + s.T[:, nodes] for nodes in (i, k))
        gap = sum_i[..., :, None] - sum_k[..., None, :]
        ri, rk = (s.turned(a, s.anchor_ray[b][:, None])[:, 0] for a, b in ((i, k), (k, i)))
        gap += ri[..., :, None] * s.Z[k][:, None, :]
        gap -= rk[..., None, :] * s.Z[i][:, :, None]
        return np.sqrt(np.einsum("cbij,cbij->bij", gap, gap)) / 2

    @property
    def boundary_gaps(self) -> tuple[AnyFloat, AnyFloat]:
        """(b, L, L) gaps of the shared boundary in the first and in the second frame."""
        ray = self.data.boundary_ray[self.rows]
        (zi, Yi), (zk, Yk) = (self.states.boundary(j, ray) for j in (self.i, self.k))
        # both points lie on one ray r: their distance is |r| times the difference of their depths
        return _distance(zi, zk), _distance(Yi, Yk)


def ends_of(soup: Soup, data: EnergyData) -> dict[GraphName, Ends]:
    """Both superpixels of every edge and every neighbour pair, in the states of a soup."""
    n, D, R, T = (a[:, None] for a in (soup.n, soup.distance, soup.R, soup.translation))
    states, unit = States(n, D, R, T, data.anchor_ray), float(np.sum(data.share * soup.distance))
    return {graph: Ends(states, data, graph, unit) for graph in get_args(GraphName)}


def relief(soup: Soup, data: EnergyData) -> Float:
    """(E,) difference of the inverse depths of an edge's anchors, relative to the nearer one."""
    return np.asarray(ends_of(soup, data)["edges"].relief[:, 0, 0])


def _distance(a: AnyFloat, b: AnyFloat) -> AnyFloat:
    """(e, x, y) root of the sum over c of `(a[c, e, x] - b[c, e, y])^2`."""
    total = (a[0][:, :, None] - b[0][:, None, :]) ** 2
    buffer = np.empty_like(total)
    for one, two in zip(a[1:], b[1:]):
        np.subtract(one[:, :, None], two[:, None, :], out=buffer)
        np.multiply(buffer, buffer, out=buffer)
        total += buffer
    return np.sqrt(total, out=total)


# --- the terms -----------------------------------------------------------------------------------


def reprojection(
    H: Float, data: EnergyData, weights: Weights, superpixels: Int | slice = slice(None)
) -> tuple[Float, Mask]:
    """E_proj of every superpixel, Eq. 3: mean distance in pixels of flow and homography.

    Of homographies H (N, L, 3, 3), `R - T n^T / D`, of all superpixels in order or of some of them:
    (N, L) costs, and (N, L) whether all pixels are in front of the camera.
    """
    ray, confidence = data.pixel_ray[superpixels], data.pixel_weight[superpixels]
    target = data.pixel_target[superpixels][:, None]
    y = np.matmul(data.K_next @ H, np.swapaxes(ray, 1, 2)[:, None])
    used = confidence[:, None] > 0
    ahead = (y[:, :, 2] > 1e-9).all(axis=2, where=used)
    with np.errstate(divide="ignore", invalid="ignore"):
        u = y[:, :, 0] / y[:, :, 2] - target[..., 0]
        v = y[:, :, 1] / y[:, :, 2] - target[..., 1]
        error = np.minimum(np.sqrt(u * u + v * v), weights.sigma_proj)
    return np.einsum("nls,ns->nl", np.where(used, error, 0.0), confidence), ahead


def arap(e: Ends, weights: Weights) -> AnyFloat:
    """E_arap of an edge, Eq. 1; an edge carries both its directions."""
    per_length = e.per_length(e.data.edge_unit)
    parts = (
        e.column(e.data.rotation_scale) * e.distance("R"),
        # how far the two motions carry the mean of both anchors apart, or the camera's centre
        per_length * (e.anchor_gap if e.data.arap_at_anchors else e.distance("T")),
        per_length * np.abs(e.distance("X") - e.distance("Y")),
    )
    leak, total = weights.leak_arap, np.zeros(1, e.states.dtype)
    for y in parts:
        total = total + ((1 - leak) * np.minimum(y, weights.sigma_arap) + leak * y)
    return total


def continuity(e: Ends, weights: Weights) -> AnyFloat:
    """E_cont of a neighbour pair, Eq. 4: gaps of the shared boundary in both frames."""
    before, after = e.boundary_gaps
    scale = e.column(e.data.pair_factor) * e.per_length(e.data.pair_unit)
    cut = np.minimum(scale * before, weights.sigma_cont_ref)
    return cut + np.minimum(scale * after, weights.sigma_cont)


def orientation(e: Ends, weights: Weights) -> AnyFloat:
    """E_orient of a neighbour pair: `rho_n(|n_i - n_k - turn|^2 / 2)`, `rho_n(1 - n_i . n_k)` if
    the normals are unit vectors and no turn is given."""
    turn = e.data.orient_turn[e.rows].T[:, :, None].astype(e.states.dtype)
    return np.minimum(e.distance("n", turn) ** 2 / 2, weights.sigma_orient)


def prior(e: Ends, weights: Weights) -> AnyFloat:
    """E_prior of an edge: slope of the inverse depth between its anchors, relative to it:
    `|(1 / Z_i - 1 / Z_k) / m - relief| / |r_i - r_k|` with anchor rays r and m `Ends.nearness`."""
    ray = e.states.anchor_ray
    reach = np.linalg.norm(ray[e.i] - ray[e.k], axis=1).astype(e.states.dtype)
    return np.abs(e.relief - e.column(e.data.prior_relief)) / reach[:, None, None]


def depth(e: Ends, weights: Weights) -> AnyFloat:
    """E_depth of an edge: `|log(Z_i / Z_k) - change|` of the depths Z of its anchors."""
    log = np.log(e.states.inverse)
    return np.abs(log[e.k][:, None, :] - log[e.i][:, :, None] - e.column(e.data.depth_change))


def order(e: Ends, weights: Weights) -> AnyFloat:
    """E_order of a neighbour pair: smooth hinge of the inverse depth that the covering superpixel
    f lacks on the boundary before the covered one b.

    `(x + sqrt(x^2 + HINGE^2)) / 2`, `x = ((1 + step) / Z_b - 1 / Z_f) / m`, m `Ends.nearness`.
    """
    ray, sign = e.data.boundary_ray[e.rows].mean(axis=1)[:, None], np.sign(e.data.order_weight)
    i, k = (e.states.inverse_along(j, ray)[0].astype(e.states.dtype) for j in (e.i, e.k))
    # the inverse depth of the covered side is enlarged by the step
    grown = [e.column(np.where(sign * side > 0, 1 + e.data.order_step, 1.0)) for side in (1, -1)]
    lack = e.column(sign) * (i[:, :, None] * grown[0] - k[:, None, :] * grown[1]) / e.nearness
    return (lack + np.hypot(lack, HINGE)) / 2
