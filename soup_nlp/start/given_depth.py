"""A start by a depth prior: the depths, slopes and scales that it decides.

See docs/depth_prior.md. `start.prior_evidence` gives the evidence of flow and image for it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from soup_nlp.arrays import Float, Mask
from soup_nlp.data.pair import Pair
from soup_nlp.geometry.graph import Segmentation
from soup_nlp.geometry.plane import about_anchor, normal_and_distance
from soup_nlp.geometry.soup import Soup
from soup_nlp.start.choice import CLIP, PIECE_SIZE
from soup_nlp.start.components import FIXED, TIES, largest
from soup_nlp.start.epipolar import Motion
from soup_nlp.start.prior_evidence import FEWEST, LEAST_SIGMA, Evidence, Seen, without_gaps
from soup_nlp.start.propose import Start
from soup_nlp.start.settle import MOST_SYSTEMATIC_PX, SYSTEMATIC, most_probable
from soup_nlp.start.views import LEAST_PARALLAX_PX, FlowFit

STANDS = {"contact below": 0.7, "ground": 0.7, "outline": 0.4, "cut off below": 0.4}
"""Probability that the scale of a component by contact is right, by its origin (`TIES`)."""
RIGHT, WRONG = 0.05, 0.5
"""Standard deviation of the log of such a scale if it is right, and if it is not."""
HELD, NEAR = 4.0, 15
"""Weight of the whole component's error beside the residuals of NEAR neighbours."""
REACH, STEEPEST = 4, 0.5
"""Pixels to either side between which a prior's slope is a difference, and the largest change of
relative inverse depth from the middle of a superpixel to its border."""


@dataclass(frozen=True, eq=False)
class Given:
    """A depth prior as the start uses it.

    Attributes:
        evidence: Evidence of flow and image for it.
        log_depth: (N,) log depth at the anchors, up to a common scale.
        sigma: (N,) its standard deviation, estimated from the flow; inf where it decides nothing.
        opened: (N,) how far the flow leaves the shape of a component open, 0 to 1.
        error: (N,) standard deviation of log depth by which E_depth weighs the prior.
        held: (N,) True where depth or scale of the start are the prior's.
    """

    evidence: Evidence
    log_depth: Float
    sigma: Float
    opened: Float
    error: Float
    held: Mask

    def as_dict(self) -> dict[str, Any]:
        """Numbers for summary.json; NaN for the ratio where the flow is no evidence."""
        e = self.evidence
        numbers = {"used": e.used, "kind": e.kind, "ratio": e.ratio, "overall": e.sigma}
        return {**numbers, "held": float(self.held.mean())}


def by_prior(
    start: Start, seg: Segmentation, pair: Pair, fitted: FlowFit, evidence: Evidence
) -> tuple[Start, Given]:
    """The start with depths and scales of the pair's prior where the flow leaves them open.

    Args:
        start: Start without the prior.
        seg: Superpixels and graphs.
        pair: Images and depth prior.
        fitted: The flow as affine maps.
        evidence: Evidence of flow and image for the prior.
    """
    n, sigma = len(seg), evidence.sigma
    value, with_value, whole = without_gaps(pair, seg)
    prior = evidence.log_depth(value)
    if not evidence.used:
        never = np.full(n, np.inf)
        return start, Given(evidence, prior, never, np.zeros(n), never, np.zeros(n, bool))
    seen, main = Seen(start, fitted), largest(start.component)
    soup, anchor = start.soup, fitted.views.anchor
    before = np.log(soup.depth_at(anchor)) - prior
    contact = np.median(before[start.component == main])
    # components that are fixed in the image keep their depth relative to the scene
    fixed = start.tie == FIXED
    from_prior, opened, strong = np.zeros(n, bool), np.ones(n), fixed.copy()
    sigmas = np.where(fixed | ~with_value, np.inf, sigma)
    # surfaces that bend have a motion for every superpixel, which grows with its depth
    off = np.where(start.bends, before, np.where(fixed, contact, 0.0))
    for c in np.unique(start.component[~start.bends & ~fixed]):
        at = np.flatnonzero(start.component == c)
        determined = evidence.determined if c == main else seen.relief(int(c))[0] > seen.tells
        soup, strong[at] = _settled(seen, soup, int(c), prior, sigma, determined)
        firm = at[strong[at]]
        if not len(firm):
            continue
        residual = np.log(soup.depth_at(anchor)[firm]) - prior[firm]
        off[at] = np.median(residual)
        local = _local(anchor[at, :2], strong[at], residual - off[firm], sigma)
        sigmas[at] = np.where(with_value[at], local, np.inf)
        flow = (start.noise / np.maximum(fitted.views.parallax(soup)[at], 1e-3)) ** 2
        opened[at] = np.where(strong[at], flow / (flow + local**2), 1.0)
        if c != main:
            gap = float(np.median(before[at])) - contact
            # a contact is no evidence where depths of the scene are the prior's
            stands = STANDS.get(TIES[start.tie[at[0]]], 0.0) if evidence.determined else 0.0
            keep = _kept(gap, sigma, stands)
            off[at] -= keep * gap
            prior[at] += keep * gap
            from_prior[at] = keep < 0.5
    from_prior |= ~strong
    # a superpixel has the translation of its component, whatever its depth
    scaled = replace(soup, lam=soup.lam * np.exp(-off))
    planes = about_anchor(
        np.exp(prior), _slopes(np.exp(-evidence.log_depth(whole)), pair, seg), anchor
    )
    normal, D = normal_and_distance(planes)
    tilted = Soup(D, normal, np.ones(n), soup.R, scaled.translation / D[:, None])
    soup = scaled.taking(tilted, ~strong).normalised()
    tie = np.where(from_prior & (start.component != main), TIES.index("given depth"), start.tie)
    # without a flow to weigh it against, terms on shape must not undo the prior
    error = sigmas if evidence.determined else np.where(np.isfinite(sigmas), LEAST_SIGMA, np.inf)
    decides = np.where(from_prior, sigmas, np.inf)
    return replace(start, soup=soup, tie=tie), Given(
        evidence, prior, decides, opened, error, from_prior
    )


def _slopes(inverse: Float, pair: Pair, seg: Segmentation) -> Float:
    """(N, 2) relative slopes of an inverse depth (H, W) in superpixels, per ray unit.

    They are medians of differences, so that a step inside a superpixel does not tilt its plane.
    """

    def along_rows(values: Float, focal: float) -> Float:
        wide = np.pad(values, ((0, 0), (REACH, REACH)), mode="reflect", reflect_type="odd")
        return focal * (wide[:, 2 * REACH :] - wide[:, : -2 * REACH]) / (2 * REACH)

    K, index = pair.K_ref, np.arange(len(seg))
    change = along_rows(inverse, K[0, 0]), along_rows(inverse.T, K[1, 1]).T
    out = np.stack([ndimage.median(d, seg.labels, index) for d in change], axis=1)
    out /= ndimage.mean(inverse, seg.labels, index)[:, None]
    steep = np.linalg.norm(out, axis=1) * np.sqrt(seg.sizes / np.pi) / K[0, 0]
    return np.asarray(out / np.maximum(1.0, steep / STEEPEST)[:, None])


def _settled(
    seen: Seen, soup: Soup, c: int, prior: Float, sigma: float, determined: bool
) -> tuple[Soup, Mask]:
    """Soup with the planes and the motion of a rigid component by flow and prior.

    Of the motions that explain the flow about as well, it takes the one that agrees with the prior.
    Where any depth explains the flow, it takes the motion that fits the depths of the prior.

    Args:
        seen: The start and its flow.
        soup: Planes and motions so far.
        c: The component.
        prior: (N,) log depth.
        sigma: Its standard deviation.
        determined: Whether the flow determines the depth of the component.

    Returns:
        The soup, and for every member of the component whether the flow determines its depth.
    """
    start, views = seen.start, seen.fitted.views
    mask = start.component == c
    at, use = np.flatnonzero(mask), seen.members(c)
    T = soup.translation[at[0]]
    length, rigid = float(np.linalg.norm(T)), np.ptp(soup.R[at], axis=0).max() < 1e-9
    all_members = np.ones(len(at), bool)
    if len(use) < FEWEST or not rigid or not length > 0:
        return soup, all_members if start.borrowed[at].all() else ~start.borrowed[at]
    _, R, T_prior, _ = seen.motion(use, np.exp(-prior[use]))
    flat = np.zeros((len(prior), 2))
    if not determined:
        return soup.taking(views.soup(np.exp(-prior), flat, R, T_prior), mask), ~all_members
    error = min(SYSTEMATIC * start.noise, MOST_SYSTEMATIC_PX)
    tried = Motion(soup.R[at[0]], T / length), Motion(R, T_prior / np.linalg.norm(T_prior))
    best = most_probable(tried, seen.fitted.anchor_matches(use), error, prior[use], sigma)
    planes = views.fit([best])
    mu, cost = planes.inverse_depth[:, 0], planes.cost[:, 0]
    strong = (mu > 0) & (planes.parallax[:, 0] * mu > LEAST_PARALLAX_PX) & (cost < CLIP)
    strong &= seen.usable & mask
    if strong.sum() < PIECE_SIZE:
        return soup, all_members
    mu, slope = np.where(strong, mu, 1.0), np.where(strong[:, None], planes.slope[:, 0], flat)
    return soup.taking(views.soup(mu, slope, best.R, best.t), mask), strong[at]


def _kept(gap: float, sigma: float, stands: float) -> float:
    """Weight of the scale by contact in a component's scale, beside the scale by the prior.

    The scale by contact is right (`RIGHT`) with the probability `stands`, else wrong (`WRONG`); the
    gap of its log to the prior, which has the deviation `sigma`, updates these odds.
    """
    spread = np.hypot(sigma, [RIGHT, WRONG])
    odds = np.array([stands, 1 - stands]) * np.exp(-0.5 * (gap / spread) ** 2) / spread
    return float(odds[0] / odds.sum() * sigma**2 / spread[0] ** 2)


def _local(position: Float, strong: Mask, residual: Float, sigma: float) -> Float:
    """(K,) standard deviation of a prior by its residuals in log depth at the nearest known depths.

    `position` (K, 2) are a component's anchors, `strong` (K,) marks the known depths, which have
    residuals, and `sigma` is the deviation in the whole component.
    """
    near = min(NEAR, len(residual))
    index = cKDTree(position[strong]).query(position, k=near)[1].reshape(len(position), near)
    squared = np.minimum(residual**2, 1.0)[index].sum(axis=1)
    return np.maximum(np.sqrt((HELD * sigma**2 + squared) / (HELD + near)), LEAST_SIGMA)
