"""Poses, motions, colours and textures of the rendered scenes."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from soup_nlp.data.scenes.raycast import Part, inverse
from soup_nlp.data.scenes.shapes import Float, Plane
from soup_nlp.data.scenes.texture import Colour, Panels, Texture
from soup_nlp.geometry import rotation

Random = np.random.Generator


def placed(x: float, y: float, z: float, yaw: float = 0.0, pitch: float = 0.0) -> Float:
    """(4, 4) pose at a position (m), turned by `yaw` about y after `pitch` about x (degrees)."""
    out = np.eye(4)
    turns = [rotation.exp(np.radians(w)) for w in ([0.0, yaw, 0.0], [pitch, 0.0, 0.0])]
    out[:3, :3], out[:3, 3] = turns[0] @ turns[1], (x, y, z)
    return out


def about(pivot: ArrayLike, turn: ArrayLike, shift: ArrayLike) -> Float:
    """(4, 4) motion: turn by a rotation vector (degrees) about a pivot (3,), then shift (3,) m."""
    out, centre = np.eye(4), np.array(pivot, float)
    out[:3, :3] = rotation.exp(np.radians(turn))
    out[:3, 3] = centre - out[:3, :3] @ centre + np.asarray(shift)
    return out


def views(pose: Float, shift: ArrayLike, turn: ArrayLike) -> tuple[Float, Float]:
    """(ref_from_scene, next_from_scene) of a camera at `pose` that moves in its own frame."""
    return inverse(pose), inverse(pose @ about([0, 0, 0], turn, shift))


def sign(rng: Random) -> float:
    """1 or -1, either with probability 1/2."""
    return float(rng.choice([-1.0, 1.0]))


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


class Materials:
    """Textures with a new noise for each surface; `contrast` scales that of them all."""

    def __init__(self, rng: Random, contrast: float = 1.0) -> None:
        self.rng, self.contrast = rng, contrast
        self.paints = [PAINTS[i] for i in rng.permutation(len(PAINTS))]

    def plain(
        self,
        colours: tuple[Colour, Colour],
        cell: float,
        panels: Panels | None = None,
        contrast: float = 0.45,
    ) -> Texture:
        """A given pair of colours."""
        seed = int(self.rng.integers(2**31))
        return Texture(colours, cell, self.contrast * contrast, seed, panels)

    def paint(self, cell: float, panels: Panels | None = None) -> Texture:
        """The next colour of the palette."""
        self.paints.append(self.paints.pop(0))
        return self.plain(self.paints[-1], cell, panels, contrast=0.5)

    def wall(self, cell: float, panels: Panels | None = None) -> Texture:
        """One of the wall colours."""
        return self.plain(WALLS[self.rng.integers(len(WALLS))], cell, panels)


def floor(texture: Texture) -> Part:
    """The infinite ground y = 0."""
    return Part(Plane(), placed(0, 0, 0, pitch=-90), texture)


def backdrop(z: float, texture: Texture, glow: float = 0.45) -> Part:
    """An infinite upright wall at a distance."""
    return Part(Plane(), placed(0, 0, z), texture, glow)
