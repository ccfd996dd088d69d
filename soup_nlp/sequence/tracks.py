"""Tracking of components through the frames of a sequence."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from soup_nlp.evaluate.metrics import overlap_shares
from soup_nlp.geometry.soup import Reconstruction

Labels = NDArray[np.integer]

SAME = 0.3
"""Smallest intersection over union of two components of one track."""


def carried(of_pixel: Labels, rec: Reconstruction) -> Labels:
    """(H', W') labels of the reference frame in the next frame; -1 where not visible."""
    source = rec.source_next
    return np.where(source >= 0, of_pixel.ravel()[source], -1)


def follow(before: Labels, after: Labels) -> dict[int, int]:
    """Matches of the components of consecutive pairs by overlap in their common frame.

    Args:
        before: (H, W) labels of the first pair in the common frame; -1 unknown, 0 background.
        after: (H, W) labels of the second pair.

    Returns:
        Label after by label before, matched greedily by overlap.
    """
    known = before >= 0
    share = overlap_shares(before[known], after[known])
    # the background has no track
    share[0], share[:, 0] = 0, 0
    out: dict[int, int] = {}
    while share.max(initial=0.0) >= SAME:
        i, k = (int(x) for x in np.unravel_index(int(share.argmax()), share.shape))
        out[i] = k
        share[i], share[:, k] = 0, 0
    return out


def number(matches: Sequence[dict[int, int]], counts: Sequence[int]) -> list[dict[int, int]]:
    """Number of the track by label of the component, for every pair; 0 is the background.

    Args:
        matches: Results of `follow` for consecutive pairs.
        counts: Number of components of every pair, with the background.
    """
    out: list[dict[int, int]] = []
    fresh = 1
    for k, count in enumerate(counts):
        own = {0: 0}
        back = {new: old for old, new in matches[k - 1].items()} if k else {}
        for label in range(1, count):
            if label in back:
                own[label] = out[k - 1][back[label]]
            else:
                own[label] = fresh
                fresh += 1
        out.append(own)
    return out
