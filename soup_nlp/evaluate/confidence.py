"""Uncertainty of depth: marginal variances of the whole assembly, calibrated against true depth.

See docs/confidence.md.
"""

import logging
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from soup_nlp.arrays import Float, Int, Labels, Mask
from soup_nlp.data.pair import Flow, Pair
from soup_nlp.errors import ModelError
from soup_nlp.evaluate.evidence import Evidence, evidence
from soup_nlp.evaluate.information import (
    Marginals,
    information,
    learned,
    marginals,
    spread_in_image,
)
from soup_nlp.geometry.soup import Reconstruction
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.formulation import FormulationOptions
from soup_nlp.start.components import FIXED, TIES
from soup_nlp.start.given_depth import Given
from soup_nlp.start.ground import STANDS
from soup_nlp.start.labelling import LEAST_NOISE
from soup_nlp.start.pace import displacement, log_pace
from soup_nlp.start.propose import Start

log = logging.getLogger(__name__)

SIGMA_PRIOR = 1.5
"""Standard deviation of log depth without any evidence, about the median, to which depths refer;
true scenes have 0.3 (rooms) to 1.4 (roads below a sky)."""
GUESSED = 2.0
"""Added in squares, of log depth, where no flow determines depth: 1.2 with the information of the
prior, which keeps the order given by the other terms."""
PRIOR_SHARE = 0.001
"""Factor of E_prior in the information: it is no evidence, but keeps variances finite where there
is none."""
FLOW_SHARE = 0.01
"""Factor of E_proj in the information without the flow; with 0 motions would be free."""
CONTACT = 0.2
"""Standard deviation of the log scale of a component by contact, added to that of the marginals: a
moving object need not touch the surface below it in the image."""
COVERING = 0.5
"""Standard deviation of the log scale of a component that occlusion places in front of what it
covers (`start.occlusion`)."""
USUAL = 0.5
"""Log ratio of the displacement of a component to that of the largest one, relative to the camera,
up to which its scale by contact is credible: see docs/confidence.md."""
FACTOR, POWER = 7.0, 1.25
"""sigma = FACTOR (noise spread)^POWER, with the flow's noise in pixels: docs/confidence.md."""
BENDING_FACTOR = 0.5
"""sigma = BENDING_FACTOR misfit sqrt(spread) where surfaces bend."""
BENDING_SIGMA = 0.235
"""Least standard deviation of log depth where surfaces bend: without a rigid motion, relief follows
from the surface's own stretching and not from parallax."""
LEAST_SPREAD = 0.1
"""Added in squares to spreads where surfaces bend: errors hardly follow smaller ones."""
MOST_MISFIT, BENDING_MISFIT = 5.0, 100.0
"""Largest misfit of a pixel, pixels: larger values carry no information. The second holds where
surfaces bend: each superpixel has a motion of its own there and misses only a wrong flow."""
OUTLINE, OUTLINE_REACH = 0.5, 0.005
"""Share of a step of log depth that is the standard deviation beside it, and the distance from the
step up to which it counts, relative to the longer side of the image."""
MIXED = 0.2
"""Standard deviation of log depth where at most half of a superpixel's flow is usable."""
MARGIN, LEAST_SEEN = 0.01, 0.3
"""Distance from the border of the next image, relative to its width, below which a pixel leaves it,
and the least share of a superpixel's pixels that stay."""
LARGEST = 1e6
"""Largest standard deviation before the prior is added, which dominates larger ones anyway."""
NO_CONFIDENCE = 0.5
"""Sigma from which the confidence, 1 - sigma / `NO_CONFIDENCE`, is 0."""
MIN_CONFIDENCE = 0.5
"""A pixel whose confidence is less is a guess."""
MOST_SIGMA = (1 - MIN_CONFIDENCE) * NO_CONFIDENCE
"""The sigma of that confidence."""


@dataclass(frozen=True, eq=False)
class Confidence:
    """Uncertainty of the depth of an answer.

    Attributes:
        sigma: (H, W) calibrated standard deviation of log depth, the global scale left out.
        spread: (H, W) standard deviation of log depth by the flow's information beside the terms
            on shape, not calibrated.
        marginals: Marginal variances of the planes and of the components' scales.
        component_sigma: (C,) standard deviation of the components' log scale.
        evidence: Evidence of the flow for the depth of every component.
        scale: (N,) standard deviation of log depth by the scales of components and contacts with
            the ground, see `scale_by_contact`.
    """

    sigma: Float
    spread: Float
    marginals: Marginals
    component_sigma: Float
    evidence: Evidence
    scale: Float

    @property
    def guessed(self) -> float:
        """Share of the pixels whose depth is a guess."""
        return float(np.mean(self.sigma > MOST_SIGMA))


def flow_misfit(rec: Reconstruction, flow: Flow, most: Float | float = MOST_MISFIT) -> Float:
    """(N,) mean distance between a flow and the flow that a reconstruction induces, pixels.

    Args:
        rec: The answer.
        flow: The flow of the solve.
        most: Limit of the distances, also where no flow is induced; (H, W) or one number.
    """
    distance = np.linalg.norm(rec.flow - flow.uv, axis=-1)
    limited = np.where(np.isfinite(distance), np.minimum(distance, most), most)
    flat = rec.labels.ravel()
    return np.asarray(np.bincount(flat, limited.ravel()) / np.bincount(flat))


def _log(depth: Float) -> Float:
    """Logarithm of depth; finite, since the answer of a foreign solver may have none."""
    return np.log(np.clip(np.nan_to_num(depth), 1e-30, 1e30))


def at_outlines(depth: Float) -> Float:
    """(H, W) standard deviation of log depth because outlines of surfaces may be misplaced.

    A pixel beside a step may belong to the surface on its other side. With range(r) the range of
    log depth within r pixels, the step is `2 range(r) - range(2 r)`, 0 on a constant slope.
    """
    log_depth = _log(depth)
    reach = max(1, round(OUTLINE_REACH * max(depth.shape)))

    def extent(r: int) -> Float:
        size = 2 * r + 1
        most, least = (f(log_depth, size) for f in (ndimage.maximum_filter, ndimage.minimum_filter))
        return np.asarray(most - least)

    return OUTLINE * np.maximum(2 * extent(reach) - extent(2 * reach), 0.0)


def of_mixed_flow(flow: Flow, labels: Labels, size: tuple[int, int]) -> Float:
    """(N,) standard deviation of log depth where part of a superpixel has no usable flow.

    Such a superpixel may contain a surface without flow of its own: `MIXED 4 p (1 - p)`, with p the
    mean confidence of its pixels that do not leave the image, at least a half.

    Args:
        flow: Flow with confidence.
        labels: (H, W) superpixel of every pixel.
        size: Height and width of the next image.
    """
    (height, width), at = size, labels.ravel()
    v, u = np.indices(labels.shape)
    end = np.stack([u, v], axis=-1) + flow.uv
    margin = MARGIN * width
    last = np.array([width, height]) - 1 - margin
    stays = ((end > margin) & (end < last)).all(axis=-1).ravel()
    count, seen = np.bincount(at), np.bincount(at, stays)
    usable = np.bincount(at, np.where(stays, flow.confidence.ravel(), 0.0))
    p = np.maximum(usable / np.maximum(seen, 1), 0.5)
    return np.where(seen > LEAST_SEEN * count, MIXED * 4 * p * (1 - p), 0.0)


def calibrated(
    spread: Float,
    noise: float,
    misfit: Float | float = 0.0,
    prior: Float | float = SIGMA_PRIOR,
    bends: Mask | bool = False,
    added: Float | float = 0.0,
) -> Float:
    """Calibrated standard deviation of log depth.

    Where surfaces bend every superpixel has a motion of its own, which fits nearly any flow. There
    errors depend little on the spread and strongly on the misfit.

    Args:
        spread: Standard deviation of log depth by the marginals.
        noise: Noise of the flow, pixels.
        misfit: Misfit of the superpixel, pixels; where it is larger than the noise, the geometric
            mean of both replaces the noise.
        prior: Standard deviation without the flow; its information is added.
        bends: True where regions bend; of the same shape, or one value.
        added: Standard deviation of log depth that does not depend on the flow's random noise, by
            scales from contact and undetermined motions; added in squares.
    """
    # where regions bend small values have no hard limit, so that they keep their order
    root = np.sqrt(np.hypot(LEAST_SPREAD, spread))
    bending = BENDING_FACTOR * np.hypot(LEAST_NOISE, misfit) * root
    rigid = FACTOR * (np.sqrt(noise * np.maximum(noise, misfit)) * spread) ** POWER
    sigma = np.where(bends, bending, rigid)
    return with_prior(np.hypot(sigma, added), prior)


def with_prior(sigma: Float, prior: Float | float = SIGMA_PRIOR) -> Float:
    """Standard deviation s with a prior's information added: `1 / s^2 + 1 / prior^2`."""
    sigma = np.minimum(sigma, LARGEST)
    return np.asarray(sigma / np.hypot(1.0, sigma / prior))


def by_start(rec: Reconstruction, start: Start, anchor_ray: Float) -> Float:
    """(N,) standard deviation of log depth because two estimates from the same flow differ.

    The answer balances all terms; the initialisation triangulates with motions of the flow alone.
    The log ratio of their depths counts without its median in the component. It is 0 where regions
    bend, since the initialisation is rough there.

    Args:
        rec: The answer.
        start: The initialisation.
        anchor_ray: (N, 3) rays through the anchors.
    """
    ratio = _log(rec.soup.depth_at(anchor_ray)) - _log(start.soup.depth_at(anchor_ray))
    middle = ndimage.median(ratio, start.component, np.arange(int(start.component.max()) + 1))
    return np.where(start.bends, 0.0, np.abs(ratio - np.asarray(middle)[start.component]))


def by_ground(off_ground: Float) -> Float:
    """(N,) standard deviation of log depth because regions may stand on the ground, or not.

    The depth of a region is its own or that of the ground below it: the log ratio (N,) of both
    (`start.ground.off_ground`) counts, in squares without what regions with the right depth have.
    """
    return np.sqrt(np.maximum(off_ground**2 - STANDS**2, 0.0))


def scale_by_contact(
    variances: Marginals, start: Start, sizes: Int, far: Float, given_depth: Given | None = None
) -> Float:
    """(N,) standard deviation of log depth by the scales of components.

    A scale from contact has the marginal variance plus `CONTACT` squared; a scale from a depth
    prior has the prior's standard deviation. An error of a scale also shifts the mean log depth of
    the image, to which all depths refer, in proportion to the component's area. Where contact makes
    a component move farther than the largest one does, by a log ratio (`log_pace`) above `USUAL`,
    the component may be anywhere between there and where both move equally far, and that log ratio
    is added in squares. A component that occlusion has placed has at least `COVERING`, and does not
    count for the mean. What does not stand on the ground below it has `by_ground`, added in
    squares.

    Args:
        variances: Marginal variances of the components' scales.
        start: Components and the origin of each scale.
        sizes: (N,) pixels of every superpixel.
        far: (N,) displacement relative to the camera (`start.pace.displacement`).
        given_depth: A depth prior.
    """
    placed = start.tie == TIES.index("occlusion")
    contact = (start.tie != TIES.index("reference")) & (start.tie != FIXED) & ~placed
    scale = np.where(contact, np.hypot(np.sqrt(variances.component)[start.component], CONTACT), 0.0)
    if given_depth is not None:
        by_prior = (start.tie == TIES.index("given depth")) & np.isfinite(given_depth.sigma)
        scale = np.where(by_prior, given_depth.sigma, scale)
    mean = float(np.sum(sizes * np.minimum(scale, SIGMA_PRIOR)) / np.sum(sizes))
    pace = log_pace(far, start.component)[start.component]
    fast = (contact | placed) & (pace > USUAL) & (start.tie != TIES.index("given depth"))
    open_scale = np.maximum(np.where(fast, pace, 0.0), np.where(placed, COVERING, 0.0))
    if start.off_ground is not None:
        open_scale = np.hypot(open_scale, by_ground(start.off_ground))
    return np.hypot(np.hypot(scale, mean), open_scale)


def confidence(
    rec: Reconstruction,
    pair: Pair,
    start: Start,
    data: EnergyData,
    weights: Weights,
    form: FormulationOptions,
    given_depth: Given | None = None,
) -> Confidence:
    """The uncertainty of the depth of an answer.

    Args:
        rec: The answer.
        pair: Intrinsics, and the flow of the solve.
        start: Rigid components and the flow's noise.
        data: Pixels, graphs and weights of the pair.
        weights: Constants of the energy.
        form: Visibility.
        given_depth: A depth prior, a measurement with its own error.
    """
    assert pair.flow is not None
    sizes = np.bincount(rec.labels.ravel())
    weak = weights.replace(prior=PRIOR_SHARE * weights.prior, depth=0.0, order=0.0)
    blind = weak.replace(proj=FLOW_SHARE * weights.proj)
    try:
        infos = [information(rec.soup, data, w, form) for w in (weak, blind)]
        with_flow, without_flow = (marginals(info, sizes, start.component) for info in infos)
        spread_with, spread_without = (
            spread_in_image(info, m.plane, rec.labels, pair.K_ref)
            for info, m in zip(infos, (with_flow, without_flow), strict=True)
        )
        spread = np.sqrt(learned(spread_with**2, spread_without**2))
        with_flow = replace(
            with_flow, component=learned(with_flow.component, without_flow.component)
        )
    except (ModelError, ArithmeticError) as error:
        # a foreign solver may return an answer without finite information
        log.warning("no uncertainty can be computed, all depth counts as a guess: %s", error)
        with_flow = Marginals(
            np.full((len(rec.soup), 3, 3), np.inf),
            np.full(int(start.component.max()) + 1, np.inf),
        )
        spread = np.full(rec.labels.shape, np.inf)
    bends = start.bends[rec.labels]
    most = np.where(bends, BENDING_MISFIT, MOST_MISFIT)
    noise, misfit = start.noise, flow_misfit(rec, pair.flow, most)
    rigid = ~start.bends & (start.tie != FIXED) & (not start.at_rest)
    by_pair = start.component, noise, pair.focal_sigma, rigid
    flow_evidence = evidence(rec.soup, data, *by_pair)
    far = displacement(rec.soup, data.anchor_ray, start.component)
    scale = scale_by_contact(with_flow, start, sizes, far, given_depth)
    by_motion = np.hypot(scale, flow_evidence.sigma)
    added = np.where(start.bends, np.maximum(scale, BENDING_SIGMA), by_motion)
    guess = flow_evidence.guess[start.component] | start.unexplained | start.at_rest
    guess |= start.tie == FIXED
    added = np.hypot(added, np.where(guess, GUESSED, 0.0))
    added = np.hypot(added, by_start(rec, start, data.anchor_ray))
    before = np.full(len(added), SIGMA_PRIOR)
    if given_depth is not None:
        # where the depth is that of a prior which no flow confirms, the flow is no evidence
        added[np.isfinite(given_depth.sigma) & (given_depth.sigma > MOST_SIGMA)] = LARGEST
        before = 1 / np.hypot(1 / SIGMA_PRIOR, 1 / given_depth.sigma)
    added = np.hypot(added, of_mixed_flow(pair.flow, rec.labels, pair.image_next.shape[:2]))
    in_image = np.hypot(added[rec.labels], at_outlines(rec.depth_ref))
    sigma = calibrated(spread, noise, misfit[rec.labels], before[rec.labels], bends, in_image)
    component_sigma = with_prior(np.sqrt(with_flow.component))
    return Confidence(sigma, spread, with_flow, component_sigma, flow_evidence, scale)
