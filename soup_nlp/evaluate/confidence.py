"""How sure depth is: marginal variances of the whole assembly, calibrated against true depth.

See docs/confidence.md.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.data.pair import Flow, Pair
from soup_nlp.errors import ModelError
from soup_nlp.evaluate.information import (
    Marginals,
    information,
    learned,
    marginals,
    spread_in_image,
)
from soup_nlp.geometry.soup import Reconstruction, Soup
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.formulation import FormulationOptions
from soup_nlp.start.choice import LEAST_NOISE, MOST_NOISE
from soup_nlp.start.components import TIES
from soup_nlp.start.propose import Start

log = logging.getLogger(__name__)

SIGMA_PRIOR = 0.5
"""Standard deviation of log depth where the pair says nothing: scenes vary by about that much."""
PRIOR_SHARE = 0.001
"""Factor of E_prior in the information: it holds depth where nothing else does, knowing little."""
FLOW_SHARE = 0.01
"""Factor of E_proj in the information without the flow; without any, motions would be free."""
MOST_BORROWED = 0.5
"""Share of superpixels without a depth of their own from which the camera is at rest."""
FACTOR, POWER = 7.0, 1.25
"""sigma = FACTOR (noise spread)^POWER, with the flow's noise in pixels: docs/confidence.md."""
BENDING_FACTOR = 0.5
"""sigma = BENDING_FACTOR misfit sqrt(spread) where surfaces bend."""
LEAST_SPREAD = 0.1
"""Added in squares to spreads where surfaces bend: errors hardly follow smaller ones."""
MOST_MISFIT, BENDING_MISFIT = 5.0, 100.0
"""Pixels beyond which a flow that the answer contradicts is as wrong as any; the latter where
surfaces bend: what an answer with a motion for every superpixel cannot follow is far off."""
LARGEST = 1e6
"""Of what is calibrated: anything above is as little."""
MIN_CONFIDENCE = 0.5
"""A pixel whose confidence, 1 - sigma / `SIGMA_PRIOR`, is less is a guess."""
MOST_SIGMA = (1 - MIN_CONFIDENCE) * SIGMA_PRIOR
"""The sigma of that confidence."""


@dataclass(frozen=True, eq=False)
class Confidence:
    """How sure the depth of an answer is.

    Attributes:
        sigma: (H, W) calibrated standard deviation of log depth, the global scale left out.
        spread: (H, W) standard deviation of log depth by what the flow adds to the terms on shape.
        marginals: Of the planes and of the components' scales.
        noise: Of the flow, pixels.
        component_sigma: (C,) standard deviation of the components' log scale.
        still: Share of the image that stands still where surfaces bend.
        misfit: (N,) mean distance of the flow from the one that the answer induces, pixels.
    """

    sigma: Float
    spread: Float
    marginals: Marginals
    noise: float
    component_sigma: Float
    still: float
    misfit: Float

    @property
    def guessed(self) -> float:
        """Share of the pixels whose depth is a guess."""
        return float(np.mean(self.sigma > MOST_SIGMA))


def without_parallax(start: Start) -> Mask:
    """(N,) superpixels that the start gave the depth of others, where these are most of the image.

    The camera is at rest then. A few of them take their depth from a surface that is known.
    """
    rest = ~start.bends
    most = rest.any() and float(start.borrowed[rest].mean()) >= MOST_BORROWED
    return np.asarray(start.borrowed & rest & most)


def stands_still(soup: Soup, anchor_ray: Float, K_next: Float) -> Mask:
    """(N,) superpixels whose translation moves them by less than any flow's noise.

    Args:
        soup: The answer.
        anchor_ray: (N, 3).
        K_next: (3, 3) intrinsics of the next frame.
    """
    focal = np.array([K_next[0, 0], K_next[1, 1]])
    moved = np.linalg.norm(soup.parallax(anchor_ray) * focal, axis=1)
    return np.asarray(moved < MOST_NOISE)


def flow_misfit(rec: Reconstruction, flow: Flow, most: Float | float = MOST_MISFIT) -> Float:
    """(N,) mean distance of a flow from the one that a reconstruction induces, pixels.

    Args:
        rec: The answer.
        flow: The flow that it was solved with.
        most: Larger distances, and those of what is not induced, count as this; (H, W) or one.
    """
    distance = np.linalg.norm(rec.flow - flow.uv, axis=-1)
    limited = np.where(np.isfinite(distance), np.minimum(distance, most), most)
    flat = rec.labels.ravel()
    return np.asarray(np.bincount(flat, limited.ravel()) / np.bincount(flat))


def calibrated(
    spread: Float,
    noise: float,
    misfit: Float | float = 0.0,
    prior: float = SIGMA_PRIOR,
    bends: Mask | bool = False,
    still: float = 0.0,
    scale: Float | float = 0.0,
) -> Float:
    """Standard deviation of log depth that errors keep to.

    Where surfaces bend every superpixel has a motion of its own, which fits nearly any flow: the
    spread says little there, and a misfit much.

    Args:
        spread: What the marginals say.
        noise: Of the flow, pixels.
        misfit: Of the same superpixel, pixels; where it is larger than the noise, their geometric
            mean is the noise.
        prior: Standard deviation before looking; its information is added.
        bends: Where regions bend; of the same shape, or one for all.
        still: Share of the image that stands still. Nothing tells its depth, nor that of the rest
            beside it: so much of `SIGMA_PRIOR` is added everywhere, in squares.
        scale: Standard deviation of the log scale of its component by the marginals, 0 for the
            reference component. The others have their scale from contact and not from the flow,
            so it counts whatever the flow's noise is; added in squares.
    """
    # no limits where regions bend: what is below them keeps its order
    known = np.sqrt(np.hypot(LEAST_SPREAD, spread))
    bent = BENDING_FACTOR * np.hypot(LEAST_NOISE, misfit) * known
    rigid = FACTOR * (np.sqrt(noise * np.maximum(noise, misfit)) * spread) ** POWER
    sigma = np.where(bends, bent, rigid)
    return with_prior(np.hypot(np.hypot(sigma, scale), SIGMA_PRIOR * still), prior)


def with_prior(sigma: Float, prior: float = SIGMA_PRIOR) -> Float:
    """Standard deviation where the information of the prior is added."""
    sigma = np.minimum(sigma, LARGEST)
    return np.asarray(sigma / np.hypot(1.0, sigma / prior))


def scale_by_contact(own: Marginals, start: Start) -> Float:
    """(N,) standard deviation of the log scale of a superpixel's component, by the marginals.

    It is 0 for the reference component, which defines the scale.
    """
    reference = start.tie == TIES.index("reference")
    return np.where(reference, 0.0, np.sqrt(own.component)[start.component])


def _spread(
    rec: Reconstruction,
    data: EnergyData,
    weights: Weights,
    form: FormulationOptions,
    component: Int,
    K_ref: Float,
) -> tuple[Marginals, Float]:
    """Marginals, and (H, W) standard deviation of log depth by them."""
    info = information(rec.soup, data, weights, form)
    own = marginals(info, np.bincount(rec.labels.ravel()), component)
    return own, spread_in_image(info, own.plane, rec.labels, K_ref)


def confidence(
    rec: Reconstruction,
    pair: Pair,
    start: Start,
    data: EnergyData,
    weights: Weights,
    form: FormulationOptions,
) -> Confidence:
    """How sure the depth of an answer is.

    Args:
        rec: The answer.
        pair: Intrinsics, and the flow that it was solved with.
        start: Rigid components and the flow's noise.
        data: Pixels, graphs and weights of the pair.
        weights: Constants of the energy.
        form: Visibility and whether kernels are compiled.
    """
    assert pair.flow is not None
    weak = weights.replace(prior=PRIOR_SHARE * weights.prior)
    blind = weak.replace(proj=FLOW_SHARE * weights.proj)
    try:
        (own, seen), (without, guessed) = (
            _spread(rec, data, w, form, start.component, pair.K_ref) for w in (weak, blind)
        )
        spread = np.sqrt(learned(seen**2, guessed**2))
        spread[without_parallax(start)[rec.labels]] = np.inf
        own = replace(own, component=learned(own.component, without.component))
    except (ModelError, ArithmeticError) as error:
        # numbers that no answer has, as a foreign solver may return: nothing is known
        log.warning("no uncertainty can be computed, all depth counts as a guess: %s", error)
        own = Marginals(
            np.full((len(rec.soup), 3, 3), np.inf),
            np.full(int(start.component.max()) + 1, np.inf),
        )
        spread = np.full(rec.labels.shape, np.inf)
    bends = start.bends[rec.labels]
    most = np.where(bends, BENDING_MISFIT, MOST_MISFIT)
    noise, misfit = start.noise, flow_misfit(rec, pair.flow, most)
    stands = stands_still(rec.soup, data.anchor_ray, pair.K_next) & start.bends
    # the answer may explain a part of the camera's turn by translations
    stands |= start.at_rest & (start.parallax < MOST_NOISE)
    still = float(stands[rec.labels].mean())
    scale = scale_by_contact(own, start)
    sigma = calibrated(
        spread, noise, misfit[rec.labels], bends=bends, still=still, scale=scale[rec.labels]
    )
    component_sigma = with_prior(np.sqrt(own.component))
    return Confidence(sigma, spread, own, noise, component_sigma, still, misfit)
