"""Elements of rendered scenes: poses, colours, textures; rooms, vehicles, trees, people."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from soup_nlp.data.scenes.raycast import Body, Part, inverse
from soup_nlp.data.scenes.shapes import Box, Ellipsoid, Float, Plane, Shape
from soup_nlp.data.scenes.texture import Colour, Panels, Texture
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
SKIN: tuple[Colour, Colour] = ((0.80, 0.60, 0.48), (0.66, 0.46, 0.36))
LEAVES: tuple[Colour, Colour] = ((0.30, 0.44, 0.16), (0.14, 0.24, 0.08))
BARK: tuple[Colour, Colour] = ((0.36, 0.28, 0.20), (0.24, 0.18, 0.14))
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

    def drift(self, size: float, spread: ArrayLike) -> Float:
        """(3,) shift of length `size` (m) in a random direction, scaled by axis with `spread`."""
        way = self.rng.standard_normal(3) * np.asarray(spread)
        return np.asarray(size * way / np.linalg.norm(way))

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

    def sky(self, z: float) -> Part:
        """The sky at a distance."""
        return backdrop(z, self.plain(SKY, 0.12 * z, contrast=0.08), glow=1.0)

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

    def tree(self, x: float, z: float, tall: float) -> list[Part]:
        """A trunk under three clumps of leaves."""
        wide = 0.04 * tall
        parts = [block((wide, 0.25 * tall, wide), x, z, self.plain(BARK, 0.2))]
        for k in range(3):
            half = tall * self.uniform([0.16, 0.16, 0.16], [0.26, 0.22, 0.24])
            at = np.array([x, -tall * (0.45 + 0.14 * k), z])
            at += 0.06 * tall * self.uniform(-1, 1, 3)
            leaves = self.plain(LEAVES, 0.06 * tall, contrast=0.7)
            parts.append(Part(Ellipsoid(half), placed(*at), leaves))
        return parts

    # --- vehicles and people ----------------------------------------------------------------------

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

    def lorry(self, x: float, z: float, high: float, long: float) -> list[Part]:
        """A van or lorry seen from behind: a box on wheels with a door, lamps and a bumper."""
        half = 1.15, (high - 0.55) / 2, long / 2
        doors = Panels((1.15, 9.0), (0.97, 0.98), (0.62, 0.64, 0.66), (0.02, -4.5), variation=0.2)
        box = self.paint(0.8, doors if high > 2.6 else None)
        parts = [
            Part(Box(half), placed(x, -0.55 - half[1], z), box),
            Part(Box((1.0, 0.2, half[2] - 0.1)), placed(x, -0.42, z), self.plain(DARK, 0.4)),
        ]
        back = z - half[2]
        for side in (-1, 1):
            lamp = self.plain(((0.7, 0.1, 0.08), (0.5, 0.06, 0.05)), 0.2)
            wheel = (0.14, 0.28, 0.3)
            parts.append(block(wheel, x + 0.8 * side, back + 0.6, self.plain(DARK, 0.3)))
            parts.append(Part(Box((0.1, 0.16, 0.02)), placed(x + side, -0.8, back - 0.02), lamp))
        if high <= 2.6:
            glass = self.plain((GLASS,) * 2, 0.5)
            parts.append(Part(Box((0.9, 0.3, 0.02)), placed(x, -high + 0.5, back - 0.02), glass))
        return parts

    def person(self, x: float, z: float, tall: float, yaw: float) -> Body:
        """A walking person of ellipsoids, towards +z at yaw 0; every limb has its own motion."""
        at, turn = placed(x, 0, z, yaw=yaw), self.sign() * self.uniform(10, 22)
        ahead, aside = at[:3, 2] * tall * self.uniform(0.02, 0.06), at[:3, 0]
        swing = -self.sign() * self.uniform(4, 10)
        chosen = self.rng.permutation(len(PAINTS))[:2]
        trousers, shirt = (self.plain(PAINTS[k], 0.1, contrast=0.3) for k in chosen)
        skin, hair = self.plain(SKIN, 0.15, contrast=0.15), self.plain(BARK, 0.05)
        limbs = [
            # half size, joint (across, up), hangs or stands, angle, change of angle (degrees)
            ((0.058, 0.26, 0.065), (-0.06, 0.49), 1, turn, swing, trousers),
            ((0.058, 0.26, 0.065), (0.06, 0.49), 1, -turn, -swing, trousers),
            ((0.12, 0.20, 0.075), (0, 0.45), -1, 4, 0.15 * swing, shirt),
            ((0.036, 0.20, 0.042), (-0.145, 0.80), 1, -turn, -1.3 * swing, shirt),
            ((0.036, 0.20, 0.042), (0.145, 0.80), 1, turn, 1.3 * swing, shirt),
            ((0.055, 0.075, 0.065), (0, 0.83), -1, 0, 0.3 * swing, skin),
            ((0.06, 0.05, 0.07), (0, 0.90), -1, 0, 0.3 * swing, hair),
        ]
        parts = []
        for share, (across, up), hangs, angle, change, texture in limbs:
            half = tall * np.array(share)
            joint = at @ placed(tall * across, -tall * up, 0, pitch=angle)
            pose = joint @ placed(0, hangs * 0.95 * half[1], 0)
            move = about(joint[:3, 3], change * aside, ahead)
            parts.append(Part(Ellipsoid(half), pose, texture, motion=move))
        return Body(parts)
