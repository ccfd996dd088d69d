"""Costs of particles: E_proj of every label, the other terms of every pair of labels, in numpy.

The sum of the costs of chosen labels equals `oracle.energy` of the soup that they make: it is the
same energy as a pairwise MRF. Differences are taken component by component, not from inner
products, which avoids cancellation where particles are nearly equal.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from soup_nlp.arrays import AnyFloat, Float, Int, Mask
from soup_nlp.model.energy_data import HINGE, EnergyData
from soup_nlp.model.energy_options import Weights
from soup_nlp.refine.particles import Particles, anchor_depth

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
    """alpha1 E_proj of every particle, and whether it keeps its pixels in front of the camera.

    Args:
        p: (N, L) particles.
        data: Pixels of the pair, all or sampled.
        weights: alpha1 and its truncation.
        superpixels: (N,) superpixels that the particles belong to; None for all, in order.

    Returns:
        (N, L) costs and (N, L) bool.
    """
    n_nodes, n_labels = p.shape
    out, ahead = np.empty(p.shape), np.empty(p.shape, bool)
    index = np.arange(n_nodes) if superpixels is None else superpixels
    step = max(1, UNARY_BYTES // (8 * 3 * n_labels * max(1, data.pixel_ray.shape[1])))
    for a in range(0, n_nodes, step):
        b = slice(a, a + step)
        ray, confidence = data.pixel_ray[index[b]], data.pixel_weight[index[b]]
        target = data.pixel_target[index[b], None]
        H = data.K_next @ p.subset(b).homographies
        y = np.matmul(H, np.swapaxes(ray, 1, 2)[:, None])
        used = confidence[:, None] > 0
        ahead[b] = (y[:, :, 2] > 1e-9).all(axis=2, where=used)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = y[:, :, 0] / y[:, :, 2] - target[..., 0]
            v = y[:, :, 1] / y[:, :, 2] - target[..., 1]
            error = np.minimum(np.sqrt(u * u + v * v), weights.sigma_proj)
        error = np.where(used, error, 0.0)
        out[b] = weights.proj * np.einsum("nls,ns->nl", error, confidence)
    return out, ahead & np.isfinite(out)


class PairCosts:
    """Pairwise costs over the union of the K-NN and the neighbour graph.

    Attributes:
        edges: (E, 2) union of `data.edges` and `data.pairs`, i < k, each pair once.
        arap_row: (E,) row of `data.edges`, -1 where there is none.
        cont_row: (E,) row of `data.pairs`, -1 where there is none.

    Args:
        data: Graphs and weights of the pair.
        weights: Factors and truncations.
    """

    def __init__(self, data: EnergyData, weights: Weights) -> None:
        self.data, self.weights = data, weights
        n = len(data)
        arap, cont = (e[:, 0] * n + e[:, 1] for e in (data.edges, data.pairs))
        key = np.union1d(arap, cont)
        self.edges = np.stack([key // n, key % n], axis=1).astype(np.int64)
        self.arap_row = _rows(key, arap)
        self.cont_row = _rows(key, cont)

    def tables(
        self, p: Particles, unit: float = 1.0, dtype: type | np.dtype = np.float64
    ) -> AnyFloat:
        """(E, L, L) weighted sum of all terms but E_proj, by edge and pair of labels.

        Args:
            p: (N, L) particles.
            unit: The scene's length unit `sum_i c_i D_i` where lengths are not local.
            dtype: float64, or float32 for half the memory.
        """
        labels = p.shape[1]
        out = np.zeros((len(self.edges), labels, labels), dtype)
        state = _State(p, self.data, dtype)
        step = max(1, BLOCK_BYTES // (out.itemsize * labels * labels))
        buffers = np.empty((4, step, labels, labels), dtype)
        for rows, add in ((self.arap_row, self._arap), (self.cont_row, self._cont)):
            present = np.flatnonzero(rows >= 0)
            for a in range(0, len(present), step):
                at = present[a : a + step]
                out[at] += add(state, rows[at], unit, buffers[:, : len(at)])
        return out

    def _arap(self, s: _State, rows: Int, unit: float, buffers: AnyFloat) -> AnyFloat:
        d, w = self.data, self.weights
        i, k = d.edges[rows].T
        total, near, x, y = buffers
        sigma = w.sigma_arap
        # |R - S|_F of unit quaternions q, r: with s = |q - r|^2 it is sqrt(2 s (4 - s))
        _distance2(s.q[:, i], s.q[:, k], total, x)
        np.subtract(4.0, total, out=x)
        total *= x
        np.maximum(total, 0.0, out=total)
        np.sqrt(total, out=total)
        total *= s.factor(np.sqrt(2.0) * d.rotation_scale[rows])
        _leaky(total, sigma, w.leak_arap)

        _nearness(s, i, k, near)
        length = s.factor(1 / (d.edge_unit[rows] * (1.0 if d.local_units else unit)))
        if d.arap_at_anchors:
            gap = _anchor_gap(s, d.anchor_ray, i, k)
            np.sqrt(np.einsum("cbij,cbij->bij", gap, gap), out=x)
        else:
            _distance2(s.T[:, i], s.T[:, k], x, y)
            np.sqrt(x, out=x)
        x *= length
        if d.local_units:
            x *= near
        total += _leaky(x, sigma, w.leak_arap)

        _distance2(s.Y[:, i], s.Y[:, k], x, y)
        after = np.sqrt(x)
        _distance2(s.X[:, i], s.X[:, k], x, y)
        np.sqrt(x, out=x)
        x -= after
        np.abs(x, out=x)
        x *= length
        if d.local_units:
            x *= near
        total += _leaky(x, sigma, w.leak_arap)
        total *= s.factor(w.arap * d.edge_weight[rows])

        reach = np.linalg.norm(d.anchor_ray[i] - d.anchor_ray[k], axis=1)
        np.subtract(s.inverse[i][:, :, None], s.inverse[k][:, None, :], out=x)
        x /= near
        x -= s.factor(d.prior_relief[rows])
        np.abs(x, out=x)
        x *= s.factor(w.prior * d.prior_weight[rows] / reach)
        total += x
        if d.depth_weight[rows].any():
            nearness = np.log(s.inverse)
            np.subtract(nearness[k][:, None, :], nearness[i][:, :, None], out=x)
            x -= s.factor(d.depth_change[rows])
            np.abs(x, out=x)
            x *= s.factor(w.depth * d.depth_weight[rows])
            total += x
        return total

    def _cont(self, s: _State, rows: Int, unit: float, buffers: AnyFloat) -> AnyFloat:
        d, w = self.data, self.weights
        i, k = d.pairs[rows].T
        total, scale, x, y = buffers
        ray = d.boundary_ray[rows]
        Xi, Yi = s.boundary(i, ray)
        Xk, Yk = s.boundary(k, ray)
        scale[:] = s.factor((d.pair_factor / d.pair_unit)[rows] / (1 if d.local_units else unit))
        if d.local_units:
            scale *= _nearness(s, i, k, x)
        # both points lie on one ray r: their distance is |r| times the difference of their depths
        _distance2(Xi, Xk, total, x)
        np.sqrt(total, out=total)
        total *= scale
        np.minimum(total, w.sigma_cont_ref, out=total)
        _distance2(Yi, Yk, x, y)
        np.sqrt(x, out=x)
        x *= scale
        total += np.minimum(x, w.sigma_cont, out=x)
        total *= s.factor(w.cont * d.pair_weight[rows])
        # 1 - n . n' = |n - n'|^2 / 2 of unit normals
        _distance2(s.n[:, i], s.n[:, k], x, y)
        x *= 0.5
        np.minimum(x, w.sigma_orient, out=x)
        x *= s.factor(w.orient * d.orient_weight[rows])
        total += x
        if d.order_weight[rows].any():
            total += self._order(s, rows, x)
        return total

    def _order(self, s: _State, rows: Int, out: AnyFloat) -> AnyFloat:
        d = self.data
        i, k = d.pairs[rows].T
        ray, sign = d.boundary_ray[rows].mean(axis=1), np.sign(d.order_weight[rows])
        # the inverse depth of the covered side, enlarged by the step
        factors = [
            s.factor(np.where(sign * side > 0, 1 + d.order_step[rows], 1.0)) for side in (1, -1)
        ]
        rho_i, rho_k = (s.inverse_along(nodes, ray).astype(s.dtype) for nodes in (i, k))
        lack = rho_i[:, :, None] * factors[0] - rho_k[:, None, :] * factors[1]
        lack *= s.factor(sign)
        lack /= _nearness(s, i, k, out)
        lack += np.hypot(lack, HINGE)
        lack *= s.factor(0.5 * self.weights.order * np.abs(d.order_weight[rows]))
        return lack


def _leaky(y: AnyFloat, sigma: float, leak: float) -> AnyFloat:
    """`(1 - leak) min(y, sigma) + leak y` in place, as (1 - leak) (min(y, sigma) + c y)."""
    if leak >= 1:
        return y
    tail = y * (leak / (1 - leak))
    np.minimum(y, sigma, out=y)
    y += tail
    y *= 1 - leak
    return y


class _State:
    """Particles with components on the first axis, (c, N, L): a block of edges reads contiguously.

    Arrays that are subtracted for every pair of labels have the type of the tables.
    """

    def __init__(self, p: Particles, data: EnergyData, dtype: type | np.dtype) -> None:
        n_nodes, labels = p.shape
        self.dtype = dtype
        self.Z = anchor_depth(p, data.anchor_ray)
        q = Rotation.from_matrix(p.R.reshape(-1, 3, 3)).as_quat()
        # the sign does not matter to the chord's formula, but its rounding is best for small s
        q = np.where(q[:, 3:] < 0, -q, q)
        X = self.Z[..., None] * data.anchor_ray[:, None]
        Y = np.matmul(p.R, X[..., None])[..., 0] + p.T
        q = q.reshape(n_nodes, labels, 4)
        self.q, self.n, self.T, self.X, self.Y = (_first(v, dtype) for v in (q, p.n, p.T, X, Y))
        self.inverse = (1 / self.Z).astype(dtype)
        self.quarter = (0.5 * self.Z**-4.0).astype(dtype)
        self.plane = _first(np.concatenate([p.n, p.D[..., None]], axis=2), np.float64)
        self.R, self.shift = _first(p.R.reshape(n_nodes, labels, 9), np.float64), p.T

    def factor(self, values: Float) -> AnyFloat:
        """Values of the edges of a block, (b, 1, 1)."""
        return values.astype(self.dtype)[:, None, None]

    def inverse_along(self, nodes: Int, ray: Float) -> Float:
        """(b, L) inverse depths along one ray (b, 3) each."""
        (*n, D) = self.plane[:, nodes]
        return np.asarray(-sum(n[c] * ray[:, c, None] for c in range(3)) / D)

    def boundary(self, nodes: Int, ray: Float) -> tuple[AnyFloat, AnyFloat]:
        """Distances along boundary rays (b, B, 3), and next-frame points.

        Returns:
            (B, b, L) depths times |r|, and (3 B, b, L) points.
        """
        (*n, D), R = self.plane[:, nodes], self.R[:, nodes]
        T = np.moveaxis(self.shift[nodes], 2, 0)
        r = ray.transpose(1, 2, 0)[..., None]
        facing = -(n[0] * r[:, 0] + n[1] * r[:, 1] + n[2] * r[:, 2])
        facing = np.where(np.abs(facing) < 1e-12, 1e-12, facing)
        z = D / facing
        turned = [
            R[3 * c] * r[:, 0] + R[3 * c + 1] * r[:, 1] + R[3 * c + 2] * r[:, 2] for c in (0, 1, 2)
        ]
        points = np.concatenate([z * v + T[c] for c, v in enumerate(turned)])
        depths = z * np.sqrt(np.sum(r * r, axis=1))
        return depths.astype(self.dtype), points.astype(self.dtype)


def _nearness(s: _State, i: Int, k: Int, out: AnyFloat) -> AnyFloat:
    """(b, L, L) power mean, of exponent 4, of the inverse depths of two anchors."""
    np.add(s.quarter[i][:, :, None], s.quarter[k][:, None, :], out=out)
    np.sqrt(out, out=out)
    return np.sqrt(out, out=out)


def _first(values: Float, dtype: type | np.dtype) -> AnyFloat:
    return np.ascontiguousarray(np.moveaxis(values, -1, 0), dtype)


def _rows(key: Int, part: Int) -> Int:
    out = np.full(len(key), -1, np.int64)
    out[np.searchsorted(key, part)] = np.arange(len(part))
    return out


def _distance2(a: AnyFloat, b: AnyFloat, out: AnyFloat, buffer: AnyFloat) -> None:
    """out[e, x, y] = sum_c (a[c, e, x] - b[c, e, y])^2."""
    for c in range(len(a)):
        target = buffer if c else out
        np.subtract(a[c][:, :, None], b[c][:, None, :], out=target)
        np.multiply(target, target, out=target)
        if c:
            out += buffer


def _anchor_gap(s: _State, ray: Float, i: Int, k: Int) -> Float:
    """(3, b, L, L) `(R_i - R_k) (X_i + X_k) / 2 + T_i - T_k`."""

    def turned(nodes: Int, partners: Int) -> Float:
        r = ray[partners].T[..., None]
        R = s.R[:, nodes]
        return np.stack([sum(R[3 * c + j] * r[j] for j in range(3)) for c in range(3)])

    sum_i, sum_k = (s.Y[:, j] + s.T[:, j] for j in (i, k))
    # Y = R X + T, so R_i X_i / 2 + T_i = (Y_i + T_i) / 2
    out = sum_i[..., :, None] - sum_k[..., None, :]
    out += turned(i, k)[..., :, None] * s.Z[k][:, None, :]
    out -= turned(k, i)[..., None, :] * s.Z[i][:, :, None]
    return 0.5 * out
