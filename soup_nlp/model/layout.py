"""Positions of the soup's variables in the solver's vector: packing, unpacking, names."""

from dataclasses import dataclass
from typing import ClassVar, Literal, Self, get_args

import numpy as np

from soup_nlp.arrays import Float, Int
from soup_nlp.geometry import rotation
from soup_nlp.geometry.plane import about_anchor, at_anchor, inverse_depth, normal_and_distance
from soup_nlp.geometry.soup import Soup
from soup_nlp.model.energy_data import EnergyData

Gauge = Literal["unit-offset", "unit-translation"]
GAUGES: tuple[Gauge, ...] = get_args(Gauge)
Chart = Literal["depth", "inverse-depth"]


@dataclass(frozen=True)
class MatrixLayout:
    """Variables of the constrained NLP.

    Per superpixel, contiguous: scale `N lam`, normal, offset `d / N` (not in gauge
    "unit-offset", where it is a constant), R by columns, translation `t / N`. Gauge
    "unit-translation" has one more variable at the end, the common length tau of all translations:
    the length unit stays sum_i c_i D_i = 1, with the weights c `share` (N,), so that the gauges
    describe one and the same problem.
    """

    share: Float
    gauge: Gauge

    @property
    def count(self) -> int:
        """Superpixels."""
        return len(self.share)

    @property
    def offset(self) -> Float:
        """(N,) d / N of gauge "unit-offset"."""
        return 1.0 / (self.count * self.share)

    @property
    def stride(self) -> int:
        """Variables per superpixel."""
        return 16 if self.gauge == "unit-offset" else 17

    @property
    def size(self) -> int:
        """Length of a vector."""
        return self.tau + (self.gauge == "unit-translation")

    @property
    def tau(self) -> int:
        """Index of tau (gauge "unit-translation")."""
        return self.count * self.stride

    def of(self, superpixel: Int) -> Int:
        """(E, stride) variable indices of superpixels (E,)."""
        return superpixel[:, None] * self.stride + np.arange(self.stride)

    def columns(self, superpixel: Int) -> dict[str, Float]:
        """Constants (E, ...) that the views of superpixels (E,) need."""
        return {"offset": self.offset[superpixel]}

    def pack(self, soup: Soup) -> Float:
        """Solver vector (size,) of a soup, brought to this gauge and length unit."""
        s = soup.normalised(self.share)
        T, R = s.translation, s.R.transpose(0, 2, 1).reshape(-1, 9)
        if self.gauge == "unit-offset":
            lam = self.count * s.lam
            return np.column_stack([lam, s.n, R, T / lam[:, None]]).ravel()
        length = np.linalg.norm(T, axis=1)
        # a superpixel at rest has no direction in this gauge: give it a tiny one
        floor = 1e-3 * max(float(np.median(length)), 1e-6)
        T = np.where((length < floor)[:, None], T + np.array([floor, 0.0, 0.0]), T)
        length = np.linalg.norm(T, axis=1)
        tau = float(length.mean())
        lam = length / tau
        x = np.column_stack([lam, s.n, s.distance / lam, R, T / lam[:, None]])
        return np.append(x.ravel(), tau)

    def unpack(self, x: Float) -> Soup:
        """Soup of a solver vector, sum(lam) as the vector has it (1 at a feasible point)."""
        n = self.count
        a = np.asarray(x, float)[: n * self.stride].reshape(n, self.stride)
        d = self.offset if self.gauge == "unit-offset" else a[:, 4]
        R = a[:, -12:-3].reshape(-1, 3, 3).transpose(0, 2, 1)
        return Soup(a[:, 0] / n, a[:, 1:4].copy(), d * n, R, a[:, -3:] * n)

    def names(self) -> list[str]:
        """Readable names in order: `lam[17]`, `n[17,2]`, `R[17,2,1]` (row, column from 1)."""
        own, more = ([], []) if self.gauge == "unit-offset" else (["d[{i}]"], ["tau"])
        axes = (1, 2, 3)
        labels = ["lam[{i}]", *(f"n[{{i}},{c}]" for c in axes), *own]
        labels += [f"R[{{i}},{r},{c}]" for c in axes for r in axes]
        labels += [f"t[{{i}},{c}]" for c in axes]
        return [s.format(i=i) for i in range(self.count) for s in labels] + more


@dataclass(frozen=True)
class TangentLayout:
    """Variables of the presolve about a base soup: `lam s w q` per superpixel (`tangent_view`).

    Chart "inverse-depth" has `rho = 1 / lam` and `rho s` in the place of scale and slopes: the
    inverse-depth plane itself. Superpixels on one plane stay on one plane along a straight line, so
    that E_cont does not limit steps that move them together. In "depth" the length unit is linear.

    Attributes:
        anchor: (N, 3) anchor rays.
        radius: (N,) reach of every superpixel, ray units.
        share: (N,) weights c of the length unit.
        depth: (N,) Z0, depth of the anchors in the base, in that unit.
        R0: (N, 3, 3) base rotations.
        t0: (N, 3) base translations / Z0.
        chart: "depth" or "inverse-depth".
    """

    anchor: Float
    radius: Float
    share: Float
    depth: Float
    R0: Float
    t0: Float
    chart: Chart = "depth"
    stride: ClassVar[int] = 9
    """Variables per superpixel."""

    @classmethod
    def about(cls, soup: Soup, data: EnergyData, chart: Chart = "depth") -> Self:
        """Layout whose base is the soup, its rotations made exactly orthogonal."""
        s = soup.normalised(data.share)
        depth = s.depth_at(data.anchor_ray)
        R0, t0 = rotation.nearest(soup.R), s.translation / depth[:, None]
        return cls(data.anchor_ray, data.radius, data.share, depth, R0, t0, chart)

    @property
    def count(self) -> int:
        """Superpixels."""
        return len(self.radius)

    def of(self, superpixel: Int) -> Int:
        """(E, 9) variable indices of superpixels (E,)."""
        return superpixel[:, None] * 9 + np.arange(9)

    def columns(self, superpixel: Int) -> dict[str, Float]:
        """Constants (E, ...) that the views of superpixels (E,) need; R0 by columns."""
        i = superpixel
        R0 = self.R0[i].transpose(0, 2, 1).reshape(-1, 9)
        constants = {"anchor": self.anchor[i], "radius": self.radius[i], "depth": self.depth[i]}
        return {**constants, "R0": R0, "t0": self.t0[i]}

    def pack(self, soup: Soup) -> Float:
        """Vector (9 N,) of a soup in this length unit; slopes are not clipped here."""
        s = soup.normalised(self.share)
        depth, g = at_anchor(inverse_depth(s.n, s.distance), self.anchor)
        slope = g * self.radius[:, None]
        turn = np.swapaxes(self.R0, 1, 2) @ s.R
        w = rotation.log(turn)
        angle = np.linalg.norm(w, axis=1, keepdims=True)
        # Cayley vector of the same rotation: 2 tan(angle / 2) along the axis
        w = w * np.where(angle > 1e-12, 2 * np.tan(angle / 2) / np.maximum(angle, 1e-12), 1.0)
        q = s.translation / depth[:, None] - self.t0
        q += np.einsum("nij,nj->ni", s.R - self.R0, self.anchor)
        a = np.column_stack([depth / self.depth, slope, w, q])
        return (_turned(a) if self.chart == "inverse-depth" else a).ravel()

    def unpack(self, x: Float) -> Soup:
        """Feasible soup (SO(3), unit normals, simplex) of a vector."""
        a = np.asarray(x, float).reshape(-1, 9)
        a = _turned(a) if self.chart == "inverse-depth" else a
        depth = a[:, 0] * self.depth
        m = about_anchor(depth, a[:, 1:3] / self.radius[:, None], self.anchor)
        n, D = normal_and_distance(m)
        R = rotation.nearest(self.R0 @ rotation.cayley(a[:, 3:6]))
        t = self.t0 + (a[:, 6:9] - np.einsum("nij,nj->ni", R - self.R0, self.anchor))
        T = depth[:, None] * t
        raw = Soup(D, n, np.ones(len(D)), R, T / D[:, None])
        return raw.normalised(self.share)

    def names(self) -> list[str]:
        """Readable names in order."""
        plane = ["lam", "s1", "s2"] if self.chart == "depth" else ["rho", "g1", "g2"]
        labels = [*plane, "w1", "w2", "w3", "q1", "q2", "q3"]
        return [f"{s}[{i}]" for i in range(self.count) for s in labels]


Layout = MatrixLayout | TangentLayout


def _turned(a: Float) -> Float:
    """(N, 9) variables of the other chart; the map is its own inverse."""
    return np.column_stack([1 / a[:, 0], a[:, 1:3] / a[:, :1], a[:, 3:]])
