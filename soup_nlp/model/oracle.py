"""The exact energy in plain NumPy, for reports and as reference of the symbolic model.

It shares nothing with the symbolic model. Every function follows its equation of the paper; lengths
are measured in the depth of their anchors or with sum_i c_i D_i = 1: either makes E independent
of the free global scale.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from soup_nlp.arrays import Float, Int
from soup_nlp.geometry.soup import Soup
from soup_nlp.model.energy_data import HINGE, EnergyData
from soup_nlp.model.energy_options import Weights


def energy(soup: Soup, data: EnergyData, weights: Weights) -> dict[str, float]:
    """E and its weighted terms.

    Args:
        soup: State; only its geometry matters, not its gauge nor its global scale.
        data: Pixels, graphs and weights of the pair.
        weights: alpha1 to alpha4 and the truncations.

    Returns:
        "total" and every one of `data.terms`, which include their factors.
    """
    terms = {
        name: getattr(weights, name) * float(ENERGIES[name](soup, data, weights).sum())
        for name in data.terms
    }
    return {"total": sum(terms.values()), **terms}


def _unit(soup: Soup, data: EnergyData, pairs: Int) -> Float | float:
    """Length unit: a mean of the depths of two anchors near the smaller, or the scene's own."""
    if data.local_units:
        Z = soup.depth_at(data.anchor_ray)
        return np.mean(Z[pairs] ** -4.0, axis=1) ** -0.25
    return float(np.sum(data.share * soup.distance))


def arap(soup: Soup, data: EnergyData, weights: Weights) -> Float:
    """(E,) E_arap of every edge, Eq. 1; an edge carries both its directions."""
    i, k = data.edges.T
    unit = _unit(soup, data, data.edges) * data.edge_unit
    sigma, leak = weights.sigma_arap, weights.leak_arap
    X = soup.points(data.anchor_ray)
    moved = soup.moved(X)
    turn = (soup.R[i] - soup.R[k]).reshape(-1, 9)
    rotation = data.rotation_scale * np.linalg.norm(turn, axis=1)
    if data.arap_at_anchors:
        # how far the two motions carry the anchors apart, mean of both anchors
        a = np.einsum("eij,ej->ei", soup.R[i] - soup.R[k], 0.5 * (X[i] + X[k]))
        translation = np.linalg.norm(a + soup.translation[i] - soup.translation[k], axis=1)
    else:
        translation = np.linalg.norm(soup.translation[i] - soup.translation[k], axis=1)
    before = np.linalg.norm(X[i] - X[k], axis=1)
    after = np.linalg.norm(moved[i] - moved[k], axis=1)
    length = np.abs(before - after)
    return data.edge_weight * (
        _leaky(rotation, sigma, leak)
        + _leaky(translation / unit, sigma, leak)
        + _leaky(length / unit, sigma, leak)
    )


def _leaky(y: Float, sigma: float, leak: float) -> Float:
    """`(1 - leak) min(y, sigma) + leak y`."""
    return (1 - leak) * np.minimum(y, sigma) + leak * y


def reprojection(soup: Soup, data: EnergyData, weights: Weights) -> Float:
    """(N,) E_proj of every superpixel, Eq. 3: mean distance in pixels of flow and homography."""
    H = soup.R - soup.t[:, :, None] * soup.n[:, None, :] / soup.d[:, None, None]
    y = np.einsum("nij,nsj->nsi", data.K_next @ H, data.pixel_ray)
    error = np.linalg.norm(y[..., :2] / y[..., 2:] - data.pixel_target, axis=-1)
    return np.sum(data.pixel_weight * np.minimum(error, weights.sigma_proj), axis=1)


def continuity(soup: Soup, data: EnergyData, weights: Weights) -> Float:
    """(P,) E_cont of every neighbour pair, Eq. 4: gaps of the shared boundary in both frames."""
    if not len(data.pairs):
        return np.zeros(0)
    i, k = data.pairs.T
    unit = _unit(soup, data, data.pairs) * data.pair_unit
    facing_i = -np.einsum("pc,pbc->pb", soup.n[i], data.boundary_ray)
    facing_k = -np.einsum("pc,pbc->pb", soup.n[k], data.boundary_ray)
    Xi = (soup.distance[i][:, None] / facing_i)[..., None] * data.boundary_ray
    Xk = (soup.distance[k][:, None] / facing_k)[..., None] * data.boundary_ray
    Yi = np.einsum("pij,pbj->pbi", soup.R[i], Xi) + soup.translation[i][:, None]
    Yk = np.einsum("pij,pbj->pbi", soup.R[k], Xk) + soup.translation[k][:, None]
    scale = data.pair_factor / unit
    before = scale * np.sqrt(np.sum((Xi - Xk) ** 2, axis=(1, 2)))
    after = scale * np.sqrt(np.sum((Yi - Yk) ** 2, axis=(1, 2)))
    return data.pair_weight * (
        np.minimum(before, weights.sigma_cont_ref) + np.minimum(after, weights.sigma_cont)
    )


def orientation(soup: Soup, data: EnergyData, weights: Weights) -> Float:
    """(P,) E_orient of every neighbour pair: `rho_n(1 - n_i . n_k)`, both directions."""
    if not len(data.pairs):
        return np.zeros(0)
    i, k = data.pairs.T
    turn = np.abs(1.0 - np.einsum("pc,pc->p", soup.n[i], soup.n[k]))
    return data.orient_weight * np.minimum(turn, weights.sigma_orient)


def prior(soup: Soup, data: EnergyData, weights: Weights | None = None) -> Float:
    """(E,) E_prior of every edge: slope of the inverse depth between its anchors, relative to it.

    `|(1 / Z_i - 1 / Z_k) / m - relief| / |r_i - r_k|` with anchor rays r and m the mean of both
    inverse depths that is near the larger.
    """
    (i, k), ray = data.edges.T, data.anchor_ray
    change = np.abs(relief(soup, data) - data.prior_relief)
    return data.prior_weight * change / np.linalg.norm(ray[i] - ray[k], axis=1)


def relief(soup: Soup, data: EnergyData) -> Float:
    """(E,) difference of the inverse depths of an edge's anchors, relative to the nearer one."""
    inverse = 1 / soup.depth_at(data.anchor_ray)[data.edges]
    return (inverse[:, 0] - inverse[:, 1]) / np.mean(inverse**4, axis=1) ** 0.25


def depth(soup: Soup, data: EnergyData, weights: Weights | None = None) -> Float:
    """(E,) E_depth of every edge: `|log(Z_i / Z_k) - change|` of the depths Z of its anchors."""
    Zi, Zk = soup.depth_at(data.anchor_ray)[data.edges.T]
    return data.depth_weight * np.abs(np.log(Zi / Zk) - data.depth_change)


def order(soup: Soup, data: EnergyData, weights: Weights | None = None) -> Float:
    """(P,) E_order of every neighbour pair: smooth hinge of the inverse depth that the covering
    superpixel f lacks on the boundary before the covered one b.

    `(x + sqrt(x^2 + HINGE^2)) / 2` with `x = ((1 + step) / Z_b - 1 / Z_f) / m` and m the mean of
    both anchors' inverse depths that is near the larger.
    """
    z = soup.depth_across(data.pairs, data.boundary_ray.mean(axis=1))
    behind, front = np.where(data.order_weight > 0, 1 / z, 1 / z[::-1])
    near = np.mean(soup.depth_at(data.anchor_ray)[data.pairs] ** -4.0, axis=1) ** 0.25
    lack = ((1 + data.order_step) * behind - front) / near
    return np.abs(data.order_weight) * (lack + np.hypot(lack, HINGE)) / 2


ENERGIES: Mapping[str, Callable[[Soup, EnergyData, Weights], Float]] = {
    "arap": arap,
    "proj": reprojection,
    "cont": continuity,
    "orient": orientation,
    "prior": prior,
    "depth": depth,
    "order": order,
}
"""Values of every term of `energy_data.TERMS`, without their factors."""
