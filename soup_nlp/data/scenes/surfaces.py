"""Surfaces for ray casting: shapes with normals and material coordinates, and their textures.

Material coordinates identify a point of a surface that bends between two frames, in which it is two
shapes (`material` of one, `place` of the other). For all others they are the coordinates of the
shape. A texture is a function of them and moves with its body, so that corresponding points of two
frames have the same colours, up to the sampling by pixels.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import lru_cache, reduce

import numpy as np
from numpy.typing import ArrayLike

from soup_nlp.arrays import Float, FloatMap, Int

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
    """A rectangular sheet that is bent into a circular cylinder, which keeps lengths along it.

    Material coordinates are (x, y, 0) on the flat sheet, with half sizes `half`. With positive
    curvature (1 / unit of length) the sides bend towards +z. The axis of bending is at `angle`
    (radians) from y towards -x.
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


# --- textures: seeded solid noise, limited to the size of a pixel ---------------------------------

Colour = tuple[float, float, float]

PERIOD = 32
"""Cells after which the noise of one octave repeats; a power of two."""
FINEST_CELLS = (1.25, 2.5)
"""Cell size in footprints of pixels at which an octave begins to appear, and is complete."""
LACUNARITY = 1.93
"""Ratio of the cell sizes of consecutive octaves."""
GOLDEN = 0.6180339887498949


@lru_cache(maxsize=64)
def _lattice(seed: int) -> FloatMap:
    """Random values in [-1, 1] on a periodic lattice, flat (PERIOD**3,)."""
    rng = np.random.default_rng([seed, 0x50])
    return rng.uniform(-1, 1, PERIOD**3).astype(np.float32)


@lru_cache(maxsize=64)
def _turn(seed: int) -> Float:
    """A random rotation (3, 3) that keeps lattice planes away from the faces of a body."""
    rng = np.random.default_rng([seed, 0x51])
    Q, R = np.linalg.qr(rng.standard_normal((3, 3)))
    return Q * np.sign(np.diag(R))


def value_noise(points: Float, seed: int) -> FloatMap:
    """Smooth solid noise (N,) in [-1, 1] at (N, 3) cells: random lattice values, interpolated."""
    cell = np.floor(points)
    f = (points - cell).T.astype(np.float32, order="C")
    f = f * f * f * (f * (f * 6 - 15) + 10)
    x, y, z = low = np.bitwise_and(cell.T.astype(np.int64, order="C"), PERIOD - 1)
    node = (z * PERIOD + y) * PERIOD + x
    # from the lower to the upper node along each axis, in the flat lattice
    steps = np.bitwise_and(low + 1, PERIOD - 1) - low
    steps *= np.array([[1], [PERIOD], [PERIOD**2]])
    return _interpolated(_lattice(seed), node, steps, f)


def _interpolated(lattice: FloatMap, node: Int, steps: Int, shares: FloatMap) -> FloatMap:
    """Values (N,) between nodes (N,) and those after steps (A, N), by shares (A, N) of each."""
    if not len(steps):
        return lattice.take(node)
    low = _interpolated(lattice, node, steps[:-1], shares[:-1])
    high = _interpolated(lattice, node + steps[-1], steps[:-1], shares[:-1])
    # in place: temporary arrays cost more than the arithmetic
    high -= low
    high *= shares[-1]
    high += low
    return high


def fractal_noise(
    points: Float,
    footprint: Float,
    *,
    cell: float,
    seed: int,
    persistence: float = 0.8,
    octaves: int = 12,
) -> FloatMap:
    """Sum of octaves of `value_noise`, each octave only where pixels can resolve it.

    `footprint` (N,) is the size of a pixel on the surface, `cell` that of the coarsest cells, both
    in the unit of the points (N, 3); `persistence` the ratio of amplitudes of consecutive octaves.
    """
    turned = points @ _turn(seed).T
    total = np.zeros(len(points), np.float32)
    finest = float(footprint.min(initial=np.inf))
    scale = 1 / np.sqrt(sum(persistence ** (2 * k) for k in range(5)))
    for k in range(octaves):
        if cell < FINEST_CELLS[0] * finest:
            break
        x = np.clip((cell / footprint - FINEST_CELLS[0]) / np.ptp(FINEST_CELLS), 0, 1)
        weight = (x * x * (3 - 2 * x)).astype(np.float32)
        visible = np.flatnonzero(weight)
        # a shift per octave, or all octaves would share a lattice node at the origin
        shift = np.mod(GOLDEN * (k + 1) * np.array([1.0, 7.0, 13.0]), 1) * PERIOD
        where = turned[visible] / cell + shift
        total[visible] += np.float32(scale) * weight[visible] * value_noise(where, seed)
        scale *= persistence
        cell /= LACUNARITY
    return total * np.float32(1.6)


def pulse_coverage(x: Float, duty: Float, width: Float) -> Float:
    """Box-filtered pulse trains (N, 2): share of [x - width/2, x + width/2] with frac(x) < duty."""
    width = np.maximum(width, 1e-6)

    def integral(y: Float) -> Float:
        whole = np.floor(y)
        return whole * duty + np.minimum(y - whole, duty)

    covered: Float = (integral(x + width / 2) - integral(x - width / 2)) / width
    return np.clip(covered, 0, 1)


@dataclass(frozen=True)
class Panels:
    """A grid of rectangles (windows, tiles, lane marks) in the chart of a surface.

    Attributes:
        period: Size of a grid cell along both chart axes, unit of length.
        duty: Share of a cell that the rectangle covers, along both axes.
        colour: RGB in [0, 1].
        offset: Where the first rectangle starts, unit of length.
        variation: Random change of brightness from one rectangle to the next, 0 for none.
    """

    period: tuple[float, float]
    duty: tuple[float, float]
    colour: Colour
    offset: tuple[float, float] = (0.0, 0.0)
    variation: float = 0.0

    def blend(self, colour: FloatMap, chart: Float, footprint: Float, seed: int) -> FloatMap:
        """Paint the panels over `colour` (N, 3) at chart positions (N, 2), anti-aliased."""
        period, duty = np.array(self.period), np.array(self.duty)
        grid = (chart - self.offset) / period
        share = pulse_coverage(grid, duty, footprint[:, None] / period).prod(axis=1)
        # each rectangle has one brightness; its jumps lie in the gaps between rectangles
        node = np.floor(grid + 0.5 * (1 - duty)).astype(np.int64) & (PERIOD - 1)
        tone = 1 + self.variation * _lattice(seed)[node[:, 0] + PERIOD * node[:, 1]]
        paint = np.asarray(self.colour, np.float32) * tone[:, None].astype(np.float32)
        return colour + share[:, None].astype(np.float32) * (paint - colour)


@dataclass(frozen=True)
class Texture:
    """Colour of a surface point from its material coordinates.

    Attributes:
        colours: Two RGB colours in [0, 1]; slow noise mixes them.
        cell: Size of the coarsest noise cells, unit of length.
        contrast: Strength of the fine multi-octave noise, 0 for flat colours.
        seed: Seed of the noise.
        panels: Rectangles painted over the two colours, or None.
    """

    colours: tuple[Colour, Colour]
    cell: float
    contrast: float = 0.6
    seed: int = 0
    panels: Panels | None = None

    def colour(self, points: Float, chart: Float, footprint: Float) -> FloatMap:
        """RGB (N, 3) in [0, 1) of material coordinates (N, 3) and charts (N, 2) of points."""
        slow = fractal_noise(
            points, footprint, cell=1.7 * self.cell, seed=self.seed + 1, persistence=0.6, octaves=3
        )
        first, second = np.asarray(self.colours, np.float32)
        mix = np.clip(0.5 + 0.9 * slow, 0, 1)[:, None]
        colour = first + mix * (second - first)
        if self.panels is not None:
            colour = self.panels.blend(colour, chart, footprint, self.seed)
        fine = fractal_noise(points, footprint, cell=self.cell, seed=self.seed)
        # exp keeps colours positive; the smooth limit at 1 keeps detail in bright parts
        colour = colour * np.exp(np.float32(self.contrast) * fine)[:, None]
        return colour / np.sqrt(np.sqrt(1 + colour**4))
