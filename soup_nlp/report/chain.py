"""A chain of solved pairs in one unit of length; a single pair is a chain of two frames."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float, Image, Int, Mask
from soup_nlp.errors import FrameError
from soup_nlp.geometry.camera import pixel_grid, rays
from soup_nlp.geometry.components import Component
from soup_nlp.geometry.rotation import RigidMotion
from soup_nlp.geometry.surface import joined
from soup_nlp.report import figures
from soup_nlp.report.figures import Picture, shown

if TYPE_CHECKING:
    from soup_nlp.report.result import Result

UNIT = "soup unit (free scale: the mean distance of the planes is 1)"
AXES = "x right, y down, z ahead"
STILL = RigidMotion(np.eye(3), np.zeros(3))
SHOWN_FRAMES = 12
"""Largest number of frames of a chain that a notebook shows."""
NEAR = 5
"""Number of pairs in memory at once: clouds compare a frame with two on either side."""
SAMPLES = 1_000_000
"""Largest number of depths of a chain from which the range of its colours is found."""

Item = TypeVar("Item")


class Lazy(Sequence[Item]):
    """Items that are made when they are needed; the last few stay in memory."""

    def __init__(self, make: Callable[[int], Item], count: int) -> None:
        self._make, self._count = lru_cache(NEAR)(make), count

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, number: Any) -> Any:
        if isinstance(number, slice):
            return [self[k] for k in range(self._count)[number]]
        return self._make(range(self._count)[number])


def some_depths(pair: Result, count: int = 1) -> Float:
    """Depths of the reference frame of one of `count` pairs, from which colours are found."""
    step = max(7, -(-pair.labels.size * count // SAMPLES))
    # a view would keep the whole map
    return pair.depths[0].ravel()[::step].copy()


def mean_shares(rows: Sequence[Mapping[str, float | None]]) -> dict[str, float]:
    """Means over pairs of the shares in `report.verdict.certainty`."""
    known = {k: [v for row in rows if (v := row[k]) is not None] for k in rows[0]}
    return {k: float(np.mean(values)) if values else np.nan for k, values in known.items()}


@dataclass(frozen=True)
class Link:
    """Ratio of the scales of the pairs `first` and `second`, measured in a common frame.

    Attributes:
        log_ratio: Logarithm of the second's scale over the first's, the median over `pixels`.
        spread: Robust standard deviation of the same over pixels (1.4826 MAD).
        bridge: Whether a pair without parallax lies between the two.
        flagged: Whether it is doubtful: a pair has no parallax, or few pixels are shared.
    """

    first: int
    second: int
    log_ratio: float
    spread: float
    pixels: int
    bridge: bool = False
    flagged: bool = False


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame of a chain, in the unit of the chain: the record that every file is written from.

    Attributes:
        name: "ref" or "next" of a pair, else its number.
        image: (H, W, 3) uint8 RGB.
        K: (3, 3) intrinsics, pixels.
        depth: (H, W) z; NaN where unknown.
        sigma: (H, W) standard deviation of log z; NaN where unknown.
        drawn: (H, W) True where nothing tells the depth; False where it is unknown.
        components: (H, W) what moves by itself, by number of its track; 0 is the static scene, -1
            unknown.
        pose: world_from_camera; the world is the first frame's camera.
        sure: (H, W) pixels of clouds, see `Result.sure`.
        labels: (H, W) superpixel of its pair; 0 where the depth is unknown.
        planes: (N, 3) m of every superpixel with depth 1 / (m . ray).
        detail: (H, W) log depth relative to the planes; 0 where it is unknown.
        flow: (H, W, 2) flow to the next frame, pixels; None of the last frame.
        unit: Unit of length as a phrase for headers of files.
    """

    name: str
    image: Image
    K: Float
    depth: Float
    sigma: Float
    drawn: Mask
    components: NDArray[np.int32]
    pose: RigidMotion
    sure: Mask
    labels: NDArray[np.integer]
    planes: Float
    detail: Float
    flow: NDArray[np.floating] | None
    unit: str

    def __repr__(self) -> str:
        h, w = self.depth.shape
        return f"Frame({self.name}, {w}x{h}, {self.drawn.mean():.0%} drawn)"

    @property
    def points(self) -> Float:
        """(H, W, 3) points in world coordinates; NaN where unknown."""
        ray = rays(self.K, pixel_grid(*self.depth.shape))
        return self.pose(self.depth[..., None] * ray)

    @property
    def normals(self) -> Float:
        """(H, W, 3) unit normals of `points` towards the camera, in world coordinates."""
        turned = -self.planes @ self.pose.R.T
        return np.asarray((turned / np.linalg.norm(turned, axis=1, keepdims=True))[self.labels])

    @property
    def static(self) -> Mask:
        """(H, W) sure pixels of the static scene."""
        return self.sure & (self.components == 0)

    @cached_property
    def surface(self) -> tuple[Mask, Mask]:
        """Continuity to the right and downwards, see `geometry.surface.joined`."""
        return joined(self.planes, self.labels, self.components, self.K, self.detail)

    def _repr_html_(self) -> str:
        near, far = figures.depth_range(self.depth)
        sigma = figures.colourise_shares(self.sigma, 0.3, "viridis")
        panels = [
            Picture("image", self.image),
            self.picture(near, far, "depth, pale = drawn"),
            Picture("expected depth error (1 sigma), bright = 30 % and more", sigma),
        ]
        return shown(str(self), figures.strip(panels, ""))

    def picture(self, near: float, far: float, title: str) -> Picture:
        """The depth in colours from `near` to `far`, pale where it is drawn."""
        image = figures.colourise_depth(self.depth, near, far, self.drawn)
        return Picture(title, image, figures.depth_legend(near, far))


@dataclass(frozen=True, eq=False)
class Chain:
    """Solved pairs of consecutive frames in the axes of the first camera and the first unit.

    Attributes:
        pairs: Results of the frames k and k + 1, in the unit of the first; those of a folder are
            read when they are needed.
        parts: Components of every pair.
        depths: Some depths of all pairs.
        certainty: Means over the pairs of the shares in `report.verdict.certainty`.
        world_from_camera: Camera poses of the K + 1 frames.
        tracks: (C,) track of every component, for every pair.
        names: Names of the K + 1 frames in files.
        scales: (K,) factor from the own unit of each pair to that of the first.
        links: Links that determine the scales, including those of pairs over two frames.
        summary: Contents of chain.json, or of a single pair's summary.json.
    """

    pairs: Sequence[Result]
    parts: Sequence[tuple[Component, ...]]
    depths: Float
    certainty: Mapping[str, float]
    world_from_camera: tuple[RigidMotion, ...]
    tracks: tuple[Int, ...]
    names: tuple[str, ...]
    scales: Float
    links: tuple[Link, ...] = ()
    summary: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, result: Result) -> Chain:
        """A result as a chain of two frames."""
        parts = result.components
        return cls(
            pairs=(result,),
            parts=(parts.members,),
            depths=some_depths(result),
            certainty=mean_shares([result.summary["certainty"]]),
            world_from_camera=(STILL, parts.camera.inverse),
            tracks=(np.arange(len(parts)),),
            names=("ref", "next"),
            scales=np.ones(1),
            summary=result.summary,
        )

    def __len__(self) -> int:
        return len(self.pairs) + 1

    def __repr__(self) -> str:
        low, high = self.scales.min(), self.scales.max()
        flagged = sum(k.flagged for k in self.links)
        return (
            f"Chain({len(self)} frames, scales {low:.3g}..{high:.3g}, {flagged} flagged links,"
            f" {self.certainty['drawn']:.0%} drawn)"
        )

    def _repr_html_(self) -> str:
        near, far = figures.depth_range(self.depths)
        chosen = sorted({*np.linspace(0, len(self) - 1, min(SHOWN_FRAMES, len(self))).astype(int)})
        panels = [self[k].picture(near, far, f"depth of frame {self.names[k]}") for k in chosen]
        return shown(str(self), figures.strip(panels, ""))

    @property
    def name(self) -> str:
        """Name for titles."""
        return str(self.summary.get("name", ""))

    @property
    def single(self) -> bool:
        """Whether it is a pair."""
        return len(self.pairs) == 1

    @property
    def metre(self) -> float | None:
        """Units of the truth in one unit of length; None where it is not known."""
        score = self.summary.get("score")
        return score["scale"] if score else self.pairs[0].metre if self.single else None

    @property
    def length(self) -> str:
        """Name of the unit of length in which depths are shown."""
        return "units" if self.metre is None else self.pairs[0].metre_unit

    @property
    def unit(self) -> str:
        """Unit of length as a phrase for headers of files."""
        return self.pairs[0].unit if self.single else f"{UNIT} of the first pair"

    @cached_property
    def depth_range(self) -> tuple[float, float]:
        """(near, far) of the colours of depth in the shown unit, one for all frames."""
        return figures.depth_range(self.depths * (self.metre or 1.0))

    def __getitem__(self, number: int) -> Frame:
        """A frame by its number; FrameError if there is none."""
        if not (isinstance(number, int | np.integer) and 0 <= number < len(self)):
            expected = f"0 to {len(self) - 1}"
            raise FrameError("there is no such frame", found=number, expected=expected)
        # the last frame is the next one of the last pair
        last = int(number == len(self.pairs))
        pair, tracks = self.pairs[number - last], self.tracks[number - last]
        maps: dict[str, tuple[NDArray[Any], float]] = {
            "sigma": (pair.sigma, np.nan),
            "drawn": (pair.drawn, False),
            "sure": (pair.sure, False),
            "labels": (pair.labels, 0),
            "detail": (pair.detail, 0.0),
            "components": (tracks[pair.components.of_pixel].astype(np.int32), -1),
        }
        return Frame(
            name=self.names[number],
            image=pair.images[last],
            K=(pair.K, pair.K_next)[last],
            depth=pair.depths[last],
            pose=self.world_from_camera[number],
            planes=pair.planes[last],
            flow=None if last else pair.flow,
            unit=self.unit,
            **{name: pair.in_next(*x) if last else x[0] for name, x in maps.items()},
        )

    def __iter__(self) -> Iterator[Frame]:
        return (self[k] for k in range(len(self)))

    def depth(self, frame: int) -> Float:
        """(H, W) z of a frame in the unit of the chain; NaN where unknown."""
        return self[frame].depth

    def points(self, frame: int) -> Float:
        """(H, W, 3) points of a frame in world coordinates; NaN where unknown."""
        return self[frame].points

    def motion(self, pair: int, label: int) -> RigidMotion:
        """Motion of a component in the world from a frame to the next; label 0 does not move."""
        before, after = self.world_from_camera[pair], self.world_from_camera[pair + 1]
        return after @ self.parts[pair][label].motion @ before.inverse

    @cached_property
    def paths(self) -> dict[int, dict[int, Float]]:
        """Centre (3,) in the world by frame, of every track; the static scene, 0, is none."""
        out = defaultdict[int, dict[int, Float]](dict)
        for k, (parts, tracks) in enumerate(zip(self.parts, self.tracks, strict=True)):
            for part, track in zip(parts[1:], tracks[1:].tolist(), strict=True):
                out[track][k] = self.world_from_camera[k](part.centre)
                out[track][k + 1] = self.motion(k, part.label)(out[track][k])
        return dict(out)
