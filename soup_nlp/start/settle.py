"""Motions of rigid components that the flow does not determine: those with the least relief.

A small turn and a small translation move an image almost alike (the bas-relief ambiguity). Motions
whose residuals differ by less than the systematic error of the flow explain it equally well, and
their depths range from a flat scene to one that recedes to infinity. Among them the one whose log
depths vary as scenes do is the most probable.
"""

from collections.abc import Sequence

import numpy as np
from scipy.optimize import least_squares

from soup_nlp.arrays import Float
from soup_nlp.start.bending import RELIEF
from soup_nlp.start.epipolar import EVALUATIONS, Matches, Motion, around, triangulate
from soup_nlp.start.labelling import PIECE_SIZE, SHARED_SCALE, Labelling
from soup_nlp.start.views import FlowFit

COMMON_NOISES, MOST_COMMON_PX = 1.5, 0.15
"""Error of the flow that is the same over large parts of the image, in units of its noise, and its
limit in pixels: more noise than that averages out."""
MOST_RELIEF = 3.0
"""Limit of a log depth relative to the median: points at infinity or behind the camera."""
EXACT_PX = 0.005
"""Shared error below which the flow is exact and leaves no motion open, pixels."""
MOTION_CHANGE = np.array([0.01] * 3 + [0.1] * 2)
"""Usual change of rotation (radians) and direction of the translation."""
EPIPOLAR_PX = 0.3
"""Scale of the Cauchy loss of epipolar distances, pixels."""


def common_error(noise: float) -> float:
    """Error, pixels, that large parts of a flow with this noise have in common."""
    return min(COMMON_NOISES * noise, MOST_COMMON_PX)


def settle(flow: FlowFit, choice: Labelling) -> Labelling:
    """The labelling with the most probable motion of every rigid component.

    The error that the flow of a component shares follows from what its motion leaves unexplained,
    across the epipolar lines: along them, depth would explain it.
    """
    motions = list(choice.motions)
    for c, motion in enumerate(motions):
        at = np.flatnonzero((choice.label == c) & flow.views.usable)
        if len(at) < PIECE_SIZE:
            continue
        error = SHARED_SCALE * float(np.median(choice.excess[at]))
        if error > EXACT_PX:
            motions[c] = most_probable([motion], flow.anchor_matches(at), error)
    return Labelling.of(flow, motions, choice.label, choice.shared)


def most_probable(
    motions: Sequence[Motion],
    matches: Matches,
    error: float,
    expected: Float | float = 0.0,
    spread: float = RELIEF,
) -> Motion:
    """The motion that minimises the mean squared epipolar distance and the relief.

    `mean rho(e, EPIPOLAR_PX) / error^2 + mean rho(log(z / median z), spread) / spread^2`, with e
    the Sampson distance and rho(x, c) = c^2 log(1 + x^2 / c^2) the Cauchy loss.

    Args:
        motions: Initial motions; the best result is returned.
        matches: Correspondences.
        error: Systematic error of the flow, pixels.
        expected: (M,) log depth by a depth prior, from which relief is counted.
        spread: Standard deviation of the relief.
    """
    root, results = np.sqrt(matches.weight / matches.weight.sum()), []

    def residual(motion: Motion) -> Float:
        distance = cauchy(matches.distance(motion), EPIPOLAR_PX)
        depth = cauchy(relief(motion, matches.ray, matches.target, expected), spread)
        return np.concatenate([root * distance / error, root * depth / spread])

    for moved in map(around, motions):
        end = least_squares(
            lambda x, moved=moved: residual(moved(x)),
            np.zeros(5),
            x_scale=MOTION_CHANGE,
            max_nfev=EVALUATIONS,
        )
        results.append((float(end.cost), moved(end.x)))
    return min(results, key=lambda result: result[0])[1]


def cauchy(x: Float, scale: float) -> Float:
    """x (M,) whose squares are its Cauchy losses."""
    return scale * np.sqrt(np.log1p((x / scale) ** 2))


def relief(motion: Motion, r: Float, q: Float, expected: Float | float = 0.0) -> Float:
    """(M,) log depth of correspondences under a motion, relative to the expected log depth.

    The median is 0, and values are limited to `MOST_RELIEF`.
    """
    z, _ = triangulate(motion, r, q)
    inverse = np.exp(expected) / np.where(np.abs(z) < 1e-12, 1e-12, z)
    middle = np.median(inverse)
    if middle <= 0:
        return np.full(len(r), MOST_RELIEF)
    return -np.log(np.clip(inverse / middle, np.exp(-MOST_RELIEF), np.exp(MOST_RELIEF)))
