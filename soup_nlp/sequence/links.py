"""Links between solved pairs, their common scale, the camera path, and tracks of components."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import least_squares, linear_sum_assignment

from soup_nlp.arrays import Float, Mask
from soup_nlp.errors import DataError, expect
from soup_nlp.evaluate.metrics import overlap_shares
from soup_nlp.geometry.graph import connected
from soup_nlp.geometry.superpixels import Labels
from soup_nlp.report.chain import STILL, Chain, Link
from soup_nlp.report.result import Result, load

MIN_PIXELS = 200
"""Links with fewer pixels are flagged."""
LEAST_SPREAD = 0.005
"""Smallest spread of a log ratio in the weight of a link."""
MAX_GUESSED = 0.5
"""A pair has no parallax if the depth of a larger share of its background is a guess, and a chain
is not good if that of a larger share of all its images is."""
MADE_BY = "soup_nlp.sequence.solve.solve_pairs(...)"
"""Where pairs of a chain come from, for messages."""
SAME = 0.3
"""Smallest intersection over union of two components of one track."""
KEPT = ("input", "start", "truth", "solution", "weights", "energy")
"""Groups of arrays of a pair that a chain needs."""


@dataclass(frozen=True, eq=False)
class SolvedPair:
    """A pair of frames, by their numbers, with its result."""

    first: int
    second: int
    result: Result

    @property
    def still(self) -> bool:
        """Whether most of the background has no parallax, so that its depth is a guess."""
        return self.result.components.background.borrowed > MAX_GUESSED

    def view(self, frame: int) -> tuple[Float, Mask]:
        """(H, W) z of one of the two frames, and its confident pixels of the static scene."""
        side, static = int(frame != self.first), self.result.static
        return self.result.depths[side], self.result.in_next(static, False) if side else static


def read_pair(first: int, second: int, folder: Path) -> SolvedPair:
    """The pair of two frames from its result folder."""
    result = load(folder)
    # a chain holds many pairs, whose other arrays it does not need
    kept = {name: result.tree[name] for name in KEPT if name in result.tree}
    return SolvedPair(first, second, replace(result, tree=kept))


def link(
    ends: tuple[int, int], one: Float, other: Float, keep: Mask, flagged: bool = False
) -> Link | None:
    """The link of depth maps `one` and `other` (H, W) of a frame; None without a shared pixel.

    `ends` are the numbers of the pairs, `keep` (H, W) is the mask of used pixels.
    """
    with np.errstate(invalid="ignore"):
        both = keep & (one > 0) & (other > 0)
    if not both.any():
        return None
    ratio = np.log(one[both] / other[both])
    middle = float(np.median(ratio))
    spread = 1.4826 * float(np.median(np.abs(ratio - middle)))
    pixels = int(both.sum())
    return Link(*ends, middle, spread, pixels, flagged=flagged or pixels < MIN_PIXELS)


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
                (z1, keep1), (z2, keep2) = first.view(frame), second.view(frame)
                guess = first.still or second.still
                shared = link((a, b), z1, z2, keep1 & keep2, guess)
                out.append(shared or link((a, b), z1, z2, np.ones_like(keep1), flagged=True))
    # consecutive pairs are the first of those that start at a frame
    at = {pair.first: b for b, pair in reversed([*enumerate(pairs)])}
    for a, pair in enumerate(pairs):
        frame, (z, keep) = pair.second, pair.view(pair.second)
        while not pair.still and frame in at and pairs[at[frame]].still:
            still = pairs[at[frame]]
            static = still.result.components.of_pixel == 0
            keep = still.result.in_next(keep & static, False)
            z, frame = still.result.in_next(z, np.nan), still.second
        if frame > pair.second and frame in at:
            other, sure = pairs[at[frame]].view(frame)
            bridge = link((a, at[frame]), z, other, keep & sure)
            out.append(bridge and replace(bridge, bridge=True))
    return [shared for shared in out if shared]


def solve_scales(total: int, links: Sequence[Link]) -> Float:
    """(total,) scales of all pairs, 1 for the first, by robust least squares of their logarithms.

    A link is weighted by its spread; the Cauchy loss lowers the weight of contradictory links.

    Raises:
        DataError: a pair is linked to no other.
    """
    ends = np.array([(k.first, k.second) for k in links], np.int64).reshape(-1, 2)
    part = connected(ends, total)
    if part.any():
        alone = int(np.argmax(part > 0))
        raise DataError("a pair shares no pixel with the others", where=f"pair {alone}")
    if total == 1:
        return np.ones(1)
    unit = np.eye(total)
    rows = unit[ends[:, 1]] - unit[ends[:, 0]]
    value = np.array([k.log_ratio for k in links])
    sigma = np.maximum([k.spread for k in links], LEAST_SPREAD)
    # a flagged link gets a low weight
    sigma = np.where([k.flagged for k in links], 10 * np.maximum(sigma, 0.1), sigma)
    A, b = rows[:, 1:] / sigma[:, None], value / sigma
    answer = np.linalg.lstsq(A, b, rcond=None)[0]
    if len(links) > total - 1:
        answer = least_squares(lambda x: A @ x - b, answer, jac=lambda x: A, loss="cauchy").x
    return np.exp(np.concatenate([[0.0], answer]))


def make_chain(
    pairs: Sequence[SolvedPair],
    over: Sequence[SolvedPair] = (),
    summary: Mapping[str, Any] | None = None,
) -> Chain:
    """Determine a common scale of consecutive pairs, the camera path, and tracks of components.

    Args:
        pairs: Pairs of the frames (0, 1), (1, 2), ...
        over: Further pairs of the same frames, such as (0, 2), for more links.
        summary: Contents of chain.json.

    Raises:
        DataError: the pairs are not consecutive, or share no pixel.
    """
    for several in (pairs, over):
        expect(several, (list, tuple), "pairs of a chain", MADE_BY)
        for pair in several:
            expect(pair, SolvedPair, "pair of a chain", MADE_BY)
    if not pairs or [(p.first, p.second) for p in pairs] != [(k, k + 1) for k in range(len(pairs))]:
        raise DataError("pairs of a chain are not consecutive", found=[p.first for p in pairs])
    links = find_links([*pairs, *over])
    scales = solve_scales(len(pairs) + len(over), links)[: len(pairs)]
    results = [pair.result.scaled(s) for pair, s in zip(pairs, scales, strict=True)]
    poses = [STILL]
    for result in results:
        poses.append(poses[-1] @ result.components.camera.inverse)
    matches = [
        follow(a.in_next(a.components.of_pixel, -1), b.components.of_pixel)
        for a, b in pairwise(results)
    ]
    tracks = number(matches, [len(result.components) for result in results])
    names = tuple(f"{k:04d}" for k in range(len(poses)))
    chained = tuple(results), tuple(poses), tuple(tracks), names
    return Chain(*chained, scales, tuple(links), {} if summary is None else summary)


def follow(before: Labels, after: Labels) -> dict[int, int]:
    """Matches of the components of consecutive pairs with the largest sum of overlaps.

    Args:
        before: (H, W) labels of the first pair in the common frame; -1 unknown, 0 background.
        after: (H, W) labels of the second pair.

    Returns:
        Label after by label before.
    """
    visible = before >= 0
    share = overlap_shares(before[visible], after[visible])
    # the background has no track
    share[0], share[:, 0] = 0, 0
    share[share < SAME] = 0
    matched = zip(*linear_sum_assignment(share, maximize=True))
    return {int(i): int(k) for i, k in matched if share[i, k] > 0}


def number(matches: Sequence[dict[int, int]], counts: Sequence[int]) -> list[dict[int, int]]:
    """Numbers of the tracks: for every pair, a dict from component to track; 0 is the background.

    Args:
        matches: Results of `follow` for consecutive pairs.
        counts: Number of components of every pair, with the background.
    """
    out: list[dict[int, int]] = []
    new_number = count(1)
    for match, total in zip([{}, *matches], counts, strict=True):
        numbers = {new: out[-1][old] for old, new in match.items()}
        rest = {label: next(new_number) for label in range(1, total) if label not in numbers}
        out.append({0: 0, **numbers, **rest})
    return out
