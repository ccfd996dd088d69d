"""Surfaces for ray casting: intersections, normals and material coordinates.

Material coordinates identify a point of a surface that bends between two frames, in which it is two
shapes (`material` of one, `place` of the other). For all others they are the coordinates of the
shape.
"""

from abc import ABC, abstractmethod
from functools import reduce

import numpy as np
from numpy.typing import ArrayLike

from soup_nlp.arrays import Float, Int

NEAR = 1e-6
"""Smallest depth of a hit, unit of length."""


class Shape(ABC):
    """A surface in its own coordinates."""

    bound: Float | None = None
    """(3,) half sizes of a box around the origin that contains the shape; None if unbounded."""

    @abstractmethod
    def intersect(self, origin: Float, rays: Float) -> Float:
        """Smallest ray parameter > NEAR (N,) of rays (N, 3) from `origin` (3,), inf for a miss."""

    @abstractmethod
    def normals(self, points: Float) -> Float:
        """Unit normals (N, 3) at surface points (N, 3)."""

    def material(self, points: Float) -> Float:
        """Material coordinates (N, 3) of surface points (N, 3)."""
        return points

    def place(self, material: Float) -> Float:
        """Surface points (N, 3) of material coordinates (N, 3)."""
        return material

    def chart(self, material: Float) -> Float:
        """Two coordinates (N, 2) along the surface, unit of length, for painted patterns."""
        return material[:, :2]


def _first_hit(*roots: Float) -> Float:
    """The smallest root > NEAR of each ray; NaN and inf are misses."""
    return reduce(np.minimum, [np.where(root > NEAR, root, np.inf) for root in roots])


class Plane(Shape):
    """The infinite plane z = 0 with normal -z, visible from both sides."""

    def intersect(self, origin: Float, rays: Float) -> Float:
        """See `Shape`."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return _first_hit(-origin[2] / rays[:, 2])

    def normals(self, points: Float) -> Float:
        """See `Shape`."""
        return np.broadcast_to([0.0, 0.0, -1.0], points.shape)


class Box(Shape):
    """A box around the origin; `half` are its half sizes along x, y and z."""

    def __init__(self, half: ArrayLike) -> None:
        self.half = self.bound = np.asarray(half, float)

    def intersect(self, origin: Float, rays: Float) -> Float:
        """See `Shape`."""
        with np.errstate(divide="ignore", invalid="ignore"):
            # one contiguous row for each axis is much faster than reducing over rows of three
            a, b = ((sign * self.half - origin)[:, None] / rays.T for sign in (-1, 1))
        # for a ray within a face (0/0), fmin and fmax use the other axes
        enter = reduce(np.fmax, np.fmin(a, b))
        leave = reduce(np.fmin, np.fmax(a, b))
        return np.where(enter <= leave, _first_hit(enter, leave), np.inf)

    def _face(self, points: Float) -> Int:
        return np.argmax(abs(points) / self.half, axis=1)

    def normals(self, points: Float) -> Float:
        """See `Shape`."""
        rows, face = np.arange(len(points)), self._face(points)
        out = np.zeros(points.shape)
        out[rows, face] = np.sign(points[rows, face])
        return out

    def chart(self, material: Float) -> Float:
        """See `Shape`; on the four upright faces the second coordinate is y."""
        face = self._face(material)
        across = np.where(face == 0, material[:, 2], material[:, 0])
        down = np.where(face == 1, material[:, 2], material[:, 1])
        return np.stack([across, down], axis=1)


class Ellipsoid(Shape):
    """An ellipsoid around the origin; `half` are its half axes along x, y and z."""

    def __init__(self, half: ArrayLike) -> None:
        self.half = self.bound = np.asarray(half, float)

    def intersect(self, origin: Float, rays: Float) -> Float:
        """See `Shape`: a unit sphere in coordinates divided by the half axes."""
        o, d = origin / self.half, rays / self.half
        a, b, c = np.einsum("ni,ni->n", d, d), d @ o, o @ o - 1
        with np.errstate(invalid="ignore"):
            root = np.sqrt(b * b - a * c)
        return _first_hit((-b - root) / a, (-b + root) / a)

    def normals(self, points: Float) -> Float:
        """See `Shape`."""
        n = points / np.square(self.half)
        out: Float = n / np.linalg.norm(n, axis=1, keepdims=True)
        return out


class Sheet(Shape):
    """A rectangular sheet that is bent isometrically into a circular cylinder.

    Material coordinates are (x, y, 0) on the flat sheet. Bending about the direction at `angle`
    from the y axis keeps lengths along the sheet: it is developable. With positive curvature the
    sides bend towards +z.

    Args:
        half: Half sizes along the material axes x and y, unit of length.
        curvature: Curvature, 1 / unit of length; 0 is flat.
        angle: Direction of the bending axis, radians from y towards -x.
    """

    def __init__(self, half: tuple[float, float], curvature: float, angle: float = 0.0) -> None:
        self.half, self.curvature = half, curvature
        self.bound = np.full(3, np.hypot(*half))
        c, s = np.cos(angle), np.sin(angle)
        # rows times this turn the axis to y
        self._to_axis = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])

    def intersect(self, origin: Float, rays: Float) -> Float:
        """See `Shape`; the cylinder is `k (x^2 + z^2) = 2 z`, which is valid for k = 0 too."""
        k = self.curvature
        o, d = (origin[None] @ self._to_axis)[0], rays @ self._to_axis
        a = k * (d[:, 0] ** 2 + d[:, 2] ** 2)
        b = k * (o[0] * d[:, 0] + o[2] * d[:, 2]) - d[:, 2]
        c = k * (o[0] ** 2 + o[2] ** 2) - 2 * o[2]
        with np.errstate(invalid="ignore", divide="ignore"):
            q = -(b + np.copysign(np.sqrt(b * b - a * c), b))
            roots = np.stack([q / a, c / q])
            material = [self.material(origin + t[:, None] * rays)[:, :2] for t in roots]
            inside = np.all(np.abs(material) <= self.half, axis=2)
        return _first_hit(*np.where(inside, roots, np.nan))

    def material(self, points: Float) -> Float:
        """See `Shape`: unroll the cylinder."""
        k, p = self.curvature, points @ self._to_axis
        arc = np.arctan2(k * p[:, 0], 1 - k * p[:, 2]) / k if k else p[:, 0]
        return np.stack([arc, p[:, 1], np.zeros(len(p))], axis=1) @ self._to_axis.T

    def place(self, material: Float) -> Float:
        """See `Shape`: roll the flat sheet up."""
        k, p = self.curvature, material @ self._to_axis
        # np.sinc(x) = sin(pi x) / (pi x) is exact at 0
        half_angle = 0.5 * k * p[:, 0] / np.pi
        x = p[:, 0] * np.sinc(2 * half_angle)
        z = 0.5 * k * p[:, 0] ** 2 * np.sinc(half_angle) ** 2
        return np.stack([x, p[:, 1], z], axis=1) @ self._to_axis.T

    def normals(self, points: Float) -> Float:
        """See `Shape`; -z at the centre."""
        k, p = self.curvature, points @ self._to_axis
        n = np.stack([k * p[:, 0], np.zeros(len(p)), k * p[:, 2] - 1], axis=1)
        return n / np.linalg.norm(n, axis=1, keepdims=True) @ self._to_axis.T
