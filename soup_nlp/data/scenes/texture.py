"""Procedural textures: seeded solid noise, band-limited to the size of a pixel.

A texture is a function of the material coordinates of a body and moves with it. The two frames of a
rendered pair therefore have the same colours at corresponding points (brightness constancy), up to
the sampling by pixels.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from soup_nlp.arrays import Float, FloatMap, Int

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
    """Smooth solid noise (N,) in [-1, 1] at positions (N, 3) in cells, of period `PERIOD`.

    Quintic interpolation of random values on the integer lattice.
    """
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

    Args:
        points: (N, 3) positions in the unit of length.
        footprint: (N,) size of a pixel on the surface, same unit.
        cell: Cell size of the coarsest octave, same unit.
        seed: Seed of the noise.
        persistence: Amplitude of an octave relative to the next coarser one.
        octaves: Largest number of octaves; with five the standard deviation is about 0.4.
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


def pulse_coverage(x: Float, duty: float, width: Float) -> Float:
    """Box-filtered pulse train: share (N,) of [x - width/2, x + width/2] where frac(x) < duty."""
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
        grid = (chart - np.asarray(self.offset)) / np.asarray(self.period)
        width = footprint[:, None] / np.asarray(self.period)
        share = pulse_coverage(grid[:, 0], self.duty[0], width[:, 0])
        share = share * pulse_coverage(grid[:, 1], self.duty[1], width[:, 1])
        # each rectangle has one brightness; its jumps lie in the gaps between rectangles
        node = np.floor(grid + 0.5 * (1 - np.asarray(self.duty))).astype(np.int64) & (PERIOD - 1)
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
