"""Surfaces for ray casting: intersections, normals and material coordinates.

Material coordinates identify a point of a surface in both frames (`material` and `place`). For
rigid shapes they are the coordinates of the shape.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from soup_nlp.arrays import Float, Int

NEAR = 1e-6
"""Smallest depth of a hit, unit of length."""


class Shape(ABC):
    """A surface in its own coordinates; `frame` is 0 for the reference and 1 for the next frame.

    Rigid shapes only implement `intersect`, `normals` and `corners`.
    """

    rigid = True

    @abstractmethod
    def intersect(self, origin: Float, rays: Float, frame: int) -> Float:
        """Smallest ray parameter > NEAR (N,) of rays (N, 3) from `origin` (3,), inf for a miss."""

    @abstractmethod
    def normals(self, points: Float, frame: int) -> Float:
        """Unit normals (N, 3) at surface points (N, 3)."""

    @abstractmethod
    def corners(self) -> Float | None:
        """Points (M, 3) whose convex hull contains the shape in both frames; None if unbounded."""

    def material(self, points: Float, frame: int) -> Float:
        """Material coordinates (N, 3) of surface points (N, 3) in a frame."""
        return points

    def place(self, material: Float, frame: int) -> Float:
        """Positions (N, 3) of material coordinates (N, 3) in a frame."""
        return material

    def chart(self, material: Float) -> Float:
        """Two coordinates (N, 2) along the surface, unit of length, for painted patterns."""
        return material[:, :2]


def _corner_points(half: Sequence[float] | Float) -> Float:
    signs = np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), axis=-1).reshape(-1, 3)
    return signs * np.asarray(half)


def _first_hit(*roots: Float) -> Float:
    """The smallest root > NEAR of each ray; NaN and inf are misses."""
    return np.minimum.reduce([np.where(root > NEAR, root, np.inf) for root in roots])


@dataclass(frozen=True)
class Plane(Shape):
    """The infinite plane z = 0 with normal -z, visible from both sides."""

    def intersect(self, origin: Float, rays: Float, frame: int) -> Float:
        """See `Shape`."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return _first_hit(-origin[2] / rays[:, 2])

    def normals(self, points: Float, frame: int) -> Float:
        """See `Shape`."""
        return np.broadcast_to([0.0, 0.0, -1.0], points.shape)

    def corners(self) -> Float | None:
        """See `Shape`."""
        return None


@dataclass(frozen=True)
class Centred(Shape):
    """A shape around the origin.

    Attributes:
        half: Half sizes along x, y and z, unit of length.
    """

    half: Sequence[float] | Float

    def corners(self) -> Float:
        """See `Shape`."""
        return _corner_points(self.half)


class Box(Centred):
    """A box."""

    def intersect(self, origin: Float, rays: Float, frame: int) -> Float:
        """See `Shape`."""
        half = np.asarray(self.half)
        with np.errstate(divide="ignore", invalid="ignore"):
            # one contiguous row for each axis is much faster than reducing over rows of three
            a, b = ((sign * half - origin)[:, None] / rays.T for sign in (-1, 1))
        # for a ray within a face (0/0), fmin and fmax use the other axes
        enter = np.fmax.reduce(np.fmin(a, b))
        leave = np.fmin.reduce(np.fmax(a, b))
        return np.where(enter <= leave, _first_hit(enter, leave), np.inf)

    def _face(self, points: Float) -> Int:
        return np.argmax(abs(points) / np.asarray(self.half), axis=1)

    def normals(self, points: Float, frame: int) -> Float:
        """See `Shape`."""
        face = self._face(points)
        rows = np.arange(len(points))
        out = np.zeros(points.shape)
        out[rows, face] = np.sign(points[rows, face])
        return out

    def chart(self, material: Float) -> Float:
        """See `Shape`; y runs along y on the four sides."""
        face = self._face(material)
        across = np.where(face == 0, material[:, 2], material[:, 0])
        down = np.where(face == 1, material[:, 2], material[:, 1])
        return np.stack([across, down], axis=1)


class Ellipsoid(Centred):
    """An ellipsoid, whose half axes are the half sizes."""

    def intersect(self, origin: Float, rays: Float, frame: int) -> Float:
        """See `Shape`: a unit sphere in coordinates divided by the half axes."""
        o, d = origin / np.asarray(self.half), rays / np.asarray(self.half)
        a, b, c = np.einsum("ni,ni->n", d, d), d @ o, o @ o - 1
        with np.errstate(invalid="ignore"):
            root = np.sqrt(b * b - a * c)
        return _first_hit((-b - root) / a, (-b + root) / a)

    def normals(self, points: Float, frame: int) -> Float:
        """See `Shape`."""
        n = points / np.square(self.half)
        out: Float = n / np.linalg.norm(n, axis=1, keepdims=True)
        return out


@dataclass(frozen=True)
class Sheet(Shape):
    """A rectangular sheet bent into a circular cylinder, differently in each frame, isometrically.

    Material coordinates are (x, y, 0) on the flat sheet. Bending about the direction at `angle`
    from the y axis keeps lengths along the sheet: it is developable. With positive curvature the
    sides bend towards +z.

    Attributes:
        half: Half sizes along the material axes x and y, unit of length.
        curvature: Curvature (1 / unit of length) in the reference and in the next frame; 0 is flat.
        angle: Direction of the bending axis in both frames, radians from y towards -x.
    """

    half: tuple[float, float]
    curvature: tuple[float, float]
    angle: tuple[float, float] = (0.0, 0.0)

    rigid = False

    def _turn(self, points: Float, angle: float) -> Float:
        c, s = np.cos(angle), np.sin(angle)
        return points @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])

    def intersect(self, origin: Float, rays: Float, frame: int) -> Float:
        """See `Shape`; the cylinder is `k (x^2 + z^2) = 2 z`, which is valid for k = 0 too."""
        k = self.curvature[frame]
        o = self._turn(origin[None], -self.angle[frame])[0]
        d = self._turn(rays, -self.angle[frame])
        a = k * (d[:, 0] ** 2 + d[:, 2] ** 2)
        b = k * (o[0] * d[:, 0] + o[2] * d[:, 2]) - d[:, 2]
        c = k * (o[0] ** 2 + o[2] ** 2) - 2 * o[2]
        with np.errstate(invalid="ignore", divide="ignore"):
            q = -(b + np.copysign(np.sqrt(b * b - a * c), b))
            roots = (q / a, c / q)
        return _first_hit(*(self._on_sheet(origin, rays, t, frame) for t in roots))

    def _on_sheet(self, origin: Float, rays: Float, t: Float, frame: int) -> Float:
        """The ray parameters `t` (N,), NaN where the point lies beyond the edge of the sheet."""
        with np.errstate(invalid="ignore"):
            material = self.material(origin + t[:, None] * rays, frame)
            inside = (abs(material[:, :2]) <= np.asarray(self.half)).all(axis=1)
        return np.where(inside, t, np.nan)

    def material(self, points: Float, frame: int) -> Float:
        """See `Shape`: unroll the cylinder."""
        k = self.curvature[frame]
        p = self._turn(points, -self.angle[frame])
        arc = np.arctan2(k * p[:, 0], 1 - k * p[:, 2]) / k if k else p[:, 0]
        flat = np.stack([arc, p[:, 1], np.zeros(len(p))], axis=1)
        return self._turn(flat, self.angle[frame])

    def place(self, material: Float, frame: int) -> Float:
        """See `Shape`: roll the flat sheet up."""
        k = self.curvature[frame]
        p = self._turn(material, -self.angle[frame])
        # np.sinc(x) = sin(pi x) / (pi x) is exact at 0
        half_angle = 0.5 * k * p[:, 0] / np.pi
        x = p[:, 0] * np.sinc(2 * half_angle)
        z = 0.5 * k * p[:, 0] ** 2 * np.sinc(half_angle) ** 2
        return self._turn(np.stack([x, p[:, 1], z], axis=1), self.angle[frame])

    def normals(self, points: Float, frame: int) -> Float:
        """See `Shape`; -z at the centre."""
        k = self.curvature[frame]
        p = self._turn(points, -self.angle[frame])
        n = np.stack([k * p[:, 0], np.zeros(len(p)), k * p[:, 2] - 1], axis=1)
        return self._turn(n / np.linalg.norm(n, axis=1, keepdims=True), self.angle[frame])

    def corners(self) -> Float:
        """See `Shape`."""
        return _corner_points((float(np.hypot(*self.half)),) * 3)
