"""Whether a depth prior belongs to a pair: by the depth that flow determines, else by image edges.

Where the flow determines the depth of the scene, the right map differs less from that depth than
one constant depth does. Where the camera rests or turns, the flow is no evidence. Shifted or
mirrored, a map of another scene follows the edges of the image as well as in its own place.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
import scipy
from scipy import ndimage, special

from soup_nlp.arrays import Float, Image, Int, Mask
from soup_nlp.data.pair import Pair
from soup_nlp.geometry import rotation
from soup_nlp.geometry.graph import Segmentation
from soup_nlp.geometry.soup import Soup
from soup_nlp.geometry.superpixels import segment
from soup_nlp.start.bending import displaced, fit_robustly, least_gap
from soup_nlp.start.epipolar import LEAST_MATCHES, RELIEF, Motion, most_probable
from soup_nlp.start.propose import Start
from soup_nlp.start.regions import SCENE
from soup_nlp.start.views import FlowFit, determined

Kind = Literal["metric", "relative", "inverse", "ordinal"]

EXPLAINED = 0.5
"""Least share of a variance that is explained: of log depth by the flow by a prior that the flow
confirms (right maps warped by 20 % explain 0.66 and more, maps of other scenes 0.39 and less), and
of a map by the superpixels, which explain next to nothing of independent pixels."""
LEAST_SIGMA, UNCONFIRMED = 0.12, RELIEF * EXPLAINED**0.5
"""Standard deviation of log depth of a prior: the least, and that of an unconfirmed one, which is
that of one that the flow hardly confirms in a usual scene."""
COMMON_NOISES, MOST_COMMON_PX = 1.5, 0.15
"""Error of the flow that is the same over large parts of the image, in units of its noise, and its
limit in pixels: more noise than that averages out."""
CLIP_PX = 3.0
"""Limit of a superpixel's error where explanations are compared, pixels."""
DEEPEST = 50.0
"""Largest depth relative to the median where an inverse depth has a shift."""
COMPARED_SIDE = 320
"""Longer side of the maps that are compared, pixels."""
JUDGED_PIECES = 300
"""Superpixels with which a prior is judged, whatever a solve has: maps that are shifted over the
image vary little within smaller ones, too."""
SHIFT_TRIALS, MOST_SHIFT, LEAST_SHIFT = 60, 1 / 3, 0.1
"""Shifted maps, every other one mirrored; the largest shift relative to the side, and the least one
of a map that is not mirrored, relative to the width."""
LEAST_MARGIN = 3.0
"""Standard deviations by which a right map follows superpixels (counted twice) and edges better
than the shifted ones. Where no flow confirms them right maps have 3.2 and more, maps of other
scenes 2.8 and less."""


@dataclass(frozen=True, eq=False)
class PriorEvidence:
    """Evidence of flow and image for a depth prior.

    Attributes:
        kind: Kind of its values.
        log_depth: Log depth, up to a common scale, as a function of its values.
        ratio: Spread of its log ratio to the depth of the scene by the flow, relative to that of
            the log of that depth; NaN where the flow is no evidence.
        sigma: Standard deviation of its log depth in the whole image; inf where it is not used.
        determined: Whether the flow determines the depth of the scene.
        margin: Standard deviations by which it follows the edges of the image better than by
            chance, see `edge_margin`; NaN where the flow decides.
    """

    kind: Kind
    log_depth: Callable[[Float], Float]
    ratio: float
    sigma: float
    determined: bool
    margin: float = np.nan

    def __str__(self) -> str:
        by_flow = f"it explains {self.explained:.0%} of the relief by flow, limit {EXPLAINED:.0%}"
        by_edges = (
            f"it follows edges by {self.margin:.1f} deviations from chance, limit {LEAST_MARGIN:g}"
        )
        why = by_flow if np.isnan(self.margin) else by_edges
        if not self.used:
            return f"the depth prior is not used: {why}"
        flow = "the flow confirms it" if self.confirmed else "no flow confirms it"
        return f"depth prior ({self.kind}): {flow}; its sigma is {self.sigma:.0%} ({why})"

    __repr__ = __str__

    @property
    def explained(self) -> float:
        """Share of the variance of log depth by the flow that the prior explains."""
        return max(1 - self.ratio**2, 0.0) if np.isfinite(self.ratio) else np.nan

    @property
    def confirmed(self) -> bool:
        """Whether the flow confirms the prior, which is to be surer where flow tells no depth."""
        return self.explained >= EXPLAINED and (self.determined or self.sigma < UNCONFIRMED)

    @property
    def used(self) -> bool:
        """Whether the prior counts anywhere."""
        return self.sigma < np.inf


class StartWithFlow(NamedTuple):
    """A start and the flow that it explains."""

    start: Start
    flow: FlowFit

    @property
    def usable(self) -> Mask:
        """(N,) True where the flow is known and the surface does not bend."""
        start, flow = self
        return flow.trusted & ~start.wrong & ~start.bends

    def members(self, c: int) -> Int:
        """Superpixels of a rigid component whose flow is known."""
        return np.flatnonzero((self.start.component == c) & self.usable)

    def motion(
        self, at: Int, inverse: Float, shifted: bool = False
    ) -> tuple[float, Float, Float, float]:
        """The rigid motion of superpixels (M,) with inverse depths (M,): its error in pixels, R and
        T of `X' = R X + T`, and the shift added to all inverse depths, 0 unless `shifted`."""
        views, target = self.flow.views, self.flow.centre[at, :2]
        middle = float(np.median(np.abs(inverse)))
        point = np.column_stack([views.anchor[at], inverse / middle])
        scale = np.tile(views.focal, (len(at), 1))
        x, miss = fit_robustly(displaced, 7 if shifted else 6, point, target, scale)
        error = np.sort(np.minimum(np.linalg.norm(miss, axis=1), CLIP_PX))
        # a component may include the largest tenth by mistake
        error = error[: int(np.ceil(0.9 * len(error)))]
        return float(np.mean(error)), rotation.exp(x[:3]), x[3:6] / middle, middle * x[6]

    def relief(self, c: int) -> float:
        """Error of the flow of a component at one depth, above the noise, pixels."""
        at = self.members(c)
        if len(at) < LEAST_MATCHES or self.start.at_rest:
            return 0.0
        floor = min(self.start.noise, float(np.median(self.start.error[at])))
        return self.motion(at, np.ones(len(at)))[0] - floor

    def refitted(self, soup: Soup, c: int, prior: Float, sigma: float) -> tuple[Soup, Mask]:
        """Soup with planes and motion of a rigid component by its flow, near a prior's depths.

        Of the motions that explain the flow about as well, it has the one that agrees with the
        log depth (N,) of the prior, whose standard deviation is sigma. The flow determines the
        depth of the members that are True in the second result (N,).
        """
        start, views = self.start, self.flow.views
        mask, use = start.component == c, self.members(c)
        _, *by_prior, _ = self.motion(use, np.exp(-prior[use]))
        tried = (soup.R[use[0]], soup.translation[use[0]]), by_prior
        motions = [Motion(R, T / np.linalg.norm(T)) for R, T in tried if np.any(T)]
        matches = self.flow.anchor_matches(use)
        error = min(COMMON_NOISES * start.noise, MOST_COMMON_PX)
        best, _ = most_probable(motions, matches, error, prior[use], sigma)
        planes = views.fit([best])
        from_flow = determined(planes)[:, 0] & (planes.cost[:, 0] < CLIP_PX) & self.usable & mask
        slope = np.where(from_flow[:, None], planes.slope[:, 0], 0.0)
        mu = np.where(from_flow, planes.inverse_depth[:, 0], 1.0)
        by_flow = views.soup(mu, slope, best.R, best.t)
        return soup.taking(by_flow, mask), from_flow


def without_gaps(pair: Pair, seg: Segmentation) -> tuple[Float, Mask, Float]:
    """Depth prior of a pair: (N,) medians, (N,) True where most pixels have a value, (H, W) values.

    A superpixel without values has the median of the nearest one with values; 1 if there is none.
    """
    prior = pair.depth_prior
    assert prior is not None
    valid = np.isfinite(prior)
    with_value = np.bincount(seg.labels[valid], minlength=len(seg)) > 0.5 * seg.sizes
    value = np.ones(len(seg))
    if with_value.any():
        labels = np.where(valid, seg.labels, -1)
        middle = np.asarray(ndimage.median(np.nan_to_num(prior), labels, np.arange(len(seg))))
        value = middle[seg.nearest(with_value)]
    return value, with_value, np.where(valid, prior, value[seg.labels])


def judged(start: Start, pair: Pair, flow: FlowFit, kind: Kind | None) -> PriorEvidence:
    """Evidence of flow and image for the depth prior of a pair, whose kind is found if it is None.

    The start without the prior and the flow are those of about `JUDGED_PIECES` superpixels.
    """
    both = StartWithFlow(start, flow)
    value, with_value, whole = without_gaps(pair, flow.seg)
    anchor, relief = flow.views.anchor, both.relief(SCENE)
    known = with_value & both.usable & (start.component == SCENE)
    determined = relief > least_gap(start.noise)
    tells = relief > least_gap(start.noise) / 3 and known.sum() >= LEAST_MATCHES
    sure = known & ~start.interpolated
    if tells and sure.sum() >= LEAST_MATCHES:
        far = start.soup.depth_at(anchor)[sure], value[sure]
    else:
        # lower parts of an image are mostly nearer
        far = -anchor[:, 1], value
    kind = kind or ("inverse" if np.cov(*map(scipy.stats.rankdata, far))[0, 1] < 0 else "relative")
    log_depth, ratio, gap = as_log_depth(kind, value), np.nan, np.inf
    if tells:
        at = np.flatnonzero(known)
        shift = both.motion(at, value[at], True)[3] if kind == "inverse" else 0.0
        shifted = as_log_depth(kind, value, shift)
        soup, from_flow = both.refitted(start.soup, SCENE, shifted(value), UNCONFIRMED)
        depth = np.log(soup.depth_at(anchor))
        if (from_flow & known).sum() >= LEAST_MATCHES:
            by_flow, gap = (
                float(np.ptp(np.quantile(log[from_flow & known], (0.16, 0.84)))) / 2
                for log in (depth, depth - shifted(value))
            )
            ratio = gap / by_flow
        sigma = float(np.clip(gap, LEAST_SIGMA, RELIEF))
        evidence = PriorEvidence(kind, shifted, ratio, sigma, determined)
        if evidence.confirmed:
            return evidence
    margin = np.nan if determined else edge_margin(log_depth(whole), pair.image_ref)
    sigma = UNCONFIRMED if margin > LEAST_MARGIN else np.inf
    return PriorEvidence(kind, log_depth, ratio, sigma, determined, margin)


def as_log_depth(kind: Kind, value: Float, shift: float = 0.0) -> Callable[[Float], Float]:
    """Log depth, up to a common scale, as a function of a prior's values, to which `shift` is added
    if they are inverse. Those of the superpixels (N,) rank ordinal ones."""
    if kind == "ordinal":
        known, rank = np.sort(value), np.arange(1, len(value) + 1) / (len(value) + 1)
        return lambda v: RELIEF * special.ndtri(np.interp(v, known, rank))
    if kind == "inverse":
        least = float(np.median(np.abs(value + shift))) / DEEPEST if shift else 0.0
        return lambda v: -np.log(np.maximum(v + shift, least))
    return np.log


def edge_margin(values: Float, image: Image) -> float:
    """Standard deviations by which a map (H, W) follows superpixels and edges of its image better
    than by chance; -inf for one that varies within superpixels, or not at all."""
    rows, columns = (max(8, round(n * COMPARED_SIDE / max(values.shape))) for n in values.shape)

    def resized(values: Any) -> Any:
        return cv2.resize(values, (columns, rows), interpolation=cv2.INTER_AREA)

    small = ndimage.median_filter(resized(values).astype(float), 3)
    if np.ptp(small) < 1e-9:
        return -np.inf
    grey = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(float), (0, 0), 1.5)
    gradients = resized(_gradient(grey)), _gradient(small)
    # ranks from -1/2 to 1/2; equal values in the order of the array
    edges, steps = (
        (scipy.stats.rankdata(v, "ordinal").reshape(v.shape) - 1) / v.size - 0.5 for v in gradients
    )
    superpixel = segment(resized(image), JUDGED_PIECES)
    count = np.maximum(np.bincount(superpixel.ravel()), 1)

    def scores(mirrored: int, right: float, down: float) -> tuple[float, float]:
        # share of the variance within superpixels, and agreement with the edges
        sign, first = (-1.0, columns - 1.0) if mirrored else (1.0, 0.0)
        move = np.array([[sign, 0.0, first + right], [0.0, 1.0, down]])
        shifted, step = (
            cv2.warpAffine(
                m, move, (columns, rows), flags=cv2.INTER_NEAREST, borderMode=cv2.BORDER_REFLECT_101
            )
            for m in (small, steps)
        )
        inside = shifted - (np.bincount(superpixel.ravel(), shifted.ravel()) / count)[superpixel]
        return float(np.mean(inside**2) / max(shifted.var(), 1e-30)), float(np.mean(step * edges))

    rng = np.random.default_rng(0)
    trials: list[tuple[float, float]] = []
    while len(trials) < SHIFT_TRIALS:
        down, right = np.trunc(MOST_SHIFT * rng.uniform(-1, 1, 2) * (rows, columns))
        mirrored = len(trials) % 2
        if mirrored or abs(down) + abs(right) >= LEAST_SHIFT * columns:
            trials.append(scores(mirrored, -right, -down))
    chance = np.array(trials)
    unshifted = np.array(scores(0, 0.0, 0.0))
    better = (unshifted - chance.mean(axis=0)) / np.maximum(chance.std(axis=0), 1e-12)
    return float(better @ [-2.0, 1.0]) if unshifted[0] <= 1 - EXPLAINED else -np.inf


def _gradient(values: Float) -> Float:
    """(H, W) length of the gradient."""
    return np.hypot(*(cv2.Sobel(values, cv2.CV_64F, x, 1 - x, ksize=3) for x in (1, 0)))
