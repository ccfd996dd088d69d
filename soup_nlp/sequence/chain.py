"""A chain of solved pairs with a common scale and frame of reference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from soup_nlp.arrays import Float, Image, Mask
from soup_nlp.errors import DataError, expect
from soup_nlp.geometry.motion import RigidMotion
from soup_nlp.geometry.superpixels import Labels
from soup_nlp.sequence.pairs import SolvedPair
from soup_nlp.sequence.scales import Link, link, solve_scales
from soup_nlp.sequence.tracks import carried, follow, number


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

    def depth(self, frame: int) -> Float:
        """(H, W) z of a frame in the unit of the chain; the last frame is a next frame."""
        if frame == len(self.pairs):
            return self.scales[-1] * self.pairs[-1].result.depths[1]
        return self.scales[frame] * self.pairs[frame].result.depths[0]

    def image(self, frame: int) -> Image:
        """(H, W, 3) uint8 RGB of a frame."""
        last = frame == len(self.pairs)
        return self.pairs[frame - last].result.images[int(last)]

    def camera(self, frame: int) -> Float:
        """(3, 3) intrinsics of a frame, pixels."""
        last = frame == len(self.pairs)
        return self.pairs[frame - last].result.K[int(last)]

    def labels(self, frame: int) -> Labels:
        """(H, W) components of a frame; -1 where the last one shows what the others do not."""
        last = frame == len(self.pairs)
        result = self.pairs[frame - last].result
        own = result.components.of_pixel
        return np.asarray(carried(own, result.reconstruction) if last else own, np.int32)

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
        for k, own in enumerate(self.tracks):
            for label, name in own.items():
                if name == track:
                    part = self.pairs[k].result.components[label]
                    out[k] = self.world_from_camera[k](self.scales[k] * part.centre)
                    out[k + 1] = self.motion(k, label)(out[k])
        return out


def make_chain(pairs: Sequence[SolvedPair], over: Sequence[SolvedPair] = ()) -> Chain:
    """Determine a common scale of consecutive pairs, the camera path, and tracks of components.

    Args:
        pairs: Pairs of the frames (0, 1), (1, 2), ...
        over: Further pairs of the same frames, such as (0, 2), for more links.

    Raises:
        DataError: the pairs are not consecutive, or share no pixel.
    """
    for own in (pairs, over):
        expect(own, (list, tuple), "pairs of a chain", "soup_nlp.sequence.pairs.solve_pairs(...)")
    for pair in (*pairs, *over):
        expect(pair, SolvedPair, "pair of a chain", "soup_nlp.sequence.pairs.solve_pairs(...)")
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
