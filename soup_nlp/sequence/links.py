"""Links between solved pairs, their common scale, the camera path, and tracks of components."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import count
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.errors import DataError
from soup_nlp.geometry.superpixels import Labels
from soup_nlp.report.chain import STILL, Chain, Lazy, Link, mean_shares, some_depths
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


def links_from(pairs: Sequence[Result], a: int) -> Iterator[Link]:
    """The links of a pair to the next one, and over pairs without parallax to the one after them.

    Pixels are static and confident in both. The first link is flagged where a pair has no parallax,
    or where no pixel is confident in both. For the second, the depth is moved by the flow of the
    pairs between.
    """
    z, keep, b = pairs[a].depths[1], pairs[a].in_next(pairs[a].static, False), a + 1
    depth, flagged = pairs[b].depths[0], still(pairs[a]) or still(pairs[b])
    near = link((a, b), z, depth, keep & pairs[b].static, flagged)
    near = near or link((a, b), z, depth, np.ones_like(keep), flagged=True)
    if near:
        yield near
    while not still(pairs[a]) and b < len(pairs) and still(pairs[b]):
        keep = pairs[b].in_next(keep & (pairs[b].components.of_pixel == 0), False)
        z, b = pairs[b].in_next(z, np.nan), b + 1
    if a + 1 < b < len(pairs):
        far = link((a, b), z, pairs[b].depths[0], keep & pairs[b].static)
        if far:
            yield replace(far, bridge=True)


def chained_scales(total: int, links: Sequence[Link]) -> Float:
    """(total,) scales of pairs, 1 for the first: links in a row, a bridge before flagged ones."""
    out = np.ones(total)
    for k in range(1, total):
        ending = [one for one in links if one.second == k]
        if not ending:
            raise DataError("a pair shares no pixel with the others", where=f"pair {k}")
        best = min(ending, key=lambda one: one.flagged)
        out[k] = out[best.first] * np.exp(best.log_ratio)
    return out


def make_chain(pairs: Sequence[Result], summary: Mapping[str, Any] | None = None) -> Chain:
    """A common scale of pairs, the frames (0, 1), (1, 2) ..., camera path and tracks of components.

    `summary` has the contents of chain.json. A pair that shares no pixel with those before it is a
    DataError.
    """
    links, depths, parts, shares, matches = list[Link](), [], [], [], []
    # every pair is read once
    for k, pair in enumerate(pairs):
        depths.append(some_depths(pair, len(pairs)))
        parts.append(pair.components.members)
        shares.append(pair.summary["certainty"])
        if k + 1 < len(pairs):
            links += links_from(pairs, k)
            before = pair.in_next(pair.components.of_pixel, -1)
            matches.append(follow(before, pairs[k + 1].components.of_pixel))
    links.sort(key=lambda one: one.bridge)
    scales = chained_scales(len(pairs), links)
    parts = [tuple(part.scaled(s) for part in own) for own, s in zip(parts, scales, strict=True)]
    poses = [STILL]
    for background, *_ in parts:
        poses.append(poses[-1] @ background.motion.inverse)
    return Chain(
        pairs=Lazy(lambda k: pairs[k].scaled(scales[k]), len(pairs)),
        parts=parts,
        depths=np.concatenate([s * z for s, z in zip(scales, depths, strict=True)]),
        certainty=mean_shares(shares),
        world_from_camera=tuple(poses),
        tracks=tuple(number(matches, [len(own) for own in parts])),
        names=tuple(f"{k:04d}" for k in range(len(poses))),
        scales=scales,
        links=tuple(links),
        summary=summary or {},
    )


def follow(before: Labels, after: Labels) -> dict[int, int]:
    """Components of the second of two pairs by those of the first that they overlap most.

    `before` and `after` (H, W) are labels in the common frame; -1 is unknown, 0 the background.
    """
    visible = before >= 0
    first, second = before[visible], after[visible]
    shared = np.zeros((first.max() + 1, second.max() + 1), np.int64)
    np.add.at(shared, (first, second), 1)
    # intersection over union
    share = shared / np.maximum(shared.sum(0) + shared.sum(1, keepdims=True) - shared, 1)
    # the background has no track
    share[0], share[:, 0] = 0, 0
    share[share < LEAST_OVERLAP] = 0
    matched = zip(*linear_sum_assignment(share, maximize=True))
    return {int(i): int(k) for i, k in matched if share[i, k] > 0}


def number(matches: Sequence[dict[int, int]], counts: Sequence[int]) -> list[Int]:
    """Track of every component, for every pair; 0 is the background.

    `matches` come from `follow`; `counts` are the components of every pair with the background.
    """
    out, new_number = list[Int](), count(1)
    for match, total in zip([{}, *matches], counts, strict=True):
        known = {0: 0, **{new: out[-1][old] for old, new in match.items()}}
        tracks = [known[k] if k in known else next(new_number) for k in range(total)]
        out.append(np.array(tracks))
    return out
