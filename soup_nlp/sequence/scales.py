"""Links between pairs of a sequence that share a frame, and the common scale that follows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from soup_nlp.arrays import Float, Mask
from soup_nlp.errors import DataError
from soup_nlp.geometry.graph import connected
from soup_nlp.sequence.pairs import SolvedPair, carried

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


def find_links(pairs: Sequence[SolvedPair]) -> list[Link]:
    """Links of all pairs that share a frame, from static pixels that are confident in both.

    The depth of a pair without parallax is a guess, so its links are flagged, as are those of pairs
    without a pixel that is confident in both. The pairs before and after a run of pairs without
    parallax are linked directly, with the depth of the former moved by the flow of the run.
    """
    out: list[Link | None] = []
    for b, second in enumerate(pairs):
        for a, first in enumerate(pairs[:b]):
            for frame in {first.first, first.second} & {second.first, second.second}:
                z1, keep1 = _view(first, frame)
                z2, keep2 = _view(second, frame)
                guess = first.still or second.still
                found = link(a, b, z1, z2, keep1 & keep2, flagged=guess)
                every = np.ones_like(keep1)
                out.append(found or link(a, b, z1, z2, every, flagged=True))
    # consecutive pairs are the first of those that start at a frame
    at = {pair.first: b for b, pair in reversed([*enumerate(pairs)])}
    for a, pair in enumerate(pairs):
        frame, (z, keep) = pair.second, _view(pair, pair.second)
        while not pair.still and frame in at and pairs[at[frame]].still:
            z, keep = _carry(z, keep, pairs[at[frame]])
            frame = pairs[at[frame]].second
        if frame > pair.second and frame in at:
            other, sure = _view(pairs[at[frame]], frame)
            out.append(link(a, at[frame], z, other, keep & sure, bridge=True))
    return [found for found in out if found]


def _view(pair: SolvedPair, frame: int) -> tuple[Float, Mask]:
    """(H, W) z of a frame of a pair, and the mask of confident pixels of the static scene."""
    result = pair.result
    keep = result.sure & (result.components.of_pixel == 0)
    if frame == pair.first:
        return result.depths[0], keep
    return result.depths[1], carried(keep, result.reconstruction) > 0


def _carry(z: Float, keep: Mask, still: SolvedPair) -> tuple[Float, Mask]:
    """z (H, W) and mask of the reference frame of a pair without parallax, in its next frame."""
    source = still.result.reconstruction.source_next
    there = (source >= 0) & (keep & (still.result.components.of_pixel == 0)).ravel()[source]
    return np.where(there, z.ravel()[source], np.nan), there


def solve_scales(count: int, links: Sequence[Link]) -> Float:
    """(count,) scales of all pairs, 1 for the first, by robust least squares of their logarithms.

    A link is weighted by its spread; the Cauchy loss lowers the weight of contradictory links.

    Raises:
        DataError: a pair is linked to no other.
    """
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
