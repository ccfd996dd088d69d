"""Options of the energy: weights, truncations, units and departures from the paper."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from soup_nlp.schema.section import NonNegative, Positive, Samples, Section, Share, Truncation


class Weights(Section):
    """Constants of E = E_arap + alpha1 E_proj + alpha2 E_cont + alpha3 E_orient + alpha4 E_prior.

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
    sigma_cont: Truncation = 1.0
    """Truncation of E_cont's second-frame gap (rho), length."""
    sigma_cont_ref: Truncation = np.inf
    """Truncation of E_cont's reference-frame gap; inf is the paper's form."""
    sigma_orient: Truncation = 0.5
    """Truncation n of rho_n."""
    sigma_arap: Truncation = 0.5
    """Truncation of every ARAP norm; inf is the paper's form."""
    leak_arap: Share = 0.01
    """Share of an ARAP norm that is not truncated: it pulls a motion that no other term determines
    towards the motions of its neighbours."""
    sigma_proj: Truncation = np.inf
    """Truncation of a pixel's re-projection error, pixels; inf is the paper's form."""


class BendingWeights(Weights):
    """Weights for bending surfaces; `orient` is the value at N = 1,000, see `BendingOptions`."""

    cont: NonNegative = 0.05
    """alpha2."""
    orient: NonNegative = 4.0
    """alpha3 at N = 1,000; it grows in proportion to N."""
    prior: NonNegative = 4.0
    """alpha4, in units of the flow's noise, here the residual of the superpixels' affine flows."""
    sigma_arap: Truncation = 1.0
    """Truncation of every ARAP norm; inf is the paper's form."""
    leak_arap: Share = 0.05
    """Share of an ARAP norm that is not truncated."""


class BendingOptions(Section):
    """The energy for pairs whose surfaces bend, always in pixels.

    Bending changes rotations but preserves lengths. E_arap therefore compares motions at the
    anchors, where a bending surface is connected, and gives rotations almost no weight. Lengths,
    continuity and orientation then hold the relief.
    """

    widest_eps: Positive = 0.1
    """Upper limit of solver.presolve_eps, pixels. Relief changes the flow by a fraction of a pixel,
    so a wider smoothing would flatten it."""
    untruncated: bool = True
    """Sets solver.untruncated where the whole image bends: E_arap truncated from the beginning
    tears bending surfaces."""
    rotation_px: Positive = 1e-3
    """Pixels per radian of rotation difference."""
    arap_across: Share = 0.3
    """Factor of E_arap across a flow discontinuity; 1 is the paper's, here and below."""
    cont_across: Share = 0.01
    """Factor of E_cont across a flow discontinuity."""
    orient_across: Share = 0.3
    """Factor of E_orient across a flow discontinuity."""
    weights: BendingWeights = BendingWeights()
    """Factors of the terms and their truncations; orient is the value at N = 1,000 and grows in
    proportion to N."""


class EnergyOptions(Section):
    """Options of the energy."""

    units: Literal["pixel", "paper"] = "pixel"
    """pixel (every term in pixels, free of scale) or paper (one length unit)."""
    length: Literal["depth", "translation", "scales"] = "depth"
    """Unit of length with units: paper. depth: the mean plane distance is 1. translation: the
    lengths of the initial translations add up to 1. scales: the plane distances add up to 1."""
    arap_at_anchors: bool = False
    """Compare motions at the anchors instead of the camera's origin."""
    arap_across: Share = 0.03
    """Factor of E_arap and E_prior between superpixels of different components; 1 is the
    paper's."""
    prior_ground: NonNegative | None = 10.0
    """Factor of E_prior between two superpixels with borrowed depth over a known ground, where it
    holds the relief of the initialisation; null treats these superpixels like all others."""
    cont_occluded: Share = 0.03
    """Factor of E_cont where one component occludes another; 1 is the paper's."""
    occlusion_gap: Annotated[float, Field(ge=0, lt=1)] = 0.1
    """Relative gap in depth, in the initialisation, from which one component occludes another."""
    rotation_px: Positive | None = None
    """Pixels per radian of rotation difference; null for the focal length."""
    pixel_samples: Samples | Literal["all"] = 16
    """Pixels per superpixel in E_proj, or all."""
    weights: Weights = Weights()
    """Factors of the terms and their truncations."""
    bending: BendingOptions = BendingOptions()
    """Replaces rotation_px, arap_at_anchors, weights and the solver's widest smoothing where
    surfaces bend."""
