"""Whether a depth map belongs to a pair: by the flow, and by the edges of the image.

The best rigid motion of a component at the depths of the right map explains its flow better than
that at one depth. Where the camera rests or turns, the flow says nothing. A map of another scene
then differs from the right one in one thing: shifted or mirrored, it follows the edges of the image
as well as it does as it is.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Literal

import cv2
import numpy as np
from scipy import ndimage, stats

from soup_nlp.arrays import Float, Image, Int, Mask
from soup_nlp.geometry import rotation
from soup_nlp.geometry.superpixels import segment
from soup_nlp.start.bending import fit_robustly
from soup_nlp.start.choice import CLIP
from soup_nlp.start.propose import Start
from soup_nlp.start.settle import RELIEF
from soup_nlp.start.views import FlowFit, Views

Kind = Literal["metric", "relative", "inverse", "ordinal"]

CONFIRMED, POSSIBLE = 0.6, 0.85
"""Error of the flow at the prior's depths relative to that at one depth, above the noise: up to the
first the flow confirms the prior, above the second it contradicts it."""
TELLS_PX, TELLS = 0.5, 3.0
"""Pixels, and multiples of the flow's noise, by which depth must explain the flow of a component
better than one depth does to be determined; a third of it confirms or contradicts a prior."""
FEWEST = 8
"""Least number of superpixels whose flow is compared with a prior."""
DEEPEST = 50.0
"""Largest depth relative to the median where an inverse depth has a shift."""
SIDE = 320
"""Longer side of the maps that are compared, pixels."""
PIECES = 300
"""Superpixels of that image. In 1,000, as many as a solve has, shifted maps vary little, too: the
score of robot's depth, warped by 20 %, falls from 4.0 to 2.9, below the limit."""
TRIALS = 60
"""Shifted and mirrored maps."""
FARTHEST, NEAREST = 1 / 3, 0.1
"""Largest shift relative to the side, and least one relative to the width if not mirrored."""
WITHIN = 0.5
"""Largest share of a map's variance within superpixels: one of independent pixels has nearly 1."""
LEAST = 3.0
"""Standard deviations by which a right map follows superpixels (counted twice) and edges better
than the shifted ones. Where no flow confirms them right maps have 3.2 and more, those of other
scenes 2.8 and less."""


@dataclass(frozen=True, eq=False)
class Seen:
    """The flow at the anchors of a start, to which motions at given depths are compared.

    Attributes:
        start: Components and noise.
        views: What planes are fitted to.
        centre: (N, 3) rays to which the anchors move, by an affine flow.
        usable: (N,) True where that is known.
        known: What `relief` has computed, by component.
    """

    start: Start
    views: Views
    centre: Float
    usable: Mask
    known: dict[int, tuple[float, float]] = field(default_factory=dict)

    @classmethod
    def of(cls, start: Start, fitted: FlowFit) -> Seen:
        """The flow that the start was made of."""
        usable = fitted.views.usable & ~start.wrong & ~start.bends & ~fitted.poor
        return cls(start, fitted.views, fitted.centre, usable)

    def members(self, c: int) -> Int:
        """Superpixels of a rigid component whose flow is known."""
        return np.flatnonzero((self.start.component == c) & self.usable)

    def motion(
        self, at: Int, inverse: Float, shifted: bool = False
    ) -> tuple[float, Float, Float, float]:
        """The rigid motion of superpixels (M,) with inverse depths (M,), and their shift.

        Returns:
            Error in pixels without the largest tenth, R and T of `X' = R X + T`, and what is added
            to all inverse depths, 0 unless `shifted`.
        """
        ray, middle = self.views.anchor[at], float(np.median(np.abs(inverse)))

        def miss(x: Float) -> Float:
            near = inverse / middle + (x[6] if shifted else 0.0)
            moved = ray @ rotation.exp(x[:3]).T + near[:, None] * x[3:6]
            gap = moved / np.maximum(moved[:, 2:], 1e-3) - self.centre[at]
            return gap[:, :2] * self.views.focal

        x = fit_robustly(miss, 7 if shifted else 6)
        error = np.sort(np.minimum(np.linalg.norm(miss(x), axis=1), CLIP))
        mean = float(np.mean(error[: int(np.ceil(0.9 * len(error)))]))
        return mean, rotation.exp(x[:3]), x[3:6] / middle, middle * x[6] if shifted else 0.0

    def relief(self, c: int) -> tuple[float, float]:
        """Error of the flow of a component at one depth, above the noise, and the noise; pixels."""
        if c not in self.known:
            at, noise = self.members(c), self.start.noise
            if len(at) < FEWEST or self.start.at_rest:
                return 0.0, noise
            floor = min(noise, float(np.median(self.start.error[at])))
            self.known[c] = self.motion(at, np.ones(len(at)))[0] - floor, floor
        return self.known[c]

    @property
    def tells(self) -> float:
        """Pixels of relief that determine depth."""
        return max(TELLS_PX, TELLS * self.start.noise)

    def determined(self, c: int) -> bool:
        """Whether the flow determines the depth of a component."""
        return self.relief(c)[0] > self.tells


def calibrated(
    seen: Seen, c: int, value: Float, known: Mask, kind: Kind | None
) -> tuple[Kind, Callable[[Float], Float], float]:
    """Kind of a prior, log depth as a function of its values, and `Given.ratio` by component c.

    `value` (N,) are those of the superpixels.
    """
    rank = stats.rankdata(value) / (len(value) + 1)
    rises = np.argsort(value)
    logs: dict[Kind, Callable[[Float], Float]] = {
        "metric": np.log,
        "relative": np.log,
        "inverse": lambda v: -np.log(v),
        "ordinal": lambda v: RELIEF * stats.norm.ppf(np.interp(v, value[rises], rank[rises])),
    }
    relief, floor = seen.relief(c)
    at = seen.members(c)
    at = at[known[at]]
    if len(at) < FEWEST or not relief > seen.tells / 3:
        # what is lower in an image is mostly nearer
        below = np.corrcoef(rank, seen.views.anchor[:, 1])[0, 1] > 0
        kind = kind or ("inverse" if below else "relative")
        return kind, logs[kind], np.nan
    tried: list[tuple[float, Kind, Callable[[Float], Float]]] = []
    for name in (kind,) if kind else ("relative", "inverse"):
        inverse = np.exp(-logs[name](value[at]))
        error, *_, shift = seen.motion(at, inverse, name == "inverse")
        tried.append(((error - floor) / relief, name, logs[name]))
        if name == "inverse":
            least = float(np.median(np.abs(value + shift))) / DEEPEST
            tried[-1] = (*tried[-1][:2], partial(_shifted, shift=shift, least=least))
    ratio, name, depth_of = min(tried, key=lambda one: one[0])
    # where neither explains the flow a shift lowers the error of any map
    return (name, depth_of, ratio) if ratio <= POSSIBLE else (tried[0][1], tried[0][2], ratio)


def _shifted(value: Float, shift: float, least: float) -> Float:
    """Log depth of inverse depths to which a shift is added, at least `least`."""
    return np.asarray(-np.log(np.maximum(value + shift, least)))


def follows_edges(values: Float, image: Image, seed: int = 0) -> bool:
    """Whether a map follows the superpixels and the edges of its image better than by chance.

    Args:
        values: (H, W) log depth or any other map without gaps.
        image: (H, W, 3) the image.
        seed: Of the shifts.
    """
    rows, columns = (max(8, round(n * SIDE / max(values.shape))) for n in values.shape)
    small = cv2.resize(values, (columns, rows), interpolation=cv2.INTER_AREA)
    small = ndimage.median_filter(small.astype(float), 3)
    if np.ptp(small) < 1e-9:
        return False
    grey = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(float), (0, 0), 1.5)
    edges = _ranks(cv2.resize(_gradient(grey), (columns, rows), interpolation=cv2.INTER_AREA))
    own = segment(cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA), PIECES)
    count = np.maximum(np.bincount(own.ravel()), 1)

    def scores(one: Float, steps: Float) -> tuple[float, float]:
        inside = one - (np.bincount(own.ravel(), one.ravel()) / count)[own]
        return -float(np.mean(inside**2) / max(one.var(), 1e-30)), float(np.mean(steps * edges))

    steps = _ranks(_gradient(small))
    pad = ((rows // 2, rows // 2), (columns // 2, columns // 2))
    rng = np.random.default_rng(seed)
    others: list[tuple[float, float]] = []
    while len(others) < TRIALS:
        down, right = (int(n * FARTHEST * rng.uniform(-1, 1)) for n in (rows, columns))
        mirrored = len(others) % 2
        if not mirrored and abs(down) + abs(right) < NEAREST * columns:
            continue
        a, b = rows // 2 + down, columns // 2 + right
        flip = -1 if mirrored else 1
        moved = (np.pad(m[:, ::flip], pad, mode="reflect") for m in (small, steps))
        others.append(scores(*(m[a : a + rows, b : b + columns] for m in moved)))
    chance = np.array(others)
    found = scores(small, steps)
    if -found[0] > WITHIN:
        return False
    better = (found - chance.mean(axis=0)) / np.maximum(chance.std(axis=0), 1e-12)
    return bool(better @ [2.0, 1.0] > LEAST)


def _gradient(values: Float) -> Float:
    """(H, W) length of the gradient."""
    return np.hypot(*(cv2.Sobel(values, cv2.CV_64F, x, 1 - x, ksize=3) for x in (1, 0)))


def _ranks(values: Float) -> Float:
    """Ranks of all values, from -1/2 to 1/2."""
    return (stats.rankdata(values, "ordinal").reshape(values.shape) - 1) / values.size - 0.5
