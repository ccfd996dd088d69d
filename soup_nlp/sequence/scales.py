"""Common scale of the pairs of a sequence from links between pairs that share a frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from soup_nlp.arrays import Float, Mask
from soup_nlp.errors import DataError
from soup_nlp.geometry.graph import connected

MIN_PIXELS = 200
"""Links with fewer pixels are flagged."""
LEAST_SPREAD = 0.005
"""Smallest spread of a log ratio in the weight of a link."""


@dataclass(frozen=True)
class Link:
    """Ratio of the scales of two pairs, measured in a common frame.

    Attributes:
        first: Index of the pair.
        second: Index of the other pair.
        log_ratio: Logarithm of the second's scale over the first's, the median over pixels.
        spread: Robust standard deviation of the same over pixels (1.4826 MAD).
        pixels: Number of pixels.
        bridge: Whether a pair without parallax lies between the two.
        flagged: Whether it is a guess: a pair has no parallax, or few pixels are shared.
    """

    first: int
    second: int
    log_ratio: float
    spread: float
    pixels: int
    bridge: bool = False
    flagged: bool = False


def link(
    first: int,
    second: int,
    one: Float,
    other: Float,
    keep: Mask,
    *,
    bridge: bool = False,
    flagged: bool = False,
) -> Link | None:
    """The link of depth maps `one` and `other` (H, W) of a frame; None without a shared pixel.

    `keep` (H, W) is the mask of used pixels; for the other arguments see `Link`.
    """
    with np.errstate(invalid="ignore"):
        both = keep & (one > 0) & (other > 0)
    if not both.any():
        return None
    ratio = np.log(one[both] / other[both])
    middle = float(np.median(ratio))
    spread = 1.4826 * float(np.median(np.abs(ratio - middle)))
    count = int(both.sum())
    return Link(first, second, middle, spread, count, bridge, flagged or count < MIN_PIXELS)


def solve_scales(count: int, links: Sequence[Link]) -> Float:
    """(count,) scales of all pairs, 1 for the first, by robust least squares of their logarithms.

    A link is weighted by its spread; the Cauchy loss lowers the weight of contradictory links.

    Raises:
        DataError: a pair is linked to no other.
    """
    from scipy.optimize import least_squares

    ends = np.array([(k.first, k.second) for k in links], np.int64).reshape(-1, 2)
    part = connected(ends, count)
    if part.any():
        alone = int(np.argmax(part > 0))
        raise DataError("a pair shares no pixel with the others", where=f"pair {alone}")
    if count == 1:
        return np.ones(1)
    rows = np.zeros((len(links), count))
    at = np.arange(len(links))
    rows[at, ends[:, 1]] += 1
    rows[at, ends[:, 0]] -= 1
    value = np.array([k.log_ratio for k in links])
    sigma = np.maximum([k.spread for k in links], LEAST_SPREAD)
    # a flagged link gets a low weight
    sigma = np.where([k.flagged for k in links], 10 * np.maximum(sigma, 0.1), sigma)
    A, b = rows[:, 1:] / sigma[:, None], value / sigma
    first = np.linalg.lstsq(A, b, rcond=None)[0]
    if len(links) > count - 1:
        answer = least_squares(lambda x: A @ x - b, first, jac=lambda x: A, loss="cauchy")
        first = answer.x
    return np.exp(np.concatenate([[0.0], first]))
