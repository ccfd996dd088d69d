"""Recomputation of the energy's stored data: pixels, graphs and weights, from labels and start.

Like `recompute` it shares nothing with the code that made these data.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from soup_nlp.arrays import Float, Mask

NOISE = (0.05, 0.6)
"""Limits of the flow's noise that E_prior is measured in, pixels."""


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
