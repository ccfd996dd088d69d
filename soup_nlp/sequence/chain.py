"""A chain of solved pairs with a common scale and frame of reference, and tracks of what moves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from soup_nlp.arrays import Float, Image
from soup_nlp.errors import DataError, expect
from soup_nlp.evaluate.metrics import overlap_shares
from soup_nlp.geometry.motion import RigidMotion
from soup_nlp.geometry.superpixels import Labels
from soup_nlp.sequence.pairs import SolvedPair, carried
from soup_nlp.sequence.scales import Link, find_links, solve_scales

MADE_BY = "soup_nlp.sequence.pairs.solve_pairs(...)"
"""Where pairs of a chain come from, for messages."""
SAME = 0.3
"""Smallest intersection over union of two components of one track."""


@dataclass(frozen=True, eq=False)
class Chain:
    """Solved pairs of consecutive frames in the axes of the first camera and the first unit.

    Attributes:
        pairs: Pair k has the frames k and k + 1.
        scales: (K,) factor from the unit of each pair to that of the first.
        links: Links that determine the scales, including those of pairs over two frames.
        world_from_camera: Camera poses of the K + 1 frames.
        tracks: Number of the track by label of a component, for every pair.
    """

    pairs: tuple[SolvedPair, ...]
    scales: Float
    links: tuple[Link, ...]
    world_from_camera: tuple[RigidMotion, ...]
    tracks: tuple[dict[int, int], ...]

    def __len__(self) -> int:
        return len(self.pairs) + 1

    def __str__(self) -> str:
        low, high = self.scales.min(), self.scales.max()
        flagged = sum(k.flagged for k in self.links)
        return f"Chain({len(self)} frames, scales {low:.3g}..{high:.3g}, {flagged} flagged links)"

    __repr__ = __str__

    def seen(self, frame: int) -> tuple[int, int]:
        """A pair that holds a frame, and the frame's number in it: 0, and 1 for the last frame."""
        last = int(frame == len(self.pairs))
        return frame - last, last

    def depth(self, frame: int) -> Float:
        """(H, W) z of a frame in the unit of the chain."""
        pair, place = self.seen(frame)
        return self.scales[pair] * self.pairs[pair].result.depths[place]

    def image(self, frame: int) -> Image:
        """(H, W, 3) uint8 RGB of a frame."""
        pair, place = self.seen(frame)
        return self.pairs[pair].result.images[place]

    def camera(self, frame: int) -> Float:
        """(3, 3) intrinsics of a frame, pixels."""
        pair, place = self.seen(frame)
        return self.pairs[pair].result.K[place]

    def labels(self, frame: int) -> Labels:
        """(H, W) components of a frame; -1 where the last one shows what the others do not."""
        pair, place = self.seen(frame)
        result = self.pairs[pair].result
        labels = result.components.of_pixel
        return np.asarray(carried(labels, result.reconstruction) if place else labels, np.int32)

    def points(self, frame: int) -> Float:
        """(H, W, 3) points of a frame but the last, in world coordinates."""
        local = self.scales[frame] * self.pairs[frame].result.points[0]
        return self.world_from_camera[frame](local)

    def motion(self, pair: int, label: int) -> RigidMotion:
        """Motion of a component in the world from a frame to the next; label 0 does not move."""
        M, s = self.pairs[pair].result.components[label].motion, self.scales[pair]
        before, after = self.world_from_camera[pair], self.world_from_camera[pair + 1]
        return after @ RigidMotion(M.R, s * M.t) @ before.inverse

    def path(self, track: int) -> dict[int, Float]:
        """Centre (3,) of a track in the world, by frame."""
        out: dict[int, Float] = {}
        for k, pair in enumerate(self.pairs):
            if (label := self.label(k, track)) is not None:
                centre = pair.result.components[label].centre
                out[k] = self.world_from_camera[k](self.scales[k] * centre)
                out[k + 1] = self.motion(k, label)(out[k])
        return out

    @property
    def track_numbers(self) -> list[int]:
        """Numbers of the tracks; the background, 0, is none."""
        return sorted({track for numbers in self.tracks for track in numbers.values()} - {0})

    def label(self, pair: int, track: int) -> int | None:
        """Label of a track's component in a pair; None where the pair does not show the track."""
        return next((label for label, t in self.tracks[pair].items() if t == track), None)


def make_chain(pairs: Sequence[SolvedPair], over: Sequence[SolvedPair] = ()) -> Chain:
    """Determine a common scale of consecutive pairs, the camera path, and tracks of components.

    Args:
        pairs: Pairs of the frames (0, 1), (1, 2), ...
        over: Further pairs of the same frames, such as (0, 2), for more links.

    Raises:
        DataError: the pairs are not consecutive, or share no pixel.
    """
    for several in (pairs, over):
        expect(several, (list, tuple), "pairs of a chain", MADE_BY)
    for pair in (*pairs, *over):
        expect(pair, SolvedPair, "pair of a chain", MADE_BY)
    if not pairs or [(p.first, p.second) for p in pairs] != [(k, k + 1) for k in range(len(pairs))]:
        raise DataError("pairs of a chain are not consecutive", found=[p.first for p in pairs])
    links = find_links([*pairs, *over])
    scales = solve_scales(len(pairs) + len(over), links)[: len(pairs)]
    poses = [RigidMotion(np.eye(3), np.zeros(3))]
    for pair, s in zip(pairs, scales, strict=True):
        camera = pair.result.components.camera
        poses.append(poses[-1] @ RigidMotion(camera.R, s * camera.t).inverse)
    matches = [
        follow(
            carried(a.result.components.of_pixel, a.result.reconstruction),
            b.result.components.of_pixel,
        )
        for a, b in pairwise(pairs)
    ]
    tracks = number(matches, [len(p.result.components) for p in pairs])
    return Chain(tuple(pairs), scales, tuple(links), tuple(poses), tuple(tracks))


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
        numbers = {0: 0}
        back = {new: old for old, new in matches[k - 1].items()} if k else {}
        for label in range(1, count):
            if label in back:
                numbers[label] = out[k - 1][back[label]]
            else:
                numbers[label] = fresh
                fresh += 1
        out.append(numbers)
    return out
