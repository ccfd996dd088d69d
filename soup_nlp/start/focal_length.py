"""The focal length of a guessed camera, from the flow."""

import numpy as np

from soup_nlp.start.epipolar import Matches, essential_motion, refine_near

FACTORS = np.exp(np.arange(-10, 11) * 0.1)
"""Focal lengths that are compared, relative to a guess."""
ERROR, LEAST_ERROR_PX = 0.5, 0.005
"""Rise of the error by which a focal length is less probable by exp(-1/2), relative to the least
error, and its lower limit in pixels: distortion and other systematic errors rise as much."""
LEAST_SIGMA = 0.05
"""Least standard deviation of a log focal length by these fits: half a step."""
PIXELS, NOISE_PX = 3000, 0.05
"""Largest number of correspondences of these fits, and the scale of their robust loss, pixels."""


def focal_length(matches: Matches, sigma: float, seed: int = 0) -> tuple[float, float]:
    """Factor of a guessed focal length, and the standard deviation of its logarithm.

    If the camera turns and shifts, no rigid motion explains the flow with a wrong focal length.
    Factor and deviation are those of the density
    `exp(-((e(x) - min e) / (ERROR min e))^2 / 2 - (x / sigma)^2 / 2)`, with x the log factor
    and e(x) the median Sampson distance of the best motion. Where e is the same with all focal
    lengths, they are about 1 and `sigma`.

    Args:
        matches: Correspondences with the guess.
        sigma: Standard deviation of its logarithm.
        seed: Of the fits.
    """
    r, q, weight, focal = matches.confident(PIXELS)
    error = np.full(len(FACTORS), np.inf)
    for k, factor in enumerate(FACTORS):
        longer = [factor, factor, 1.0]
        tried = Matches(r / longer, q / longer, weight, factor * focal)
        motion = essential_motion(tried, None, seed)
        if motion is not None:
            motion = refine_near(motion, tried, NOISE_PX)
            error[k] = np.median(np.abs(tried.distance(motion)))
    least = error.min()
    if not np.isfinite(least):
        return 1.0, sigma
    rise = (error - least) / max(ERROR * least, LEAST_ERROR_PX)
    x = np.log(FACTORS)
    density = np.exp(-(rise**2 + (x / sigma) ** 2) / 2)
    density /= density.sum()
    mean = float(density @ x)
    deviation = float(np.sqrt(density @ (x - mean) ** 2))
    return float(np.exp(mean)), float(np.clip(deviation, LEAST_SIGMA, sigma))
