"""Links between solved pairs, their common scale, the camera path, and tracks of components."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import count, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from soup_nlp.arrays import Float, Mask
from soup_nlp.errors import DataError, expect
from soup_nlp.evaluate.metrics import overlap_shares
from soup_nlp.geometry.superpixels import Labels
from soup_nlp.report.chain import STILL, Chain, Link
from soup_nlp.report.result import Result, load

MIN_PIXELS = 200
"""Links with fewer pixels are flagged."""
MAX_GUESSED = 0.5
"""A pair has no parallax if the depth of a larger share of its background is a guess, and a chain
is not good if that of a larger share of all its images is."""
MADE_BY = "soup_nlp.load(...) of the folder of each pair"
"""Where pairs of a chain come from, for messages."""
SAME = 0.3
"""Smallest intersection over union of two components of one track."""
KEPT = ("input", "start", "truth", "solution", "weights", "energy")
"""Groups of arrays of a pair that a chain needs."""


def read_pair(folder: Path) -> Result:
    """The result of a folder, with the arrays that a chain needs."""
    result = load(folder)
    return replace(result, tree={name: result.tree[name] for name in KEPT if name in result.tree})


def still(result: Result) -> bool:
    """Whether most of the background has no parallax, so that its depth is a guess."""
    return result.components.background.borrowed > MAX_GUESSED


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


def find_links(pairs: Sequence[Result]) -> list[Link]:
    """Links of consecutive pairs, from static pixels that are confident in both.

    The depth of a pair without parallax is a guess, so its links are flagged, as are those of pairs
    without a pixel that is confident in both. The pairs before and after a run of pairs without
    parallax are linked directly, with the depth of the former moved by the flow of the run.
    """
    out: list[Link | None] = []
    for a, (first, second) in enumerate(pairwise(pairs)):
        z, keep = first.depths[1], first.in_next(first.static, False)
        guess, every = still(first) or still(second), np.ones_like(keep)
        near = link((a, a + 1), z, second.depths[0], keep & second.static, guess)
        out.append(near or link((a, a + 1), z, second.depths[0], every, flagged=True))
    for a, first in enumerate(pairs):
        z, keep, b = first.depths[1], first.in_next(first.static, False), a + 1
        while not still(first) and b < len(pairs) and still(pairs[b]):
            keep = pairs[b].in_next(keep & (pairs[b].components.of_pixel == 0), False)
            z, b = pairs[b].in_next(z, np.nan), b + 1
        if a + 1 < b < len(pairs):
            bridge = link((a, b), z, pairs[b].depths[0], keep & pairs[b].static)
            out.append(bridge and replace(bridge, bridge=True))
    return [shared for shared in out if shared]


def chained_scales(total: int, links: Sequence[Link]) -> Float:
    """(total,) scales of pairs, 1 for the first: links in a row, a bridge before flagged ones.

    Raises:
        DataError: a pair is linked to none before it.
    """
    out = np.ones(total)
    for k in range(1, total):
        before = sorted((link for link in links if link.second == k), key=lambda one: one.flagged)
        if not before:
            raise DataError("a pair shares no pixel with the others", where=f"pair {k}")
        out[k] = out[before[0].first] * np.exp(before[0].log_ratio)
    return out


def make_chain(pairs: Sequence[Result], summary: Mapping[str, Any] | None = None) -> Chain:
    """Determine a common scale of consecutive pairs, the camera path, and tracks of components.

    Args:
        pairs: Results of the frames (0, 1), (1, 2), ..., at least one.
        summary: Contents of chain.json.

    Raises:
        DataError: a pair shares no pixel with those before it.
    """
    expect(pairs, (list, tuple), "pairs of a chain", MADE_BY)
    for pair in pairs or (None,):
        expect(pair, Result, "pair of a chain", MADE_BY)
    links = find_links(pairs)
    scales = chained_scales(len(pairs), links)
    results = [pair.scaled(s) for pair, s in zip(pairs, scales, strict=True)]
    poses = [STILL]
    for result in results:
        poses.append(poses[-1] @ result.components.camera.inverse)
    matches = [
        follow(a.in_next(a.components.of_pixel, -1), b.components.of_pixel)
        for a, b in pairwise(results)
    ]
    tracks = number(matches, [len(result.components) for result in results])
    names = tuple(f"{k:04d}" for k in range(len(poses)))
    parts = tuple(results), tuple(poses), tuple(tracks), names
    return Chain(*parts, scales, tuple(links), {} if summary is None else summary)


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
