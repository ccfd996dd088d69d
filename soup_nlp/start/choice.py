"""Choice of a motion for every superpixel: candidates, smallest sufficient set, smoothness."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from soup_nlp.arrays import Float, Int
from soup_nlp.geometry.plane import PlaneFit
from soup_nlp.mrf.trws import solve_trws
from soup_nlp.start.components import connected_pieces
from soup_nlp.start.epipolar import SIDEWAYS, Motion, estimate, repeated
from soup_nlp.start.views import FlowFit, Views

CLIP = 3.0
"""Errors are clipped at this many pixels where motions are compared."""


DOMINANT, ROUNDS = 5, 3
"""Largest number of motions of the whole image, and rounds in which motions are added."""
UNEXPLAINED_PX = 0.1
"""Error below which a superpixel does not look for another motion, pixels."""
PIECES, PIECE_SIZE = 6, 4
"""Largest number of unexplained pieces that get candidate motions in a round, and the least number
of superpixels of a piece: fewer do not determine a motion."""


LEAST_CONFIDENCE = 0.3
"""Mean confidence of a superpixel above which an error is due to its motion, not to its flow."""


def least_gain(noise: float) -> float:
    """Least gain in error (pixels) for which a superpixel changes its motion, for a flow noise."""
    return max(2 * noise, UNEXPLAINED_PX)


def dominant(flow: FlowFit) -> list[Motion]:
    """Motions that many pixels share, the most frequent first; at least one."""
    seed = flow.options.seed
    matches = flow.views.matches()
    good = np.flatnonzero(matches.weight > 0.3 * matches.weight.max())
    rng = np.random.default_rng(seed)
    pick = good if len(good) <= 6000 else rng.choice(good, 6000, replace=False)
    motions = repeated(matches.at(pick), DOMINANT, flow.options.threshold_px, seed)
    return motions or [SIDEWAYS]


LEAST_NOISE, MOST_NOISE = 0.05, 0.6
"""Limits of the flow's noise, pixels."""


def limited_noise(error: Float) -> float:
    """Noise of the flow, pixels: the median of the superpixels' errors (N,), within limits."""
    return float(np.clip(np.median(error), LEAST_NOISE, MOST_NOISE))


def of_pieces(flow: FlowFit, cost: Float, noise: float) -> list[Motion]:
    """Motions of the connected pieces whose flow the present motions do not explain.

    A piece gets the motion of its own essential matrix.

    Args:
        flow: The flow of every superpixel.
        cost: (N, M) penalised error under them, pixels.
        noise: Flow noise, pixels.
    """
    bad = cost.min(axis=1) > max(3 * noise, UNEXPLAINED_PX)
    bad &= flow.views.weight.mean(axis=1) > LEAST_CONFIDENCE
    piece = connected_pieces(bad, flow.seg)
    out: list[Motion] = []
    sizes = np.bincount(piece[piece >= 0], minlength=1)
    for c in np.argsort(-sizes)[:PIECES]:
        if sizes[c] < PIECE_SIZE:
            break
        matches = flow.views.subset(piece == c).matches()
        motion = estimate(matches, max(3 * noise, 0.3), flow.options.seed)
        out += [] if motion is None else [motion]
    return out


def select(cost: Float, noise: float) -> list[int]:
    """Smallest set of motions that explains the flow, found greedily.

    Each motion must lower the error of enough superpixels by the least gain.

    Args:
        cost: (N, M) penalised error of each superpixel under each motion, pixels.
        noise: Flow noise, pixels.

    Returns:
        Kept columns, the best motion first.
    """
    clipped = np.minimum(cost, CLIP)
    kept = [int(np.argmin(clipped.sum(axis=0)))]
    while len(kept) < clipped.shape[1]:
        best = clipped[:, kept].min(axis=1)
        better = np.maximum(best[:, None] - clipped - least_gain(noise), 0.0)
        c = int(np.argmax(better.sum(axis=0)))
        if np.sum(better[:, c] > 0) < PIECE_SIZE:
            break
        kept.append(c)
    return kept


def smooth_choice(flow: FlowFit, cost: Float, price: float) -> Int:
    """Labels that minimise the costs plus `price` where neighbours differ, by TRW-S.

    A superpixel that differs from all its neighbours pays about twice the price. The weight of a
    neighbour is its share of the outlines times its affinity.

    Args:
        flow: The flow of every superpixel.
        cost: (N, M) cost of each superpixel under each label, pixels; +inf forbids one.
        price: Price of two different labels, pixels.

    Returns:
        (N,) label of every superpixel.
    """
    (n, m), seg = cost.shape, flow.seg
    if m == 1 or not len(seg.pairs):
        return np.argmin(cost, axis=1)
    i, k = seg.pairs.T
    length = seg.boundary_length.astype(float)
    outline = np.bincount(i, length, n) + np.bincount(k, length, n)
    weight = price * flow_affinity(flow) * length * (1 / outline[i] + 1 / outline[k])
    tables = weight[:, None, None] * (1 - np.eye(m))
    return solve_trws(cost, seg.pairs, tables, max_iter=50).labels


def flow_affinity(flow: FlowFit) -> Float:
    """(P,) affinity of two neighbours: 1 where their flow is continuous, towards 0 at jumps."""
    return np.exp(-2 * flow.jump / flow.options.discontinuity_px)


@dataclass(frozen=True)
class Choice:
    """Chosen motion and plane of every superpixel.

    Attributes:
        motions: Motions, the most frequent first (`Choice.of`).
        label: (N,) index of the motion of every superpixel.
        fit: Planes (N, 1) under these motions.
        noise: Noise of the flow under all candidate motions, pixels.
    """

    motions: list[Motion]
    label: Int
    fit: PlaneFit
    noise: float

    @classmethod
    def of(cls, views: Views, motions: list[Motion], label: Int, noise: float) -> Self:
        """Motions by indices (N,), which are numbered by frequency, and their planes."""
        used, inverse, count = np.unique(label, return_inverse=True, return_counts=True)
        order = np.argsort(-count, kind="stable")
        motions, label = [motions[c] for c in used[order]], np.argsort(order)[inverse.ravel()]
        return cls(motions, label, views.fit(motions, label), noise)

    @property
    def error(self) -> Float:
        """(N,) penalised re-projection error, pixels."""
        return self.fit.penalised()[:, 0]

    @property
    def parallax(self) -> Float:
        """(N,) pixels that each translation moves the anchor."""
        return self.fit.parallax[:, 0] * np.abs(self.fit.inverse_depth[:, 0])

    def main_error(self, views: Views) -> Float:
        """(N,) penalised re-projection error under the first motion, pixels."""
        return views.fit(self.motions[:1]).penalised()[:, 0]

    def gain(self, views: Views) -> Float:
        """(N,) error, pixels, that the motions save over the first one, times the confidence."""
        saved = np.clip(self.main_error(views) - self.error, 0.0, CLIP)
        return saved * views.weight.mean(axis=1)


def rigid_choice(flow: FlowFit, motions: list[Motion]) -> Choice:
    """One of few rigid motions for every superpixel.

    To the candidates for the whole image those of unexplained pieces are added.
    """
    with_flow = flow.views.weight.any(axis=1)
    for extend in range(ROUNDS + 1):
        fit = flow.views.fit(motions)
        cost = fit.penalised()
        kept = select(cost, limited_noise(cost.min(axis=1)[with_flow]))
        motions, cost = [motions[c] for c in kept], cost[:, kept]
        noise = limited_noise(cost.min(axis=1)[with_flow])
        # motions of the pieces that no motion explains yet
        extra = of_pieces(flow, cost, noise) if extend < ROUNDS else []
        if not extra:
            break
        motions = motions + extra
    # the dominant motion is preferred where another is not clearly better
    prefer = np.where(np.arange(len(motions)) == 0, 0.0, max(noise, 0.5 * UNEXPLAINED_PX))
    # beyond 5 pixels one motion is as wrong as another
    label = smooth_choice(flow, np.minimum(cost + prefer, 5.0), flow.options.smoothness)
    return Choice.of(flow.views, motions, label, noise)
