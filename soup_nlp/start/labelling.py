"""One labelling: every superpixel takes one of few rigid motions, each at a price.

The labels l minimise, with TRW-S, the energy

    sum_i c_i rho(e_i(l_i)) + sum_ij w_ij [l_i != l_j] + price * (number of motions that are used)
    rho(e) = min(max(e / s - 1, 0), MOST_COST)

where e is the error that a motion leaves beyond that of an affine flow, c the confidence of the
flow, and w the price of a change of motion where the flow is continuous. Large parts of a dense
flow share an error s. It is no evidence of another motion, however many superpixels have it, so
that errors up to s cost nothing.

Motions are proposed from the whole image, for surfaces and for pieces that no motion explains.
Those that do not pay are removed, and the others are fitted to their superpixels, as in PEARL
(H. Isack, Y. Boykov, IJCV 97, 2012) and Progressive-X (D. Barath, J. Matas, ICCV 2019).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.geometry.plane import PlaneFit
from soup_nlp.mrf.trws import solve_trws
from soup_nlp.start.epipolar import (
    SIDEWAYS,
    Motion,
    estimate,
    fit_translation,
    refine_near,
)
from soup_nlp.start.regions import belonging, connected_labels, connected_pieces
from soup_nlp.start.views import FlowFit

CLIP = 3.0
"""Errors are clipped at this many pixels where motions are compared."""
LEAST_NOISE, MOST_NOISE = 0.05, 0.6
"""Limits of the flow's noise, pixels."""
SHARED_SCALE, LEAST_SHARED = 3.0, 0.03
"""Error that the flow shares, in units of the median error under the best motions, and its least,
pixels."""
MOST_COST, CHANGE_COST, PRICE = 8.0, 6.0, 0.04
"""Largest cost of a superpixel, half the cost of one that differs from all its neighbours, and
price of a motion by the number of superpixels: half a percent of them, if no other motion explains
them, and at least one, pay for it."""
PROPOSAL_SURFACES, PROPOSAL_PIECES, PROPOSAL_ROUNDS = 12, 6, 3
"""Largest numbers of surfaces and of pieces that no motion explains for which motions are proposed,
and of rounds of proposals."""
PIECE_SIZE = 4
"""Least number of superpixels that determine a motion."""
UNEXPLAINED = 0.25
"""Share of `MOST_COST` from which on a motion does not explain a superpixel."""
MOTION_PIXELS, SCENE_PIXELS = 1500, 6000
"""Largest number of pixels to which a motion is fitted, and that of the whole image."""


def limited_noise(error: Float) -> float:
    """Noise of the flow, pixels: the median of the superpixels' errors (N,), within limits."""
    return float(np.clip(np.median(error), LEAST_NOISE, MOST_NOISE))


@dataclass(frozen=True)
class Labelling:
    """Motion and plane of every superpixel.

    Attributes:
        motions: Motions, the most frequent first.
        label: (N,) index of the motion of every superpixel.
        fit: Planes (N, 1) under these motions.
        excess: (N,) error beyond that of an affine flow, pixels.
        shared: Error that large parts of the flow share, pixels.
    """

    motions: list[Motion]
    label: Int
    fit: PlaneFit
    excess: Float
    shared: float

    @classmethod
    def of(cls, flow: FlowFit, motions: list[Motion], label: Int, shared: float) -> Self:
        """Motions by indices (N,), which are numbered by frequency, and their planes."""
        used, inverse, count = np.unique(label, return_inverse=True, return_counts=True)
        order = np.argsort(-count, kind="stable")
        motions, label = [motions[c] for c in used[order]], np.argsort(order)[inverse.ravel()]
        fit = flow.views.fit(motions, label)
        excess = np.maximum(fit.penalised()[:, 0] - flow.residual, 0.0)
        return cls(motions, label, fit, excess, shared)

    @property
    def parallax(self) -> Float:
        """(N,) pixels that each translation moves the anchor."""
        return self.fit.parallax[:, 0] * np.abs(self.fit.inverse_depth[:, 0])

    @property
    def unexplained(self) -> Mask:
        """(N,) True where the motion does not explain the flow."""
        return _price(self.excess, self.shared) > UNEXPLAINED * MOST_COST


def labelled(flow: FlowFit, motions: list[Motion], surface: Int) -> Labelling:
    """The labelling of least energy among the given motions and those that are proposed here.

    A surface (N,) is a connected part with continuous flow.

    Superpixels without usable flow take the motion of the surface that they continue.
    """
    views, seen = flow.views, flow.views.usable & ~flow.poor
    if not seen.any():
        return Labelling.of(flow, motions[:1], np.zeros(len(flow.seg), np.int64), LEAST_SHARED)
    motions = motions + _of_surfaces(flow, seen, surface, motions[0])
    for left in reversed(range(PROPOSAL_ROUNDS + 1)):
        error = views.fit(motions).penalised() - flow.residual[:, None]
        excess = np.maximum(error, 0.0)
        shared = max(LEAST_SHARED, SHARED_SCALE * float(np.median(excess.min(axis=1)[seen])))
        cost = views.weight.mean(axis=1)[:, None] * _price(excess, shared)
        used, label = _paying(flow, cost)
        if left:
            bad = seen & (
                cost[np.arange(len(cost)), np.array(used)[label]] > UNEXPLAINED * MOST_COST
            )
            kept = [motions[c] for c in used]
            motions = _refitted(flow, kept, label, seen, bad, shared / SHARED_SCALE)
    label = belonging(flow.seg, label, seen)
    label = _earned(flow, np.where(seen[:, None], cost[:, used], 0.0), label)
    return Labelling.of(flow, [motions[c] for c in used], label, shared)


def price_of_motion(count: int) -> float:
    """Price of a motion in an image of `count` superpixels."""
    return max(MOST_COST, PRICE * count)


def _price(excess: Float, shared: float) -> Float:
    return np.clip(excess / shared - 1.0, 0.0, MOST_COST)


def dominant(flow: FlowFit) -> Motion:
    """The motion that most of the image shares."""
    matches = flow.views.matches().confident(SCENE_PIXELS)
    return estimate(matches, flow.options.threshold_px) or SIDEWAYS


def _of_surfaces(flow: FlowFit, seen: Mask, surface: Int, main: Motion) -> list[Motion]:
    """Motions of the surfaces (N,) with the most superpixels that are seen."""
    largest = np.argsort(-np.bincount(surface[seen]))[:PROPOSAL_SURFACES]
    groups = [np.flatnonzero((surface == c) & seen) for c in largest]
    scale = limited_noise(flow.residual[seen])
    large = [at for at in groups if len(at) >= PIECE_SIZE]
    return [m for at in large for m in candidates(flow, at, main, [], scale)]


def candidates(
    flow: FlowFit, at: Int, main: Motion, present: Sequence[Motion], scale: float
) -> list[Motion]:
    """Candidate motions for superpixels `at`: the present ones and a translation with the rotation
    of the main motion, refined, and the motion of their own essential matrix.

    `scale` is the error of the flow across epipolar lines, pixels.
    """
    noise = limited_noise(flow.residual[at])
    matches = flow.views.subset(at).matches(MOTION_PIXELS)
    shift = fit_translation(main.R, matches, max(noise, 0.1))
    refined = [refine_near(m, matches, scale) for m in (*present, shift)]
    own = estimate(matches, max(3 * noise, 0.3))
    return refined if own is None else [*refined, own]


def _refitted(
    flow: FlowFit, motions: list[Motion], label: Int, seen: Mask, bad: Mask, scale: float
) -> list[Motion]:
    """Motions with candidates for the superpixels of each and for pieces that none explains."""
    main = motions[int(np.argmax(np.bincount(label[seen], minlength=len(motions))))]
    piece = connected_pieces(bad, flow.seg)
    large = np.argsort(-np.bincount(piece[bad], minlength=1))[:PROPOSAL_PIECES]
    groups = [((label == c) & seen, [m]) for c, m in enumerate(motions)]
    out = list(motions)
    for mask, own in groups + [(piece == c, []) for c in large]:
        at = np.flatnonzero(mask)
        if len(at) >= PIECE_SIZE:
            out += candidates(flow, at, main, own, scale)
    return out


def _paying(flow: FlowFit, cost: Float) -> tuple[list[int], Int]:
    """Columns of the costs (N, M) that pay their price, and (N,) the index among them of each.

    Motions are first added greedily while costs alone pay for them. Then that which saves least
    over the second best ones is removed, until all pay.
    """
    used, least = [int(np.argmin(cost.sum(axis=0)))], price_of_motion(len(cost))
    while True:
        best = cost[:, used].min(axis=1, keepdims=True)
        saved = np.maximum(best - cost, 0.0).sum(axis=0)
        if saved.max() < least:
            break
        used.append(int(np.argmax(saved)))
    while True:
        mine = cost[:, used]
        label = smooth(flow, mine)
        if len(used) == 1:
            return used, label
        rows = np.arange(len(mine))
        others = mine.copy()
        others[rows, label] = np.inf
        saved = np.bincount(label, others.min(axis=1) - mine[rows, label], len(used))
        if saved.min() >= least:
            return used, label
        del used[int(np.argmin(saved))]


def _earned(flow: FlowFit, cost: Float, label: Int) -> Int:
    """(N,) labels, where connected pieces that save less than a price over the main one take it."""
    main, rows = int(np.argmax(np.bincount(label))), np.arange(len(label))
    piece = connected_labels(~flow.seg.across(label), flow.seg)
    saved = np.bincount(piece, cost[:, main] - cost[rows, label])
    return np.where(saved[piece] < price_of_motion(len(label)), main, label)


def smooth(flow: FlowFit, cost: Float) -> Int:
    """(N,) labels that minimise costs (N, M) plus `CHANGE_COST` where neighbours differ, by TRW-S.

    The weight of a neighbour is its share of the outlines times its affinity.
    """
    (n, m), seg = cost.shape, flow.seg
    if m == 1 or not len(seg.pairs):
        return np.argmin(cost, axis=1)
    i, k = seg.pairs.T
    length = seg.boundary_length.astype(float)
    outline = np.bincount(i, length, n) + np.bincount(k, length, n)
    weight = CHANGE_COST * flow_affinity(flow) * length * (1 / outline[i] + 1 / outline[k])
    return solve_trws(cost, seg.pairs, weight[:, None, None] * (1 - np.eye(m)), max_iter=30).labels


def flow_affinity(flow: FlowFit) -> Float:
    """(P,) affinity of two neighbours: 1 where their flow is continuous, towards 0 at jumps."""
    return np.exp(-2 * flow.jump / flow.options.discontinuity_px)


# --- regions that stand still in the image of a moving camera -------------------------------------

FIXED_PX = 1.0
"""Mean displacement up to which a superpixel may stand still, pixels: it may reflect movers."""
CONTRADICTED_PX = 0.5
"""Least error of the best depth, pixels, beside the displacement."""
LEAST_SCENE = 0.6
"""Least share of the superpixels that the camera's motion explains; below it, the
still part may be the scene."""
LEAST_STILL = 0.5
"""Least share of still superpixels in a piece with continuous flow."""


def fixed_to_camera(flow: FlowFit) -> tuple[Mask, Float]:
    """(N,) True where the image stands still, which the camera's motion contradicts.

    A bonnet, a logo or dirt on the lens is fixed to the camera, or moves as it does, so that its
    flow shows neither depth nor the camera's motion. A distant region stands still as well, but its
    depth under the camera's motion explains that; the flow of a fixed region contradicts every
    depth. Nothing is fixed between frames with different intrinsics.

    Returns:
        The mask, and (N,) the mean displacement of every superpixel, pixels.
    """
    seg, views, usable = flow.seg, flow.views, flow.views.usable
    none, shift = np.zeros(len(seg), bool), views.distance(views.ray)
    may = usable & (shift < FIXED_PX)
    if may.sum() < PIECE_SIZE or not np.array_equal(flow.K_ref, flow.K_next):
        return none, shift
    camera = dominant(flow.without(may | ~usable))
    error = views.fit([camera]).penalised()[:, 0]
    if (error[usable] < CONTRADICTED_PX).sum() < LEAST_SCENE * usable.sum():
        return none, shift
    may &= error - shift > CONTRADICTED_PX
    moves = ~usable | (error > CONTRADICTED_PX)
    continuous = flow.jump < flow.options.discontinuity_px
    piece = connected_labels(moves[seg.pairs].all(axis=1) & continuous, seg)
    count, still_count = (np.bincount(piece, m, minlength=len(seg)) for m in (usable & moves, may))
    mostly = (still_count >= PIECE_SIZE) & (still_count >= LEAST_STILL * count)
    return may & mostly[piece], shift
