"""Options of the energy: weights, truncations, units and departures from the paper."""

from __future__ import annotations

from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from soup_nlp.schema.section import NonNegative, Positive, Samples, Section, Share, Truncation


class Weights(Section):
    """Constants of E = E_arap + alpha1 E_proj + alpha2 E_cont + alpha3 E_orient + alpha4 E_prior.

    E_prior is not in the paper. It draws depth that the flow leaves undetermined (little parallax,
    a camera at rest, a motion of few superpixels) to that of the neighbours. It is the un-squared
    slope of the inverse depth relative to the nearer of the two, so that its gradient is bounded
    and it does not draw a far background to the foreground.

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
    """Truncation of its reference-frame gap; inf is the paper's form."""
    sigma_orient: Truncation = 0.5
    """Truncation n of rho_n."""
    sigma_arap: Truncation = 0.5
    """Truncation of every ARAP norm; inf is the paper's form."""
    leak_arap: Share = 0.01
    """Share of an ARAP norm that is not truncated: it pulls a motion that no other term determines
    towards its neighbours'."""
    sigma_proj: Truncation = np.inf
    """Truncation of a pixel's re-projection error, pixels; inf is the paper's form."""


class BendingWeights(Weights):
    """Weights where surfaces bend; `orient` is that of 1,000 superpixels, see `BendingOptions`."""

    cont: NonNegative = 0.05
    """alpha2."""
    orient: NonNegative = 4.0
    """alpha3, of 1,000 superpixels; it grows with their number."""
    prior: NonNegative = 4.0
    """alpha4, in units of the flow's noise, here that of the superpixels' affine flow."""
    sigma_arap: Truncation = 1.0
    """Truncation of every ARAP norm; inf is the paper's form."""
    leak_arap: Share = 0.05
    """Share of an ARAP norm that is not truncated."""


class BendingOptions(Section):
    """The energy where the start finds that surfaces bend, always in pixels.

    Bending is a difference of rotations that keeps lengths: E_arap compares motions at the
    anchors, where a bending surface is connected, and its rotations count for next to
    nothing. The relief is then held by lengths, continuity and orientation.
    """

    widest_eps: Positive = 0.1
    """Widest smoothing of the presolve, pixels: wider ones of solver.presolve_eps become this.
    Relief shows as a fraction of a pixel of flow; a wider smoothing flattens it."""
    untruncated: bool = True
    """Switches solver.untruncated on: truncated from the start, E_arap tears surfaces that bend."""
    rotation_px: Positive = 1e-3
    """Pixels per radian of rotation difference."""
    arap_across: Share = 0.3
    """Factor of E_arap across a discontinuity of the flow; 1 is the paper's, as of the others."""
    cont_across: Share = 0.01
    """Factor of E_cont there."""
    orient_across: Share = 0.3
    """Factor of E_orient there."""
    weights: BendingWeights = BendingWeights()
    """Factors of the terms and their truncations; orient is that of 1,000 superpixels and grows
    with their number."""


class EnergyOptions(Section):
    """The energy."""

    units: Literal["pixel", "paper"] = "pixel"
    """pixel (every term in pixels, free of scale) or paper (one length unit)."""
    length: Literal["depth", "translation", "scales"] = "depth"
    """Unit of length with units: paper. depth: the mean plane distance is 1. translation: the
    translations add up to 1, at the lengths that the start gives them. scales: the plane distances
    add up to 1."""
    arap_at_anchors: bool = False
    """Motion difference at the anchors instead of the camera's origin."""
    arap_across: Share = 0.03
    """Factor of E_arap and E_prior between superpixels of different components; 1 is the
    paper's."""
    prior_ground: NonNegative | None = 10.0
    """Factor of E_prior between two superpixels without depth of their own where the start knows
    the ground: it holds the relief that the start gave them; null for E_prior as elsewhere."""
    cont_occluded: Share = 0.03
    """Factor of E_cont where one of these components hides another; 1 is the paper's."""
    occlusion_gap: Annotated[float, Field(ge=0, lt=1)] = 0.1
    """It does where the start leaves a larger gap in depth between them, relative to the farther
    side."""
    rotation_px: Positive | None = None
    """Pixels per radian of rotation difference; null for the focal length."""
    pixel_samples: Samples | Literal["all"] = 16
    """Pixels per superpixel in E_proj, or all."""
    weights: Weights = Weights()
    """Factors of the terms and their truncations."""
    bending: BendingOptions = BendingOptions()
    """What replaces rotation_px, arap_at_anchors, weights and the solver's wide smoothing where
    surfaces bend."""
