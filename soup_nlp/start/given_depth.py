"""A start by a depth prior: the depths, slopes and scales that it decides.

See docs/depth_prior.md. `start.prior_evidence` gives the evidence of flow and image for it.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.spatial.distance import cdist

from soup_nlp.arrays import Float, Mask
from soup_nlp.data.pair import Pair
from soup_nlp.geometry.graph import Segmentation
from soup_nlp.geometry.soup import Soup
from soup_nlp.start.bending import least_gap
from soup_nlp.start.epipolar import LEAST_MATCHES
from soup_nlp.start.labelling import PIECE_SIZE
from soup_nlp.start.prior_evidence import (
    JUDGED_PIECES,
    LEAST_SIGMA,
    PriorEvidence,
    StartWithFlow,
    without_gaps,
)
from soup_nlp.start.propose import Start
from soup_nlp.start.regions import FIXED, ORIGINS, SCENE
from soup_nlp.start.views import FlowFit

HELD_SHARE, NEAR_SHARE = PIECE_SIZE / JUDGED_PIECES, 0.1
"""Weight of the whole image's error beside residuals, as a share of its area; standard deviation of
the distance up to which a residual counts, relative to the square root of that area."""
SLOPE_REACH = 4
"""Pixels to either side between which a prior's slope is a difference."""


@dataclass(frozen=True, eq=False)
class GivenDepth:
    """A depth prior as the start uses it.

    Attributes:
        evidence: Evidence of flow and image for it.
        log_depth: (N,) log depth at the anchors, up to a common scale.
        sigma: (N,) its standard deviation, estimated from the flow; inf where it decides nothing.
        ambiguity: (N,) how far the flow leaves the shape of a component open, 0 to 1.
        error: (N,) standard deviation of log depth by which E_depth weighs the prior.
        from_prior: (N,) True where depth or scale of the start are the prior's.
    """

    evidence: PriorEvidence
    log_depth: Float
    sigma: Float
    ambiguity: Float
    error: Float
    from_prior: Mask

    def as_dict(self) -> dict[str, Any]:
        """Numbers for summary.json; NaN for the ratio where the flow is no evidence."""
        e = self.evidence
        numbers = {"used": e.used, "kind": e.kind, "ratio": e.ratio, "overall": e.sigma}
        return {**numbers, "held": float(self.from_prior.mean())}


def by_prior(
    start: Start, pair: Pair, flow: FlowFit, evidence: PriorEvidence
) -> tuple[Start, GivenDepth]:
    """The start with depths and scales of the pair's prior where the flow leaves them open.

    Every rigid component, the scene first, takes its shape and motion from flow and prior and its
    scale from the prior. Depths of the scene that the flow determines correct the
    prior near them and tell its error. All superpixels whose depth the flow does not determine,
    and those that bend, take depth and slope of the prior.
    """
    seg, anchor, n = flow.seg, flow.views.anchor, len(flow.seg)
    value, with_value, whole = without_gaps(pair, seg)
    prior, sigma = evidence.log_depth(value), np.full(n, evidence.sigma)
    if not evidence.used:
        return start, GivenDepth(evidence, prior, sigma, np.zeros(n), sigma, np.zeros(n, bool))
    both, main = StartWithFlow(start, flow), start.component == SCENE
    soup, before = start.soup, np.log(start.soup.depth_at(anchor))
    # components that are fixed in the image keep their depth relative to the scene
    fixed = start.origin == FIXED
    off, from_flow = np.zeros(n), fixed.copy()
    for c in np.unique(start.component[~start.bends & ~fixed]):
        determined = evidence.determined if c == SCENE else both.relief(c) > least_gap(start.noise)
        soup, own = _shaped(both, soup, c, prior, evidence.sigma, determined)
        from_flow |= own
        if not own.any():
            continue
        gap = np.log(soup.depth_at(anchor)) - prior
        off[start.component == c] = np.median(gap[own])
        if c == SCENE:
            shift, sigma = _local(seg, own & with_value, gap - off, evidence.sigma)
            prior = np.where(main, prior + shift, prior)
    off[fixed] = np.median((before - prior)[main])
    # surfaces that bend have a motion for every superpixel, which grows with its depth
    off = np.where(start.bends, before - prior, off)
    sigma = np.where(fixed | ~with_value, np.inf, sigma)
    noise = start.noise / np.maximum(flow.views.parallax(soup), 1e-3)
    ambiguity = np.where(from_flow & ~fixed, 1 / (1 + (sigma / noise) ** 2) ** 2, 1.0)
    from_prior = ~fixed & ~(main & from_flow)
    # a superpixel has the translation of its component, whatever its depth
    scaled = replace(soup, lam=soup.lam * np.exp(-off))
    slope = _slopes(np.exp(-evidence.log_depth(whole)), pair, seg) * flow.views.radius[:, None]
    tilted = flow.views.soup(np.exp(-prior), slope, soup.R, scaled.translation)
    soup = scaled.taking(tilted, ~from_flow).normalised()
    origin = np.where(from_prior & ~main, ORIGINS.index("given depth"), start.origin)
    # without a flow to weigh it against, terms on shape must not undo the prior
    error = sigma if evidence.determined else np.where(np.isfinite(sigma), LEAST_SIGMA, np.inf)
    decides = np.where(from_prior, sigma, np.inf)
    given = GivenDepth(evidence, prior, decides, ambiguity, error, from_prior)
    return replace(start, soup=soup, origin=origin), given


def _shaped(
    both: StartWithFlow, soup: Soup, c: int, prior: Float, sigma: float, determined: bool
) -> tuple[Soup, Mask]:
    """Soup with the planes and the motion of a rigid component by flow and prior, see `refitted`.

    Unless the flow has determined the depth of component `c`, it takes the motion that fits the log
    depth (N,) of the prior.
    """
    start, use, views = both.start, both.members(c), both.flow.views
    mask = start.component == c
    rigid = np.ptp(soup.R[mask], axis=0).max() < 1e-9 and np.any(soup.translation[mask][0])
    if len(use) < LEAST_MATCHES or not rigid:
        own = mask & ~start.interpolated
        return soup, own if own.any() else mask
    if not determined:
        _, R, T, _ = both.motion(use, np.exp(-prior[use]))
        by_prior = views.soup(np.exp(-prior), np.zeros((len(prior), 2)), R, T)
        return soup.taking(by_prior, mask), np.zeros(len(mask), bool)
    return both.refitted(soup, c, prior, sigma)


def _slopes(inverse: Float, pair: Pair, seg: Segmentation) -> Float:
    """(N, 2) relative slopes of an inverse depth (H, W) in superpixels, per ray unit.

    They are medians of differences, so that a step inside a superpixel does not tilt its plane.
    """

    def along_rows(values: Float, focal: float) -> Float:
        reach, span = (SLOPE_REACH, SLOPE_REACH), 2 * SLOPE_REACH
        wide = np.pad(values, ((0, 0), reach), mode="reflect", reflect_type="odd")
        return focal * (wide[:, span:] - wide[:, :-span]) / span

    K, index = pair.K_ref, np.arange(len(seg))
    change = along_rows(inverse, K[0, 0]), along_rows(inverse.T, K[1, 1]).T
    out = np.stack([ndimage.median(d, seg.labels, index) for d in change], axis=1)
    return np.asarray(out / ndimage.mean(inverse, seg.labels, index)[:, None])


def _local(seg: Segmentation, known: Mask, residual: Float, sigma: float) -> tuple[Float, Float]:
    """(N,) correction of a prior's log depth by known depths near it, and its standard deviation.

    A Gaussian window averages the residuals (N,), log ratios of depths that are known (N,) to the
    prior's, and their squares, beside `HELD_SHARE` of none and sigma^2, that of the whole image.
    """
    area = seg.labels.size
    squared = cdist(seg.anchors, seg.anchors[known], "sqeuclidean")
    weight = np.exp(-0.5 * squared / (NEAR_SHARE**2 * area)) * seg.sizes[known] / area
    total = HELD_SHARE + weight.sum(axis=1)
    mean = weight @ residual[known] / total
    variance = (HELD_SHARE * sigma**2 + weight @ residual[known] ** 2) / total - mean**2
    return mean, np.sqrt(np.maximum(variance, LEAST_SIGMA**2))
