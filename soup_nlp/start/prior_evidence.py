"""Whether a depth prior belongs to a pair: by the flow, and by the edges of the image.

The best rigid motion of a component at the depths of the right map explains its flow better than
the best one at equal depths. Where the camera rests or turns, the flow is no evidence. A map of
another scene then differs from the right map in one way: shifted or mirrored, it follows the edges
of the image as well as in its own place.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from scipy import ndimage, stats
from scipy.spatial import cKDTree

from soup_nlp.arrays import Float, Image, Int, Mask
from soup_nlp.data.pair import Pair
from soup_nlp.geometry import rotation
from soup_nlp.geometry.graph import Segmentation
from soup_nlp.geometry.superpixels import segment
from soup_nlp.start.bending import fit_robustly
from soup_nlp.start.choice import CLIP
from soup_nlp.start.components import largest
from soup_nlp.start.propose import Start
from soup_nlp.start.settle import RELIEF
from soup_nlp.start.views import FlowFit

Kind = Literal["metric", "relative", "inverse", "ordinal"]

CONFIRMED, POSSIBLE = 0.6, 0.85
"""Error of the flow at the prior's depths relative to that at one depth, above the noise: up to the
first the flow confirms the prior, above the second it contradicts it."""
TELLS_PX, TELLS = 0.5, 3.0
"""Pixels, and multiples of the flow's noise, by which the depths of a component must explain its
flow better than one depth, so that it determines them; a third confirms or contradicts a prior."""
LEAST_SIGMA, UNCONFIRMED = 0.12, 0.35
"""Standard deviation of log depth of a prior: the least, and that of an unconfirmed one."""
FEWEST = 8
"""Least number of superpixels whose flow is compared with a prior."""
DEEPEST = 50.0
"""Largest depth relative to the median where an inverse depth has a shift."""
SIDE = 320
"""Longer side of the maps that are compared, pixels."""
PIECES = 300
"""Superpixels with which a prior is judged, whatever a solve has. With 1,000 the flow of
omd_occlusion_161 does not confirm its depth warped by 20 % (0.66 instead of 0.56), and maps that
are shifted over the image vary little within superpixels, too."""
TRIALS, FARTHEST, NEAREST = 60, 1 / 3, 0.1
"""Shifted maps, every other one mirrored; the largest shift relative to the side, and the least one
of a map that is not mirrored, relative to the width."""
WITHIN = 0.5
"""Largest share of a map's variance within superpixels: that of independent pixels is nearly 1."""
LEAST = 3.0
"""Standard deviations by which a right map follows superpixels (counted twice) and edges better
than the shifted ones. Where no flow confirms them right maps have 3.2 and more, maps of other
scenes 2.8 and less."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """Evidence of flow and image for a depth prior.

    Attributes:
        kind: Kind of its values.
        log_depth: Log depth, up to a common scale, as a function of its values.
        ratio: Error of the flow of the largest component at the prior's depths relative to that at
            one depth, above the noise; NaN where the flow is no evidence.
        sigma: Standard deviation of its log depth in the whole image; inf where it is not used.
        determined: Whether the flow determines the depth of the largest component.
    """

    kind: Kind
    log_depth: Callable[[Float], Float]
    ratio: float
    sigma: float
    determined: bool

    def __str__(self) -> str:
        if not self.used:
            return "the depth prior is not used: flow or edges of the image contradict it"
        flow = "the flow confirms it" if self.confirmed else "no flow confirms it"
        return f"depth prior ({self.kind}): {flow}; its sigma is {self.sigma:.0%}"

    __repr__ = __str__

    @property
    def confirmed(self) -> bool:
        """Whether the flow confirms the prior."""
        return self.ratio <= CONFIRMED

    @property
    def used(self) -> bool:
        """Whether the prior counts anywhere."""
        return self.sigma < np.inf


class Seen(NamedTuple):
    """A start and its flow as affine maps, to which motions at given depths are compared."""

    start: Start
    fitted: FlowFit

    @property
    def usable(self) -> Mask:
        """(N,) True where the flow is known and the surface does not bend."""
        start, fitted = self
        return fitted.views.usable & ~start.wrong & ~start.bends & ~fitted.poor

    def members(self, c: int) -> Int:
        """Superpixels of a rigid component whose flow is known."""
        return np.flatnonzero((self.start.component == c) & self.usable)

    def motion(
        self, at: Int, inverse: Float, shifted: bool = False
    ) -> tuple[float, Float, Float, float]:
        """The rigid motion of superpixels (M,) with inverse depths (M,), and their shift.

        Returns:
            Error in pixels without the largest tenth, R and T of `X' = R X + T`, and the shift
            added to all inverse depths, 0 unless `shifted`.
        """
        views, target = self.fitted.views, self.fitted.centre[at]
        ray, middle = views.anchor[at], float(np.median(np.abs(inverse)))

        def miss(x: Float) -> Float:
            near = inverse / middle + (x[6] if shifted else 0.0)
            moved = ray @ rotation.exp(x[:3]).T + near[:, None] * x[3:6]
            gap = moved / np.maximum(moved[:, 2:], 1e-3) - target
            return gap[:, :2] * views.focal

        x = fit_robustly(miss, 7 if shifted else 6)
        error = np.sort(np.minimum(np.linalg.norm(miss(x), axis=1), CLIP))
        mean = float(np.mean(error[: int(np.ceil(0.9 * len(error)))]))
        return mean, rotation.exp(x[:3]), x[3:6] / middle, middle * x[6] if shifted else 0.0

    def relief(self, c: int) -> tuple[float, float]:
        """Error of the flow of a component at one depth, above the noise, and the noise; pixels."""
        at, noise = self.members(c), self.start.noise
        if len(at) < FEWEST or self.start.at_rest:
            return 0.0, noise
        floor = min(noise, float(np.median(self.start.error[at])))
        return self.motion(at, np.ones(len(at)))[0] - floor, floor

    @property
    def tells(self) -> float:
        """Pixels of relief that determine the depth of a component."""
        return max(TELLS_PX, TELLS * self.start.noise)


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
        value = middle[with_value][cKDTree(seg.anchors[with_value]).query(seg.anchors)[1]]
    return value, with_value, np.where(valid, prior, value[seg.labels])


def judged(
    start: Start, seg: Segmentation, pair: Pair, fitted: FlowFit, kind: Kind | None
) -> Evidence:
    """Evidence of flow and image for the depth prior of a pair.

    Args:
        start: Start without the prior, with about `PIECES` superpixels.
        seg: Superpixels and graphs.
        pair: Images and depth prior.
        fitted: The flow as affine maps.
        kind: Kind of the prior's values; None to choose it by the flow.
    """
    seen, main = Seen(start, fitted), largest(start.component)
    value, with_value, whole = without_gaps(pair, seg)
    if np.ptp(value) < 1e-6 * value.max():
        return Evidence(kind or "relative", np.log, np.nan, np.inf, False)
    relief, floor = seen.relief(main)
    at = seen.members(main)
    kind, log_depth, ratio = calibrated(seen, at[with_value[at]], value, relief, floor, kind)
    determined = relief > seen.tells
    if ratio <= CONFIRMED:
        # the share of the relief that is wrong
        low, high = np.quantile(log_depth(value)[start.component == main], (0.16, 0.84))
        sigma = float(np.clip(ratio * (high - low) / 2, LEAST_SIGMA, RELIEF))
    elif ratio > POSSIBLE and determined:
        sigma = np.inf
    else:
        sigma = UNCONFIRMED if follows_edges(log_depth(whole), pair.image_ref) else np.inf
    return Evidence(kind, log_depth, ratio, sigma, determined)


def calibrated(
    seen: Seen, at: Int, value: Float, relief: float, floor: float, kind: Kind | None
) -> tuple[Kind, Callable[[Float], Float], float]:
    """Kind of a prior, log depth as a function of its values, and `Evidence.ratio`.

    Args:
        seen: The flow at the anchors.
        at: (M,) superpixels whose flow is compared with the prior.
        value: (N,) values of the prior.
        relief: Error of their flow at one depth, above the noise, pixels.
        floor: The noise, pixels.
        kind: Kind of the values; None for the kind that explains the flow better.
    """
    rank = stats.rankdata(value) / (len(value) + 1)
    rises = np.argsort(value)

    def inverse(v: Float, shift: float = 0.0) -> Float:
        least = float(np.median(np.abs(value + shift))) / DEEPEST if shift else 0.0
        return np.asarray(-np.log(np.maximum(v + shift, least)))

    logs: dict[Kind, Callable[[Float], Float]] = {
        "metric": np.log,
        "relative": np.log,
        "inverse": inverse,
        "ordinal": lambda v: RELIEF * stats.norm.ppf(np.interp(v, value[rises], rank[rises])),
    }
    if len(at) < FEWEST or not relief > seen.tells / 3:
        # lower parts of an image are mostly nearer
        below = np.corrcoef(rank, seen.fitted.views.anchor[:, 1])[0, 1] > 0
        kind = kind or ("inverse" if below else "relative")
        return kind, logs[kind], np.nan
    tried: list[tuple[float, Kind, Callable[[Float], Float]]] = []
    for name in (kind,) if kind else ("relative", "inverse"):
        depth = logs[name]
        error, *_, shift = seen.motion(at, np.exp(-depth(value[at])), name == "inverse")
        if name == "inverse":
            depth = partial(inverse, shift=shift)
        tried.append(((error - floor) / relief, name, depth))
    ratio, name, log_depth = min(tried, key=lambda trial: trial[0])
    # where neither explains the flow a shift lowers the error of any map
    return (name, log_depth, ratio) if ratio <= POSSIBLE else (tried[0][1], tried[0][2], ratio)


def follows_edges(values: Float, image: Image) -> bool:
    """Whether a map follows the superpixels and the edges of its image better than by chance.

    Args:
        values: (H, W) log depth or any other map without gaps.
        image: (H, W, 3) the image.
    """
    rows, columns = (max(8, round(n * SIDE / max(values.shape))) for n in values.shape)

    def resized(values: Any) -> Any:
        return cv2.resize(values, (columns, rows), interpolation=cv2.INTER_AREA)

    small = ndimage.median_filter(resized(values).astype(float), 3)
    if np.ptp(small) < 1e-9:
        return False
    grey = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(float), (0, 0), 1.5)
    edges, steps = _ranks(resized(_gradient(grey))), _ranks(_gradient(small))
    superpixel = segment(resized(image), PIECES)
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
    while len(trials) < TRIALS:
        down, right = np.trunc(FARTHEST * rng.uniform(-1, 1, 2) * (rows, columns))
        mirrored = len(trials) % 2
        if mirrored or abs(down) + abs(right) >= NEAREST * columns:
            trials.append(scores(mirrored, -right, -down))
    chance = np.array(trials)
    unshifted = np.array(scores(0, 0.0, 0.0))
    better = (unshifted - chance.mean(axis=0)) / np.maximum(chance.std(axis=0), 1e-12)
    return bool(unshifted[0] <= WITHIN and better @ [-2.0, 1.0] > LEAST)


def _gradient(values: Float) -> Float:
    """(H, W) length of the gradient."""
    return np.hypot(*(cv2.Sobel(values, cv2.CV_64F, x, 1 - x, ksize=3) for x in (1, 0)))


def _ranks(values: Float) -> Float:
    """Ranks of all values, from -1/2 to 1/2."""
    return (stats.rankdata(values, "ordinal").reshape(values.shape) - 1) / values.size - 0.5
