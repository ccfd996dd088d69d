"""Whether a depth map belongs to an image: its steps lie on edges of the image.

Where the camera rests or turns, the flow says nothing of a given depth. A map of another scene then
differs from the right one in one thing: shifted or mirrored, it follows the edges of the image as
well as it does as it is.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy import ndimage, stats

from soup_nlp.arrays import Float, Image, Labels

SIDE = 320
"""Longer side of the maps that are compared, pixels."""
TRIALS = 60
"""Shifted and mirrored maps."""
FARTHEST, NEAREST = 1 / 3, 0.1
"""Largest shift relative to the side, and least one relative to the width if not mirrored."""
WITHIN = 0.5
"""Largest share of a map's variance within superpixels: one of independent pixels has nearly 1."""
LEAST = 3.0
"""Standard deviations by which a right map follows superpixels (counted twice) and edges better
than the shifted ones; right maps have 3.3 and more, those of other scenes 2.8 and less."""


def follows_edges(values: Float, image: Image, labels: Labels, seed: int = 0) -> bool:
    """Whether a map follows the superpixels and the edges of its image better than by chance.

    Args:
        values: (H, W) log depth or any other map without gaps.
        image: (H, W, 3) the image.
        labels: (H, W) its superpixels.
        seed: Of the shifts.
    """
    rows, columns = (max(8, round(n * SIDE / max(labels.shape))) for n in labels.shape)
    small = cv2.resize(values, (columns, rows), interpolation=cv2.INTER_AREA)
    small = ndimage.median_filter(small.astype(float), 3)
    if np.ptp(small) < 1e-9:
        return False
    grey = cv2.GaussianBlur(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY).astype(float), (0, 0), 1.5)
    edges = _ranks(cv2.resize(_gradient(grey), (columns, rows), interpolation=cv2.INTER_AREA))
    own = cv2.resize(labels, (columns, rows), interpolation=cv2.INTER_NEAREST)
    count = np.maximum(np.bincount(own.ravel()), 1)

    def scores(one: Float, steps: Float) -> tuple[float, float]:
        inside = one - (np.bincount(own.ravel(), one.ravel()) / count)[own]
        return -float(np.mean(inside**2) / max(one.var(), 1e-30)), float(np.mean(steps * edges))

    steps = _ranks(_gradient(small))
    pad = ((rows // 2, rows // 2), (columns // 2, columns // 2))
    rng = np.random.default_rng(seed)
    others: list[tuple[float, float]] = []
    while len(others) < TRIALS:
        down, right = (int(n * FARTHEST * rng.uniform(-1, 1)) for n in (rows, columns))
        mirrored = len(others) % 2
        if not mirrored and abs(down) + abs(right) < NEAREST * columns:
            continue
        a, b = rows // 2 + down, columns // 2 + right
        flip = -1 if mirrored else 1
        moved = (np.pad(m[:, ::flip], pad, mode="reflect") for m in (small, steps))
        others.append(scores(*(m[a : a + rows, b : b + columns] for m in moved)))
    chance = np.array(others)
    found = scores(small, steps)
    if -found[0] > WITHIN:
        return False
    better = (found - chance.mean(axis=0)) / np.maximum(chance.std(axis=0), 1e-12)
    return bool(better @ [2.0, 1.0] > LEAST)


def _gradient(values: Float) -> Float:
    """(H, W) length of the gradient."""
    return np.hypot(*(cv2.Sobel(values, cv2.CV_64F, x, 1 - x, ksize=3) for x in (1, 0)))


def _ranks(values: Float) -> Float:
    """Ranks of all values, from -1/2 to 1/2."""
    return (stats.rankdata(values, "ordinal").reshape(values.shape) - 1) / values.size - 0.5
