"""Rendered scenes of the kinds that people photograph, most with little or no parallax.

Layouts are those of `soup_nlp.data.scenes.catalogue`; some read the seed as a choice.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from soup_nlp.data.scenes.raycast import Body, Part, Scene, inverse
from soup_nlp.data.scenes.shapes import Box, Plane
from soup_nlp.data.scenes.texture import Colour, Panels
from soup_nlp.data.scenes.things import (
    ASPHALT,
    BACK,
    FRONT,
    GLASS,
    PAINTS,
    SKY,
    WALLS,
    Materials,
    Random,
    about,
    backdrop,
    car,
    floor,
    furniture,
    interior,
    lorry,
    person,
    placed,
    sign,
    tree,
    views,
)

GRASS: tuple[Colour, Colour] = ((0.34, 0.46, 0.20), (0.24, 0.36, 0.14))


def _sky(m: Materials, z: float) -> Part:
    return backdrop(z, m.plain(SKY, 0.12 * z, contrast=0.08), glow=1.0)


def _house(rng: Random, m: Materials, x: float, z: float, wide: float, high: float) -> Part:
    """A house with rows of windows, its front at a distance."""
    period = rng.uniform(1.8, 2.6), rng.uniform(2.4, 3.0)
    windows = Panels(period, (0.45, 0.55), GLASS, (0.3, 0.4), variation=0.5)
    half = wide / 2, high / 2, 3.0
    return Part(Box(half), placed(x, -high / 2, z + 3.0), m.wall(1.5, windows))


def _landscape(rng: Random, m: Materials) -> list[Part]:
    """A lawn with trees before houses and the sky."""
    parts = [floor(m.plain(GRASS, 0.8)), _sky(m, 76)]
    x = -42.0
    while x < 42:
        wide = rng.uniform(6, 12)
        parts.append(_house(rng, m, x, rng.uniform(30, 48), wide, rng.uniform(4, 11)))
        x += wide + rng.uniform(0, 5)
    for slot in np.linspace(-0.8, 0.8, 7):
        z = rng.uniform(8, 28)
        parts += tree(rng, m, z * slot + rng.uniform(-1, 1), z, rng.uniform(3, 7))
    return parts


def _pan(rng: Random, half_width: float, half_height: float, seed: int) -> Scene:
    """camera that only turns; something crosses the view at odd seeds"""
    m = Materials(rng, 0.6)
    x, way = rng.uniform(-0.3, 0.3), sign(rng)
    if (seed + 1) // 2 % 2:
        rest, pitch, up = _landscape(rng, m), rng.uniform(0, 4), rng.uniform(1.6, 3)
        z = rng.uniform(8, 11)
        crosses = car(m, z * x, z, 90 * way)
        shift = [way * rng.uniform(0.2, 0.5), 0.0, 0.0]
    else:
        things = [part for part, _ in furniture(rng, m, FRONT + BACK, half_width)]
        ((box, _),) = furniture(rng, m, ((x, 2.8),), half_width)
        rest, pitch, up = [*interior(rng, m, half_width), *things], -9, rng.uniform(1.2, 1.5)
        crosses = (box,)
        shift = [way * rng.uniform(0.05, 0.1), 0.0, rng.uniform(-0.05, 0.05)]
    bodies = [Body(tuple(rest))]
    if seed % 2:
        bodies.append(Body(crosses, about([0, 0, 0], [0, 0, 0], shift)))
    size = rng.uniform(2, 6)
    turn = size * np.array([0.3 * rng.uniform(-1, 1), sign(rng), 0.1 * rng.uniform(-1, 1)])
    pose = placed(0, -up, 0, yaw=rng.uniform(-15, 15), pitch=pitch)
    return Scene(tuple(bodies), *views(pose, [0, 0, 0], turn))


def _small_people(
    rng: Random, m: Materials, half_width: float, half_height: float, count: int, far: float
) -> list[Body]:
    """People side by side, each on 1 to 4 % of the image, nearer than `far`."""
    bodies = []
    for slot in rng.permutation(count):
        across = 1.5 * ((slot + 0.5 + 0.3 * rng.uniform(-1, 1)) / count - 0.5)
        # a person fills about 0.16 of the square of its height
        seen = np.sqrt(rng.uniform(0.012, 0.03) * 4 * half_width * half_height / 0.16)
        z = min(rng.uniform(1.0, 1.8) / seen, 0.8 * far)
        bodies.append(person(rng, m, z * half_width * across, z, z * seen, rng.uniform(0, 360)))
    return bodies


def _handheld(rng: Random, half_width: float, half_height: float, seed: int) -> Scene:
    """camera in a hand; three to five small people walk on a lawn or in a hall"""
    m = Materials(rng, 0.6)
    far = rng.uniform(8, 12)
    if seed % 2:
        tiles = Panels((0.8, 0.8), (0.97, 0.97), (0.58, 0.52, 0.46), variation=0.2)
        rest = [floor(m.plain(WALLS[2], 0.8, tiles, contrast=0.3)), backdrop(far, m.wall(1.0))]
        for k in range(3):
            x = (k - 1 + rng.uniform(-0.3, 0.3)) * 0.7 * far * half_width
            half = rng.uniform([0.4, 0.5, 0.3], [0.9, 1.1, 0.5])
            box = Box((half[0], half[1], half[2]))
            rest.append(Part(box, placed(x, -half[1], far - half[2]), m.paint(0.4)))
    else:
        rest = [floor(m.plain(GRASS, 0.5)), _sky(m, 60)]
        rest.append(Part(Box((30, rng.uniform(0.5, 1.0), 0.6)), placed(0, -0.5, far), m.wall(0.6)))
        for slot in (-0.9, -0.3, 0.4, 0.9):
            z = far + rng.uniform(1, 8)
            rest += tree(rng, m, z * half_width * slot, z, rng.uniform(3, 6))
    bodies = _small_people(rng, m, half_width, half_height, int(rng.integers(3, 6)), far)
    size = 0.7 * far * rng.uniform(0.01, 0.03)
    way = rng.standard_normal(3) * [1, 0.4, 0.7]
    pose = placed(0, -rng.uniform(1.3, 1.7), 0, yaw=rng.uniform(-8, 8), pitch=-rng.uniform(5, 11))
    view = views(pose, size * way / np.linalg.norm(way), rng.uniform(-0.8, 0.8, 3))
    return Scene((Body(tuple(rest)), *bodies), *view)


def _swing(rng: Random, half_width: float, half_height: float, seed: int) -> Scene:
    """camera that hardly moves; a box swings close to it, a tower slides"""
    m = Materials(rng, 0.6)
    rest = [part for part, _ in furniture(rng, m, BACK, half_width)]
    z, x = rng.uniform(1.8, 2.6), rng.uniform(-0.2, 0.2)
    side = 0.42 * z * np.sqrt(rng.uniform(0.10, 0.17) * 4 * half_width * half_height)
    half = side * rng.uniform(0.85, 1.15, 3)
    at = np.array([x * z * half_width, -1.35 + rng.uniform(-0.1, 0.1), z])
    print_ = Panels((0.4 * side, 0.4 * side), (0.6, 0.6), (0.75, 0.72, 0.66), variation=0.4)
    pose = placed(at[0], at[1], at[2], yaw=rng.uniform(15, 70), pitch=rng.uniform(-8, 8))
    box = Part(Box((half[0], half[1], half[2])), pose, m.paint(0.5 * side, print_))
    turn = [rng.uniform(-2, 2), sign(rng) * rng.uniform(2, 6), sign(rng) * rng.uniform(1, 4)]
    swings = about(at - [0, 1.0, 0], turn, [0, 0, rng.uniform(-0.03, 0.03)])
    high, away = rng.uniform(0.6, 0.9), 3.6
    across = -np.sign(x) * rng.uniform(0.5, 0.7) * away * half_width
    tower = Part(Box((0.22, high, 0.22)), placed(across, -high, away, yaw=30), m.paint(0.3))
    slides = about([0, 0, 0], [0, 0, 0], [sign(rng) * rng.uniform(0.04, 0.08), 0, 0.03])
    parts = Body((*interior(rng, m, half_width), *rest))
    size = rng.uniform(0.025, 0.05)
    way = rng.standard_normal(3) * [1, 0.5, 0.6]
    view = views(
        placed(0, -1.4, 0, pitch=-rng.uniform(4, 9)),
        size * way / np.linalg.norm(way),
        rng.uniform(-0.4, 0.4, 3),
    )
    return Scene((parts, Body((box,), swings), Body((tower,), slides)), *view)


def _jam(rng: Random, half_width: float, half_height: float, seed: int) -> Scene:
    """camera that creeps in a traffic jam; vehicles over half of the image move differently"""
    m = Materials(rng, 0.6)
    lanes = Panels((3.4, 5.0), (0.035, 0.5), (0.78, 0.78, 0.74), (-1.75, rng.uniform(0, 5)))
    rest = [floor(m.plain(ASPHALT, 2.0, lanes, contrast=0.3)), _sky(m, 76)]
    for side in (-1, 1):
        z = 2.0
        while z < 70:
            long, high = rng.uniform(8, 16), rng.uniform(4, 9)
            half = 3.0, high / 2, long / 2
            windows = Panels((2.6, 2.9), (0.45, 0.55), GLASS, (0.4, 0.5), variation=0.5)
            pose = placed(side * rng.uniform(10.5, 12), -high / 2, z + long / 2)
            rest.append(Part(Box(half), pose, m.wall(2.0, windows)))
            z += long + rng.uniform(0, 3)
    bodies = [Body(tuple(rest))]
    mirror = sign(rng)
    # low ones in front, or they would hide the others
    spots = [(2.8, 4.8), (-2.8, 4.6), (0.0, 5.0), (-2.8, 11.0), (0.0, 11.5), (-5.8, 12.0)]
    for k, (across, z) in enumerate(spots[: int(rng.integers(4, 7))]):
        x, z = mirror * across + rng.uniform(-0.2, 0.2), z + rng.uniform(-0.5, 0.5)
        if k in (1, 2):
            parts = car(m, x, z + 2, 0.0)
        else:
            long = rng.uniform(3.6, 5.0)
            parts = lorry(m, x, z + long / 2, rng.uniform(2.3, 3.4), long)
        bodies.append(Body(parts, about([0, 0, 0], [0, 0, 0], [0, 0, rng.uniform(0.0, 0.5)])))
    pose = placed(rng.uniform(-0.3, 0.3), -rng.uniform(1.4, 1.9), 0, pitch=rng.uniform(-2, 1))
    forward = [0.01 * rng.uniform(-1, 1), 0, rng.uniform(0.03, 0.07)]
    return Scene(tuple(bodies), *views(pose, forward, rng.uniform(-0.15, 0.15, 3)))


def _facade(rng: Random, half_width: float, half_height: float, seed: int) -> Scene:
    """camera in a hand before a facade: piers, sills and balconies on a nearly plane wall"""
    m = Materials(rng, 0.6)
    away = rng.uniform(7, 13)
    deep = away * rng.uniform(0.02, 0.05)
    wide, high = rng.uniform(2.0, 3.2), rng.uniform(2.7, 3.3)
    glass = Panels((wide / 4, high / 3), (0.88, 0.92), GLASS, variation=0.5)
    parts = [backdrop(away, m.plain(WALLS[3], 0.5, glass, contrast=0.3))]
    wall, ledge, rail = m.wall(0.8), m.wall(0.4), m.paint(0.3)
    for k in range(-6, 7):
        pier = Box((wide * 0.27, 30, deep))
        parts.append(Part(pier, placed(k * wide, 0, away), wall))
        sill = placed(0, -high * (k + 5) - 0.2, away)
        parts.append(Part(Box((40, high * 0.22, 0.9 * deep)), sill, wall))
        parts.append(Part(Box((40, 0.09, 1.5 * deep)), sill @ placed(0, -0.2 * high, 0), ledge))
    for k, row in np.argwhere(rng.random((9, 5)) < 0.3):
        at = placed((k - 4 + 0.5) * wide, -high * row - 0.7, away)
        parts.append(Part(Box((0.36 * wide, 0.5, 2 * deep)), at, rail))
    parts.append(floor(m.plain(ASPHALT, 0.6, contrast=0.3)))
    pose = placed(0, -1.6, 0, yaw=sign(rng) * rng.uniform(8, 22), pitch=rng.uniform(8, 16))
    size = away * rng.uniform(0.005, 0.01)
    way = rng.standard_normal(3) * [1, 0.5, 0.4]
    view = views(pose, size * way / np.linalg.norm(way), rng.uniform(-0.5, 0.5, 3))
    return Scene((Body(tuple(parts)),), *view)


def _corridor(rng: Random, half_width: float, half_height: float, seed: int) -> Scene:
    """camera that flies through a corridor with weakly textured walls, turning"""
    m = Materials(rng)
    wide, high, long = rng.uniform(1.2, 1.7), rng.uniform(2.6, 3.0), rng.uniform(12, 20)
    tint = WALLS[rng.integers(len(WALLS))]
    weak = [m.plain(tint, 1.2, contrast=rng.uniform(0.04, 0.09)) for _ in range(4)]
    tiles = Panels((0.6, 0.6), (0.98, 0.98), (0.50, 0.52, 0.52), variation=0.06)
    parts = [
        floor(m.plain(ASPHALT, 1.0, tiles, contrast=0.08)),
        backdrop(long, weak[0]),
        Part(Plane(), placed(0, -high, 0, pitch=90), weak[1], glow=0.9),
        Part(Plane(), placed(-wide, 0, 0, yaw=-90), weak[2]),
        Part(Plane(), placed(wide, 0, 0, yaw=90), weak[3]),
        Part(Box((0.5, 1.05, 0.05)), placed(0.2, -1.05, long), m.plain(PAINTS[1], 0.6)),
    ]
    for side in (-1, 1):
        rail = Part(Box((0.04, 0.06, long / 2)), placed(side * wide, -0.9, long / 2), m.paint(0.5))
        parts.append(rail)
        for z in np.arange(rng.uniform(1.5, 3), long - 1, rng.uniform(2.4, 3.6)):
            door = m.plain(PAINTS[rng.integers(len(PAINTS))], 0.7, contrast=0.08)
            parts.append(Part(Box((0.04, 1.05, 0.5)), placed(side * wide, -1.05, z), door))
    lamp = m.plain(((0.95, 0.95, 0.9),) * 2, 1.0, contrast=0.0)
    for z in np.arange(rng.uniform(1, 2), long, 2.4):
        parts.append(Part(Box((0.15, 0.02, 0.6)), placed(0, -high, z), lamp, glow=1.0))
    for z in (rng.uniform(3.5, 5), rng.uniform(6, 9)):
        half = rng.uniform([0.25, 0.35, 0.5], [0.35, 0.5, 1.0])
        side = sign(rng) * (wide - half[0] - 0.05)
        box = Box((half[0], half[1], half[2]))
        parts.append(Part(box, placed(side, -half[1], z), m.plain(PAINTS[4], 0.5, contrast=0.15)))
    pose = placed(0.3 * rng.uniform(-1, 1), -rng.uniform(1.2, 1.7), 0, yaw=rng.uniform(-8, 8))
    turn = rng.uniform([-0.5, 0.8, -0.8], [0.5, 2.0, 0.8]) * [1, sign(rng), 1]
    return Scene((Body(tuple(parts)),), *views(pose, [0.02, 0.01, rng.uniform(0.09, 0.14)], turn))


def _standing(rng: Random, half_width: float, half_height: float, seed: int) -> Scene:
    """camera at rest; two people walk through a room"""
    m = Materials(rng, 0.6)
    rest = [part for part, _ in furniture(rng, m, BACK, half_width)]
    bodies = [Body((*interior(rng, m, half_width), *rest))]
    for side in rng.permutation([-1.0, 1.0]):
        z = rng.uniform(2.1, 3.4)
        x = side * rng.uniform(0.2, 0.55) * z * half_width
        bodies.append(person(rng, m, x, z, rng.uniform(1.55, 1.85), rng.uniform(0, 360)))
    pose = inverse(placed(0, -rng.uniform(1.2, 1.6), 0, yaw=rng.uniform(-8, 8), pitch=-6))
    return Scene(tuple(bodies), pose, pose)


LAYOUTS: dict[str, tuple[Callable[[Random, float, float, int], Scene], float]] = {
    "pan": (_pan, 0.85),
    "handheld": (_handheld, 0.75),
    "swing": (_swing, 0.8),
    "jam": (_jam, 0.9),
    "facade": (_facade, 0.75),
    "corridor": (_corridor, 0.7),
    "standing": (_standing, 0.8),
}
"""Layout and focal length (in image widths) of each scene."""
