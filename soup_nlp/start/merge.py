"""Each independently moving, connected region gets one rigid motion if one fits.

A few pixels do not determine a motion: several motions, including the camera's, explain the flow of
a small region equally well with different depths. If its superpixels choose independently, the
region falls apart. Flow discontinuities show the outlines of regions more reliably.
"""

from __future__ import annotations

import numpy as np

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.geometry.graph import Segmentation
from soup_nlp.start.choice import (
    CLIP,
    PIECE_SIZE,
    UNEXPLAINED_PX,
    Choice,
    flow_affinity,
    least_gain,
    limited_noise,
    smooth_choice,
)
from soup_nlp.start.components import connected_labels, connected_pieces, largest
from soup_nlp.start.epipolar import Motion, estimate, fit_translation, refine_near
from soup_nlp.start.start_options import SeededStart
from soup_nlp.start.views import Views

LEAST_GAIN_PX, LEAST_GAIN = 0.15, 10.0
"""Least mean error that the main motion leaves of a region with motions of its own: in pixels, and
in units of the median error of all superpixels; the lower one decides, as flow may be exact."""
SMALL = 0.008
"""Largest share of the superpixels of a piece that may be a mixture of the flows around it."""
MIXED_PX = 2.0
"""Largest distance, pixels, between the flow of a mixture that its own motion explains badly and
the flows around it."""
PIXELS = 1500
"""Largest number of pixels of a component to which a motion is fitted."""
AGREE = 0.7
"""Least share of a component's superpixels that its motion explains."""
DISCONTINUITIES = (1.0, 0.5, 0.25)
"""Jumps of the flow that separate two regions, relative to `discontinuity_px`. A smaller
jump is tried where no single motion explains a region that a larger one separates."""


def gather(
    views: Views, seg: Segmentation, jump: Float, choice: Choice, noise: float, o: SeededStart
) -> Choice:
    """Give each region one motion and then add neighbouring superpixels that this motion explains.

    Args:
        views: Rays, targets and confidence of every superpixel.
        seg: Superpixels and graphs.
        jump: (P,) pixels by which the flow of two neighbours differs on their boundary.
        choice: Present choice.
        noise: Flow noise, pixels.
        o: Price of differing neighbours, where a surface ends, and seed.
    """
    gain = least_gain(noise)
    for share in DISCONTINUITIES:
        whole = jump < share * o.discontinuity_px
        choice = _one_motion_each(views, seg, whole, choice, noise, gain, o)
    return _spread(views, seg, jump, choice, gain, o)


def earned(views: Views, choice: Choice, seg: Segmentation, noise: float) -> tuple[Choice, Mask]:
    """The choice without regions whose own motions explain too little.

    A connected region keeps its motions if the main one leaves a larger mean error there, by
    `LEAST_GAIN_PX` or `LEAST_GAIN`; otherwise it takes the main one.

    Args:
        views: Rays, targets and confidence of every superpixel.
        choice: Present choice.
        seg: Superpixels and graphs.
        noise: Flow noise, pixels.

    Returns:
        The choice, and (N,) True where the main motion does not explain the flow, so that its depth
        is not known.
    """
    gain, moves = choice.gain(views), choice.label > 0
    region = connected_pieces(moves, seg)
    count, total = (np.bincount(region[moves], v, minlength=1) for v in (None, gain[moves]))
    least = min(LEAST_GAIN_PX, LEAST_GAIN * float(np.median(choice.error)))
    left = moves & ((total < least * count)[region])
    kept = Choice.of(views, choice.motions, np.where(left, 0, choice.label))
    return kept, left & (gain > 3 * noise)


def unmoved(
    component: Int, choice: Choice, flow: Float, usable: Mask, views: Views, seg: Segmentation
) -> Mask:
    """(N,) True in pieces whose flow shows no motion of their own.

    The motion of a piece with more than `SMALL` of all superpixels may be due to a systematic error
    of the flow if it lowers the mean error by less than the noise. A smaller piece may be a
    mixture: along a depth discontinuity the flow of a superpixel mixes those of both sides. It is a
    mixture if its flow lies between the flows of adjacent superpixels of the largest component. If
    its own motion explains its flow badly and hardly better than the main motion does, a flow near
    the adjacent flows is enough.

    Args:
        component: (N,) rigid component of every superpixel.
        choice: Motion and plane of every superpixel.
        flow: (N, 2) displacement of the anchors, pixels.
        usable: (N,) True where the flow counts.
        views: Rays, targets and confidence of every superpixel.
        seg: Superpixels and graphs.
    """
    main, noise = largest(component), limited_noise(choice.error)
    error = views.fit(choice.motions[:1]).penalised()[:, 0]
    gain = choice.gain(views)
    i, k = seg.pairs.T
    piece = connected_labels(component[i] == component[k], seg)
    moving, mixed = choice.label > 0, np.zeros(len(seg), bool)
    for p in np.unique(piece[(component != main) & usable]):
        at = piece == p
        if at.mean() > SMALL:
            mixed |= at & (moving[at].any() and gain[at].mean() < noise)
            continue
        if usable[at].mean() <= 0.5:
            continue
        around = np.concatenate([k[at[i] & ~at[k]], i[at[k] & ~at[i]]])
        around = around[usable[around] & (component[around] == main)]
        if not len(around):
            continue
        middle, sides = np.median(flow[at], axis=0), flow[around]
        outside = np.maximum(sides.min(axis=0) - middle, middle - sides.max(axis=0)).max()
        own_error = np.median(choice.error[at])
        badly = (
            own_error > 2 * noise and np.median(error[at]) < 3 * own_error and outside < MIXED_PX
        )
        mixed |= at & (badly or outside < 3 * noise)
    return mixed


def _one_motion_each(
    views: Views,
    seg: Segmentation,
    whole: Mask,
    choice: Choice,
    noise: float,
    gain: float,
    o: SeededStart,
) -> Choice:
    """Give each piece without the main motion, joined by the pairs `whole` (P,), one motion."""
    motions, label = list(choice.motions), choice.label.copy()
    mover = label > 0
    piece = connected_pieces(mover, seg, whole)
    for c in np.unique(piece[mover]):
        at = np.flatnonzero(piece == c)
        # it has one motion already, and a change of it by a few pixels is not reliable
        if len(at) < PIECE_SIZE or len(np.unique(label[at])) == 1:
            continue
        present = [choice.motions[c] for c in np.unique(label[at])]
        tried = candidates(views, at, choice.motions[0], present, noise, o.seed)
        cost = views.subset(at).fit(tried).penalised()
        m = int(np.argmin(np.minimum(cost, CLIP).mean(axis=0)))
        agrees = cost[:, m] < choice.error[at] + gain
        if agrees.sum() >= AGREE * len(at):
            label[at[agrees]] = len(motions)
            motions.append(tried[m])
    return Choice.of(views, motions, label)


def candidates(
    views: Views, at: Int, main: Motion, present: list[Motion], noise: float, seed: int
) -> list[Motion]:
    """Candidate motions for superpixels `at`, fitted to all their pixels.

    These are a translation with the rotation of `main`, before and after refinement, the `present`
    motions of the superpixels, refined, and the motion of their own essential matrix.
    """
    step = max(1, len(at) * views.ray.shape[1] // PIXELS)
    r, q = (v[at].reshape(-1, 3)[::step] for v in (views.ray, views.target))
    w = views.weight[at].ravel()[::step]
    correspondences = r, q, w, views.focal[0]
    start = [fit_translation(main.R, *correspondences, max(noise, 0.1)), *present]
    motion = estimate(*correspondences, max(3 * noise, 0.3), seed)
    refined = [refine_near(m, *correspondences, max(noise, 0.1)) for m in start]
    return [*refined, start[0], *([] if motion is None else [motion])]


def _spread(
    views: Views, seg: Segmentation, jump: Float, choice: Choice, gain: float, o: SeededStart
) -> Choice:
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
    cost = np.minimum(views.fit([choice.motions[c] for c in kept]).penalised(), CLIP)
    cost[:, 0] -= 0.5 * UNEXPLAINED_PX
    stay = np.where(large[label], np.inf, np.minimum(choice.error, CLIP) + 0.5 * gain)
    # motions of whole regions are more reliable than those of pieces: twice the price
    near = flow_affinity(jump, o)
    new = smooth_choice(np.column_stack([cost, stay]), near, seg, 2 * o.smoothness)
    return Choice.of(views, choice.motions, np.where(new < m, np.append(kept, -1)[new], label))
