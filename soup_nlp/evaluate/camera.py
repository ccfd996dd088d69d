"""Errors of a given camera that the flow shows: wrong intrinsics, distortion, zoom.

With a wrong camera hardly any rigid motion explains the flow of a rigid scene, unless its error
acts as a motion does. Each kind of error is tried by itself, because several kinds together explain
nearly any flow. See docs/confidence.md.
"""

import numpy as np

from soup_nlp.arrays import Float
from soup_nlp.start.epipolar import Matches, essential_motion, refine_near
from soup_nlp.start.focal_length import NOISE_PX

KINDS = {
    "focal length": 0.3,
    "principal point in x": 0.1,
    "principal point in y": 0.1,
    "lens distortion": 0.2,
    "zoom between the frames": 0.1,
}
"""Standard deviation of every error: of a log focal length, of the principal point relative to the
focal length, of k1, and of the log ratio of the focal lengths of the frames."""
STEPS = np.linspace(-2.0, 2.0, 17)
"""Errors that are tried, in standard deviations."""
RISE, LEAST_RISE_PX = 0.25, 0.0025
"""Rise of the median error by which an error of the camera is less probable by exp(-1/2), relative
to the least median error, and its lower limit in pixels."""


def corrected(kind: str, x: float, ref: Float, following: Float) -> tuple[Float, Float]:
    """Rays (..., 3) of both frames if the camera has an error of a kind and size x."""
    a, b = ref[..., :2], following[..., :2]
    if kind == "lens distortion":
        a, b = (v * (1 - x * np.sum(v**2, axis=-1, keepdims=True)) for v in (a, b))
    elif kind.startswith("principal point"):
        shift = np.roll([x, 0.0], kind.endswith("y"))
        a, b = a - shift, b - shift
    else:
        a, b = a * np.exp(-x * (kind == "focal length")), b * np.exp(-x)
    pad = [(0, 0)] * (a.ndim - 1) + [(0, 1)]
    return np.pad(a, pad, constant_values=1.0), np.pad(b, pad, constant_values=1.0)


def camera_errors(matches: Matches) -> tuple[Float, str | None]:
    """Size of every error of the camera by itself, and the kind that explains the flow best.

    With e(x) the median Sampson distance of the best motion if an error is x, its size is the mean
    of the density `exp(-((e(x) - min e) / (RISE min e))^2 / 2 - (x / sigma)^2 / 2)`. It is 0 where
    no x lowers the median error by `RISE` of the least one: the given camera is believed.

    Args:
        matches: Correspondences with the given camera.

    Returns:
        (K,) sizes, in the order of `KINDS`, and the kind, None where the camera is believed.
    """
    size, best, most = np.zeros(len(KINDS)), None, 1.0
    motion = essential_motion(matches, None)
    if motion is None:
        return size, best
    for k, (kind, sigma) in enumerate(KINDS.items()):
        error = np.zeros(len(STEPS))
        for j, step in enumerate(STEPS):
            rays = corrected(kind, step * sigma, matches.ray, matches.target)
            # the error in pixels of the corrected camera
            focal = matches.focal * np.exp(step * sigma * (kind == "focal length"))
            tried = Matches(*rays, matches.weight, focal)
            near = refine_near(motion, tried, NOISE_PX)
            error[j] = np.median(np.abs(tried.distance(near)))
        rise = (error - error.min()) / max(RISE * error.min(), LEAST_RISE_PX)
        given = rise[len(STEPS) // 2]
        if given > 1.0:
            density = np.exp(-(rise**2 + STEPS**2) / 2)
            size[k] = sigma * (density @ STEPS) / density.sum()
        if given > most:
            best, most = kind, given
    return size, best
