"""Frames of different focal lengths, in pixels: flow methods need both at one scale."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np

from soup_nlp.data.flow.consistency import leaves
from soup_nlp.data.formats.images import DataWarning
from soup_nlp.data.pair import Flow, Pair
from soup_nlp.data.working_size import scaled_camera
from soup_nlp.geometry.camera import pixel_grid

ALIKE = 1.1
"""Largest ratio of two focal lengths of which flow methods find displacements reliably."""
FEW = 0.2
"""Share of usable pixels below which the focal lengths are doubted."""


def at_common_focal(pair: Pair) -> Pair:
    """The pair with the next image resampled to the intrinsics of the reference frame.

    It is the same pair if the focal lengths differ by less than a tenth.
    """
    ratio = np.sqrt(np.linalg.det(pair.K_next[:2, :2]) / np.linalg.det(pair.K_ref[:2, :2]))
    if 1 / ALIKE <= ratio <= ALIKE:
        return pair
    image, K = pair.image_next, pair.K_next
    if ratio > 1:
        # the mean of pixels, since a warp takes single ones
        size = [max(1, round(side / ratio)) for side in image.shape[:2]]
        K = scaled_camera(K, image.shape, (size[0], size[1]))
        image = np.asarray(cv2.resize(image, size[::-1], interpolation=cv2.INTER_AREA))
    warped = cv2.warpPerspective(
        image,
        K @ np.linalg.inv(pair.K_ref),
        pair.size[::-1],
        flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return replace(pair, image_next=np.asarray(warped), K_next=pair.K_ref, truth=None)


def in_own_pixels(flow: Flow, pair: Pair, compute: Callable[[Pair], Flow]) -> Flow:
    """The flow of `at_common_focal(pair)` as the flow of the pair, in pixels of both frames.

    Where hardly any of it is usable, but the images match as they are, that flow (of `compute`) is
    taken.

    Warns:
        DataWarning: the images match as they are, which the focal lengths contradict.
    """
    uv = pixel_grid(*pair.size)
    A = (pair.K_next @ np.linalg.inv(pair.K_ref))[:2]
    own = (uv + flow.uv) @ A[:, :2].T + A[:, 2] - uv
    seen = ~leaves(own, pair.image_next.shape[:2])
    found = Flow(own.astype(np.float32), flow.confidence * seen, flow.source)
    if _usable(found) >= FEW:
        return found
    plain = compute(pair)
    if _usable(plain) < 2 * FEW:
        return found
    warnings.warn(
        f"the images match as they are ({_usable(plain):.0%} of the pixels), but not at their focal"
        f" lengths, {pair.K_ref[0, 0]:g} and {pair.K_next[0, 0]:g} px ({_usable(found):.0%}): these"
        " are probably wrong",
        DataWarning,
        stacklevel=2,
    )
    return plain


def _usable(flow: Flow) -> float:
    return float((flow.confidence > 0).mean())
