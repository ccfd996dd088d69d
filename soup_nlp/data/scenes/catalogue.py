"""Named dynamic scenes with exact truth, rendered by `soup_nlp.data.scenes.raycast`.

Scenes are laid out in level coordinates: x right, y down, z forward, the ground is y = 0. The
truth of the rendered pair is in the usual coordinates, those of the reference camera, in metres.
"""

from collections.abc import Callable

import numpy as np

from soup_nlp.arrays import Float
from soup_nlp.data.pair import Pair
from soup_nlp.data.scenes.raycast import Body, Part, Scene, inverse, render
from soup_nlp.data.scenes.surfaces import Panels, Sheet
from soup_nlp.data.scenes.things import (
    BACK,
    FRONT,
    SKY,
    SceneBuilder,
    about,
    backdrop,
    block,
    foot,
    placed,
    views,
    windows,
)
from soup_nlp.geometry import camera, rotation
from soup_nlp.schema.section import check_image_size


def render_scene(
    name: str, seed: int = 0, width: int = 1024, height: int = 436, frame: int = 0
) -> Pair:
    """Render a scene of `LAYOUTS`, with full truth in metres and no flow.

    Component 0 is the static background. Motions include that of the camera; NaN for what bends.
    The seed changes layout, textures and motions; the focal length grows with the width. `frame` is
    the first one of the pair: camera and bodies repeat their motion from frame 0 to 1.
    """
    check_image_size(width, height, "scene", name)
    layout, focal, contrast = LAYOUTS[name]
    # tall images keep the field of view of a 4:3 image, else the ground would be behind the camera
    f = focal * max(width, 4 / 3 * height)
    K = camera.intrinsics(f, f, (width - 1) / 2, (height - 1) / 2)
    rng = np.random.default_rng([seed, list(LAYOUTS).index(name)])
    scene = layout(SceneBuilder(rng, width / (2 * f), height / (2 * f), contrast, seed))
    return render(scene.advanced(frame), K, height, width)


def _street(b: SceneBuilder) -> Scene:
    """driving camera, two moving cars on a street between houses; depth to 80 m"""
    static = [
        b.road(3.6, -0.06, 2.5, contrast=0.5),
        backdrop(78, b.plain(SKY, 9.0, contrast=0.16), glow=1.0),
    ]
    for side in (-1.0, 1.0):
        z = b.uniform(-4, 0)
        while z < 74:
            length, height = b.uniform(9, 18), b.uniform(7, 15)
            front = 7.5 + b.uniform(0, 1.6)
            period = b.uniform(2.2, 3.2), b.uniform(2.6, 3.4)
            panes = windows(period, (b.uniform(0, 3), b.uniform(0, 3)))
            half = 3.0, height / 2, min(length, 76 - z) / 2
            static.append(block(half, side * (front + 3.0), z + half[2], b.wall(3.0, panes)))
            z += length + b.rng.choice([0.0, 0.0, 3.0])
    drive = b.uniform(0.5, 0.6)
    lane = 2.0
    ahead, coming = b.uniform(11, 13.5), b.uniform(15, 20)
    speeds = b.uniform(0.3, 0.6, 2) * drive
    if b.rng.random() < 0.5:
        same = b.car(lane, ahead, 0.0)
        move = about([lane, 0, ahead], [0, b.sign(), 0], [0, 0, speeds[0]])
    else:
        yaw = -b.uniform(50, 75)
        same = b.car(lane, ahead, yaw)
        nose = rotation.exp(np.radians([0, yaw, 0])) @ [0, 0, speeds[0]]
        move = about([lane, 0, ahead], shift=nose)
    other = Body(b.car(-lane, coming, 180.0), about(shift=[0, 0, -speeds[1]]))
    turn = [b.uniform(-0.1, 0.1), b.sign() * b.uniform(0.2, 0.4), 0.1]
    pose = placed(b.uniform(-0.4, 0.4), -b.uniform(2.1, 2.4), 0, yaw=b.uniform(-2, 2))
    view = views(pose, [b.uniform(-0.03, 0.03), 0, drive], turn)
    return Scene([Body(static), Body(same, move), other], *view)


def _sideways(b: SceneBuilder) -> tuple[Float, Float]:
    """Poses of a camera in a room that moves to one side and turns back to the middle."""
    side = b.sign()
    return views(
        placed(0, -1.35, 0, yaw=side, pitch=-9),
        [side * b.uniform(0.06, 0.085), b.uniform(-0.01, 0.01), 0.04],
        [0.1, -side * b.uniform(0.2, 0.5), b.sign() * 0.2],
    )


def _room(b: SceneBuilder) -> Scene:
    """camera moving sideways, three independently moving objects among furniture"""
    objects = b.furniture(FRONT + BACK)
    moving = [b.rng.integers(3), *(3 + b.rng.permutation(4)[:2])]
    static = [part for k, part in enumerate(objects) if k not in moving]
    bodies = [Body([*b.interior(), *static])]
    for rank, k in enumerate(moving):
        shift = np.array([b.sign(), 0, b.sign()]) * b.uniform([0.03, 0, 0.01], [0.06, 0, 0.06])
        if rank == 2:
            shift[1] = -b.uniform(0.02, 0.05)  # lifted off the floor
        turn = [0, b.sign() * b.uniform(2, 4), 0]
        bodies.append(Body([objects[k]], about(foot(objects[k]), turn, shift)))
    return Scene(bodies, *_sideways(b))


def _sheet(b: SceneBuilder) -> Scene:
    """a bending, non-rigid sheet at about 1 m before a wall"""
    bend, change = b.sign() * b.uniform(0.7, 1.0), b.sign() * b.uniform(0.15, 0.25)
    axis = b.uniform(-0.25, 0.25)
    # sides that bend away from the camera look smaller
    room = 1.06 if bend > 0 else 0.93
    half = room * b.half_width, room * b.half_height
    bent = Sheet(half, bend + change, axis + b.sign() * b.uniform(0.02, 0.06))
    dots = Panels((0.16, 0.16), (0.5, 0.5), (0.66, 0.64, 0.56), variation=0.3)
    pose = placed(0, 0, 1.0, yaw=b.uniform(-8, 8))
    cloth = Part(Sheet(half, bend, axis), pose, b.paint(0.12, dots), glow=0.6, bent=bent)
    shift = b.uniform([-0.003, -0.003, -0.01], [0.003, 0.003, 0.01])
    wall = Body([backdrop(1.7, b.wall(0.3))])
    sheet = Body([cloth], about([0, 0, 1], b.uniform(-0.4, 0.4, 3), shift))
    way = [b.sign() * b.uniform(0.008, 0.013), b.uniform(-0.004, 0.004), 0.004]
    return Scene([wall, sheet], *views(np.eye(4), way, b.uniform(-0.15, 0.15, 3)))


def _orbit(b: SceneBuilder) -> Scene:
    """camera orbiting a still life; one rigid motion"""
    objects = b.furniture(FRONT + BACK)
    bodies = [Body(b.interior()), *(Body([part]) for part in objects)]
    pose = placed(0, -1.45, 0, pitch=-9)
    turn = [0, b.sign() * b.uniform(1.2, 2.0), 0]
    around = about([0, 0, 4.2], turn, [0, b.uniform(-0.03, 0.03), b.uniform(-0.03, 0.06)])
    return Scene(bodies, inverse(pose), inverse(around @ pose))


def _still(b: SceneBuilder) -> Scene:
    """camera at rest, one moving object"""
    objects = b.furniture(FRONT + BACK)
    part = objects.pop(int(b.rng.integers(3)))
    turn = [0, b.sign() * b.uniform(3, 6), 0]
    shift = [b.sign() * b.uniform(0.05, 0.09), 0, b.uniform(-0.08, 0.08)]
    bodies = [Body([*b.interior(), *objects]), Body([part], about(foot(part), turn, shift))]
    pose = inverse(placed(0, -1.35, 0, pitch=-9))
    return Scene(bodies, pose, pose)


def _banner(b: SceneBuilder) -> Scene:
    """a banner that bends, standing in a rigid room before a moving camera"""
    things = b.furniture(BACK)
    bend, change = b.sign() * b.uniform(0.5, 0.8), b.sign() * b.uniform(0.12, 0.25)
    axis = b.uniform(-0.2, 0.2)
    z, up = 3.5, 0.81  # its foot is on the floor, in the image
    unit = z * b.half_width
    half = 0.4 * unit, up
    bent = Sheet(half, bend + change, axis + b.sign() * b.uniform(0.02, 0.05))
    dots = Panels((0.3, 0.3), (0.5, 0.5), (0.66, 0.64, 0.56), variation=0.3)
    x = b.uniform(-0.3, 0.3) * unit
    pose = placed(x, -up, z, yaw=b.uniform(-10, 10))
    cloth = Part(Sheet(half, bend, axis), pose, b.paint(0.25, dots), glow=0.4, bent=bent)
    turn, shift = b.uniform(-0.5, 0.5, 3), b.uniform(-0.015, 0.015, 3)
    bodies = [Body([*b.interior(), *things]), Body([cloth], about([x, 0, z], turn, shift))]
    return Scene(bodies, *_sideways(b))


Layouts = dict[str, tuple[Callable[[SceneBuilder], Scene], float, float]]
"""Layout, focal length (in image widths) and contrast of each scene."""
LAYOUTS: Layouts = {
    "street": (_street, 0.9, 1.0),
    "room": (_room, 0.8, 1.0),
    "sheet": (_sheet, 0.9, 1.0),
    "orbit": (_orbit, 0.8, 1.0),
    "still": (_still, 0.8, 1.0),
    "banner": (_banner, 0.8, 1.0),
}
"""The index of a scene in this table is part of its seed: others may be added at the end."""
