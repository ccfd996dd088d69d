"""Named dynamic scenes with exact truth: their elements, layouts and rendering.

Scenes are laid out in level coordinates: x right, y down, z forward, the ground is y = 0. The
truth of the rendered pair is in the usual coordinates, those of the reference camera, in metres.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from soup_nlp.arrays import Float
from soup_nlp.data.pair import Pair
from soup_nlp.data.scenes.raycast import Body, Part, Scene, inverse, render
from soup_nlp.data.scenes.surfaces import (
    Box,
    Colour,
    Ellipsoid,
    Panels,
    Plane,
    Shape,
    Sheet,
    Texture,
)
from soup_nlp.geometry import camera, rotation
from soup_nlp.schema.section import check_image_size

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


Colours = tuple[Colour, Colour]
PAINTS: tuple[Colours, ...] = (
    ((0.72, 0.20, 0.14), (0.50, 0.12, 0.10)),
    ((0.16, 0.36, 0.68), (0.10, 0.22, 0.46)),
    ((0.82, 0.66, 0.18), (0.66, 0.46, 0.10)),
    ((0.18, 0.52, 0.30), (0.34, 0.62, 0.26)),
    ((0.62, 0.58, 0.56), (0.40, 0.40, 0.44)),
    ((0.52, 0.26, 0.56), (0.68, 0.40, 0.62)),
    ((0.20, 0.58, 0.60), (0.12, 0.40, 0.46)),
    ((0.80, 0.44, 0.20), (0.62, 0.30, 0.14)),
)
WALLS: tuple[Colours, ...] = (
    ((0.70, 0.62, 0.50), (0.58, 0.50, 0.42)),
    ((0.62, 0.38, 0.30), (0.50, 0.32, 0.27)),
    ((0.60, 0.62, 0.64), (0.48, 0.50, 0.54)),
    ((0.74, 0.70, 0.62), (0.62, 0.60, 0.56)),
)
ASPHALT: Colours = ((0.42, 0.42, 0.43), (0.32, 0.32, 0.34))
SKY: Colours = ((0.52, 0.68, 0.88), (0.84, 0.88, 0.92))
GLASS: Colour = (0.16, 0.20, 0.26)
DARK: Colours = ((0.12, 0.12, 0.13), (0.20, 0.20, 0.21))

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
    half_width: float
    half_height: float
    contrast: float
    seed: int

    def __post_init__(self) -> None:
        self.uniform = self.rng.uniform
        self.paints = [PAINTS[i] for i in self.rng.permutation(len(PAINTS))]

    def sign(self) -> float:
        """1 or -1, either with probability 1/2."""
        return float(self.rng.choice([-1.0, 1.0]))

    def plain(
        self, colours: Colours, cell: float, panels: Panels | None = None, contrast: float = 0.45
    ) -> Texture:
        """A texture of two colours, each with another seed."""
        seed = int(self.rng.integers(2**31))
        return Texture(colours, cell, self.contrast * contrast, seed, panels)

    def paint(self, cell: float, panels: Panels | None = None) -> Texture:
        """A texture in the next colour of the palette."""
        self.paints.append(self.paints.pop(0))
        return self.plain(self.paints[-1], cell, panels, contrast=0.5)

    def wall(self, cell: float, panels: Panels | None = None) -> Texture:
        """A texture of a random wall colour."""
        return self.plain(WALLS[self.rng.integers(len(WALLS))], cell, panels)

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
                half = size * np.full(3, self.uniform(0.85, 1.05))
                shape, yaw = Ellipsoid(half), self.uniform(0, 360)
            else:
                half = size * self.uniform([0.75, 0.75, 0.75], [1.0, 1.4, 1.0])
                shape, yaw = Box(half), self.uniform(20, 70)
            out.append(Part(shape, placed(x, -half[1], z, yaw=yaw), self.paint(0.8 * size)))
        return out

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


# --- layouts --------------------------------------------------------------------------------------


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
