"""Errors of a camera that the flow shows: focal length, principal point, distortion, zoom.

With a wrong camera hardly any rigid motion explains the flow of a rigid scene, unless its error
acts as a motion does. Each kind of error is tried by itself, because several kinds together explain
nearly any flow. A focal length that is a guess has an error for certain, which is all that
distinguishes it from one that is given. See docs/confidence.md.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import special

from soup_nlp.arrays import Float
from soup_nlp.geometry.camera import intrinsics
from soup_nlp.start.epipolar import (
    FITS,
    Matches,
    Motion,
    essential_motion,
    refine_near,
    triangulate,
)
from soup_nlp.start.labelling import EXACT_PX, LEAST_NOISE

ERROR_KINDS = {
    "focal length": (0.8, 0.25),
    "principal point in x": (0.1, 0.02),
    "principal point in y": (0.1, 0.02),
    "lens distortion": (0.2, 0.02),
    "zoom between the frames": (0.1, 0.02),
}
"""Standard deviation of every error of a given camera, and the probability of one without the flow:
of a log focal length, which is mistaken more often than all else, of the principal point relative
to the focal length, of k1, and of the log ratio of the focal lengths of the frames."""
TRIED_ERRORS = np.linspace(-2.0, 2.0, 33)
"""Errors that are tried, in standard deviations."""
MEASUREMENTS = 80
"""The flow counts as this many independent measurements: its errors are alike over parts of the
image, so that its pixels are no independent ones."""
LEAST_ODDS = 3.0
"""Log odds at which there is an error, and, against it, none that counts: twenty to one."""
ERROR_PIXELS = 2000
"""Largest number of correspondences."""
MOST_CHANGE = 2.5
"""Largest log ratio of a depth to the median: what is behind the camera is farther away."""


class CameraError(NamedTuple):
    """What a flow says of one kind of error of the camera.

    Attributes:
        kind: One of `ERROR_KINDS`.
        mean: Its mean, if there is one.
        deviation: Its standard deviation, if there is one.
        log_odds: Logarithm of the probability that there is one, over that of none.
        tried: The errors x that are tried, none where no motion explains the flow.
        density: Probability of each of them, if there is an error.
        motions: Best motion with each of them.
    """

    kind: str
    mean: float
    deviation: float
    log_odds: float
    tried: Sequence[float] = ()
    density: Sequence[float] = ()
    motions: Sequence[Motion] = ()

    def squares(self, ray: Float, target: Float, depth: Float) -> Float:
        """(N,) mean square of the log ratio of depth with the error to the depth of an answer.

        Depth is triangulated with the best motion, a common factor left out. It is 0 where the odds
        against an error are `LEAST_ODDS`; what the flow leaves open, such as the focal length on a
        straight drive, counts. The points (N,) of the answer have rays (N, 3) in both frames.
        """
        if not self.motions or self.log_odds <= -LEAST_ODDS:
            return np.zeros(len(ray))
        tried = zip(self.tried, self.motions, strict=True)
        depths = (triangulate(m, *corrected(self.kind, x, ray, target))[0] for x, m in tried)
        rows = [_relative(np.where(z > 0, z, np.inf)) for z in depths]
        # a foreign solver may return a depth that is no number
        change = np.nan_to_num(np.array(rows) - _relative(depth))
        change -= np.mean(change, axis=1, keepdims=True)
        return float(special.expit(self.log_odds)) * (np.array(self.density) @ change**2)


def _relative(depth: Float) -> Float:
    """Log of depths relative to their median, at most `MOST_CHANGE` from 0."""
    log = np.log(np.maximum(depth, 1e-30) / np.clip(np.nanmedian(depth), 1e-30, 1e30))
    return np.clip(log, -MOST_CHANGE, MOST_CHANGE)


def corrected(kind: str, x: float, ref: Float, following: Float) -> tuple[Float, Float]:
    """Rays (..., 3) of both frames if the camera has an error of a kind and size x."""
    a, b = ref[..., :2], following[..., :2]
    if kind == "focal length":
        a, b = a * np.exp(-x), b * np.exp(-x)
    elif kind == "lens distortion":
        a, b = (v * (1 - x * np.sum(v**2, axis=-1, keepdims=True)) for v in (a, b))
    elif kind == "zoom between the frames":
        a, b = a * np.exp(x / 2), b * np.exp(-x / 2)
    else:
        shift = np.roll([x, 0.0], kind.endswith("y"))
        a, b = a - shift, b - shift
    pad = [(0, 0)] * (a.ndim - 1) + [(0, 1)]
    return np.pad(a, pad, constant_values=1.0), np.pad(b, pad, constant_values=1.0)


def camera_error(matches: Matches, kind: str, deviation: float, wrong: float = 1.0) -> CameraError:
    """What correspondences say of an error of the camera.

    With s(x) the Sampson distances of the best motion if the error is x, and g the least of their
    medians, the flow has the probability `exp(-MEASUREMENTS mean log(1 + (s(x) / g)^2))`, that of
    errors with a Cauchy distribution. Errors of the camera are normal with this deviation; `wrong`
    is the probability of one without the flow, 1 for a guess. `kind` is one of `ERROR_KINDS`.
    """
    matches = matches.confident(ERROR_PIXELS)
    distance, motions = _explained(matches, kind, deviation)
    prior = float(special.logit(wrong))
    if not motions:
        return CameraError(kind, 0.0, deviation, prior)
    noise = max(float(np.median(distance, axis=1).min()), EXACT_PX)
    against = MEASUREMENTS * np.mean(np.log1p((distance / noise) ** 2), axis=1)
    gain = against[len(TRIED_ERRORS) // 2] - against - TRIED_ERRORS**2 / 2
    density = special.softmax(gain)
    x = deviation * TRIED_ERRORS
    mean = float(density @ x)
    # no finer than the errors that are tried
    finest = deviation * (TRIED_ERRORS[1] - TRIED_ERRORS[0])
    spread = max(float(np.sqrt(density @ (x - mean) ** 2)), finest)
    # the flow is so much more probable with an error
    more = float(special.logsumexp(gain) - special.logsumexp(-(TRIED_ERRORS**2) / 2))
    return CameraError(kind, mean, spread, prior + more, tuple(x), tuple(density), motions)


def _explained(matches: Matches, kind: str, deviation: float) -> tuple[Float, tuple[Motion, ...]]:
    """The best motion with every error, and its Sampson distances (len(TRIED_ERRORS), M), pixels;
    no motions where the flow determines none.

    Motions change little from one error to the next, so that half the rounds of a fit do. That of a
    focal length changes much from one end to the other, and is sought from the ends as well.
    """
    of_focal = kind == "focal length"
    errors, tried = deviation * TRIED_ERRORS, []
    for x in errors:
        rays = corrected(kind, x, matches.ray, matches.target)
        tried.append(Matches(*rays, matches.weight, matches.focal * np.exp(x * of_focal)))
    count, middle = len(TRIED_ERRORS), len(TRIED_ERRORS) // 2
    ways = [range(middle, count), range(middle, -1, -1)]
    if of_focal:
        ways += [range(count), range(count - 1, -1, -1)]
    best, least = np.zeros((count, len(matches.ray))), np.full(count, np.inf)
    motions: dict[int, Motion] = {}
    for way in ways:
        motion = essential_motion(tried[way[0]], None)
        if motion is None:
            continue
        for k in way:
            motion = refine_near(motion, tried[k], LEAST_NOISE, FITS // 2)
            distance = _distance(tried[k], motion, kind, errors[k], matches)
            error = float(np.mean(np.log1p((distance / LEAST_NOISE) ** 2)))
            if error < least[k]:
                best[k], least[k], motions[k] = distance, error, motion
    complete = len(motions) == count
    return best, tuple(motions[k] for k in range(count)) if complete else ()


def _distance(tried: Matches, motion: Motion, kind: str, x: float, given: Matches) -> Float:
    """(M,) Sampson distances of corrected rays, in pixels of the images before the correction.

    A correction that shrinks an image must not shrink its errors.
    """
    E = motion.essential()
    by_q, by_r = (tried.ray @ E.T)[:, :2], (tried.target @ E)[:, :2]
    miss = np.abs(np.sum(tried.target[:, :2] * by_q, axis=1) + tried.ray @ E[2])
    if kind == "lens distortion":
        for slope, v in ((by_q, given.target[:, :2]), (by_r, given.ray[:, :2])):
            along = np.sum(v * slope, axis=1, keepdims=True)
            slope -= x * (np.sum(v**2, axis=1, keepdims=True) * slope + 2 * along * v)
    elif kind == "zoom between the frames":
        by_q, by_r = by_q * np.exp(-x / 2), by_r * np.exp(x / 2)
    elif kind == "focal length":
        by_q, by_r = by_q * np.exp(-x), by_r * np.exp(-x)
    squared = np.sum(by_q**2 + by_r**2, axis=1)
    return given.focal * miss / np.sqrt(np.maximum(squared, 1e-24))


def camera_errors(matches: Matches) -> dict[str, CameraError]:
    """What correspondences say of every kind of error of a given camera, see `camera_error`."""
    return {kind: camera_error(matches, kind, *prior) for kind, prior in ERROR_KINDS.items()}


def better_camera(K: Float, kind: str, x: float) -> Float | None:
    """(3, 3) intrinsics with square pixels and without an error of size x; None where no pinhole
    camera is without it."""
    if kind not in ("focal length", "principal point in x", "principal point in y"):
        return None
    focal = float(np.sqrt(K[0, 0] * K[1, 1]))
    if kind == "focal length":
        return intrinsics(focal * np.exp(x), focal * np.exp(x), *K[:2, 2])
    return intrinsics(focal, focal, *(K[:2, 2] + np.roll([x * focal, 0.0], kind.endswith("y"))))
