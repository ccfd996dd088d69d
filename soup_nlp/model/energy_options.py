"""Options of the energy: weights, truncations, units and departures from the paper."""

from typing import Literal

import numpy as np

from soup_nlp.schema.section import NonNegative, Section, Share, Truncation, Whole


class WeightOptions(Section):
    """Constants of E = E_arap + alpha1 E_proj + alpha2 E_cont + alpha3 E_orient + alpha4 E_prior,
    and of E_depth where a depth prior is given.

    E_prior is not in the paper. Where the flow leaves the depth undetermined (little parallax, a
    camera at rest, a motion of few superpixels), it pulls the depth to that of the neighbours. It
    is the un-squared slope of the inverse depth relative to the nearer superpixel. Its gradient is
    therefore bounded, and it does not pull a far background to the foreground.

    The defaults belong to `in_pixels`, where every term is measured in pixels; in the paper's
    units (lengths with sum_i c_i D_i = 1) other values are needed. beta and w1 to w4 are options of
    the segmentation.
    """

    arap: NonNegative = 0.15
    """Factor of E_arap (the paper's is 1; only the ratios of the four factors matter)."""
    proj: NonNegative = 1.0
    """alpha1, per pixel of re-projection error."""
    cont: NonNegative = 3e-4
    """alpha2."""
    orient: NonNegative = 5e-3
    """alpha3."""
    prior: NonNegative = 0.03
    """alpha4, cost of a relative change of inverse depth by 1 per ray unit, in units of the flow's
    noise; 0 is the paper's form."""
    depth: NonNegative = 10.0
    """Factor of E_depth, differences of log depth from those of a given depth prior in units of its
    error, times the flow's noise: neighbours share most of that error. 0 ignores a prior."""
    order: NonNegative = 10.0
    """Factor of E_order, by how much inverse depths along outlines lack the order that occlusion
    shows, relative to them, times the flow's noise; 0 leaves it out."""
    sigma_cont: Truncation = 1.0
    """Truncation of E_cont's second-frame gap (rho), length."""
    sigma_orient: Truncation = 0.5
    """Truncation n of rho_n."""
    sigma_arap: Truncation = 0.5
    """Truncation of every ARAP norm; inf is the paper's form."""
    leak_arap: Share = 0.01
    """Share of an ARAP norm that is not truncated: it pulls a motion that no other term determines
    towards the motions of its neighbours."""


class Weights(WeightOptions):
    """WeightOptions with truncations that are no option of a problem."""

    sigma_cont_ref: Truncation = np.inf
    """Truncation of E_cont's reference-frame gap."""
    sigma_proj: Truncation = np.inf
    """Truncation of a pixel's re-projection error, pixels."""


# --- surfaces that bend ---------------------------------------------------------------------------
#
# Bending changes rotations but preserves lengths. E_arap therefore compares motions at the anchors,
# where a bending surface is connected, and gives rotations almost no weight. Lengths, continuity
# and orientation then hold the relief. This energy is always in pixels.

GAP = 0.1
"""Relative gap in depth, at the start, from which two components do not touch."""
BENDING = {"cont": 500 / 3, "orient": 800.0, "prior": 400 / 3}
"""Factors of terms between superpixels that bend; orient is for N = 1,000: on the same relief
1 - cos between neighbours falls as 1 / N. Fitted on kinect_paper, sheet and rgbd."""
BENDING_TURN_PX = 1e-3
"""Pixels per radian of rotation difference beside superpixels that bend."""
BENDING_ARAP = {"sigma_arap": 1.0, "leak_arap": 0.05}
"""Truncation of E_arap where the whole image bends."""
WIDEST_BENDING_EPS = 0.1
"""Upper limit of solver.presolve_eps where surfaces bend, pixels. Relief changes the flow by a
fraction of a pixel, so a wider smoothing would flatten it."""


class EnergyOptions(Section):
    """Options of the energy."""

    units: Literal["pixel", "paper"] = "pixel"
    """pixel (every term in pixels, free of scale) or paper (one length unit: the lengths of the
    initial translations add up to 1)."""
    across: Share = 0.03
    """Factor of E_arap, E_prior and, over gaps in depth, E_cont between superpixels of different
    components; 1 is the paper's."""
    pixel_samples: Whole | Literal["all"] = 16
    """Pixels per superpixel in E_proj, or all."""
    weights: WeightOptions = WeightOptions()
    """Factors of the terms and their truncations."""
