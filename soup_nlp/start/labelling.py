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
from soup_nlp.geometry.graph import connected
from soup_nlp.geometry.plane import PlaneFit
from soup_nlp.mrf.trws import solve_trws
from soup_nlp.start.epipolar import (
    MOTION_CHANGE,
    SIDEWAYS,
    Motion,
    estimate,
    fit_translation,
    most_probable,
    refine_near,
)
from soup_nlp.start.regions import belonging, connected_pieces
from soup_nlp.start.views import JUMP_PX, FlowFit

LEAST_NOISE, MOST_NOISE = 0.05, 0.6
"""Limits of the flow's noise, pixels."""
IN_NOISE, LEAST_SHARED = 3.0, 0.03
"""Error that large parts of a flow share, so that it is no evidence: in units of the noise, which
is the median error under the best motions, and its least, pixels."""
MOST_COST, CHANGE_COST, PRICE = 8.0, 6.0, 0.04
"""Largest cost of a superpixel, half the cost of one that differs from all its neighbours, and
price of a motion by the number of superpixels: half a percent of them, if no other motion explains
them, and at least one, pay for it."""
PROPOSAL_SURFACES, PROPOSAL_PIECES, PROPOSAL_ROUNDS = 12, 6, 3
"""Largest numbers of surfaces and of pieces that no motion explains for which motions are proposed,
and of rounds of proposals."""
PIECE_SIZE = 4
"""Least number of superpixels that determine a motion."""
UNEXPLAINED = 2.0
"""Cost of a superpixel from which on a motion does not explain it."""
MOTION_PIXELS = 1500
"""Largest number of pixels to which a motion is fitted, a turn to twice and the motion of the whole
image to four times as many."""
EXACT_PX = 0.005
"""Error below which a flow is exact, as a rendered one is, and leaves no motion open, pixels."""


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
        return _cost(self.excess, self.shared) > UNEXPLAINED


def labelled(flow: FlowFit, motions: list[Motion], surface: Int) -> Labelling:
    """The labelling of least energy among the given motions and those that are proposed here.

    A surface (N,) is a connected part with continuous flow. Superpixels without usable flow take
    the motion of the surface that they continue. Connected pieces that save less than the price of
    a motion take the most frequent one.
    """
    views, seen, rows = flow.views, flow.trusted, np.arange(len(flow.seg))
    if not seen.any():
        return Labelling.of(flow, motions[:1], 0 * rows, LEAST_SHARED)
    groups: list[tuple[Mask, list[Motion]]]
    groups = [((surface == c) & seen, []) for c in _largest(surface[seen], PROPOSAL_SURFACES)]
    main, noise = motions[0], limited_noise(flow.residual[seen])
    for _ in range(PROPOSAL_ROUNDS + 1):
        for mask, own in groups:
            if mask.sum() >= PIECE_SIZE:
                motions = motions + candidates(flow, np.flatnonzero(mask), main, own, noise)
        error = views.fit(motions).penalised() - flow.residual[:, None]
        excess = np.maximum(error, 0.0)
        shared = max(LEAST_SHARED, IN_NOISE * float(np.median(excess.min(axis=1)[seen])))
        cost = views.weight.mean(axis=1)[:, None] * _cost(excess, shared)
        used, label = _paying(flow, cost)
        motions, cost = [motions[c] for c in used], cost[:, used]
        bad = seen & (cost[rows, label] > UNEXPLAINED)
        piece = connected_pieces(bad, flow.seg)
        groups = [((label == c) & seen, [m]) for c, m in enumerate(motions)]
        groups += [(piece == c, []) for c in _largest(piece[bad], PROPOSAL_PIECES)]
        main, noise = motions[np.argmax(np.bincount(label[seen]))], shared / IN_NOISE
    label = belonging(flow.seg, label, seen)
    cost = np.where(seen[:, None], cost, 0.0)
    first = int(np.argmax(np.bincount(label)))
    piece = connected(flow.seg.pairs[~flow.seg.across(label)], len(label))
    saved = np.bincount(piece, cost[:, first] - cost[rows, label])
    label = np.where(saved[piece] < price_of_motion(len(label)), first, label)
    return Labelling.of(flow, motions, label, shared)


def _largest(label: Int, most: int) -> Int:
    """The most frequent labels, at most so many."""
    return np.argsort(-np.bincount(label, minlength=1))[:most]


def price_of_motion(count: int) -> float:
    """Price of a motion in an image of `count` superpixels."""
    return max(MOST_COST, PRICE * count)


def _cost(excess: Float, shared: float) -> Float:
    return np.clip(excess / shared - 1.0, 0.0, MOST_COST)


def dominant(flow: FlowFit) -> Motion:
    """The motion that most of the image shares."""
    return estimate(flow.views.matches().confident(4 * MOTION_PIXELS)) or SIDEWAYS


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


def smooth(flow: FlowFit, cost: Float) -> Int:
    """(N,) labels that minimise costs (N, M) plus `CHANGE_COST` where neighbours differ, by TRW-S.

    The weight of a neighbour is its share of the outlines, the less the more the flow jumps there.
    """
    (n, m), seg = cost.shape, flow.seg
    if m == 1 or not len(seg.pairs):
        return np.argmin(cost, axis=1)
    i, k = seg.pairs.T
    length = seg.boundary_length.astype(float)
    outline = np.bincount(i, length, n) + np.bincount(k, length, n)
    weight = CHANGE_COST * np.exp(-2 * flow.jump / JUMP_PX) * length
    weight = weight * (1 / outline[i] + 1 / outline[k])
    return solve_trws(cost, seg.pairs, weight[:, None, None] * (1 - np.eye(m)), max_iter=30).labels


def with_least_relief(flow: FlowFit, choice: Labelling) -> tuple[Labelling, Float]:
    """The labelling with the most probable motion of every rigid component (`most_probable`), and
    (M, 5, 5) covariances of its motions by the error that the flow of a component shares.

    That follows from what its motion leaves unexplained, across the epipolar lines: along them,
    depth would explain it. An exact flow leaves none.
    """
    motions = list(choice.motions)
    covariance = np.tile(np.diag(MOTION_CHANGE**2), (len(motions), 1, 1))
    for c, motion in enumerate(motions):
        at = np.flatnonzero((choice.label == c) & flow.views.usable)
        if len(at) < PIECE_SIZE:
            continue
        error = IN_NOISE * float(np.median(choice.excess[at]))
        covariance[c] = 0.0
        if error > EXACT_PX:
            motions[c], covariance[c] = most_probable([motion], flow.anchor_matches(at), error)
    return Labelling.of(flow, motions, choice.label, choice.shared), covariance


# --- regions that stand still in the image of a moving camera -------------------------------------

LEAST_GAP_PX = 0.5
"""Pixels by which one explanation of the flow must be better than another to refute it: the best
depth than none, or depths than one depth or a turn, so that the flow determines the depth of a
component. From a third on it may confirm a prior."""
LEAST_SCENE = 0.6
"""Least share of the superpixels that the camera's motion explains; below it, the
still part may be the scene."""


def fixed_to_camera(flow: FlowFit) -> tuple[Mask, Float]:
    """(N,) True where the image stands still, which the camera's motion contradicts, and (N,) the
    mean displacement of every superpixel, pixels.

    A bonnet, a logo or dirt on the lens is fixed to the camera, or moves as it does, so that its
    flow shows neither depth nor the camera's motion. A distant region stands still as well, but its
    depth under the camera's motion explains that; the flow of a fixed region contradicts every
    depth. In a piece with continuous flow no more moves than stands still. Nothing is fixed between
    frames with different intrinsics.
    """
    seg, views, usable = flow.seg, flow.views, flow.views.usable
    none, shift = np.zeros(len(seg), bool), views.distance(views.ray)
    may = usable & (shift < JUMP_PX)
    if may.sum() < PIECE_SIZE or not np.array_equal(flow.K_ref, flow.K_next):
        return none, shift
    camera = dominant(flow.without(may | ~usable))
    error = views.fit([camera]).penalised()[:, 0]
    if (error[usable] < LEAST_GAP_PX).sum() < LEAST_SCENE * usable.sum():
        return none, shift
    may &= error - shift > LEAST_GAP_PX
    moves = ~usable | (error > LEAST_GAP_PX)
    inside = moves[seg.pairs].all(axis=1) & (flow.jump < JUMP_PX)
    piece = connected(seg.pairs[inside], len(seg))
    others, still = (np.bincount(piece, mask) for mask in (usable & moves & ~may, may))
    return may & ((still >= PIECE_SIZE) & (still >= others))[piece], shift
