"""Independent computation of energy, depth and scores from stored arrays.

Nothing of `soup_nlp.model`, `soup_nlp.solve` or `soup_nlp.evaluation.metrics` is used, so that an
error there cannot confirm itself.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.linalg import norm

from soup_nlp.arrays import Float, Int, Mask

State = Mapping[str, Float]
"""lam (N,), n (N, 3), d (N,), R (N, 3, 3), t (N, 3) of a soup."""


def lift(s: State, ray: Float, superpixel: Int) -> tuple[Float, Float]:
    """Points (M, B, 3) in both frames of rays (M, B, 3), each row on the plane of one of the
    superpixels (M,)."""
    facing = -(s["n"][superpixel][:, None] * ray).sum(-1)
    X = ((s["lam"] * s["d"])[superpixel][:, None] / facing)[..., None] * ray
    T = (s["lam"][:, None] * s["t"])[superpixel]
    return X, np.matmul(X, np.swapaxes(s["R"][superpixel], 1, 2)) + T[:, None]


def energy(s: State, e: Mapping[str, Any], w: Mapping[str, float]) -> dict[str, float]:
    """Exact E and its weighted terms (paper Eq. 1 to 6 as in docs/formulation.md).

    A term whose factor or data are not stored is absent, as in results from before it existed.
    """
    A, B = (x[:, 0] for x in lift(s, e["anchor_ray"][:, None], np.arange(len(s["lam"]))))
    T = s["lam"][:, None] * s["t"]
    rho = 1 / A[:, 2]
    (i, k), (a, b) = e["edges"].T, e["pairs"].T

    def near(pairs: Int) -> Float:
        """Power mean of the inverse depths of two anchors."""
        return np.asarray((rho[pairs] ** 4).mean(axis=1) ** 0.25)

    def unit(pairs: Int) -> Float:
        scene = (e["share"] * s["lam"] * s["d"]).sum()
        return 1 / near(pairs) if bool(e["local_units"]) else np.full(len(pairs), scene)

    def arap() -> Float:
        length = unit(e["edges"]) * e["edge_unit"]
        dR, shift = s["R"][i] - s["R"][k], T[i] - T[k]
        if bool(e["arap_at_anchors"]):
            shift = shift + np.einsum("eij,ej->ei", dR, (A[i] + A[k]) / 2)
        stretch = norm(A[i] - A[k], axis=-1) - norm(B[i] - B[k], axis=-1)
        parts = (
            e["rotation_scale"] * norm(dR, axis=(1, 2)),
            norm(shift, axis=-1) / length,
            np.abs(stretch) / length,
        )
        leak = w["leak_arap"]
        cut = [(1 - leak) * np.minimum(p, w["sigma_arap"]) + leak * p for p in parts]
        return np.sum(cut, axis=0)

    def proj() -> Float:
        image = lift(s, e["pixel_ray"], np.arange(len(A)))[1] @ e["K_next"].T
        miss = norm(image[..., :2] / image[..., 2:] - e["pixel_target"], axis=-1)
        return np.minimum(miss, w["sigma_proj"])

    def cont() -> Float:
        gaps = [p - q for p, q in zip(lift(s, e["boundary_ray"], a), lift(s, e["boundary_ray"], b))]
        factor = e["pair_factor"] / (unit(e["pairs"]) * e["pair_unit"])
        before, after = (factor * norm(gap, axis=(1, 2)) for gap in gaps)
        return np.minimum(before, w["sigma_cont_ref"]) + np.minimum(after, w["sigma_cont"])

    def orient() -> Float:
        change = s["n"][a] - s["n"][b] - e.get("orient_turn", 0.0)
        return np.minimum((change**2).sum(1) / 2, w["sigma_orient"])

    def prior() -> Float:
        reach = norm(e["anchor_ray"][i] - e["anchor_ray"][k], axis=-1)
        return np.abs((rho[i] - rho[k]) / near(e["edges"]) - e.get("prior_relief", 0.0)) / reach

    def depth() -> Float:
        return np.abs(np.log(A[i, 2]) - np.log(A[k, 2]) - e["depth_change"])

    def order() -> Float:
        # along the mean ray, whose length does not matter
        middle = e["boundary_ray"].sum(axis=1, keepdims=True)
        rhos = [1 / lift(s, middle, superpixel)[0][:, 0, 2] for superpixel in (a, b)]
        behind, front = np.where(e["order_weight"] > 0, rhos, rhos[::-1])
        lack = ((1 + e["order_step"]) * behind - front) / near(e["pairs"])
        return np.asarray((lack + np.sqrt(lack**2 + 0.01**2)) / 2)

    terms = {
        cost.__name__: w[cost.__name__] * float((np.abs(e[weight]) * cost()).sum())
        for cost, weight, always in (
            (arap, "edge_weight", True),
            (proj, "pixel_weight", True),
            (cont, "pair_weight", True),
            (orient, "orient_weight", True),
            (prior, "prior_weight", True),
            (depth, "depth_weight", False),
            (order, "order_weight", False),
        )
        if cost.__name__ in w and weight in e and (always or e[weight].any())
    }
    return {"total": sum(terms.values()), **terms}


def depth_map(s: State, labels: Int, K: Float) -> Float:
    """(H, W) z of the reference frame; NaN where a plane does not face its pixel."""
    v, u = np.mgrid[0 : labels.shape[0], 0 : labels.shape[1]]
    ray = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T
    facing = -(s["n"][labels] * ray).sum(-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        z = (s["lam"] * s["d"])[labels] / facing
    return np.where(facing > 1e-6, z, np.nan)


def detail(s: State, labels: Int, given: Mapping[str, Any], used: Mask) -> Float:
    """(H, W) log depth relative to the planes of a soup by the flow of the pixels, equation 30.

    Flow, its confidence and intrinsics are `given` as stored under "input"; the superpixels with
    detail are `used` (N,).
    """
    v, u = np.mgrid[0 : labels.shape[0], 0 : labels.shape[1]]
    pixel = np.stack([u, v, np.ones_like(u)], -1)
    z, step, c = depth_map(s, labels, given["K_ref"]), 1e-30, given["confidence"].astype(float)
    X = np.einsum("hwij,hwj->hwi", s["R"][labels], pixel @ np.linalg.inv(given["K_ref"]).T)
    with np.errstate(divide="ignore", invalid="ignore"):
        # a complex step: the imaginary part is the derivative by the relative inverse depth
        X = X * (z / (1 + 1j * step))[..., None] + (s["lam"][:, None] * s["t"])[labels]
        image = X @ given["K_next"].T
        image = image[..., :2] / image[..., 2:]
        e, g = pixel[..., :2] + given["flow"] - image.real, image.imag / step
        change = (e * g).sum(-1) / (g**2).sum(-1)
        off = norm(e - change[..., None] * g, axis=-1)
        known = used[labels] & (c > 0) & (change >= -0.5) & (change <= 1)
    of, c, count, change = labels[known], c[known], len(used), change[known]
    mean = np.maximum(np.bincount(of, c, count), 1e-300)
    both, error = (
        (np.bincount(of, c * x**2, count) / mean)[of]
        for x in (change * norm(g[known], axis=-1), off[known])
    )
    share = 1 - (error - np.log(c) / 2) / np.maximum(both, 1e-300)
    out = np.zeros(labels.shape)
    out[known] = -np.log(1 + c * np.maximum(share, 0) * change)
    return out


def shrinkage(
    s: State, e: Mapping[str, Any], seg: Mapping[str, Any], labels: Int, sigma: Float, drawn: Mask
) -> Float:
    """(H, W) change of the log depth of drawn superpixels, equation 31, by its normal equations.

    Data of the energy and the segmentation are as stored; sigma (N,) is that of log depth, and
    `drawn` (H, W) True where nothing tells the depth.
    """
    every, (a, b) = np.arange(len(s["lam"])), e["pairs"].T
    if not len(a):
        return np.zeros(labels.shape)
    share, variance = np.array([drawn[labels == k].mean() for k in every]), sigma**2
    anchor = lift(s, e["anchor_ray"][:, None], every)[0][:, 0, 2]
    ray = e["boundary_ray"].mean(axis=1, keepdims=True)
    first, second = (lift(s, ray, k)[0][:, 0, 2] for k in (a, b))
    step = np.log(anchor[b] * second / (anchor[a] * first)) / 2
    w = seg["boundary_length"] * (seg["pair_weight"] / seg["pair_weight"].max()) ** 3
    w = w / w.mean() / 0.3**2 * np.exp(-(step**2) / (variance[a] + variance[b]) / 2)
    w = np.where(e.get("order_weight", 0) == 0, w, 0)
    A, rhs = np.diag(1 / variance), np.zeros(len(every))
    for at, other, sign in ((a, b, 1), (b, a, -1)):
        np.add.at(A, (at, at), w)
        np.add.at(A, (at, other), -w)
        np.add.at(rhs, at, sign * w * step)
    free, x = share > 0.5, np.zeros(len(every))
    x[free] = np.linalg.solve(A[np.ix_(free, free)], rhs[free])
    return np.asarray(x[labels])


def ground(s: State, labels: Int, K: Float, p: Float, sigma: Float, beside: Float) -> Float:
    """(H, W) log depth relative to the planes of a soup: `beside` (H, W), lifted to a ground p (3,)
    the farther the larger its standard deviation sigma (H, W) is, equation 32."""
    v, u = np.mgrid[0 : labels.shape[0], 0 : labels.shape[1]]
    inverse = np.linalg.solve(K.T, p) @ np.stack([u, v, np.ones_like(u)]).reshape(3, -1)
    ratio = inverse.reshape(labels.shape) * depth_map(s, labels, K) * np.exp(beside)
    lifted = beside - np.log(np.where(ratio > 1, ratio, 1.0)) / (1 + (0.05 / sigma) ** 2)
    return np.asarray(lifted)


def scores(z: Float, gt: Float, rule: str, cap: float | None) -> dict[str, float]:
    """Errors of a depth z to the truth gt, both NaN where unknown, by their names in summary.json.

    The one global scale follows from the rule: "median", "mre", "lsq" or "none".
    """
    true = np.isfinite(gt) & (gt > 0) & (gt <= (np.inf if cap is None else cap))
    compared = true & np.isfinite(z) & (z > 0)
    z, gt = z[compared], gt[compared]
    if not len(z):
        return {"coverage": 0.0, "n_pixels": 0.0}
    ratio, factor = gt / z, 1.0
    if rule == "median":
        factor = float(np.median(ratio))
    elif rule == "mre":
        # the weighted median of the ratios
        order = np.argsort(ratio)
        mass = np.cumsum(1.0 / ratio[order])
        factor = float(ratio[order][np.searchsorted(mass, 0.5 * mass[-1])])
    elif rule == "lsq":
        factor = float((z * gt).sum() / (z * z).sum())
    off = np.abs(gt - factor * z)
    fold = np.maximum(gt / (factor * z), factor * z / gt)
    return {
        "mre": float((off / gt).mean()),
        "median_relative": float(np.median(off / gt)),
        "sq_rel": float((off**2 / gt).mean()),
        "rmse": float(np.sqrt((off**2).mean())),
        "log_rmse": float(np.sqrt((np.log(fold) ** 2).mean())),
        **{f"delta{k}": float((fold < 1.25**k).mean()) for k in (1, 2, 3)},
        "scale": factor,
        "coverage": len(z) / int(true.sum()),
        "n_pixels": float(len(z)),
    }


def at_points(z: Float, points: Float) -> tuple[Float, Float]:
    """Depth at the pixels nearest to sparse points (u, v, z): (estimate, truth)."""
    u, v = (np.floor(points[:, c] + 0.5) for c in (0, 1))
    inside = (u >= 0) & (v >= 0) & (u < z.shape[1]) & (v < z.shape[0])
    out = np.full(len(points), np.nan)
    out[inside] = z[v[inside].astype(int), u[inside].astype(int)]
    return out, points[:, 2]
