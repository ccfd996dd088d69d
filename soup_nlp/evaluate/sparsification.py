"""How well an uncertainty tells large errors from small ones, and how often errors keep to it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from soup_nlp.arrays import Float

STEPS = 50
"""Points of a sparsification curve."""
LAST = 0.02
"""Share of the pixels that its last point keeps."""


@dataclass(frozen=True)
class Sparsification:
    """Mean error of the pixels that are kept when the most uncertain ones are removed.

    Ilg et al., "Uncertainty estimates and multi-hypotheses networks for optical flow", ECCV 2018.

    Attributes:
        kept: (STEPS,) shares of the pixels, from 1 down.
        error: (STEPS,) mean error of that share with the least uncertainty.
        oracle: (STEPS,) mean error of that share with the least error.
        ause: Area between the two curves over the mean error: 0 is perfect, about 1 is chance.
    """

    kept: Float
    error: Float
    oracle: Float
    ause: float


def sparsification(error: ArrayLike, uncertainty: ArrayLike) -> Sparsification:
    """Sort pixels by uncertainty and compare with sorting them by error.

    Pixels of equal uncertainty are removed in an arbitrary order: each counts as their mean error.

    Args:
        error: (M,) errors, not negative; M at least 1.
        uncertainty: (M,) larger where the error is expected to be larger.
    """
    e, s = np.asarray(error, float), np.asarray(uncertainty, float)
    kept = np.linspace(1.0, LAST, STEPS)
    last = np.maximum((kept * len(e)).astype(int) - 1, 0)
    _, group = np.unique(s, return_inverse=True)
    alike = np.bincount(group, e) / np.bincount(group)
    sums = np.cumsum(alike[np.sort(group)]), np.cumsum(np.sort(e))
    mean_error, best = (total[last] / (last + 1) for total in sums)
    whole = float(e.mean())
    ause = float((mean_error - best).mean() / whole) if whole > 0 else 0.0
    return Sparsification(kept, mean_error, best, ause)


def coverage(error: ArrayLike, sigma: ArrayLike) -> list[float]:
    """Shares of the errors (M,) that are at most one and two times their sigma (M,)."""
    e, s = np.abs(np.asarray(error, float)), np.asarray(sigma, float)
    return [float(np.mean(e <= k * s)) for k in (1, 2)]
