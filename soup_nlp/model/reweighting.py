"""Weights of all edges and neighbour pairs as one function of what is known before a solve, and
their units. See docs/formulation.md, 14.
"""

from dataclasses import dataclass, replace

import numpy as np

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.geometry.graph import Segmentation
from soup_nlp.geometry.soup import Soup
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.model.energy_options import BENDING, BENDING_TURN_PX, GAP, EnergyOptions
from soup_nlp.model.formulas import relief

HELD = 30.0
"""Factor of E_prior where it keeps the relief of the start: of what is not seen, and from there to
what is. With 1, unseen parts run away on alley_1 and kitti_tracking 0 (MRE 33 and 0.66)."""


@dataclass(frozen=True, eq=False)
class Known:
    """What is known of N superpixels and P neighbour pairs before a solve.

    Attributes:
        component: (N,) group that shares one motion and scale; 0 is the scene.
        bends: (N,) True where every superpixel has a motion of its own.
        variance: (N,) variance of log depth by the flow; inf where it determines none.
        noise: Noise of the flow, pixels.
        order: (P,) probability of the order of every pair, signed as `EnergyData.order_weight`;
            None where none is known.
        placed: (N,) True where the order alone gives the component its scale.
        prior: Of a depth prior (N,) log depth up to a common scale, how far the flow leaves the
            shape to it (0 to 1), and its standard deviation, inf where it does not count.
    """

    component: Int
    bends: Mask
    variance: Float
    noise: float
    order: Float | None
    placed: Mask
    prior: tuple[Float, Float, Float] | None = None


def weighted(data: EnergyData, soup: Soup, known: Known, options: EnergyOptions) -> EnergyData:
    """The data, which has the weights of the paper, with the weights of all edges and pairs.

    The steps of depth that order asks for are those of the soup, the start.
    """
    (i, k), (a, b) = data.edges.T, data.pairs.T
    group, bends = known.component, known.bends
    # what two components have in common is not known: little of each term joins them
    joined = np.where(group[i] == group[k], 1.0, options.across)
    # contact gives scales; where the start leaves a gap between components, the gap is real
    z = soup.depth_across(data.pairs, data.boundary_ray.mean(axis=1))
    gap = z.min(axis=0) < (1 - GAP) * z.max(axis=0)
    touching = np.where(gap & (group[a] != group[b]), options.across, 1.0)
    stiff = bends.copy()
    prior = known.noise * data.prior_weight
    # terms on shape flatten what is not seen: it keeps the relief of the start
    unseen = np.isinf(known.variance) & ~bends
    held = unseen[i] | unseen[k]
    by_prior, depth, change = np.zeros((3, len(i)))
    turn = np.zeros((len(a), 3))
    if known.prior is not None:
        log_depth, ambiguity, error = known.prior
        error = np.maximum(error[i], error[k])
        by_prior = np.where(group[i] == group[k], np.maximum(ambiguity[i], ambiguity[k]), 1.0)
        by_prior = np.where(np.isfinite(error), by_prior, 0.0)
        depth, change = by_prior * prior / error, log_depth[i] - log_depth[k]
        # the flow holds no slopes where the prior decides: its own stay; it may have steps
        tilted = np.flatnonzero((ambiguity > 0.5)[data.pairs].all(axis=1) & ~(bends[a] | bends[b]))
        turn[tilted] = (soup.n[a] - soup.n[b])[tilted]
        stiff |= ambiguity > 0.5
        steps = gap & (ambiguity > 0.5)[data.pairs].any(axis=1)
        touching = np.where(steps, options.across, touching)
    order, step = np.zeros((2, len(a)))
    if known.order is not None and options.weights.order > 0:
        order = known.noise * known.order
        step = np.where(order > 0, z[0] / z[1], z[1] / z[0]) - 1
        step = np.where(known.placed[data.pairs].any(axis=1), np.maximum(step, 0.0), 0.0)

    def bending(name: str, ends: Int) -> Float:
        return np.where(bends[ends].all(axis=1), BENDING[name], 1.0)

    steep = len(data) / 1000 * BENDING["orient"]
    shown = bending("prior", data.edges) * (1 - by_prior)
    return replace(
        data,
        edge_weight=joined * data.edge_weight,
        prior_weight=shown * np.where(held, HELD, joined) * prior,
        prior_relief=np.where(held, relief(soup, data), 0.0),
        depth_weight=depth,
        depth_change=change,
        pair_weight=bending("cont", data.pairs) * touching * data.pair_weight,
        orient_weight=np.where(stiff[data.pairs].all(axis=1), steep, 1.0) * data.orient_weight,
        orient_turn=turn,
        order_weight=order,
        order_step=step,
    )


def in_pixels(
    data: EnergyData, soup: Soup, seg: Segmentation, bends: Mask | None = None
) -> EnergyData:
    """The same data with every term measured in pixels: the weights mean the same on every scene.

    A rotation by an angle a moves the image by `focal a`; a length l at depth Z by `focal l / Z`;
    a depth gap g changes the parallax of a baseline T by `focal g / Z * T / Z`. Z is the depth
    of the two anchors as they are: with one global unit, the depth of superpixels without parallax
    diverges, because that shortens all other lengths. It is their power mean of exponent -4: with
    the arithmetic mean the energy falls as one of the two recedes. T / Z is a constant of the
    energy: its median around the superpixels of the soup, the start. Rotations cost next to nothing
    where superpixels bend, `bends` (N,).
    """
    ratio = np.linalg.norm(soup.translation, axis=1) / soup.depth_at(data.anchor_ray)
    if seg.knn.shape[1]:
        ratio = np.median(ratio[np.column_stack([np.arange(len(soup)), seg.knn])], axis=1)
    # a camera at rest leaves no parallax: half a pixel of it is the least taken
    focal = float(data.K_next[0, 0])
    ratio = np.maximum(ratio, 0.5 / focal)
    ri, rk = ratio[data.pairs].T
    bent = np.zeros(len(data), bool) if bends is None else bends
    return replace(
        data,
        local_units=True,
        edge_unit=np.full(len(data.edges), 1.0 / focal),
        rotation_scale=np.where(bent[data.edges].any(axis=1), BENDING_TURN_PX, focal),
        pair_unit=1.0 / (focal * np.sqrt(ri * rk)),
    )


def in_translations(data: EnergyData, soup: Soup) -> EnergyData:
    """The same data in the paper's units with the sum of the translations as unit of length.

    `sum_i lam_i = 1` fixes the unit; the paper does not say what a scale multiplies: here it is the
    translation of unit length, whose ratio to the plane distance is that of the soup, the start.
    """
    share = np.maximum(np.linalg.norm(soup.translation, axis=1) / soup.distance, 1e-9)
    # lengths have sum_i c_i D_i = 1, shares c add up to 1; the unit is that of sum_i s_i D_i = 1
    unit = float(share.sum())
    return replace(
        data, share=share / unit, edge_unit=unit * data.edge_unit, pair_unit=unit * data.pair_unit
    )
