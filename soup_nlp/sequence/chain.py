"""A chain of solved pairs with a common scale and frame of reference; tracks of components."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import count, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, linear_sum_assignment

from soup_nlp.arrays import Float, Image, Mask
from soup_nlp.errors import DataError, expect
from soup_nlp.evaluate.metrics import overlap_shares
from soup_nlp.geometry.components import Component
from soup_nlp.geometry.graph import connected
from soup_nlp.geometry.motion import RigidMotion
from soup_nlp.geometry.soup import Reconstruction
from soup_nlp.geometry.superpixels import Labels
from soup_nlp.report.result import INPUTS, Result, load

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


@dataclass(frozen=True, eq=False)
class SolvedPair:
    """A pair of frames with its result.

    Attributes:
        first: Index of the reference frame.
        second: Index of the next frame.
        result: Result of the solve, with the arrays of its input and truth only.
        parallax_px: Median displacement that the camera's translation causes, pixels.
    """

    first: int
    second: int
    result: Result
    parallax_px: float

    @property
    def still(self) -> bool:
        """Whether most of the background has no parallax, so that its depth is a guess."""
        return self.result.components.background.borrowed > MAX_GUESSED

    @property
    def static(self) -> Mask:
        """(H, W) confident pixels of the static scene in the reference frame."""
        return np.asarray(self.result.sure & (self.result.components.of_pixel == 0))

    def view(self, frame: int) -> tuple[Float, Mask]:
        """(H, W) z of one of the two frames, and its confident pixels of the static scene."""
        if frame == self.first:
            return self.result.depths[0], self.static
        return self.result.depths[1], carried(self.static, self.result.reconstruction) > 0


def read_pair(first: int, second: int, folder: Path) -> SolvedPair:
    """The pair of two frames from its result folder."""
    result = load(folder)
    tree = result.tree
    parallax = float(np.median(tree["start"]["parallax"][result.components.of_superpixel == 0]))
    # a chain holds many pairs, whose other arrays it does not need
    kept = {"input": {name: tree["input"][name] for name in INPUTS}}
    kept["truth"] = tree.get("truth", {})
    return SolvedPair(first, second, replace(result, tree=kept), parallax)


def carried(of_pixel: NDArray[np.generic], rec: Reconstruction) -> NDArray[Any]:
    """(H', W') labels of the reference frame in the next frame; -1 where not visible."""
    source = rec.source_next
    return np.where(source >= 0, of_pixel.ravel()[source], -1)


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
            source, static = still.result.reconstruction.source_next, still.result.components
            keep = (source >= 0) & (keep & (static.of_pixel == 0)).ravel()[source]
            z, frame = np.where(keep, z.ravel()[source], np.nan), still.second
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
        guess = np.mean([pair.result.summary["certainty"]["guess"] for pair in self.pairs])
        return (
            f"Chain({len(self)} frames, scales {low:.3g}..{high:.3g}, {flagged} flagged links,"
            f" {guess:.0%} a guess)"
        )

    __repr__ = __str__

    def seen(self, frame: int) -> tuple[int, int]:
        """A pair that holds a frame, and the frame's number in it: 0, and 1 for the last frame."""
        last = int(frame == len(self.pairs))
        return frame - last, last

    def depth(self, frame: int) -> Float:
        """(H, W) z of a frame in the unit of the chain."""
        pair, side = self.seen(frame)
        return self.scales[pair] * self.pairs[pair].result.depths[side]

    def image(self, frame: int) -> Image:
        """(H, W, 3) uint8 RGB of a frame."""
        pair, side = self.seen(frame)
        return self.pairs[pair].result.images[side]

    def camera(self, frame: int) -> Float:
        """(3, 3) intrinsics of a frame, pixels."""
        pair, side = self.seen(frame)
        return self.pairs[pair].result.K[side]

    def labels(self, frame: int) -> Labels:
        """(H, W) components of a frame; -1 at pixels that only the last frame shows."""
        pair, side = self.seen(frame)
        result = self.pairs[pair].result
        labels = result.components.of_pixel
        return np.asarray(carried(labels, result.reconstruction) if side else labels, np.int32)

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
        for k, part in self.members(track).items():
            out[k] = self.world_from_camera[k](self.scales[k] * part.centre)
            out[k + 1] = self.motion(k, part.label)(out[k])
        return out

    @property
    def track_numbers(self) -> list[int]:
        """Numbers of the tracks; the background, 0, is none."""
        return sorted({track for numbers in self.tracks for track in numbers.values()} - {0})

    def members(self, track: int) -> dict[int, Component]:
        """Components of a track, by number of the pair; a pair need not show the track."""
        numbered = enumerate(zip(self.pairs, self.tracks, strict=True))
        return {
            k: pair.result.components[label]
            for k, (pair, numbers) in numbered
            for label, number in numbers.items()
            if number == track
        }


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
        for pair in several:
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
