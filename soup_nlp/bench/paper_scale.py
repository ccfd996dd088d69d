"""Does E_arap determine the relative scale of a moving component? Energies over that scale.

Planes and motions are the true ones. The scale of one moving component is varied about its true
value. E_proj and E_orient do not depend on it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from scipy import ndimage

from soup_nlp.arrays import Mask
from soup_nlp.bench.paper_measures import loaded
from soup_nlp.bench.suite_pairs import Item
from soup_nlp.bench.truth import TrueSoup, moves_by_itself, true_soup
from soup_nlp.config.problem import make_problem
from soup_nlp.data.pair import Pair, Truth
from soup_nlp.errors import DataError
from soup_nlp.geometry.camera import pixel_grid, rays
from soup_nlp.geometry.graph import Segmentation, build_segmentation
from soup_nlp.model import oracle
from soup_nlp.model.energy_data import EnergyData, build_energy_data
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.reweighting import across_components, at_occlusions, in_length, in_pixels
from soup_nlp.pipeline.case import superpixels
from soup_nlp.start.epipolar import motion_of_points
from soup_nlp.storage.rows import Row

SCALES = np.geomspace(0.25, 4.0, 49)
"""Factors of the true scale; the middle one is 1."""
MIN_SUPERPIXELS = 4
"""Components with fewer superpixels are left out."""
MIN_POINTS = 30
"""The motion of a component with fewer true points is not estimated."""
KINDS = ("arap", "arap px", "cont", "paper", "defaults")
"""E_arap as printed, E_arap in pixels, E_cont as printed, E of `preset: paper`, E by default."""


def measure_scale(item: Item, overrides: tuple[str, ...] = (), variant: str = "") -> Row:
    """Energies over the scale of every moving component of a pair.

    Raises:
        DataError: the pair has no dense depth, no components, or none that is large enough.
    """
    problem = item.problem(overrides)
    pair, _ = loaded(problem)
    assert pair.flow is not None
    pair = with_motions(pair)
    s = problem.segmentation
    seg = build_segmentation(superpixels(problem, pair), pair.image_ref, s.neighbours, s.beta)
    true = true_soup(pair, seg)
    assert pair.truth is not None
    moving = moves_by_itself(pair.truth)[true.component] & (true.component > 0)
    energies = _energies(pair, seg, true, problem.seed)
    bodies = []
    for c in np.unique(true.component[moving]):
        own = moving & (true.component == c)
        if own.sum() >= MIN_SUPERPIXELS:
            bodies.append({"superpixels": int(own.sum()), "curves": curves(true, own, energies)})
    if not bodies:
        raise DataError(
            "no moving component is large enough",
            where=item.key,
            expected=f"{MIN_SUPERPIXELS} superpixels of one",
        )
    return {"metrics": {}, "bodies": bodies, "superpixels": len(seg)}


Energies = Mapping[str, tuple[EnergyData, Weights]]


def _energies(pair: Pair, seg: Segmentation, true: TrueSoup, seed: int) -> Energies:
    """Data and weights of every kind of energy, at the true soup."""
    assert pair.flow is not None
    bare = build_energy_data(seg, pair.flow, pair.K_ref, pair.K_next, 16, seed)
    source = {"input": {"kind": "motorcycle"}}
    printed = make_problem({**source, "preset": "paper"}).energy
    ours = make_problem(source).energy
    paper = in_length(bare, true.soup, printed.length)
    pixels = in_pixels(bare, true.soup, seg)
    apart = across_components(bare, true.component, ours.arap_across)
    gap, factor = ours.occlusion_gap, ours.cont_occluded
    apart = at_occlusions(apart, true.soup, true.component, gap, factor)
    none = dict.fromkeys(("arap", "proj", "cont", "orient", "prior"), 0.0)
    full = printed.weights
    return {
        "arap": (paper, full.replace(**{**none, "arap": 1.0})),
        "arap px": (pixels, full.replace(**{**none, "arap": 1.0})),
        "cont": (paper, full.replace(**{**none, "cont": 1.0})),
        "paper": (paper, full),
        "defaults": (in_pixels(apart, true.soup, seg), ours.weights),
    }


def curves(true: TrueSoup, own: Mask, energies: Energies) -> dict[str, list[float]]:
    """Every kind of energy over SCALES, factors of the scale of the superpixels `own` (N,)."""
    out: dict[str, list[float]] = {}
    for kind, (data, weights) in energies.items():
        out[kind] = []
        for scale in SCALES:
            lam = np.where(own, scale, 1.0) * true.soup.lam
            soup = replace(true.soup, lam=lam).normalised(data.share)
            out[kind].append(oracle.energy(soup, data, weights)["total"])
    return out


def scale_of_least_energy(curve: list[float]) -> float:
    """The factor of SCALES at which a curve is lowest."""
    return float(SCALES[int(np.argmin(curve))])


def with_motions(pair: Pair) -> Pair:
    """The pair with motions of its components; unknown ones by PnP on true depth and flow.

    Raises:
        DataError: it has no dense depth and flow with components.
    """
    truth = pair.truth
    if truth is None or truth.depth_ref is None or truth.components is None:
        raise DataError(
            "scales of moving bodies need a true depth and a mask of what moves", where=pair.name
        )
    if truth.motions is not None:
        return pair
    if truth.flow is None:
        raise DataError("motions of bodies need a true flow", where=pair.name)
    return replace(pair, truth=_with_estimated_motions(pair, truth))


def _with_estimated_motions(pair: Pair, truth: Truth) -> Truth:
    """The truth with (B, 4, 4) motions, NaN where a component does not determine one.

    A mask marks what moves but not what moves together, so every connected piece of it becomes a
    component.
    """
    depth, mask, flow = truth.depth_ref, truth.components, truth.flow
    assert depth is not None
    assert mask is not None
    assert flow is not None
    pieces, _ = ndimage.label(mask > 0)
    components = np.where(mask < 0, -1, pieces).astype(np.int32)
    grid = pixel_grid(*depth.shape)
    points = depth[..., None] * rays(pair.K_ref, grid)
    target = grid[..., :2] + flow
    known = np.isfinite(points).all(axis=2) & np.isfinite(target).all(axis=2)
    motions = np.full((int(components.max()) + 1, 4, 4), np.nan)
    for c in range(len(motions)):
        at = known & (components == c)
        if at.sum() < MIN_POINTS:
            continue
        X, x = points[at].astype(np.float64), target[at].astype(np.float64)
        step = max(1, len(X) // 5000)
        pose = motion_of_points(X[::step], x[::step], pair.K_next)
        if pose is not None:
            motions[c] = pose
    return replace(truth, components=components, motions=motions)
