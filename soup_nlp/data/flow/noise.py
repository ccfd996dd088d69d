"""The true flow with noise of a known size, to measure how results depend on errors of flow."""

from __future__ import annotations

import cv2
import numpy as np

from soup_nlp.data.pair import Flow
from soup_nlp.errors import DataError

PREFIX = "truth+noise:"
"""Name of the source, followed by the standard deviation in pixels."""


def noise_level(source: str) -> float:
    """Standard deviation in pixels that a source such as "truth+noise:0.5" names.

    Raises:
        DataError: it names none.
    """
    try:
        sigma = float(source.removeprefix(PREFIX))
    except ValueError:
        sigma = np.nan
    if not 0 <= sigma < 1000:
        raise DataError(
            "noise of the flow is not a number of pixels", found=source, expected=f"{PREFIX}0.5"
        )
    return sigma


def noisy(flow: Flow, sigma: float, correlation: float = 5.0, seed: int = 0) -> Flow:
    """A flow with Gaussian noise that is correlated over a few pixels, as errors of real flows are.

    White noise would average out within a superpixel.

    Args:
        flow: Any flow.
        sigma: Standard deviation of either component, pixels.
        correlation: Standard deviation of the Gaussian that white noise is blurred with, pixels;
            0 leaves it white.
        seed: Of the noise.
    """
    height, width = flow.confidence.shape
    pad = int(np.ceil(4 * correlation))
    shape = (height + 2 * pad, width + 2 * pad, 2)
    noise = np.random.default_rng(seed).standard_normal(shape).astype(np.float32)
    if correlation > 0:
        noise = np.asarray(cv2.GaussianBlur(noise, (0, 0), correlation), np.float32)
    noise = noise[pad : pad + height, pad : pad + width]
    # the blurred noise has a known expected size, but a small image has its own
    noise = noise * np.float32(sigma / max(float(noise.std()), 1e-12))
    uv = np.where(flow.confidence[:, :, None] > 0, flow.uv + noise, flow.uv)
    return Flow(uv.astype(np.float32), flow.confidence.copy(), f"{flow.source}+noise:{sigma:g}")
