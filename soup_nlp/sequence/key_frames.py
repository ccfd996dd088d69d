"""Choice of key frames of a sequence by their parallax."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from scipy.optimize import least_squares

from soup_nlp.arrays import Float, Image
from soup_nlp.data.formats.images import read_image
from soup_nlp.geometry.camera import intrinsics
from soup_nlp.geometry.rotation import exp

KEY_PARALLAX = 0.01
"""Median parallax of consecutive key frames, relative to the larger side of the image."""
MAX_STEP = 10
"""Largest number of frames from a key frame to the next."""
SIDE = 640
"""Larger side of the images in which points are tracked, pixels."""
MIN_TRACKED = 0.3
"""Smallest share of the points that must be tracked."""
MIN_POINTS = 30
"""Smallest number of tracked points."""


def key_frames(images: Sequence[Path], K: Float, most: int | None = None) -> list[int]:
    """Indices of key frames.

    The next key frame is the first one with a parallax of `KEY_PARALLAX`, or the last one before
    points are lost or after `MAX_STEP` frames.

    Args:
        images: All frames in order.
        K: (3, 3) intrinsics, pixels.
        most: Largest number of key frames.
    """
    read = lru_cache(MAX_STEP + 1)(_small)
    chosen, last = [0], len(images) - 1
    while chosen[-1] < last and (most is None or len(chosen) < most):
        here = chosen[-1]
        one, scale = read(images[here])
        camera = np.diag([scale, scale, 1.0]) @ K
        best = here + 1
        for there in range(here + 1, min(here + MAX_STEP, last) + 1):
            found = parallax(one, read(images[there])[0], camera)
            if found is None:
                break
            best = there
            if found >= KEY_PARALLAX:
                break
        chosen.append(best)
    return chosen


def continues(one: Path, other: Path) -> bool:
    """Whether enough points of an image can be tracked into the other one."""
    a, b = (_small(path)[0] for path in (one, other))
    camera = intrinsics(a.shape[1], a.shape[1], a.shape[1] / 2, a.shape[0] / 2)
    return parallax(a, b, camera) is not None


def parallax(one: Image, other: Image, K: Float) -> float | None:
    """Median displacement of two grey images (H, W) after removal of a camera rotation.

    It is relative to the larger side of the image; None if too few points can be tracked. K (3, 3)
    are the intrinsics, pixels.
    """
    start = cv2.goodFeaturesToTrack(one, 1000, 0.01, 7)
    if start is None or one.shape != other.shape:
        return None
    options = {"winSize": (21, 21), "maxLevel": 4}
    end, there, _ = cv2.calcOpticalFlowPyrLK(one, other, start, None, **options)
    again, back, _ = cv2.calcOpticalFlowPyrLK(other, one, end, None, **options)
    error = np.linalg.norm(start - again, axis=2).ravel()
    good = (there.ravel() > 0) & (back.ravel() > 0) & (error < 1)
    if good.sum() < max(MIN_POINTS, MIN_TRACKED * len(good)):
        return None
    p, q = (x.reshape(-1, 2)[good].astype(np.float64) for x in (start, end))
    rays = np.column_stack([p, np.ones(len(p))]) @ np.linalg.inv(K).T

    def left(turn: Float) -> Float:
        seen = rays @ exp(turn).T @ K.T
        return np.asarray(seen[:, :2] / seen[:, 2:] - q)

    turn = least_squares(lambda w: left(w).ravel(), np.zeros(3), loss="soft_l1").x
    return float(np.median(np.linalg.norm(left(turn), axis=1))) / max(one.shape)


def _small(path: Path) -> tuple[Image, float]:
    """An image in grey, reduced to `SIDE`, and its scale."""
    image = cv2.cvtColor(read_image(path, turn=True), cv2.COLOR_RGB2GRAY)
    scale = min(1.0, SIDE / max(image.shape))
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8), scale
