"""Named dynamic scenes with exact truth, rendered by `soup_nlp.data.scenes.raycast`.

Scenes are laid out in level coordinates: x right, y down, z forward, the ground is y = 0. The
truth of the rendered pair is in the usual coordinates, those of the reference camera, in metres.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from soup_nlp.arrays import Float
from soup_nlp.data.pair import Pair
from soup_nlp.data.scenes import everyday
from soup_nlp.data.scenes.raycast import Body, Part, Scene, advanced, inverse, render
from soup_nlp.data.scenes.shapes import Box, Sheet
from soup_nlp.data.scenes.texture import Panels
from soup_nlp.data.scenes.things import (
    ASPHALT,
    BACK,
    FRONT,
    GLASS,
    SKY,
    Materials,
    Random,
    about,
    backdrop,
    car,
    floor,
    furniture,
    interior,
    placed,
    sign,
    views,
)
from soup_nlp.geometry import camera, rotation
from soup_nlp.schema.limits import check_image_size


def render_scene(
    name: str, seed: int = 0, width: int = 1024, height: int = 436, frame: int = 0
) -> Pair:
    """Render a named scene.

    Args:
        name: One of `SCENES`.
        seed: Changes layout, textures and motions within sensible ranges; same seed, same bytes.
        width: Columns of both images, at least 64; the focal length grows with it.
        height: Rows of both images, at least 48.
        frame: First frame of the pair; camera and bodies repeat their motion from frame 0 to 1.

    Returns:
        A `Pair` with full `Truth` in metres and no flow. Component 0 is the static background.
        Motions are `next_from_ref` with the camera's motion included; NaN for what bends.
    """
    check_image_size(width, height, "scene", name)
    layout, focal = _LAYOUTS[name]
    # tall images keep the field of view of a 4:3 image, else the ground would be behind the camera
    f = focal * max(width, 4 / 3 * height)
    K = camera.intrinsics(f, f, (width - 1) / 2, (height - 1) / 2)
    rng = np.random.default_rng([seed, list(_LAYOUTS).index(name)])
    scene = layout(rng, width / (2 * f), height / (2 * f), seed)
    own = f"{name}-{seed}" + (f"-{frame}" if frame else "")
    return render(advanced(scene, frame), K, height, width, name=own)


# layouts: (rng, half width / f, half height / f, seed) -> Scene


def _street(rng: Random, half_width: float, half_height: float, seed: int) -> Scene:
    """driving camera, two moving cars on a street between houses; depth to 80 m"""
    m = Materials(rng)
    lanes = Panels((3.6, 5.0), (0.035, 0.5), (0.78, 0.78, 0.74), (-0.06, rng.uniform(0, 5)))
    parts = [
        floor(m.plain(ASPHALT, 2.5, lanes, contrast=0.5)),
        backdrop(78, m.plain(SKY, 9.0, contrast=0.16), glow=1.0),
    ]
    for side in (-1.0, 1.0):
        z = rng.uniform(-4, 0)
        while z < 74:
            length, height = rng.uniform(9, 18), rng.uniform(7, 15)
            front = 7.5 + rng.uniform(0, 1.6)
            windows = Panels(
                (rng.uniform(2.2, 3.2), rng.uniform(2.6, 3.4)),
                (0.45, 0.55),
                GLASS,
                (rng.uniform(0, 3), rng.uniform(0, 3)),
                variation=0.5,
            )
            half = (3.0, height / 2, min(length, 76 - z) / 2)
            pose = placed(side * (front + 3.0), -height / 2, z + half[2])
            parts.append(Part(Box(half), pose, m.wall(3.0, windows)))
            z += length + rng.choice([0.0, 0.0, 3.0])
    drive = rng.uniform(0.5, 0.6)
    lane = 2.0
    ahead, coming = rng.uniform(11, 13.5), rng.uniform(15, 20)
    bodies = [Body(tuple(parts))]
    speeds = rng.uniform(0.3, 0.6, 2) * drive
    if rng.random() < 0.5:
        same = car(m, lane, ahead, 0.0)
        move = about([lane, 0, ahead], [0, sign(rng), 0], [0, 0, speeds[0]])
    else:
        yaw = -rng.uniform(50, 75)
        same = car(m, lane, ahead, yaw)
        nose = rotation.exp(np.radians([0, yaw, 0])) @ [0, 0, speeds[0]]
        move = about([lane, 0, ahead], [0, 0, 0], nose)
    bodies.append(Body(same, move))
    shift = [0, 0, -speeds[1]]
    bodies.append(Body(car(m, -lane, coming, 180.0), about([0, 0, 0], [0, 0, 0], shift)))
    turn = [rng.uniform(-0.1, 0.1), sign(rng) * rng.uniform(0.2, 0.4), 0.1]
    pose = placed(rng.uniform(-0.4, 0.4), -rng.uniform(2.1, 2.4), 0, yaw=rng.uniform(-2, 2))
    view = views(pose, [rng.uniform(-0.03, 0.03), 0, drive], turn)
    return Scene(tuple(bodies), *view)


def _sideways(rng: Random) -> tuple[Float, Float]:
    """Poses of a camera in a room that moves to one side and turns back to the middle."""
    side = sign(rng)
    return views(
        placed(0, -1.35, 0, yaw=side, pitch=-9),
        [side * rng.uniform(0.06, 0.085), rng.uniform(-0.01, 0.01), 0.04],
        [0.1, -side * rng.uniform(0.2, 0.5), sign(rng) * 0.2],
    )


def _room(rng: Random, half_width: float, half_height: float, seed: int) -> Scene:
    """camera moving sideways, three independently moving objects among furniture"""
    m = Materials(rng)
    objects = furniture(rng, m, FRONT + BACK, half_width)
    moving = [rng.integers(3), *(3 + rng.permutation(4)[:2])]
    rest = [part for k, (part, _) in enumerate(objects) if k not in moving]
    bodies = [Body((*interior(rng, m, half_width), *rest))]
    for rank, k in enumerate(moving):
        part, foot = objects[k]
        shift = np.array([sign(rng), 0, sign(rng)]) * rng.uniform([0.03, 0, 0.01], [0.06, 0, 0.06])
        if rank == 2:
            shift[1] = -rng.uniform(0.02, 0.05)  # lifted off the floor
        turn = [0, sign(rng) * rng.uniform(2, 4), 0]
        bodies.append(Body((part,), about(foot, turn, shift)))
    return Scene(tuple(bodies), *_sideways(rng))


def _sheet(rng: Random, half_width: float, half_height: float, seed: int) -> Scene:
    """a bending, non-rigid sheet at about 1 m before a wall"""
    m = Materials(rng)
    bend, change = sign(rng) * rng.uniform(0.7, 1.0), sign(rng) * rng.uniform(0.15, 0.25)
    axis = rng.uniform(-0.25, 0.25)
    # sides that bend away from the camera look smaller
    room = 1.06 if bend > 0 else 0.93
    shape = Sheet(
        (room * half_width, room * half_height),
        (bend, bend + change),
        (axis, axis + sign(rng) * rng.uniform(0.02, 0.06)),
    )
    dots = Panels((0.16, 0.16), (0.5, 0.5), (0.66, 0.64, 0.56), variation=0.3)
    cloth = Part(shape, placed(0, 0, 1.0, yaw=rng.uniform(-8, 8)), m.paint(0.12, dots), glow=0.6)
    shift = rng.uniform([-0.003, -0.003, -0.01], [0.003, 0.003, 0.01])
    bodies = (
        Body((backdrop(1.7, m.wall(0.3)),)),
        Body((cloth,), about([0, 0, 1], rng.uniform(-0.4, 0.4, 3), shift)),
    )
    view = views(
        np.eye(4),
        [sign(rng) * rng.uniform(0.008, 0.013), rng.uniform(-0.004, 0.004), 0.004],
        rng.uniform(-0.15, 0.15, 3),
    )
    return Scene(bodies, *view)


def _orbit(rng: Random, half_width: float, half_height: float, seed: int) -> Scene:
    """camera orbiting a still life; one rigid motion"""
    m = Materials(rng)
    objects = furniture(rng, m, FRONT + BACK, half_width)
    bodies = [Body(tuple(interior(rng, m, half_width)))]
    bodies += [Body((part,)) for k, (part, _) in enumerate(objects)]
    pose = placed(0, -1.45, 0, pitch=-9)
    turn = [0, sign(rng) * rng.uniform(1.2, 2.0), 0]
    around = about([0, 0, 4.2], turn, [0, rng.uniform(-0.03, 0.03), rng.uniform(-0.03, 0.06)])
    return Scene(tuple(bodies), inverse(pose), inverse(around @ pose))


def _still(rng: Random, half_width: float, half_height: float, seed: int) -> Scene:
    """camera at rest, one moving object"""
    m = Materials(rng)
    objects = furniture(rng, m, FRONT + BACK, half_width)
    mover = int(rng.integers(3))
    part, foot = objects.pop(mover)
    turn = [0, sign(rng) * rng.uniform(3, 6), 0]
    shift = [sign(rng) * rng.uniform(0.05, 0.09), 0, rng.uniform(-0.08, 0.08)]
    bodies = (
        Body((*interior(rng, m, half_width), *(p for p, _ in objects))),
        Body((part,), about(foot, turn, shift)),
    )
    pose = inverse(placed(0, -1.35, 0, pitch=-9))
    return Scene(bodies, pose, pose)


def _banner(rng: Random, half_width: float, half_height: float, seed: int) -> Scene:
    """a banner that bends, standing in a rigid room before a moving camera"""
    m = Materials(rng)
    rest = [part for part, _ in furniture(rng, m, BACK, half_width)]
    bend, change = sign(rng) * rng.uniform(0.5, 0.8), sign(rng) * rng.uniform(0.12, 0.25)
    axis = rng.uniform(-0.2, 0.2)
    z, up = 3.5, 0.81  # its foot is on the floor, in the image
    unit = z * half_width
    shape = Sheet(
        (0.4 * unit, up),
        (bend, bend + change),
        (axis, axis + sign(rng) * rng.uniform(0.02, 0.05)),
    )
    dots = Panels((0.3, 0.3), (0.5, 0.5), (0.66, 0.64, 0.56), variation=0.3)
    x = rng.uniform(-0.3, 0.3) * unit
    pose = placed(x, -up, z, yaw=rng.uniform(-10, 10))
    cloth = Part(shape, pose, m.paint(0.25, dots), glow=0.4)
    turn, shift = rng.uniform(-0.5, 0.5, 3), rng.uniform(-0.015, 0.015, 3)
    bodies = (
        Body((*interior(rng, m, half_width), *rest)),
        Body((cloth,), about([x, 0, z], turn, shift)),
    )
    return Scene(bodies, *_sideways(rng))


_LAYOUTS: dict[str, tuple[Callable[[Random, float, float, int], Scene], float]] = {
    "street": (_street, 0.9),
    "room": (_room, 0.8),
    "sheet": (_sheet, 0.9),
    "orbit": (_orbit, 0.8),
    "still": (_still, 0.8),
    "banner": (_banner, 0.8),
    **everyday.LAYOUTS,
}
"""Layout and focal length (in image widths) of each scene. New ones go last: places are seeds."""

SCENES = {name: str(layout.__doc__) for name, (layout, _) in _LAYOUTS.items()}
"""Description of every scene by name."""
