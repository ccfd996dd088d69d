"""Independent computation of energy, constraints, depth and scores from stored arrays.

Nothing of `soup_nlp.model`, `soup_nlp.solve` or `soup_nlp.evaluate.metrics` is used, so that an
error there cannot confirm itself.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float, Int, Mask

NOISE = (0.05, 0.6)
"""Limits of the flow's noise that E_prior is measured in, pixels."""
DOUBT = 1e-6
"""Distance from a pixel border, in pixels, within which a target may round to either side."""
State = Mapping[str, Float]
"""lam (N,), n (N, 3), d (N,), R (N, 3, 3), t (N, 3) of a soup."""


def lift(s: State, ray: Float, who: Int) -> tuple[Float, Float]:
    """Points in both frames of rays on the planes of superpixels.

    Args:
        s: Soup.
        ray: (M, B, 3) rays.
        who: (M,) superpixel of each row.

    Returns:
        (M, B, 3) reference-frame and next-frame points.
    """
    facing = -(s["n"][who][:, None] * ray).sum(-1)
    X = ((s["lam"] * s["d"])[who][:, None] / facing)[..., None] * ray
    T = (s["lam"][:, None] * s["t"])[who]
    return X, np.matmul(X, np.swapaxes(s["R"][who], 1, 2)) + T[:, None]


def energy(s: State, e: Mapping[str, Any], w: Mapping[str, float]) -> dict[str, float]:
    """Exact E and its weighted terms (paper Eq. 1 to 6 as in docs/formulation.md)."""
    every = np.arange(len(s["lam"]))
    A, B = (x[:, 0] for x in lift(s, e["anchor_ray"][:, None], every))
    T = s["lam"][:, None] * s["t"]
    scene = float((e["share"] * s["lam"] * s["d"]).sum())

    def unit(pairs: Int) -> Float:
        if bool(e["local_units"]):
            return np.asarray((1 / A[pairs, 2] ** 4).mean(axis=1) ** -0.25)
        return np.full(len(pairs), scene)

    arap = cont = orient = prior = 0.0
    if len(e["edges"]):
        i, k = e["edges"].T
        length = unit(e["edges"]) * e["edge_unit"]
        dR = s["R"][i] - s["R"][k]
        shift = T[i] - T[k]
        if bool(e["arap_at_anchors"]):
            shift = shift + np.einsum("eij,ej->ei", dR, (A[i] + A[k]) / 2)
        stretch = _length(A[i] - A[k]) - _length(B[i] - B[k])
        parts = (
            e["rotation_scale"] * np.sqrt((dR**2).sum((1, 2))),
            _length(shift) / length,
            np.abs(stretch) / length,
        )
        leak = w["leak_arap"]
        cut = sum((1 - leak) * np.minimum(p, w["sigma_arap"]) + leak * p for p in parts)
        arap = float((e["edge_weight"] * cut).sum())
        apart = _length(e["anchor_ray"][i] - e["anchor_ray"][k])
        rho = 1 / A[:, 2]
        change = (rho[i] - rho[k]) / ((rho[i] ** 4 + rho[k] ** 4) / 2) ** 0.25
        # older results have no relief that is free
        change = np.abs(change - e.get("prior_relief", 0.0))
        prior = float((e["prior_weight"] * change / apart).sum())

    image = lift(s, e["pixel_ray"], every)[1] @ e["K_next"].T
    miss = _length(image[..., :2] / image[..., 2:] - e["pixel_target"])
    proj = float((e["pixel_weight"] * np.minimum(miss, w["sigma_proj"])).sum())

    if len(e["pairs"]):
        i, k = e["pairs"].T
        Xi, Yi = lift(s, e["boundary_ray"], i)
        Xk, Yk = lift(s, e["boundary_ray"], k)
        factor = e["pair_factor"] / (unit(e["pairs"]) * e["pair_unit"])
        before = factor * np.sqrt(((Xi - Xk) ** 2).sum((1, 2)))
        after = factor * np.sqrt(((Yi - Yk) ** 2).sum((1, 2)))
        gap = np.minimum(before, w["sigma_cont_ref"]) + np.minimum(after, w["sigma_cont"])
        cont = float((e["pair_weight"] * gap).sum())
        turn = np.abs(1 - (s["n"][i] * s["n"][k]).sum(1))
        orient = float((e["orient_weight"] * np.minimum(turn, w["sigma_orient"])).sum())
    terms = {"arap": arap, "proj": proj, "cont": cont, "orient": orient, "prior": prior}
    terms = {name: w[name] * value for name, value in terms.items()}
    return {"total": sum(terms.values()), **terms}


def _length(v: Float) -> Float:
    return np.asarray(np.sqrt((v**2).sum(-1)))


def constraints(s: State, rim_ray: Float, min_facing: float) -> dict[str, Float]:
    """Violation of every kind of constraint, by superpixel (simplex: one number).

    Args:
        s: Soup.
        rim_ray: (N, V, 3) rays where visibility is imposed.
        min_facing: c of `-n . r >= c`.
    """
    n = len(s["lam"])
    gram = np.einsum("nji,njk->nik", s["R"], s["R"]) - np.eye(3)
    facing = -(s["n"][:, None] * rim_ray).sum(-1)
    return {
        "so3": np.abs(gram).reshape(n, -1).max(1),
        "normal": np.abs((s["n"] ** 2).sum(1) - 1),
        "simplex": np.abs(s["lam"].sum(keepdims=True) - 1),
        "positive": np.maximum(0.0, -np.minimum(s["lam"], s["d"])),
        "det": np.abs(np.linalg.det(s["R"]) - 1),
        "visible": np.maximum(0.0, (min_facing - facing).max(1)),
    }


def depth_map(s: State, labels: Int, K: Float) -> Float:
    """(H, W) z of the reference frame; NaN where a plane does not face its pixel."""
    v, u = np.mgrid[0 : labels.shape[0], 0 : labels.shape[1]]
    ray = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T
    facing = -(s["n"][labels] * ray).sum(-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        z = (s["lam"] * s["d"])[labels] / facing
    return np.where(facing > 1e-6, z, np.nan)


def next_depth_map(
    s: State, labels: Int, K_ref: Float, K_next: Float, size: tuple[int, int]
) -> tuple[Float, Mask]:
    """Depth of the next frame, and where rounding decides it.

    Every reference pixel is moved to the pixel nearest to its target, and the nearest surface is
    kept; pixels that stay empty take the nearest surface of the 2 x 2 footprints that cover them.

    Args:
        s: Soup.
        labels: (H, W) superpixel of every pixel.
        K_ref: (3, 3) intrinsics of the reference frame.
        K_next: (3, 3) intrinsics of the next frame.
        size: (H', W') of the next frame.

    Returns:
        (H', W') z, NaN where there is no target; (H', W') True where a target lies so near to a
        border between two pixels that either may receive it.
    """
    z = depth_map(s, labels, K_ref).ravel()
    v, u = (x.ravel() for x in np.mgrid[0 : labels.shape[0], 0 : labels.shape[1]])
    who = labels.ravel()
    X = z[:, None] * (np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K_ref).T)
    Y = np.matmul(s["R"][who], X[..., None])[..., 0] + (s["lam"][:, None] * s["t"])[who]
    Y = Y[Y[:, 2] > 0]
    # farthest first, so that the nearest one is written last
    Y = Y[np.argsort(-Y[:, 2], kind="stable")]
    image = Y @ K_next.T
    at = image[:, :2] / image[:, 2:]

    def inside(column: Float, row: Float) -> Mask:
        return np.asarray((column >= 0) & (row >= 0) & (column < size[1]) & (row < size[0]))

    def put(out: NDArray[Any], uv: Float, value: Any) -> None:
        good = inside(uv[:, 0], uv[:, 1])
        out[uv[good, 1].astype(int), uv[good, 0].astype(int)] = value[good]

    nearest = np.full(size, np.nan)
    put(nearest, np.floor(at + 0.5), Y[:, 2])
    covered = np.full((4, *size), np.nan)
    for k, corner in enumerate([(0, 0), (1, 0), (0, 1), (1, 1)]):
        put(covered[k], np.floor(at) + corner, Y[:, 2])
    empty = np.isnan(nearest)
    filled = np.where(empty, np.fmin.reduce(covered), nearest)

    either, crack = np.zeros(size, bool), np.zeros(size, bool)
    beside = [(a, b) for a in (-1, 0, 1) for b in (-1, 0, 1)]
    for mark, shift in ((either, 0.5), (crack, 0.0)):
        off = at + shift
        near = (np.abs(off - np.round(off)) < DOUBT).any(1)
        for step in beside:
            put(mark, np.floor(at[near] + 0.5) + step, np.ones(int(near.sum()), bool))
    return filled, either | (crack & empty)


def scores(z: Float, gt: Float, rule: str, cap: float | None) -> dict[str, float]:
    """Depth errors after one global scale, by their names in summary.json.

    Args:
        z: Estimated depth, NaN where unknown.
        gt: True depth of the same shape, NaN where unknown.
        rule: "median", "mre", "lsq" or "none".
        cap: Truth beyond this depth is left out.
    """
    true = np.isfinite(gt) & (gt > 0) & (gt <= (np.inf if cap is None else cap))
    both = true & np.isfinite(z) & (z > 0)
    z, gt = z[both], gt[both]
    if not len(z):
        return {"coverage": 0.0, "n_pixels": 0.0}
    ratio = gt / z
    if rule == "median":
        factor = float(np.median(ratio))
    elif rule == "mre":
        order = np.argsort(ratio)
        mass = np.cumsum(1.0 / ratio[order])
        factor = float(ratio[order][np.searchsorted(mass, 0.5 * mass[-1])])
    else:
        factor = float((z * gt).sum() / (z * z).sum()) if rule == "lsq" else 1.0
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


def data_errors(tree: Mapping[str, Any], settings: Mapping[str, Any]) -> dict[str, float]:
    """Differences of the energy's stored data from labels, flow, cameras and the start.

    Returns:
        Largest absolute difference by name; 0 is agreement.
    """
    e, seg, given = tree["energy"], tree["segmentation"], tree["input"]
    labels, inverse = seg["labels"], np.linalg.inv(given["K_ref"])
    flat, n = labels.ravel(), len(seg["anchors"])
    count = np.bincount(flat, minlength=n)
    v, u = (x.ravel() for x in np.mgrid[0 : labels.shape[0], 0 : labels.shape[1]])
    centre = np.stack([np.bincount(flat, x, n) / count for x in (u, v)], 1)

    def rays(uv: Float) -> Float:
        return np.asarray(np.concatenate([uv, np.ones((*uv.shape[:-1], 1))], -1) @ inverse.T)

    rim = np.concatenate([seg["anchors"][:, None], seg["rim"]], 1)
    pixel = e["pixel_ray"] @ given["K_ref"].T
    at = np.floor(pixel[..., :2] + 0.5).astype(int)
    used = e["pixel_weight"] > 0
    column, row = at[used].T
    owner = np.nonzero(used)[0]
    target = at[used] + given["flow"].astype(float)[row, column]
    i, k = e["edges"].T
    gap = np.sqrt(((centre[i] - centre[k]) ** 2).sum(1))
    own, near = np.repeat(np.arange(n), seg["knn"].shape[1]), seg["knn"].ravel()
    directed = np.unique(np.minimum(own, near) * n + np.maximum(own, near))
    component = tree["start"]["component"]
    weight = seg["edge_multiplicity"] * np.exp(-float(settings["segmentation"]["beta"]) * gap)
    across = np.where(component[i] == component[k], 1.0, float(settings["energy"]["arap_across"]))
    weight *= across
    bending = settings["energy"]["bending"]
    weight[_discontinuous(tree, settings["energy"], "edges")] *= float(bending["arap_across"])
    bends = bends_where(tree, {"units": "pixel"})
    if bends.all():
        # that of affine flows, which is not recomputed; older results held the prior in pixels
        noise = float(tree["start"].get("noise", 1.0))
    else:
        noise = float(np.clip(np.median(tree["start"]["error"][~bends]), *NOISE))
    prior = noise * across * seg["edge_multiplicity"] / max(1, seg["knn"].shape[1])
    free = _grounded(tree, settings)
    prior[free] = noise * (seg["edge_multiplicity"] / max(1, seg["knn"].shape[1]))[free]
    prior[free] *= float(settings["energy"].get("prior_ground") or 0.0)
    weight *= _within_bending(tree, settings["energy"], "edges", "arap")
    prior *= _within_bending(tree, settings["energy"], "edges", "prior")
    held = np.full(len(e["pairs"]), 2.0)
    held[_discontinuous(tree, settings["energy"], "pairs")] *= float(bending["orient_across"])
    held *= _within_bending(tree, settings["energy"], "pairs", "orient")
    return {
        "anchors": _gap(centre, seg["anchors"]),
        "anchor rays": _gap(rays(centre), e["anchor_ray"]),
        "rim rays": _gap(rays(rim), e["rim_ray"]),
        "boundary rays": _gap(rays(seg["boundary"]), e["boundary_ray"]),
        "pixels in superpixels": float((labels[row, column] != owner).sum()),
        "pixel targets": _gap(target, e["pixel_target"][used]),
        "K-NN edges": float(len(np.setxor1d(directed, i * n + k))),
        "edge weights": _gap(weight, e["edge_weight"]),
        "prior weights": _gap(prior, e["prior_weight"]),
        "prior relief": _gap(_relief(tree, free), e.get("prior_relief", np.zeros(len(i)))),
        "pair counts": _gap(held, e["orient_weight"]),
        "pair weights": _gap(_pair_weights(tree, settings["energy"]), e["pair_weight"]),
    }


def _pair_weights(tree: Mapping[str, Any], form: Mapping[str, Any]) -> Float:
    """w4 of the image, reduced where a component occludes another and at flow discontinuities."""
    start, seg = tree["start"], tree["segmentation"]
    weight = seg["pair_weight"].copy()
    middle = tree["energy"]["boundary_ray"].mean(1)
    i, k = tree["energy"]["pairs"].T
    facing = [np.maximum(-(start["n"][who] * middle).sum(1), 1e-3) for who in (i, k)]
    z = np.stack([(start["lam"] * start["d"])[who] / f for who, f in zip((i, k), facing)])
    open_gap = z.min(0) < (1 - float(form["occlusion_gap"])) * z.max(0)
    weight[open_gap & (start["component"][i] != start["component"][k])] *= float(
        form["cont_occluded"]
    )
    weight[_discontinuous(tree, form, "pairs")] *= float(form["bending"]["cont_across"])
    return np.asarray(weight * _within_bending(tree, form, "pairs", "cont"))


def _grounded(tree: Mapping[str, Any], settings: Mapping[str, Any]) -> Mask:
    """K-NN edges along which E_prior holds the relief of the initialisation."""
    ends = tree["energy"]["edges"]
    if settings["energy"].get("prior_ground") is None:
        return np.zeros(len(ends), bool)
    one, other = tree["start"]["grounded"].astype(bool)[ends.T]
    return np.asarray(one & other)


def _relief(tree: Mapping[str, Any], free: Mask) -> Float:
    """(E,) relative difference of inverse depth that the initialisation has along these edges."""
    start = tree["start"]
    rho = -(start["n"] * tree["energy"]["anchor_ray"]).sum(1) / (start["lam"] * start["d"])
    a, b = rho[tree["energy"]["edges"].T]
    return np.where(free, (a - b) / np.sqrt(np.sqrt((a**4 + b**4) / 2)), 0.0)


def _discontinuous(tree: Mapping[str, Any], form: Mapping[str, Any], graph: str) -> Mask:
    """Edges of a graph between two surfaces, if the whole image bends."""
    surface = tree["start"]["surface"]
    i, k = tree["energy"][graph].T
    return np.asarray(bends_where(tree, form).all() & (surface[i] != surface[k]))


def bends_where(tree: Mapping[str, Any], form: Mapping[str, Any]) -> Mask:
    """(N,) where the energy of bending surfaces is in force; older results have one answer."""
    start = tree["start"]
    bends = start.get("bends", np.full(len(start["component"]), bool(start.get("bending", False))))
    return np.asarray(bends, bool) & (form["units"] == "pixel")


def _within_bending(
    tree: Mapping[str, Any], form: Mapping[str, Any], graph: str, term: str
) -> Float:
    """Ratio of the factors of a term between bending and rigid regions, on edges of a graph."""
    bends = bends_where(tree, form)
    own, bent = (float(w[term]) for w in (form["weights"], form["bending"]["weights"]))
    if bends.all() or not own:
        return np.ones(len(tree["energy"][graph]))
    if term == "orient":
        bent *= len(bends) / 1000
    one, other = bends[tree["energy"][graph].T]
    return np.where(one & other, bent / own, 1.0)


def _gap(a: Float, b: Float) -> float:
    return float(np.abs(a - b).max(initial=0.0))
