"""Uncertainty of depth: marginal variances of the whole assembly, and what they cannot know.

See docs/confidence.md. All standard deviations are of log depth, the global scale left out. The
factors are fitted by `python -m benchmarks sigma`, which leaves out one family after the other.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from soup_nlp.arrays import Float, Image, Mask
from soup_nlp.data.formats.images import warn
from soup_nlp.data.pair import Flow, Pair
from soup_nlp.errors import ModelError
from soup_nlp.evaluation.evidence import Evidence, evidence
from soup_nlp.evaluation.information import information, marginals, spread_in_image
from soup_nlp.geometry.soup import Reconstruction
from soup_nlp.geometry.surface import hidden
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.formulation import FormulationOptions
from soup_nlp.start.epipolar import relief_spread
from soup_nlp.start.given_depth import GivenDepth
from soup_nlp.start.propose import Start
from soup_nlp.start.regions import FIXED, SCENE

FACTORS = {
    "flow": 2.5,
    "scale": 1.5,
    "outline": 0.45,
    "mixed": 0.1,
    "bends": 0.18,
    "drawn": 0.55,
    "prior": 1.2,
}
"""Constants of sigma: factors of the terms, and the standard deviations of log depth of what is
drawn, and within a scene without any evidence; see `sigma_of`."""
ADDED = ("flow", "scale", "relief", "outline", "mixed", "starts", "camera", "bends")
"""Terms whose squares are added up; those without a factor are standard deviations as they are."""
CORRELATED = ("relief", "camera")
"""Terms of errors that a whole component shares: they bend its relief, and neighbours tell nothing
of them."""
MISFIT, MOST_MISFIT = 2.0, 5.0
"""Misfits count as this many times as much noise, and the largest misfit of a pixel, pixels: larger
values carry no information."""
OUTLINE_REACH = 0.005
"""Distance from a step of depth up to which it counts, relative to the longer side of the image."""
PRIOR_SHARE = 0.001
"""Factor of E_prior in the information: it is no evidence, but keeps variances finite where there
is none."""
LARGEST = 1e6
"""Largest standard deviation before the prior is added, which dominates larger ones anyway."""
NO_CONFIDENCE = 0.5
"""Sigma from which the confidence, 1 - sigma / `NO_CONFIDENCE`, is 0."""
MIN_CONFIDENCE = 0.5
"""Least confidence of a pixel of a cloud."""
MOST_SIGMA = (1 - MIN_CONFIDENCE) * NO_CONFIDENCE
"""The sigma of that confidence."""
KINDS = ("measured", "inferred", "drawn")
"""By what the depth of a pixel is known. Measured: by parallax, in the static scene. Inferred: from
a contact or an order (what moves by itself), from a surface that is continued where no flow can be
used or nothing is seen of it in the next frame, from how a surface bends, or from a given depth.
Drawn: nothing tells it."""


@dataclass(frozen=True, eq=False)
class Confidence:
    """Uncertainty of the depth of an answer.

    Attributes:
        sigma: (H, W) standard deviation of log depth, the global scale left out.
        spread: (H, W) standard deviation of log depth by the marginals, not calibrated.
        plane: (N, 3, 3) marginal covariance of relative inverse depth and slopes.
        component_sigma: (C,) standard deviation of the components' log scale.
        own_sigma: (N,) root mean square of sigma in a superpixel without the terms `CORRELATED`.
        evidence: Evidence of the flow for the camera.
        terms: (H, W) terms of sigma by name, without their factors, see `terms`.
        kind: (H, W) by what the depth is known, an index of `KINDS`.
    """

    sigma: Float
    spread: Float
    plane: Float
    component_sigma: Float
    own_sigma: Float
    evidence: Evidence
    terms: Mapping[str, Float]
    kind: Image

    def share(self, kind: str) -> float:
        """Share of the pixels of one of `KINDS`."""
        return float(np.mean(self.kind == KINDS.index(kind)))


def flow_misfit(rec: Reconstruction, flow: Flow) -> Float:
    """(N,) mean distance between a flow and the flow that a reconstruction induces, pixels.

    A pixel counts at most `MOST_MISFIT`, also where no flow is induced.
    """
    distance = np.linalg.norm(rec.flow - flow.uv, axis=-1)
    limited = np.where(np.isfinite(distance), np.minimum(distance, MOST_MISFIT), MOST_MISFIT)
    flat = rec.labels.ravel()
    return np.asarray(np.bincount(flat, limited.ravel()) / np.bincount(flat))


def at_outlines(depth: Float) -> Float:
    """(H, W) steps of log depth near every pixel, which may belong to the surface on either side.

    With range(r) the range of log depth within r pixels, the step is `2 range(r) - range(2 r)`, 0
    on a constant slope.
    """
    # finite, since the answer of a foreign solver may have none
    log_depth = np.log(np.clip(np.nan_to_num(depth), 1e-30, 1e30))
    reach = max(1, round(OUTLINE_REACH * max(depth.shape)))
    near, wide = (ndimage.morphological_gradient(log_depth, 2 * r + 1) for r in (reach, 2 * reach))
    return np.maximum(2 * near - wide, 0.0)


def with_prior(sigma: Float, prior: Float | float = FACTORS["prior"]) -> Float:
    """Standard deviation s with a prior's information added: `1 / s^2 + 1 / prior^2`."""
    sigma = np.minimum(sigma, LARGEST)
    return np.asarray(sigma / np.hypot(1.0, sigma / prior))


def sigma_of(terms: Mapping[str, Float], factor: Mapping[str, float] = FACTORS) -> Float:
    """Standard deviation of log depth by its terms, see `terms`, and `FACTORS`.

    What is drawn has one number. Elsewhere it is the root of the sum of the squares of the terms
    times their factors, to which the information of a prior is added.
    """
    squares = sum((factor.get(name, 1.0) * terms[name]) ** 2 for name in ADDED)
    known = with_prior(np.sqrt(squares), factor["prior"])
    return np.where(terms["drawn"] > 0, factor["drawn"], known)


def terms(
    rec: Reconstruction,
    flow: Flow,
    start: Start,
    anchor_ray: Float,
    spread: Float,
    component: Float,
    sure: Evidence,
) -> dict[str, Float]:
    """(H, W) terms of the standard deviation of log depth by name, without their factors.

    * flow: `sqrt(noise max(noise, MISFIT misfit)) spread`. The random error of the flow, pixels,
      times the standard deviation by the marginals. The misfit is that of the answer.
    * scale: standard deviation of the log scale of a component beside the scene, by the marginals.
    * relief: standard deviation by the motion of a rigid component, see `Start.covariance`. A small
      turn and a small translation move an image almost alike, so that an error that a flow shares
      stretches or flattens relief (bas-relief).
    * outline: step of log depth nearby.
    * mixed: `4 p (1 - p)`, p the share of usable flow of the superpixel, at least a half: two
      surfaces may share it.
    * starts: root mean square difference of log depth between the starts from several samples of
      the flow, see `Start.scatter`.
    * camera: standard deviation by errors of the camera.
    * bends: 1 where surfaces bend: relief follows from their own stretching, not from parallax.
    * drawn: 1 where nothing tells the depth: the camera rests or only turns, something stands still
      in the image, or a surface is taken to bend although its flow jumps (`Start.unexplained`).

    By the marginals are the standard deviations of log depth, `spread` (H, W), and of the mean log
    depth of a `component` (C,). The anchors have rays (N, 3).
    """
    labels, noise, part = rec.labels, start.noise, start.component
    at = labels.ravel()
    usable = np.maximum(np.bincount(at, flow.confidence.ravel()) / np.bincount(at), 0.5)
    target, relief = rec.soup.moved(rec.soup.points(anchor_ray)), np.zeros(len(part))
    for c in np.unique(start.motion[start.motion >= 0]):
        of = start.motion == c
        motion = start.motions[c], start.covariance[c]
        relief[of] = relief_spread(*motion, anchor_ray[of], target[of])
    other = part != SCENE
    drawn = start.at_rest | (start.origin == FIXED) | (start.bends & start.unexplained)
    local = np.sqrt(noise * np.maximum(noise, MISFIT * flow_misfit(rec, flow)))
    return {
        "flow": local[labels] * np.minimum(spread, LARGEST),
        "scale": (other * np.minimum(component, LARGEST)[part])[labels],
        "relief": np.nan_to_num(relief, nan=LARGEST)[labels],
        "outline": at_outlines(rec.depth_ref),
        "mixed": (4 * usable * (1 - usable))[labels],
        "starts": np.broadcast_to(start.scatter, len(part))[labels],
        "camera": np.minimum(sure.sigma, LARGEST)[labels],
        "bends": start.bends[labels].astype(float),
        "drawn": drawn[labels].astype(float),
    }


def kinds(rec: Reconstruction, flow: Flow, start: Start, drawn: Mask, given: Mask) -> Image:
    """(H, W) indices of `KINDS`; drawn (H, W) where nothing tells the depth, `given` (N,) where a
    given one decides."""
    by_others = (start.component != SCENE) | start.bends | start.interpolated | given
    inferred = by_others[rec.labels] | (flow.confidence <= 0) | hidden(rec)
    return np.where(drawn, 2, inferred).astype(np.uint8)


def confidence(
    rec: Reconstruction,
    pair: Pair,
    start: Start,
    data: EnergyData,
    weights: Weights,
    form: FormulationOptions,
    given_depth: GivenDepth | None = None,
) -> Confidence:
    """The uncertainty of the depth of an answer on a pair with the flow of its solve.

    The information of a depth prior, a measurement with its own error, is added to that of
    `sigma_of`.
    """
    assert pair.flow is not None
    labels = rec.labels
    found = weights.replace(prior=PRIOR_SHARE * weights.prior, depth=0.0, order=0.0)
    try:
        info = information(rec.soup, data, found, form)
        plane, variance = marginals(info, np.bincount(labels.ravel()), start.component)
        spread = spread_in_image(info, plane, labels, pair.K_ref)
    except (ModelError, ArithmeticError) as error:
        # a foreign solver may return an answer without finite information
        warn("sigma", f"no uncertainty can be computed, all depth counts as drawn: {error}")
        shapes = (len(rec.soup), 3, 3), int(start.component.max()) + 1, labels.shape
        plane, variance, spread = (np.full(shape, np.inf) for shape in shapes)
    rigid = ~start.bends & (start.origin != FIXED) & (not start.at_rest)
    sure = evidence(rec.soup, data, start.component, pair.focal_sigma, rigid)
    component = np.sqrt(variance)
    known = terms(rec, pair.flow, start, data.anchor_ray, spread, component, sure)
    sigma = sigma_of(known)
    given = np.zeros(len(rec.soup), bool)
    if given_depth is not None:
        # where the depth is that of a prior which no flow confirms, the flow is no evidence
        alone = np.isfinite(given_depth.sigma) & (given_depth.sigma > MOST_SIGMA)
        sigma = with_prior(
            np.where(alone[labels], FACTORS["prior"], sigma), given_depth.sigma[labels]
        )
        given = given_depth.from_prior
    # what is as uncertain as a drawing is one
    nothing = ((known["drawn"] > 0) & ~given[labels]) | (sigma >= FACTORS["drawn"])
    kind = kinds(rec, pair.flow, start, nothing, given)
    own = sigma_of(known | {name: np.zeros(labels.shape) for name in CORRELATED})
    squares = np.bincount(labels.ravel(), own.ravel() ** 2) / np.bincount(labels.ravel())
    scale = with_prior(component)
    return Confidence(sigma, spread, plane, scale, np.sqrt(squares), sure, known, kind)
