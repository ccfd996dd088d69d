"""Rendered scenes of the kinds that people photograph, most with little or no parallax.

Importing this module makes them known to `render_scene` and to problem files. Some layouts read the
seed as a choice.
"""

import numpy as np
from numpy.typing import ArrayLike

from soup_nlp.arrays import Float
from soup_nlp.data.scenes import catalogue
from soup_nlp.data.scenes.catalogue import (
    ASPHALT,
    BACK,
    DARK,
    FRONT,
    GLASS,
    PAINTS,
    SKY,
    WALLS,
    SceneBuilder,
    about,
    backdrop,
    block,
    floor,
    placed,
    views,
    windows,
)
from soup_nlp.data.scenes.raycast import Body, Part, Scene, inverse
from soup_nlp.data.scenes.surfaces import Box, Colour, Ellipsoid, Panels, Plane

GRASS: tuple[Colour, Colour] = ((0.34, 0.46, 0.20), (0.24, 0.36, 0.14))
SKIN: tuple[Colour, Colour] = ((0.80, 0.60, 0.48), (0.66, 0.46, 0.36))
LEAVES: tuple[Colour, Colour] = ((0.30, 0.44, 0.16), (0.14, 0.24, 0.08))
BARK: tuple[Colour, Colour] = ((0.36, 0.28, 0.20), (0.24, 0.18, 0.14))


def drift(b: SceneBuilder, size: float, spread: ArrayLike) -> Float:
    """(3,) shift of length `size` (m) in a random direction, scaled by axis with `spread`."""
    way = b.rng.standard_normal(3) * np.asarray(spread)
    return np.asarray(size * way / np.linalg.norm(way))


def sky(b: SceneBuilder, z: float) -> Part:
    """The sky at a distance."""
    return backdrop(z, b.plain(SKY, 0.12 * z, contrast=0.08), glow=1.0)


def tree(b: SceneBuilder, x: float, z: float, tall: float) -> list[Part]:
    """A trunk under three clumps of leaves."""
    wide = 0.04 * tall
    parts = [block((wide, 0.25 * tall, wide), x, z, b.plain(BARK, 0.2))]
    for k in range(3):
        half = tall * b.uniform([0.16, 0.16, 0.16], [0.26, 0.22, 0.24])
        at = np.array([x, -tall * (0.45 + 0.14 * k), z])
        at += 0.06 * tall * b.uniform(-1, 1, 3)
        leaves = b.plain(LEAVES, 0.06 * tall, contrast=0.7)
        parts.append(Part(Ellipsoid(half), placed(*at), leaves))
    return parts


def lorry(b: SceneBuilder, x: float, z: float, high: float, long: float) -> list[Part]:
    """A van or lorry seen from behind: a box on wheels with a door, lamps and a bumper."""
    half = 1.15, (high - 0.55) / 2, long / 2
    doors = Panels((1.15, 9.0), (0.97, 0.98), (0.62, 0.64, 0.66), (0.02, -4.5), variation=0.2)
    box = b.paint(0.8, doors if high > 2.6 else None)
    parts = [
        Part(Box(half), placed(x, -0.55 - half[1], z), box),
        Part(Box((1.0, 0.2, half[2] - 0.1)), placed(x, -0.42, z), b.plain(DARK, 0.4)),
    ]
    back = z - half[2]
    for side in (-1, 1):
        lamp = b.plain(((0.7, 0.1, 0.08), (0.5, 0.06, 0.05)), 0.2)
        wheel = (0.14, 0.28, 0.3)
        parts.append(block(wheel, x + 0.8 * side, back + 0.6, b.plain(DARK, 0.3)))
        parts.append(Part(Box((0.1, 0.16, 0.02)), placed(x + side, -0.8, back - 0.02), lamp))
    if high <= 2.6:
        glass = b.plain((GLASS,) * 2, 0.5)
        parts.append(Part(Box((0.9, 0.3, 0.02)), placed(x, -high + 0.5, back - 0.02), glass))
    return parts


def person(b: SceneBuilder, x: float, z: float, tall: float, yaw: float) -> Body:
    """A walking person of ellipsoids, towards +z at yaw 0; every limb has its own motion."""
    at, turn = placed(x, 0, z, yaw=yaw), b.sign() * b.uniform(10, 22)
    ahead, aside = at[:3, 2] * tall * b.uniform(0.02, 0.06), at[:3, 0]
    swing = -b.sign() * b.uniform(4, 10)
    chosen = b.rng.permutation(len(PAINTS))[:2]
    trousers, shirt = (b.plain(PAINTS[k], 0.1, contrast=0.3) for k in chosen)
    skin, hair = b.plain(SKIN, 0.15, contrast=0.15), b.plain(BARK, 0.05)
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


def _landscape(b: SceneBuilder) -> list[Part]:
    """A lawn with trees before houses and the sky."""
    parts = [floor(b.plain(GRASS, 0.8)), sky(b, 76)]
    x = -42.0
    while x < 42:
        wide = b.uniform(6, 12)
        z, high = b.uniform(30, 48), b.uniform(4, 11)
        panes = windows((b.uniform(1.8, 2.6), b.uniform(2.4, 3.0)), (0.3, 0.4))
        parts.append(block((wide / 2, high / 2, 3.0), x, z + 3.0, b.wall(1.5, panes)))
        x += wide + b.uniform(0, 5)
    for slot in np.linspace(-0.8, 0.8, 7):
        z = b.uniform(8, 28)
        parts += tree(b, z * slot + b.uniform(-1, 1), z, b.uniform(3, 7))
    return parts


def _pan(b: SceneBuilder) -> Scene:
    """camera that only turns; something crosses the view at odd seeds"""
    x, way = b.uniform(-0.3, 0.3), b.sign()
    if (b.seed + 1) // 2 % 2:
        static, pitch, up = _landscape(b), b.uniform(0, 4), b.uniform(1.6, 3)
        z = b.uniform(8, 11)
        crosses = b.car(z * x, z, 90 * way)
        shift = [way * b.uniform(0.2, 0.5), 0.0, 0.0]
    else:
        things = b.furniture(FRONT + BACK)
        crosses = b.furniture(((x, 2.8),))
        static, pitch, up = [*b.interior(), *things], -9, b.uniform(1.2, 1.5)
        shift = [way * b.uniform(0.05, 0.1), 0.0, b.uniform(-0.05, 0.05)]
    bodies = [Body(static)]
    if b.seed % 2:
        bodies.append(Body(crosses, about(shift=shift)))
    size = b.uniform(2, 6)
    turn = size * np.array([0.3 * b.uniform(-1, 1), b.sign(), 0.1 * b.uniform(-1, 1)])
    pose = placed(0, -up, 0, yaw=b.uniform(-15, 15), pitch=pitch)
    return Scene(bodies, *views(pose, [0, 0, 0], turn))


def _small_people(b: SceneBuilder, count: int, far: float) -> list[Body]:
    """People side by side, each on 1 to 4 % of the image, nearer than `far`."""
    bodies = []
    for slot in b.rng.permutation(count):
        across = 1.5 * ((slot + 0.5 + 0.3 * b.uniform(-1, 1)) / count - 0.5)
        # a person fills about 0.16 of the square of its height
        seen = np.sqrt(b.uniform(0.012, 0.03) * 4 * b.half_width * b.half_height / 0.16)
        z = min(b.uniform(1.0, 1.8) / seen, 0.8 * far)
        bodies.append(person(b, z * b.half_width * across, z, z * seen, b.uniform(0, 360)))
    return bodies


def _handheld(b: SceneBuilder) -> Scene:
    """camera in a hand; three to five small people walk on a lawn or in a hall"""
    far = b.uniform(8, 12)
    if b.seed % 2:
        tiles = Panels((0.8, 0.8), (0.97, 0.97), (0.58, 0.52, 0.46), variation=0.2)
        static = [floor(b.plain(WALLS[2], 0.8, tiles, contrast=0.3)), backdrop(far, b.wall(1.0))]
        for k in range(3):
            x = (k - 1 + b.uniform(-0.3, 0.3)) * 0.7 * far * b.half_width
            half = b.uniform([0.4, 0.5, 0.3], [0.9, 1.1, 0.5])
            static.append(block(half, x, far - half[2], b.paint(0.4)))
    else:
        static = [floor(b.plain(GRASS, 0.5)), sky(b, 60)]
        static.append(Part(Box((30, b.uniform(0.5, 1.0), 0.6)), placed(0, -0.5, far), b.wall(0.6)))
        for slot in (-0.9, -0.3, 0.4, 0.9):
            z = far + b.uniform(1, 8)
            static += tree(b, z * b.half_width * slot, z, b.uniform(3, 6))
    people = _small_people(b, int(b.rng.integers(3, 6)), far)
    shift = drift(b, 0.7 * far * b.uniform(0.01, 0.03), [1, 0.4, 0.7])
    pose = placed(0, -b.uniform(1.3, 1.7), 0, yaw=b.uniform(-8, 8), pitch=-b.uniform(5, 11))
    return Scene([Body(static), *people], *views(pose, shift, b.uniform(-0.8, 0.8, 3)))


def _swing(b: SceneBuilder) -> Scene:
    """camera that hardly moves; a box swings close to it, a tower slides"""
    things = b.furniture(BACK)
    z, x = b.uniform(1.8, 2.6), b.uniform(-0.2, 0.2)
    side = 0.42 * z * np.sqrt(b.uniform(0.10, 0.17) * 4 * b.half_width * b.half_height)
    half = side * b.uniform(0.85, 1.15, 3)
    at = np.array([x * z * b.half_width, -1.35 + b.uniform(-0.1, 0.1), z])
    print_ = Panels((0.4 * side, 0.4 * side), (0.6, 0.6), (0.75, 0.72, 0.66), variation=0.4)
    pose = placed(at[0], at[1], at[2], yaw=b.uniform(15, 70), pitch=b.uniform(-8, 8))
    box = Part(Box(half), pose, b.paint(0.5 * side, print_))
    turn = [b.uniform(-2, 2), b.sign() * b.uniform(2, 6), b.sign() * b.uniform(1, 4)]
    swings = about(at - [0, 1.0, 0], turn, [0, 0, b.uniform(-0.03, 0.03)])
    high, away = b.uniform(0.6, 0.9), 3.6
    across = -np.sign(x) * b.uniform(0.5, 0.7) * away * b.half_width
    tower = block((0.22, high, 0.22), across, away, b.paint(0.3), yaw=30)
    slides = about(shift=[b.sign() * b.uniform(0.04, 0.08), 0, 0.03])
    static = Body([*b.interior(), *things])
    shift = drift(b, b.uniform(0.025, 0.05), [1, 0.5, 0.6])
    view = views(placed(0, -1.4, 0, pitch=-b.uniform(4, 9)), shift, b.uniform(-0.4, 0.4, 3))
    return Scene([static, Body([box], swings), Body([tower], slides)], *view)


def _jam(b: SceneBuilder) -> Scene:
    """camera that creeps in a traffic jam; vehicles over half of the image move differently"""
    static = [b.road(3.4, -1.75, 2.0, contrast=0.3), sky(b, 76)]
    panes = windows((2.6, 2.9), (0.4, 0.5))
    for side in (-1, 1):
        z = 2.0
        while z < 70:
            long, high = b.uniform(8, 16), b.uniform(4, 9)
            half = 3.0, high / 2, long / 2
            static.append(block(half, side * b.uniform(10.5, 12), z + long / 2, b.wall(2.0, panes)))
            z += long + b.uniform(0, 3)
    bodies = [Body(static)]
    mirror = b.sign()
    # low vehicles in front, else they would hide the others
    spots = [(2.8, 4.8), (-2.8, 4.6), (0.0, 5.0), (-2.8, 11.0), (0.0, 11.5), (-5.8, 12.0)]
    for k, (across, z) in enumerate(spots[: int(b.rng.integers(4, 7))]):
        x, z = mirror * across + b.uniform(-0.2, 0.2), z + b.uniform(-0.5, 0.5)
        if k in (1, 2):
            parts = b.car(x, z + 2, 0.0)
        else:
            long = b.uniform(3.6, 5.0)
            parts = lorry(b, x, z + long / 2, b.uniform(2.3, 3.4), long)
        bodies.append(Body(parts, about(shift=[0, 0, b.uniform(0.0, 0.5)])))
    pose = placed(b.uniform(-0.3, 0.3), -b.uniform(1.4, 1.9), 0, pitch=b.uniform(-2, 1))
    forward = [0.01 * b.uniform(-1, 1), 0, b.uniform(0.03, 0.07)]
    return Scene(bodies, *views(pose, forward, b.uniform(-0.15, 0.15, 3)))


def _facade(b: SceneBuilder) -> Scene:
    """camera in a hand before a facade: piers, sills and balconies on a nearly plane wall"""
    away = b.uniform(7, 13)
    deep = away * b.uniform(0.02, 0.05)
    wide, high = b.uniform(2.0, 3.2), b.uniform(2.7, 3.3)
    glass = Panels((wide / 4, high / 3), (0.88, 0.92), GLASS, variation=0.5)
    parts = [backdrop(away, b.plain(WALLS[3], 0.5, glass, contrast=0.3))]
    wall, ledge, rail = b.wall(0.8), b.wall(0.4), b.paint(0.3)
    for k in range(-6, 7):
        pier = Box((wide * 0.27, 30, deep))
        parts.append(Part(pier, placed(k * wide, 0, away), wall))
        sill = placed(0, -high * (k + 5) - 0.2, away)
        parts.append(Part(Box((40, high * 0.22, 0.9 * deep)), sill, wall))
        parts.append(Part(Box((40, 0.09, 1.5 * deep)), sill @ placed(0, -0.2 * high, 0), ledge))
    for k, row in np.argwhere(b.rng.random((9, 5)) < 0.3):
        at = placed((k - 4 + 0.5) * wide, -high * row - 0.7, away)
        parts.append(Part(Box((0.36 * wide, 0.5, 2 * deep)), at, rail))
    parts.append(floor(b.plain(ASPHALT, 0.6, contrast=0.3)))
    pose = placed(0, -1.6, 0, yaw=b.sign() * b.uniform(8, 22), pitch=b.uniform(8, 16))
    shift = drift(b, away * b.uniform(0.005, 0.01), [1, 0.5, 0.4])
    return Scene([Body(parts)], *views(pose, shift, b.uniform(-0.5, 0.5, 3)))


def _corridor(b: SceneBuilder) -> Scene:
    """camera that flies through a corridor with weakly textured walls, turning"""
    wide, high, long = b.uniform(1.2, 1.7), b.uniform(2.6, 3.0), b.uniform(12, 20)
    tint = WALLS[b.rng.integers(len(WALLS))]
    weak = [b.plain(tint, 1.2, contrast=b.uniform(0.04, 0.09)) for _ in range(4)]
    tiles = Panels((0.6, 0.6), (0.98, 0.98), (0.50, 0.52, 0.52), variation=0.06)
    parts = [
        floor(b.plain(ASPHALT, 1.0, tiles, contrast=0.08)),
        backdrop(long, weak[0]),
        Part(Plane(), placed(0, -high, 0, pitch=90), weak[1], glow=0.9),
        Part(Plane(), placed(-wide, 0, 0, yaw=-90), weak[2]),
        Part(Plane(), placed(wide, 0, 0, yaw=90), weak[3]),
        block((0.5, 1.05, 0.05), 0.2, long, b.plain(PAINTS[1], 0.6)),
    ]
    for side in (-1, 1):
        at = placed(side * wide, -0.9, long / 2)
        parts.append(Part(Box((0.04, 0.06, long / 2)), at, b.paint(0.5)))
        for z in np.arange(b.uniform(1.5, 3), long - 1, b.uniform(2.4, 3.6)):
            door = b.plain(PAINTS[b.rng.integers(len(PAINTS))], 0.7, contrast=0.08)
            parts.append(block((0.04, 1.05, 0.5), side * wide, z, door))
    lamp = b.plain(((0.95, 0.95, 0.9),) * 2, 1.0, contrast=0.0)
    for z in np.arange(b.uniform(1, 2), long, 2.4):
        parts.append(Part(Box((0.15, 0.02, 0.6)), placed(0, -high, z), lamp, glow=1.0))
    for z in (b.uniform(3.5, 5), b.uniform(6, 9)):
        half = b.uniform([0.25, 0.35, 0.5], [0.35, 0.5, 1.0])
        side = b.sign() * (wide - half[0] - 0.05)
        parts.append(block(half, side, z, b.plain(PAINTS[4], 0.5, contrast=0.15)))
    pose = placed(0.3 * b.uniform(-1, 1), -b.uniform(1.2, 1.7), 0, yaw=b.uniform(-8, 8))
    turn = b.uniform([-0.5, 0.8, -0.8], [0.5, 2.0, 0.8]) * [1, b.sign(), 1]
    return Scene([Body(parts)], *views(pose, [0.02, 0.01, b.uniform(0.09, 0.14)], turn))


def _standing(b: SceneBuilder) -> Scene:
    """camera at rest; two people walk through a room"""
    things = b.furniture(BACK)
    bodies = [Body([*b.interior(), *things])]
    for side in b.rng.permutation([-1.0, 1.0]):
        z = b.uniform(2.1, 3.4)
        x = side * b.uniform(0.2, 0.55) * z * b.half_width
        bodies.append(person(b, x, z, b.uniform(1.55, 1.85), b.uniform(0, 360)))
    pose = inverse(placed(0, -b.uniform(1.2, 1.6), 0, yaw=b.uniform(-8, 8), pitch=-6))
    return Scene(bodies, pose, pose)


LAYOUTS: catalogue.Layouts = {
    "pan": (_pan, 0.85, 0.6),
    "handheld": (_handheld, 0.75, 0.6),
    "swing": (_swing, 0.8, 0.6),
    "jam": (_jam, 0.9, 0.6),
    "facade": (_facade, 0.75, 0.6),
    "corridor": (_corridor, 0.7, 1.0),
    "standing": (_standing, 0.8, 0.6),
}

catalogue.LAYOUTS.update(LAYOUTS)
