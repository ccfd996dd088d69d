"""Departures from the paper's weights and graph: in a scene, across components, in pixels.

Every function takes the data of a pair, and where it needs it the soup of its start.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.geometry.graph import Segmentation
from soup_nlp.geometry.soup import Soup
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.oracle import PAIR_TERMS, relief

LEAST_STEP = 0.05
"""Least step of inverse depth that E_order asks for where it asks for one, relative."""
CONFIDENT = 0.5
"""Mean confidence of a superpixel's flow above which an edge joins it to the rest of the scene."""
OF_EDGES: tuple[str, ...] = ("edges", "edge_weight", "edge_unit", "rotation_scale")
OF_EDGES += ("prior_weight", "prior_relief", "depth_weight", "depth_change")
"""Arrays of `EnergyData` with a row per edge."""
CREASE = 0.01
"""1 - cos of the angle between two planes of a depth prior that halves E_orient between them, 8
degrees: 0.005 and 0.02 differ by at most 0.0006 in the mean relative error of robot."""


def scaled(data: EnergyData, edges: Mask, pairs: Mask, factors: Mapping[str, float]) -> EnergyData:
    """The same data with terms times a factor each, by name, on some edges and pairs."""
    chosen, weights = {"edges": edges, "pairs": pairs}, {}
    for name, factor in factors.items():
        term = PAIR_TERMS[name]
        weight = getattr(data, term.weight)
        weights[term.weight] = np.where(chosen[term.graph], factor, 1.0) * weight
    return replace(data, **weights)


def across(data: EnergyData, group: Int, **factors: float) -> EnergyData:
    """The same data with terms times a factor each between superpixels of different groups.

    As-rigid-as-possible holds inside a component. Across components it pulls a component that the
    camera's motion explains at a wrong depth to that depth: with equal motions such an edge costs
    nothing. The prior would pull a component to its background, against the contact that fixes its
    scale. At a flow discontinuity, moreover, one surface passes in front of another: their gap in
    depth is real, and they need not face the same way.

    Args:
        group: (N,) component or surface of every superpixel, as the start finds them.
        factors: By the name of a term; 1 is the paper's energy.
    """
    pairs, edges = (group[a] != group[b] for a, b in (data.pairs.T, data.edges.T))
    return scaled(data, edges, pairs, factors)


def rigid_scene(data: EnergyData, soup: Soup, scene: Mask, weight: float) -> EnergyData:
    """The same data with an E_arap edge from the superpixel of median depth to all of the scene.

    K-NN edges join the near and the far part of a scene by few links. E_arap is truncated, so that
    cutting these costs little, and each part gets a translation of a length of its own.

    Args:
        data: Data of the pair in the paper's units.
        scene: (N,) the scene, one rigid component; superpixels without confident flow are left out.
        weight: w1 of these edges; 0 is the paper's graph.
    """
    members = np.flatnonzero(scene & (data.pixel_weight.sum(axis=1) > CONFIDENT))
    if weight == 0 or len(members) < 2:
        return data
    z = soup.depth_at(data.anchor_ray)[members]
    hub = members[np.argsort(z)[len(z) // 2]]
    edges = np.sort(np.column_stack([np.full(len(members), hub), members]), axis=1)
    n = len(data)
    edges = edges[~np.isin(edges @ [n, 1], np.append(data.edges @ [n, 1], hub * (n + 1)))]

    values = {"edge_weight": weight, "edge_unit": 1.0, "rotation_scale": 1.0}
    more = {k: np.full(len(edges), values.get(k, 0.0)) for k in OF_EDGES} | {"edges": edges}
    rows: dict[str, Any] = {k: np.concatenate([getattr(data, k), v]) for k, v in more.items()}
    return replace(data, **rows)


def first_edges(data: EnergyData, count: int) -> EnergyData:
    """The same data with the first `count` edges: those of the K-NN graph precede others."""
    rows: dict[str, Any] = {k: getattr(data, k)[:count] for k in OF_EDGES}
    return replace(data, **rows)


def over_ground(data: EnergyData, soup: Soup, grounded: Mask, weight: Float) -> EnergyData:
    """The same data with E_prior holding the initialisation's relief over a known ground.

    Without usable flow only the terms that flatten act on the depth: what is seen below the
    horizon would recede below the ground, although the initialisation has put it there.

    Args:
        grounded: (N,) whether a superpixel without depth of its own has ground below it.
        weight: (E,) weight of E_prior on edges between two of them.
    """
    both = grounded[data.edges].all(axis=1)
    return replace(
        data,
        prior_weight=np.where(both, weight, data.prior_weight),
        prior_relief=np.where(both, relief(soup, data), 0.0),
    )


def with_prior(
    data: EnergyData,
    soup: Soup,
    log_depth: Float,
    opened: Float,
    error: Float,
    component: Int,
    weight: Float,
    stiffer: Float,
    creased: bool,
) -> EnergyData:
    """The same data with E_depth instead of E_prior where a depth prior counts.

    Args:
        soup: Start; where the flow leaves slopes open, its planes are those of the prior.
        log_depth: (N,) log depth of the anchors by the depth prior.
        opened: (N,) how far the flow leaves the shape of a component open, 0 to 1.
        error: (N,) standard deviation of the prior; inf where it does not count.
        component: (N,) group of every superpixel: scales of different ones are open.
        weight: (E,) of E_depth for a difference by one standard deviation.
        stiffer: (N,) factor of E_orient between superpixels whose slopes the flow leaves open.
        creased: Whether that factor is smaller where their planes meet at an angle. Where the flow
            confirms a prior, its noise would tilt them.
    """
    i, k = data.edges.T
    same = component[i] == component[k]
    between = np.where(same, np.maximum(opened[i], opened[k]), 1.0)
    between = np.where(np.isfinite(error[i] + error[k]), between, 0.0)
    slopes = np.where(opened > 0.5, stiffer, 1.0)[data.pairs].min(axis=1)
    if creased:
        a, b = data.pairs.T
        turn = 1 - np.sum(soup.n[a] * soup.n[b], axis=1)
        both = (opened[a] > 0.5) & (opened[b] > 0.5)
        slopes = np.where(both, slopes / (1 + turn / CREASE), slopes)
    return replace(
        data,
        depth_weight=between * weight / np.maximum(error[i], error[k]),
        depth_change=log_depth[i] - log_depth[k],
        prior_weight=(1 - between) * data.prior_weight,
        orient_weight=slopes * data.orient_weight,
    )


def with_order(
    data: EnergyData, soup: Soup, order: Float, placed: Mask, weight: float
) -> EnergyData:
    """The same data with E_order where it is known which superpixel of a pair is in front.

    Where nothing else gives a scale, the step of the start is asked for; else none, only the order.

    Args:
        order: (P,) probability of the order, signed as `EnergyData.order_weight`.
        placed: (N,) True where the steps of the start are asked for.
        weight: Of a sure order.
    """
    z = soup.depth_across(data.pairs, data.boundary_ray.mean(axis=1))
    step = np.where(order > 0, z[0] / z[1], z[1] / z[0]) - 1
    step = np.where(placed[data.pairs].any(axis=1), np.maximum(step, LEAST_STEP), 0.0)
    return replace(data, order_weight=weight * order, order_step=step)


def at_occlusions(
    data: EnergyData, soup: Soup, component: Int, gap: float, factor: float
) -> EnergyData:
    """The same data with E_cont's weights times `factor` where one component hides another.

    A component in front touches what is behind it along a part of its outline alone, where the
    start has brought both together. The gaps along the rest are real; closing them moves the
    component away from the camera, and nothing else fixes its scale.

    Args:
        soup: Start, its components scaled to where they touch.
        component: (N,) group of every superpixel, as the start finds them.
        gap: Smallest gap in depth that is one, relative to the farther side.
        factor: 1 is the paper's energy.
    """
    i, k = data.pairs.T
    z = soup.depth_across(data.pairs, data.boundary_ray.mean(axis=1))
    hidden = (component[i] != component[k]) & (z.min(axis=0) < (1 - gap) * z.max(axis=0))
    return replace(data, pair_weight=np.where(hidden, factor, 1.0) * data.pair_weight)


def in_pixels(
    data: EnergyData, soup: Soup, seg: Segmentation, rotation_px: float | None = None
) -> EnergyData:
    """The same data with every term measured in pixels: the weights mean the same on every scene.

    A rotation by an angle a moves the image by `focal a`; a length l at depth Z by `focal l / Z`;
    a depth gap g changes the parallax of a baseline T by `focal g / Z * T / Z`. Z is the depth
    of the two anchors as they are, so that no term gains from shrinking or growing the scene: with
    one global unit, the depth of superpixels without parallax diverges, because that shortens all
    other lengths. It is their power mean of exponent -4, close to the nearer one: with the
    arithmetic mean the energy falls as one of the two recedes. The ratio T / Z is a constant of the
    energy: its median around the superpixels at the start.

    Args:
        data: Data in the paper's units.
        soup: Start, for the ratio of baseline and depth.
        seg: For the neighbourhoods.
        rotation_px: Pixels that a radian of rotation difference costs; default the focal length.
    """
    ratio = np.linalg.norm(soup.translation, axis=1) / soup.depth_at(data.anchor_ray)
    if seg.knn.shape[1]:
        ratio = np.median(ratio[np.column_stack([np.arange(len(soup)), seg.knn])], axis=1)
    # a camera at rest leaves no parallax: half a pixel of it is the least taken
    focal = float(data.K_next[0, 0])
    ratio = np.maximum(ratio, 0.5 / focal)
    ri, rk = ratio[data.pairs].T
    return replace(
        data,
        local_units=True,
        edge_unit=np.full(len(data.edges), 1.0 / focal),
        rotation_scale=np.full(len(data.edges), rotation_px or focal),
        pair_unit=1.0 / (focal * np.sqrt(ri * rk)),
    )


def within_bending(
    data: EnergyData, bends: Mask, rigid: Weights, bent: Weights, rotation_px: float
) -> EnergyData:
    """The same data with the weights for bending surfaces between superpixels that bend.

    Where rigid and bending regions lie in one image, the factors of the terms are those of rigid
    regions. The weights of single edges and pairs then make up the difference.

    Args:
        data: Data in pixels.
        bends: (N,) True where the superpixel lies in a region that bends.
        rigid: Factors of the terms elsewhere, which the energy has.
        bent: Factors of the terms in regions that bend.
        rotation_px: Pixels per radian of rotation difference on edges with an end there.
    """
    edges, pairs = (bends[ends[:, 0]] & bends[ends[:, 1]] for ends in (data.edges, data.pairs))
    weights = {k: getattr(rigid, k) for k in ("arap", "prior", "cont", "orient")}
    factors = {k: getattr(bent, k) / weight for k, weight in weights.items() if weight}
    scale = np.where(bends[data.edges].any(axis=1), rotation_px, data.rotation_scale)
    return scaled(replace(data, rotation_scale=scale), edges, pairs, factors)


def in_translations(data: EnergyData, soup: Soup) -> EnergyData:
    """The same data in the paper's units with the sum of the translations as unit of length.

    `sum_i lam_i = 1` fixes the unit, and the paper does not say what a scale multiplies; here it is
    the translation t-hat of unit length. Translations have the ratio to their plane distances that
    the start has.

    Args:
        data: Data in the paper's units, the mean plane distance being 1.
        soup: Start, for the length of translations.
    """
    share = np.maximum(np.linalg.norm(soup.translation, axis=1) / soup.distance, 1e-9)
    # lengths have sum_i c_i D_i = 1, shares c add up to 1; the unit is that of sum_i s_i D_i = 1
    unit = float(share.sum())
    return replace(
        data, share=share / unit, edge_unit=unit * data.edge_unit, pair_unit=unit * data.pair_unit
    )
