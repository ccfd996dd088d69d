"""A soft census transform: a descriptor of the surroundings of a pixel, independent of exposure.

The census transform has a bit for each neighbour, set if it is brighter. The soft version instead
has the number `tanh((neighbour - centre) / 10)`. In regions without texture the numbers are
near zero, so that they hardly contribute to matching costs.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import FloatMap, Image
from soup_nlp.data.flow.consistency import sampled

SOFT_GREY = 10.0
"""Difference in grey levels that becomes tanh(1) = 0.76."""
SIGMA_PX = 0.7
"""Standard deviation of the Gaussian smoothing, pixels."""
NEIGHBOURS = ((-2, -2), (-2, 0), (-2, 2), (0, -2), (0, 2), (2, -2), (2, 0), (2, 2))
"""(dv, du) of the neighbours, pixels."""


def census(image: Image) -> FloatMap:
    """(2, H, W, 4) soft census of an image (H, W, 3) or (H, W), in two layers for OpenCV."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), SIGMA_PX)
    height, width = smooth.shape
    padded = np.pad(smooth, 2, mode="edge")
    other = np.stack(
        [padded[2 + dv : 2 + dv + height, 2 + du : 2 + du + width] for dv, du in NEIGHBOURS], -1
    )
    soft = np.tanh((other - smooth[..., None]) / np.float32(SOFT_GREY))
    return np.ascontiguousarray(np.moveaxis(soft.reshape(height, width, 2, 4), 2, 0))


def census_at(layers: FloatMap, u: NDArray[np.floating], v: NDArray[np.floating]) -> FloatMap:
    """(2, ..., 4) census at sub-pixel positions (R, C) with C < 32768; the border repeats."""
    x, y = np.asarray(u, np.float32), np.asarray(v, np.float32)
    # cv2.remap accepts fewer than 32768 rows
    parts = [slice(a, a + 30000) for a in range(0, len(x), 30000)]
    return np.stack(
        [np.concatenate([sampled(layer, x[s], y[s]) for s in parts]) for layer in layers]
    )
