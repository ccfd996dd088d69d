"""Confidence of a flow from its forward-backward consistency."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import FloatMap
from soup_nlp.data.pair import Flow

SUPPORT = 15
"""Side of the window over which the round-trip error is averaged, pixels: a wrong flow may be
consistent at a single pixel, but rarely in a whole window."""

LIMIT = 3.0
"""Round-trip error, pixels, above which a flow is not used: its confidence would be 0.0001."""

_NOISE_CAP = 5.0  # pixels; limits the effect of an outlier on its window


def round_trip_error(forward: FloatMap, backward: FloatMap) -> FloatMap:
    """Distance of each pixel to its image under the forward and then the backward flow.

    Args:
        forward: (H, W, 2) flow from the first to the second image, pixels.
        backward: (H', W', 2) flow from the second to the first image, pixels.

    Returns:
        (H, W) float32, pixels; infinite where the forward flow leaves the second image or one of
        the flows is not finite.
    """
    height, width = forward.shape[:2]
    u, v = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    inside = ~leaves(forward, (backward.shape[0], backward.shape[1]))
    x = np.where(inside, u + forward[:, :, 0], 0.0).astype(np.float32)
    y = np.where(inside, v + forward[:, :, 1], 0.0).astype(np.float32)
    back = cv2.remap(
        np.ascontiguousarray(backward, dtype=np.float32),
        x,
        y,
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    error = np.hypot(x + back[:, :, 0] - u, y + back[:, :, 1] - v)
    error[~inside | ~np.isfinite(error)] = np.inf
    return np.asarray(error, dtype=np.float32)


def leaves(flow: NDArray[np.floating], shape: tuple[int, int]) -> NDArray[np.bool_]:
    """(H, W) bool, True where a flow (H, W, 2) is not finite or points outside the next image."""
    height, width = flow.shape[:2]
    x = np.arange(width)[None, :] + flow[:, :, 0]
    y = np.arange(height)[:, None] + flow[:, :, 1]
    inside = (x >= 0) & (x <= shape[1] - 1) & (y >= 0) & (y <= shape[0] - 1)
    return np.asarray(~inside)


def checked_flow(forward: FloatMap, backward: FloatMap, source: str) -> Flow:
    """A Flow from forward (H, W, 2) and backward (H', W', 2) displacements, pixels.

    Its confidence is the forward-backward consistency, see `confidence_of`.
    """
    uv = np.ascontiguousarray(forward, dtype=np.float32)
    confidence = confidence_of(round_trip_error(uv, backward))
    uv[~np.isfinite(uv).all(axis=2)] = 0.0
    return Flow(uv, confidence, source)


def confidence_of(gap: FloatMap, support: int = SUPPORT) -> FloatMap:
    """(H, W) confidence in [0, 1] of a round-trip error.

    With e the error and E the larger of e and the mean of min(e, 5) over a window, the confidence
    is `exp(-E^2)`, E in pixels, and 0 where E > `LIMIT`.

    Args:
        gap: (H, W) round-trip error, pixels; infinite where the flow leaves the next image.
        support: Side of the window for the mean error, odd, pixels; 1 is the pixel itself.
    """
    if support > 1:
        mean = cv2.blur(np.minimum(gap, _NOISE_CAP), (support, support))
        gap = np.maximum(gap, mean)
    confidence = np.exp(-np.square(np.minimum(gap, LIMIT)), dtype=np.float32)
    confidence[~(gap <= LIMIT)] = 0.0
    return np.asarray(confidence, dtype=np.float32)
