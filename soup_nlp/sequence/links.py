"""Links between solved pairs, their common scale, the camera path, and tracks of components."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from soup_nlp.arrays import Float, Mask
from soup_nlp.errors import DataError
from soup_nlp.geometry.superpixels import Labels
from soup_nlp.report.chain import STILL, Brief, Chain, Lazy, Link
from soup_nlp.report.result import Result

MIN_PIXELS = 200
"""Links with fewer pixels are flagged."""
MOST_DRAWN = 0.5
"""A pair has no parallax if a larger share of its background has the depth of neighbours, and a
chain is not good if a larger share of all its images is drawn."""
LEAST_OVERLAP = 0.3
"""Smallest intersection over union of two components of one track."""


def still(result: Result) -> bool:
    """Whether most of the background has no parallax."""
    return result.components.background.interpolated > MOST_DRAWN


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
    return Link(*ends, middle, spread, len(ratio), flagged=flagged or len(ratio) < MIN_PIXELS)


def bridge(pairs: Sequence[Result], a: int) -> Link | None:
    """The link of a pair to the one after a run of pairs without parallax; None if there is none.

    The depth of the pair is moved by the flow of the run.
    """
    z, keep, b = pairs[a].depths[1], pairs[a].in_next(pairs[a].static, False), a + 1
    while not still(pairs[a]) and b < len(pairs) and still(pairs[b]):
        keep = pairs[b].in_next(keep & (pairs[b].components.of_pixel == 0), False)
        z, b = pairs[b].in_next(z, np.nan), b + 1
    if not a + 1 < b < len(pairs):
        return None
    found = link((a, b), z, pairs[b].depths[0], keep & pairs[b].static)
    return found and replace(found, bridge=True)


def near_link(pairs: Sequence[Result], a: int) -> Link | None:
    """The link of a pair and the next one, from static pixels that are confident in both.

    It is flagged where a pair has no parallax, or where no pixel is confident in both.
    """
    first, second = pairs[a], pairs[a + 1]
    z, keep = first.depths[1], first.in_next(first.static, False)
    flagged, every = still(first) or still(second), np.ones_like(keep)
    near = link((a, a + 1), z, second.depths[0], keep & second.static, flagged)
    return near or link((a, a + 1), z, second.depths[0], every, flagged=True)


def chained_scales(total: int, links: Sequence[Link]) -> Float:
    """(total,) scales of pairs, 1 for the first: links in a row, a bridge before flagged ones."""
    out, ending = np.ones(total), dict[int, list[Link]]()
    for one in links:
        ending.setdefault(one.second, []).append(one)
    for k in range(1, total):
        before = sorted(ending.get(k, ()), key=lambda one: one.flagged)
        if not before:
            raise DataError("a pair shares no pixel with the others", where=f"pair {k}")
        out[k] = out[before[0].first] * np.exp(before[0].log_ratio)
    return out


def make_chain(pairs: Sequence[Result], summary: Mapping[str, Any] | None = None) -> Chain:
    """A common scale of pairs, the frames (0, 1), (1, 2) ..., camera path and tracks of components.

    `summary` has the contents of chain.json. A pair that shares no pixel with those before it is a
    DataError.
    """
    near, bridges, matches, briefs = list[Link | None](), list[Link | None](), [], list[Brief]()
    # every pair is read once
    for k, pair in enumerate(pairs):
        briefs.append(Brief.of(pair, len(pairs)))
        if k + 1 < len(pairs):
            near.append(near_link(pairs, k))
            bridges.append(bridge(pairs, k))
            before = pair.in_next(pair.components.of_pixel, -1)
            matches.append(follow(before, pairs[k + 1].components.of_pixel))
    links = [one for one in (*near, *bridges) if one]
    scales = chained_scales(len(pairs), links)
    briefs = [brief.scaled(s) for brief, s in zip(briefs, scales, strict=True)]
    poses = [STILL]
    for brief in briefs:
        poses.append(poses[-1] @ brief.parts[0].motion.inverse)
    numbers = number(matches, [len(brief.parts) for brief in briefs])
    tracks = (np.array([of[label] for label in range(len(of))]) for of in numbers)
    names = tuple(f"{k:04d}" for k in range(len(poses)))
    results = Lazy(lambda k: pairs[k].scaled(scales[k]), len(pairs))
    parts = results, tuple(briefs), tuple(poses), tuple(tracks), names
    return Chain(*parts, scales, tuple(links), {} if summary is None else summary)


def follow(before: Labels, after: Labels) -> dict[int, int]:
    """Components of the second of two pairs by those of the first that they overlap most.

    `before` and `after` (H, W) are labels in the common frame; -1 is unknown, 0 the background.
    """
    visible = before >= 0
    share = overlap_shares(before[visible], after[visible])
    # the background has no track
    share[0], share[:, 0] = 0, 0
    share[share < LEAST_OVERLAP] = 0
    matched = zip(*linear_sum_assignment(share, maximize=True))
    return {int(i): int(k) for i, k in matched if share[i, k] > 0}


def overlap_shares(first: NDArray[np.integer], second: NDArray[np.integer]) -> Float:
    """(A, B) intersection over union of the labels 0..A-1 and 0..B-1 of the same pixels (M,)."""
    count = int(second.max()) + 1
    flat, size = first.astype(np.int64) * count + second, count * (int(first.max()) + 1)
    shared = np.bincount(flat, minlength=size).reshape(-1, count)
    union = shared.sum(axis=0) + shared.sum(axis=1, keepdims=True) - shared
    return np.asarray(shared / np.maximum(union, 1))


def number(matches: Sequence[dict[int, int]], counts: Sequence[int]) -> list[dict[int, int]]:
    """Tracks by component of every pair; 0 is the background.

    `matches` come from `follow`; `counts` are the components of every pair with the background.
    """
    out, new_number = list[dict[int, int]](), count(1)
    for match, total in zip([{}, *matches], counts, strict=True):
        numbers = {new: out[-1][old] for old, new in match.items()}
        rest = {label: next(new_number) for label in range(1, total) if label not in numbers}
        out.append({0: 0, **numbers, **rest})
    return out
