"""Elements of rendered scenes: poses, colours, textures; rooms, furniture, roads, cars."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from soup_nlp.data.scenes.raycast import Part, inverse
from soup_nlp.data.scenes.surfaces import (
    Box,
    Colour,
    Ellipsoid,
    Float,
    Panels,
    Plane,
    Shape,
    Texture,
)
from soup_nlp.geometry import rotation

ZERO = (0.0, 0.0, 0.0)


def placed(x: float, y: float, z: float, yaw: float = 0.0, pitch: float = 0.0) -> Float:
    """(4, 4) pose at a position (m), turned by `yaw` about y after `pitch` about x (degrees)."""
    return about(turn=[0, yaw, 0], shift=(x, y, z)) @ about(turn=[pitch, 0, 0])


def about(pivot: ArrayLike = ZERO, turn: ArrayLike = ZERO, shift: ArrayLike = ZERO) -> Float:
    """(4, 4) motion: turn by a rotation vector (degrees) about a pivot (3,), then shift (3,) m."""
    out, centre = np.eye(4), np.array(pivot, float)
    out[:3, :3] = rotation.exp(np.radians(turn))
    out[:3, 3] = centre - out[:3, :3] @ centre + np.asarray(shift)
    return out


def views(pose: Float, shift: ArrayLike, turn: ArrayLike) -> tuple[Float, Float]:
    """(ref_from_scene, next_from_scene) of a camera at `pose` that moves in its own frame."""
    return inverse(pose), inverse(pose @ about(turn=turn, shift=shift))


def foot(part: Part) -> Float:
    """(3,) point of the ground below the centre of a part."""
    return part.scene_from_part[:3, 3] * [1, 0, 1]


def block(
    half: Sequence[float] | Float, x: float, z: float, texture: Texture, **pose: float
) -> Part:
    """A box that stands on the ground; `pose` has the angles of `placed`."""
    return Part(Box(half), placed(x, -half[1], z, **pose), texture)


def windows(period: tuple[float, float], offset: tuple[float, float]) -> Panels:
    """Dark windows of uneven brightness on a facade; period and offset in m."""
    return Panels(period, (0.45, 0.55), GLASS, offset, variation=0.5)


PAINTS: tuple[tuple[Colour, Colour], ...] = (
    ((0.72, 0.20, 0.14), (0.50, 0.12, 0.10)),
    ((0.16, 0.36, 0.68), (0.10, 0.22, 0.46)),
    ((0.82, 0.66, 0.18), (0.66, 0.46, 0.10)),
    ((0.18, 0.52, 0.30), (0.34, 0.62, 0.26)),
    ((0.62, 0.58, 0.56), (0.40, 0.40, 0.44)),
    ((0.52, 0.26, 0.56), (0.68, 0.40, 0.62)),
    ((0.20, 0.58, 0.60), (0.12, 0.40, 0.46)),
    ((0.80, 0.44, 0.20), (0.62, 0.30, 0.14)),
)
WALLS: tuple[tuple[Colour, Colour], ...] = (
    ((0.70, 0.62, 0.50), (0.58, 0.50, 0.42)),
    ((0.62, 0.38, 0.30), (0.50, 0.32, 0.27)),
    ((0.60, 0.62, 0.64), (0.48, 0.50, 0.54)),
    ((0.74, 0.70, 0.62), (0.62, 0.60, 0.56)),
)
ASPHALT: tuple[Colour, Colour] = ((0.42, 0.42, 0.43), (0.32, 0.32, 0.34))
SKY: tuple[Colour, Colour] = ((0.52, 0.68, 0.88), (0.84, 0.88, 0.92))
GLASS: Colour = (0.16, 0.20, 0.26)
DARK: tuple[Colour, Colour] = ((0.12, 0.12, 0.13), (0.20, 0.20, 0.21))

FRONT = ((-0.62, 3.5), (0.0, 3.4), (0.62, 3.6))
BACK = ((-0.88, 4.9), (-0.3, 5.0), (0.31, 4.8), (0.88, 5.0))
"""Spots on the floor: fraction of half the image's width, distance (m). The back row stands in the
gaps of the front row."""

WALL = 6.4
"""Distance of a room's back wall, m."""


def floor(texture: Texture) -> Part:
    """The infinite ground y = 0."""
    return Part(Plane(), placed(0, 0, 0, pitch=-90), texture)


def backdrop(z: float, texture: Texture, glow: float = 0.45) -> Part:
    """An infinite upright wall at a distance."""
    return Part(Plane(), placed(0, 0, z), texture, glow)


@dataclass
class SceneBuilder:
    """Makes the parts of one scene from one stream of random numbers.

    Attributes:
        rng: Random numbers; those of a part depend on the order of the calls.
        half_width, half_height: Half the size of the image over the focal length.
        contrast: Factor of the contrast of all textures.
        seed: Number of the scene; some layouts choose by it.
    """

    rng: np.random.Generator
    half_width: float = 0.5
    half_height: float = 0.5
    contrast: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        self.uniform = self.rng.uniform
        self.paints = [PAINTS[i] for i in self.rng.permutation(len(PAINTS))]

    def sign(self) -> float:
        """1 or -1, either with probability 1/2."""
        return float(self.rng.choice([-1.0, 1.0]))

    # --- textures, each with another seed ---------------------------------------------------------

    def plain(
        self,
        colours: tuple[Colour, Colour],
        cell: float,
        panels: Panels | None = None,
        contrast: float = 0.45,
    ) -> Texture:
        """A texture of two colours."""
        seed = int(self.rng.integers(2**31))
        return Texture(colours, cell, self.contrast * contrast, seed, panels)

    def paint(self, cell: float, panels: Panels | None = None) -> Texture:
        """A texture in the next colour of the palette."""
        self.paints.append(self.paints.pop(0))
        return self.plain(self.paints[-1], cell, panels, contrast=0.5)

    def wall(self, cell: float, panels: Panels | None = None) -> Texture:
        """A texture of a random wall colour."""
        return self.plain(WALLS[self.rng.integers(len(WALLS))], cell, panels)

    # --- surroundings -----------------------------------------------------------------------------

    def interior(self) -> list[Part]:
        """Floor with tiles, papered back wall with a picture, and two side walls."""
        tiles = Panels((0.6, 0.6), (0.965, 0.965), (0.60, 0.50, 0.40), variation=0.25)
        paper = Panels((0.5, 9.0), (0.5, 1.0), (0.62, 0.64, 0.56))
        side = 0.94 * self.half_width * WALL
        picture = placed(self.uniform(-0.5, 0.5) * side, -1.65, WALL - 0.02)
        return [
            floor(self.plain(((0.36, 0.30, 0.25), (0.30, 0.26, 0.22)), 0.7, tiles)),
            backdrop(WALL, self.wall(0.9, paper)),
            Part(Plane(), placed(-side, 0, 0, yaw=-90), self.wall(0.9)),
            Part(Plane(), placed(side, 0, 0, yaw=90), self.wall(0.9)),
            Part(Box((0.55, 0.4, 0.02)), picture, self.paint(0.3)),
        ]

    def furniture(self, spots: tuple[tuple[float, float], ...]) -> list[Part]:
        """Alternating boxes and spheres, one on each spot."""
        out = []
        for k, (across, distance) in enumerate(spots):
            z = distance + self.uniform(-0.1, 0.1)
            unit = z * self.half_width
            size = 0.15 * unit
            x = (across + self.uniform(-0.03, 0.03)) * unit
            shape: Shape
            if k % 2:
                up = size * self.uniform(0.85, 1.05)
                shape, yaw = Ellipsoid((up, up, up)), self.uniform(0, 360)
            else:
                half = size * self.uniform([0.75, 0.75, 0.75], [1.0, 1.4, 1.0])
                shape, up, yaw = Box(half), half[1], self.uniform(20, 70)
            out.append(Part(shape, placed(x, -up, z, yaw=yaw), self.paint(0.8 * size)))
        return out

    # --- roads and vehicles ----------------------------------------------------------------------

    def road(self, lane: float, line: float, cell: float, contrast: float) -> Part:
        """The ground as a road with a dashed line every `lane` metres, the first one at `line`."""
        dashes = Panels((lane, 5.0), (0.035, 0.5), (0.78, 0.78, 0.74), (line, self.uniform(0, 5)))
        return floor(self.plain(ASPHALT, cell, dashes, contrast=contrast))

    def car(self, x: float, z: float, yaw: float) -> list[Part]:
        """A car of three boxes that stands on the ground, nose along +z at yaw 0."""
        at = placed(x, 0, z, yaw=yaw)
        body = self.paint(0.7)
        tyres = self.plain(DARK, 0.4)
        glass = self.plain((GLASS, (0.3, 0.36, 0.42)), 0.5)
        sizes = [
            # half size, bottom above ground, offset along the car, texture
            ((0.86, 0.12, 2.02), 0.0, 0.0, tyres),
            ((0.92, 0.33, 2.15), 0.24, 0.0, body),
            ((0.78, 0.24, 1.1), 0.9, -0.3, glass),
            ((0.76, 0.03, 1.0), 1.38, -0.3, body),
        ]
        return [
            Part(Box(half), at @ placed(0, -(bottom + half[1]), along), texture)
            for half, bottom, along, texture in sizes
        ]
