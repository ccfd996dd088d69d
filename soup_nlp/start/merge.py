"""Each independently moving, connected region gets one rigid motion if one fits.

A few pixels do not determine a motion: several motions, including the camera's, explain the flow of
a small region equally well with different depths. If its superpixels choose independently, the
region falls apart. Flow discontinuities show the outlines of regions more reliably.
"""

import numpy as np

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.start.choice import (
    CLIP,
    LEAST_CONFIDENCE,
    PIECE_SIZE,
    UNEXPLAINED_PX,
    Choice,
    least_gain,
    limited_noise,
    smooth_choice,
)
from soup_nlp.start.components import SCENE, connected_labels, connected_pieces
from soup_nlp.start.epipolar import Motion, estimate, fit_translation, refine_near
from soup_nlp.start.views import FlowFit

LEAST_GAIN_PX, LEAST_GAIN = 0.15, 3.0
"""Least mean error that the main motion leaves of a region with motions of its own: in pixels, and
in units of the median error of all superpixels; the lower one decides, as flow may be exact. Below
0.15 px, parts of rigid scenes have up to 2.1 units, a ball along the epipolar lines 3.5 and 4.6."""
SMALL = 0.008
"""Largest share of the superpixels of a piece that may be a mixture of the flows around it."""
MIXED_PX = 2.0
"""Largest distance, pixels, between the flow of a mixture that its own motion explains badly and
the flows around it."""
PIXELS = 1500
"""Largest number of pixels of a component to which a motion is fitted."""
AGREE = 0.7
"""Least share of a component's superpixels that its motion explains."""
UNEXPLAINED = 3.0
"""Error beyond that of an affine flow, in units of the flow's noise, above which a motion does not
explain the flow of a superpixel."""
DISCONTINUITIES = (1.0, 0.5, 0.25)
"""Jumps of the flow that separate two regions, relative to `discontinuity_px`. A smaller
jump is tried where no single motion explains a region that a larger one separates."""


def gather(flow: FlowFit, choice: Choice) -> Choice:
    """Give each region one motion and then add neighbouring superpixels that this motion explains.

    Where no single motion explains a region, it is cut at smaller jumps of the flow.
    """
    for share in DISCONTINUITIES:
        motions, label = list(choice.motions), choice.label.copy()
        mover = label > 0
        piece = connected_pieces(mover, flow.seg, flow.jump < share * flow.options.discontinuity_px)
        for c in np.unique(piece[mover]):
            at = np.flatnonzero(piece == c)
            present = [choice.motions[m] for m in np.unique(label[at])]
            # it has one motion already, and a change of it by a few pixels is not reliable
            if len(at) < PIECE_SIZE or len(present) == 1:
                continue
            tried = candidates(flow, at, choice.motions[0], present, choice.noise)
            cost = flow.views.subset(at).fit(tried).penalised()
            m = int(np.argmin(np.minimum(cost, CLIP).mean(axis=0)))
            agrees = cost[:, m] < choice.error[at] + least_gain(choice.noise)
            if agrees.sum() >= AGREE * len(at):
                label[at[agrees]] = len(motions)
                motions.append(tried[m])
        choice = Choice.of(flow.views, motions, label, choice.noise)
    return _spread(flow, choice)


def candidates(
    flow: FlowFit, at: Int, main: Motion, present: list[Motion], noise: float
) -> list[Motion]:
    """Candidate motions for superpixels `at`, fitted to all their pixels.

    These are a translation with the rotation of `main`, before and after refinement, the `present`
    motions of the superpixels, refined, and the motion of their own essential matrix.
    """
    matches = flow.views.subset(at).matches(PIXELS)
    start = [fit_translation(main.R, matches, max(noise, 0.1)), *present]
    motion = estimate(matches, max(3 * noise, 0.3), flow.options.seed)
    refined = [refine_near(m, matches, max(noise, 0.1)) for m in start]
    return [*refined, start[0], *([] if motion is None else [motion])]


def _spread(flow: FlowFit, choice: Choice) -> Choice:
    """Choose among the motions of whole regions, preferring equal ones where flow is continuous.

    Superpixels with their own motion may keep it. TRW-S is used because many superpixels have to
    change together, for example where half of a region has the camera's motion.
    """
    label = choice.label
    large = np.bincount(label) >= PIECE_SIZE
    large[0] = True
    kept = np.flatnonzero(large)
    m = len(kept)
    if m == 1:
        return choice
    cost = np.minimum(flow.views.fit([choice.motions[c] for c in kept]).penalised(), CLIP)
    cost[:, 0] -= 0.5 * UNEXPLAINED_PX
    own_cost = np.minimum(choice.error, CLIP) + 0.5 * least_gain(choice.noise)
    cost = np.column_stack([cost, np.where(large[label], np.inf, own_cost)])
    # motions of whole regions are more reliable than those of pieces: twice the price
    new = smooth_choice(flow, cost, 2 * flow.options.smoothness)
    label = np.where(new < m, np.append(kept, -1)[new], label)
    return Choice.of(flow.views, choice.motions, label, choice.noise)


def earned(flow: FlowFit, choice: Choice) -> tuple[Choice, Mask]:
    """The choice without regions whose own motions explain too little.

    A connected region keeps its motions if the main one leaves a larger mean error there, by
    `LEAST_GAIN_PX` or `LEAST_GAIN`; otherwise it takes the main one.

    Returns:
        The choice, and (N,) True where the main motion does not explain the flow, so that its depth
        is not known.
    """
    gain, moves = choice.gain(flow.views), choice.label > 0
    region = connected_pieces(moves, flow.seg)
    count, total = (np.bincount(region[moves], v, minlength=1) for v in (None, gain[moves]))
    least = min(LEAST_GAIN_PX, LEAST_GAIN * float(np.median(choice.error)))
    left = moves & ((total < least * count)[region])
    kept = Choice.of(flow.views, choice.motions, np.where(left, 0, choice.label), choice.noise)
    return kept, left & (gain > 3 * choice.noise)


def unexplained(flow: FlowFit, error: Float, component: Int, noise: float) -> Mask:
    """(N,) True in pieces of components (N,) whose flow is affine, but not that of the motion.

    They may move by themselves, along the epipolar lines: then the depth that fits best is wrong.
    Superpixels with the flows of two surfaces are not affine. The errors (N,) under the motions of
    the components and the noise of the flow are in pixels.
    """
    bad = error - flow.residual > UNEXPLAINED * noise
    bad &= flow.views.weight.mean(axis=1) > LEAST_CONFIDENCE
    piece = connected_pieces(bad, flow.seg, ~flow.seg.across(component))
    size = np.bincount(piece[bad], minlength=1)
    return bad & (size[piece] >= PIECE_SIZE)


def unmoved(flow: FlowFit, choice: Choice, component: Int) -> Mask:
    """(N,) True in pieces of components (N,) whose flow shows no motion of their own.

    The motion of a piece with more than `SMALL` of all superpixels may be due to a systematic error
    of the flow if it lowers the mean error by less than the noise. A smaller piece may be a
    mixture: along a depth discontinuity the flow of a superpixel mixes those of both sides. It is a
    mixture if its flow lies between the flows of adjacent superpixels of the scene. If
    its own motion explains its flow badly and hardly better than the main motion does, a flow near
    the adjacent flows is enough.
    """
    noise = limited_noise(choice.error)
    error, gain = choice.main_error(flow.views), choice.gain(flow.views)
    shift, usable = flow.displacement, flow.views.usable
    i, k = flow.seg.pairs.T
    piece = connected_labels(~flow.seg.across(component), flow.seg)
    moving, mixed = choice.label > 0, np.zeros(len(piece), bool)
    for p in np.unique(piece[(component != SCENE) & usable]):
        at = piece == p
        if at.mean() > SMALL:
            mixed |= at & (moving[at].any() and gain[at].mean() < noise)
            continue
        if usable[at].mean() <= 0.5:
            continue
        around = np.concatenate([k[at[i] & ~at[k]], i[at[k] & ~at[i]]])
        around = around[usable[around] & (component[around] == SCENE)]
        if not len(around):
            continue
        middle, sides = np.median(shift[at], axis=0), shift[around]
        outside = np.maximum(sides.min(axis=0) - middle, middle - sides.max(axis=0)).max()
        own_error = np.median(choice.error[at])
        badly = (
            own_error > 2 * noise and np.median(error[at]) < 3 * own_error and outside < MIXED_PX
        )
        mixed |= at & (badly or outside < 3 * noise)
    return mixed
