"""A start by a depth prior: the depths, slopes and scales that it decides.

See docs/depth_prior.md. It decides what the flow leaves open if the flow confirms it, or, where the
flow says nothing, if its steps lie on edges of the image (`start.prior_evidence`); its depths are
guesses then.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from soup_nlp.arrays import Float, Mask
from soup_nlp.data.pair import Pair
from soup_nlp.geometry.camera import rays
from soup_nlp.geometry.graph import Segmentation
from soup_nlp.geometry.plane import about_anchor, normal_and_distance
from soup_nlp.geometry.soup import Soup
from soup_nlp.start.choice import CLIP, PIECE_SIZE
from soup_nlp.start.components import FIXED, TIES, largest
from soup_nlp.start.epipolar import Motion
from soup_nlp.start.prior_evidence import (
    CONFIRMED,
    FEWEST,
    POSSIBLE,
    Kind,
    Seen,
    calibrated,
    follows_edges,
)
from soup_nlp.start.propose import Start
from soup_nlp.start.settle import (
    MOST_SYSTEMATIC_PX,
    RELIEF,
    SYSTEMATIC,
    most_probable,
)
from soup_nlp.start.views import LEAST_PARALLAX_PX, FlowFit

LEAST_SIGMA, UNCONFIRMED = 0.12, 0.35
"""Standard deviation of log depth of a prior: the least, and that of one that no flow confirms."""
STANDS = {"contact below": 0.7, "ground": 0.7, "outline": 0.4, "cut off below": 0.4}
"""Probability that the scale of a component by contact is right, by its origin (`TIES`)."""
RIGHT, WRONG = 0.05, 0.5
"""Standard deviation of the log of such a scale if it is right, and if it is not."""
HELD, NEAR = 4.0, 15
"""Weight of the whole component's error beside the residuals of so many neighbours."""
ROUNDS, LEAST_OFF, RIDGE, STEEPEST = 4, 0.005, 1e-6, 0.5
"""Of the fit of planes to a prior: rounds, least scale of its residuals, ridge, and largest slope
per mean radius of the superpixel; all relative to the inverse depth."""


@dataclass(frozen=True, eq=False)
class Given:
    """A depth prior as the start uses it.

    Attributes:
        log_depth: (N,) log depth at the anchors, up to a common scale.
        sigma: (N,) standard deviation of it, estimated from the flow; inf where it does not decide.
        opened: (N,) how far the flow leaves the shape of a component open, 0 to 1.
        error: (N,) standard deviation of log depth by which E_depth weighs the prior.
        kind: What its values are taken for.
        ratio: Error of the flow of the largest component at the prior's depths relative to that at
            one depth, above the noise; NaN where the flow says nothing.
        held: (N,) True where depth or scale of the start are the prior's.
        overall: Standard deviation of its log depth in the whole image; inf where it is not used.
        inside: (H, W) its log depth where `held`, NaN elsewhere; None if the flow confirms it, or
            if it is not used.
    """

    log_depth: Float
    sigma: Float
    opened: Float
    error: Float
    kind: Kind
    ratio: float
    held: Mask
    overall: float = np.inf
    inside: Float | None = None

    def __str__(self) -> str:
        if not self.used:
            return "the depth prior is not used: flow or edges of the image contradict it"
        flow = "the flow confirms it" if self.confirmed else "no flow confirms it"
        return f"depth prior ({self.kind}): {flow}; its sigma is {self.overall:.0%}"

    __repr__ = __str__

    @property
    def confirmed(self) -> bool:
        """Whether the flow confirms the prior."""
        return self.ratio <= CONFIRMED

    @property
    def used(self) -> bool:
        """Whether the prior counts anywhere."""
        return self.overall < np.inf

    def as_dict(self) -> dict[str, Any]:
        """Numbers for summary.json; NaN for the ratio where the flow says nothing."""
        names = ("used", "kind", "ratio", "overall")
        return {**{k: getattr(self, k) for k in names}, "held": float(self.held.mean())}


def by_prior(
    start: Start,
    seg: Segmentation,
    pair: Pair,
    fitted: FlowFit,
    kind: Kind | None,
    seed: int,
) -> tuple[Start, Given]:
    """The start with depths and scales of the pair's prior where the flow leaves them open.

    Args:
        start: Start without the prior.
        seg: Superpixels and graphs.
        pair: Images and depth prior.
        fitted: The flow as affine maps.
        kind: What the values of the prior are; None to find out.
        seed: Of the draws that the prior's edges are compared with.
    """
    prior = pair.depth_prior
    assert prior is not None
    seen = Seen.of(start, fitted)
    value, known = _at_superpixels(prior, seg)
    main = largest(start.component)
    none = np.full(len(seg), np.inf), np.zeros(len(seg)), np.full(len(seg), np.inf)
    nowhere = np.zeros(len(seg), bool)
    if not known.any() or np.ptp(value[known]) < 1e-6 * value[known].max():
        return start, Given(np.log(value), *none, kind or "relative", np.nan, nowhere)
    kind, depth_of, ratio = calibrated(seen, main, value, known, kind)
    log_depth = depth_of(value)
    whole = depth_of(np.where(np.isfinite(prior), prior, value[seg.labels]))
    nothing = Given(log_depth, *none, kind, ratio, nowhere)
    if ratio <= CONFIRMED:
        # the share of the relief that is wrong
        wrong = ratio * _deviation(log_depth[start.component == main])
        sigma = float(np.clip(wrong, LEAST_SIGMA, RELIEF))
    else:
        contradicted = ratio > POSSIBLE and seen.determined(main)
        if contradicted or not follows_edges(whole, pair.image_ref, seed):
            return start, nothing
        sigma = UNCONFIRMED
    slope = _slopes(whole, np.isfinite(prior), log_depth, pair, seg)
    placed = _placed(seen, main, log_depth, slope, sigma)
    if placed is None:
        return start, nothing
    soup, log_depth, held, opened, own = placed
    own = np.where(known, own, np.inf)
    # without a flow to weigh it against, terms on shape must not undo the prior
    error = own if ratio <= CONFIRMED else np.where(np.isfinite(own), LEAST_SIGMA, np.inf)
    tie = np.where(held & (start.component != main), TIES.index("given depth"), start.tie)
    made = replace(start, soup=soup.normalised(), tie=tie)
    decides = np.where(held, own, np.inf)
    # superpixels of a confirmed prior keep the borders of the flow, which agrees with it
    shaped = np.isfinite(decides)[seg.labels] & np.isfinite(prior)
    inside = None if ratio <= CONFIRMED else np.where(shaped, whole, np.nan)
    return made, Given(log_depth, decides, opened, error, kind, ratio, held, sigma, inside)


def _at_superpixels(prior: Float, seg: Segmentation) -> tuple[Float, Mask]:
    """(N,) median value of every superpixel, the nearest known one where most is unknown."""
    there = np.isfinite(prior)
    known = np.bincount(seg.labels[there], minlength=len(seg)) > 0.5 * seg.sizes
    if not known.any():
        return np.ones(len(seg)), known
    labels = np.where(there, seg.labels, -1)
    value = np.asarray(ndimage.median(np.nan_to_num(prior), labels, np.arange(len(seg))), float)
    return value[known][cKDTree(seg.anchors[known]).query(seg.anchors)[1]], known


def _deviation(value: Float) -> float:
    """Half the distance of the quantiles of one standard deviation."""
    low, high = np.quantile(value, (0.16, 0.84))
    return float(high - low) / 2


def _slopes(log_depth: Float, known: Mask, middle: Float, pair: Pair, seg: Segmentation) -> Float:
    """(N, 2) slopes of the relative inverse depth of a prior within superpixels, per ray unit.

    Each is a robust fit of a plane, with Cauchy weights in units of the median residual, so that a
    step of depth inside a superpixel does not tilt its plane.

    Args:
        log_depth: (H, W) of the prior.
        known: (H, W) True where the prior has a value.
        middle: (N,) log depth of the superpixels.
        pair: Intrinsics.
        seg: Superpixels.
    """
    v, u = np.nonzero(known)
    label = seg.labels[v, u]
    inside = rays(pair.K_ref, np.stack([u, v], axis=1)) - rays(pair.K_ref, seg.anchors)[label]
    reach = np.sqrt(np.bincount(label, (inside**2).sum(axis=1), len(seg)) / seg.sizes)
    reach = np.maximum(reach, 1 / pair.K_ref[0, 0])
    basis = np.column_stack([inside[:, :2] / reach[label, None], np.ones(len(label))])
    target = np.expm1(np.clip(middle[label] - log_depth[v, u], -1.0, 1.0))
    plane: Float = np.zeros((len(seg), 3))
    for _ in range(ROUNDS):
        off = np.abs(target - np.sum(plane[label] * basis, axis=1))
        scale = np.asarray(ndimage.median(off, label, np.arange(len(seg))), float)
        weight = 1 / (1 + (off / np.maximum(scale, LEAST_OFF)[label]) ** 2)
        weighted = weight[:, None] * basis
        rows = np.einsum("pa,pb->pab", weighted, np.column_stack([basis, target])).reshape(-1, 12)
        sums = np.stack([np.bincount(label, x, len(seg)) for x in rows.T], axis=1).reshape(-1, 3, 4)
        left = sums[..., :3] + RIDGE * np.eye(3)
        plane = np.asarray(np.linalg.solve(left, sums[..., 3:])[..., 0])
    slope = plane[:, :2] / (1 + plane[:, 2:])
    steep = np.linalg.norm(slope, axis=1, keepdims=True)
    return np.asarray(slope * np.minimum(1.0, STEEPEST / np.maximum(steep, 1e-9)) / reach[:, None])


def _placed(
    seen: Seen, main: int, prior: Float, slope: Float, sigma: float
) -> tuple[Soup, Float, Mask, Float, Float] | None:
    """Soup in the unit of a prior, its log depth by component, where the prior decides, how far the
    flow leaves the shape of a component open (0 to 1), and the sigma of the prior; all (N,).

    None where depths that the flow determines contradict the prior.

    Args:
        seen: The start and its flow.
        main: The largest component, to which scales by contact refer.
        prior: (N,) log depth.
        slope: (N, 2) slopes of its planes (`_slopes`).
        sigma: Its standard deviation.
    """
    start, anchor = seen.start, seen.views.anchor
    soup, prior, n = start.soup, prior.copy(), len(prior)
    held, opened, own = np.zeros(n, bool), np.ones(n), np.full(n, sigma)
    tilted = np.zeros(n, bool)
    before = np.log(soup.depth_at(anchor)) - prior
    contact = np.median(before[start.component == main])
    for c in np.unique(start.component):
        mask = start.component == c
        at = np.flatnonzero(mask)
        if start.bends[at].all():
            # every superpixel has a motion of its own, which grows with its depth
            soup = soup.taking(replace(soup, lam=soup.lam * np.exp(-before)), mask)
            held[at] = tilted[at] = True
            continue
        if start.tie[at[0]] == FIXED:
            # it stays where it is relative to the scene: a map of the scene may not know of it
            soup = soup.taking(replace(soup, lam=soup.lam * np.exp(-contact)), mask)
            own[at] = np.inf
            continue
        soup, strong = _component(seen, soup, int(c), prior, sigma)
        flow = (start.noise / np.maximum(seen.views.parallax(soup)[at], 1e-3)) ** 2
        found = np.log(soup.depth_at(anchor)[at])
        off = np.zeros(len(at))
        if strong.any():
            residual = (found - prior[at])[strong]
            if c == main and _deviation(residual) > POSSIBLE * _deviation(found[strong]):
                return None
            off += np.median(residual)
            own[at] = _local(anchor[at, :2], strong, residual - off[0], sigma)
            opened[at] = np.where(strong, flow / (flow + own[at] ** 2), 1.0)
            if c != main:
                gap = float(np.median(before[at])) - contact
                # a contact says nothing where depths of the scene are the prior's
                stands = STANDS.get(TIES[start.tie[at[0]]], 0.0) if seen.determined(main) else 0.0
                keep = _kept(gap, sigma, stands)
                off -= keep * gap
                prior[at] += keep * gap
                held[at] = keep < 0.5
        level = np.where(strong, found - off, prior[at])
        factor, shift = np.ones(n), np.ones(n)
        factor[at], shift[at] = np.exp(level - found), np.exp(-off)
        # the translation is the component's, whatever the depth of a superpixel
        soup = replace(soup, lam=soup.lam * factor, t=soup.t * (shift / factor)[:, None])
        held[at] |= ~strong
        tilted[at] = ~strong
    normal, D = normal_and_distance(about_anchor(soup.depth_at(anchor), slope, anchor))
    tilt = Soup(D, normal, np.ones(n), soup.R, soup.translation / D[:, None])
    return soup.taking(tilt, tilted), prior, held, opened, own


def _component(seen: Seen, soup: Soup, c: int, prior: Float, sigma: float) -> tuple[Soup, Mask]:
    """Soup with the planes and the motion of a rigid component by flow and prior.

    Of the motions that explain the flow about as well, it takes that which agrees with the prior.

    Returns:
        The soup, and for every member of the component whether the flow determines its depth.
    """
    start, views = seen.start, seen.views
    mask = start.component == c
    at, use = np.flatnonzero(mask), seen.members(c)
    T = soup.translation[at[0]]
    length, rigid = float(np.linalg.norm(T)), np.ptp(soup.R[at], axis=0).max() < 1e-9
    if len(use) < FEWEST or not rigid or not length > 0:
        return soup, ~start.borrowed[at] if (~start.borrowed[at]).any() else np.ones(len(at), bool)
    _, R, T_prior, _ = seen.motion(use, np.exp(-prior[use]))
    if not seen.determined(c):
        # any depth explains the flow: the prior's, with the motion that belongs to it
        own = views.soup(np.exp(-prior), np.zeros((len(prior), 2)), R, T_prior)
        return soup.taking(own, mask), np.zeros(len(at), bool)
    error = min(SYSTEMATIC * start.noise, MOST_SYSTEMATIC_PX)
    rest = views.anchor[use], seen.centre[use], np.ones(len(use)), views.focal[0], error
    tried = Motion(soup.R[at[0]], T / length), Motion(R, T_prior / np.linalg.norm(T_prior))
    best = most_probable(tried, *rest, prior[use], sigma)
    planes = views.fit([best])
    mu, cost = planes.inverse_depth[:, 0], planes.cost[:, 0]
    strong = (mu > 0) & (planes.parallax[:, 0] * mu > LEAST_PARALLAX_PX) & (cost < CLIP)
    strong &= seen.usable & mask
    if strong.sum() < PIECE_SIZE:
        return soup, np.ones(len(at), bool)
    middle = np.median(mu[strong] * np.exp(prior[strong]))
    mu = np.where(strong, mu, middle * np.exp(-prior))
    slope = np.where(strong[:, None], planes.slope[:, 0], 0.0)
    own = views.soup(mu, slope, best.R, best.t)
    return soup.taking(own, mask), strong[at]


def _kept(gap: float, sigma: float, stands: float) -> float:
    """Share of the scale by contact in that of a component, the rest is the prior's.

    With the probability `stands` it is right (`RIGHT`), else not (`WRONG`); the gap of its log to
    the prior, which has the deviation `sigma`, tells which.
    """
    spread = np.hypot(sigma, [RIGHT, WRONG])
    odds = np.array([stands, 1 - stands]) * np.exp(-0.5 * (gap / spread) ** 2) / spread
    return float(odds[0] / odds.sum() * sigma**2 / spread[0] ** 2)


def _local(place: Float, strong: Mask, residual: Float, sigma: float) -> Float:
    """(K,) standard deviation of a prior by its residuals in log depth at the nearest known depths.

    `place` (K, 2) are a component's anchors, `strong` (K,) marks known depths, to which residuals
    belong, and `sigma` is the deviation in the whole component.
    """
    near = min(NEAR, len(residual))
    index = cKDTree(place[strong]).query(place, k=near)[1].reshape(len(place), near)
    squared = np.minimum(residual**2, 1.0)[index].sum(axis=1)
    return np.maximum(np.sqrt((HELD * sigma**2 + squared) / (HELD + near)), LEAST_SIGMA)
