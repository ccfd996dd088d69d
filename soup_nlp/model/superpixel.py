"""A superpixel in symbols: the same expressions for every choice of variables.

The energy terms are written once against `View`; a parametrisation (matrix rotations in one of
two gauges, or tangent coordinates about a base) says how its variables make one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import casadi as ca


@dataclass(frozen=True)
class View:
    """Symbolic superpixel.

    Attributes:
        lam: Scale (1x1): reference point of ray r is `lam r / (m . r)`.
        m: (3x1) inverse-depth plane of unit scale, `m = -n / d`.
        n: (3x1) unit normal that faces the camera.
        turn: (3x3) what variables add to the rotation.
        t: (3x1) translation of unit scale: `X' = R X + lam t`.
        drift: (3x1) what variables add to the translation `lam t`.
        R0, T0: (3x3), (3x1) the rest of rotation and translation, constant; nothing, unless a view
            has a base.
        depth: (1x1) depth of the anchor where it is a variable: `lam / (m . r)` is the same there,
            but its Hessian does not know that slopes leave it as it is. None elsewhere.
    """

    lam: ca.SX
    m: ca.SX
    n: ca.SX
    turn: ca.SX
    t: ca.SX
    drift: ca.SX
    R0: ca.SX = field(default_factory=lambda: ca.SX(3, 3))
    T0: ca.SX = field(default_factory=lambda: ca.SX(3, 1))
    depth: ca.SX | None = None

    @property
    def R(self) -> ca.SX:
        """(3x3) rotation."""
        return self.R0 + self.turn

    def turn_from(self, other: View) -> ca.SX:
        """(3x3) difference of two rotations: small numbers are subtracted, not those near 1."""
        return (self.R0 - other.R0) + (self.turn - other.turn)

    def drift_from(self, other: View) -> ca.SX:
        """(3x1) difference of two translations `lam t`, likewise."""
        return (self.T0 - other.T0) + (self.drift - other.drift)

    def point(self, ray: ca.SX) -> ca.SX:
        """Reference-frame point (3x1) of a ray (3x1)."""
        return self.lam / ca.dot(self.m, ray) * ray

    def anchor(self, ray: ca.SX) -> ca.SX:
        """`point` of the anchor's own ray."""
        return self.point(ray) if self.depth is None else self.depth * ray

    def next_gap(self, X: ca.SX, other: View, Y: ca.SX) -> ca.SX:
        """Difference of the next-frame points `R X + lam t` of X and, by another view, of Y: a sum
        of small differences."""
        return self._turned_gap(self.R, X, other, Y)

    def stretch(self, X: ca.SX, other: View, Y: ca.SX) -> ca.SX:
        """`|X - Y|` less the distance of their next-frame points, see `next_gap`."""
        # from the small difference of both vectors: of lengths of what is far away, rounding held
        # the dual infeasibility at 1e-5
        gap = X - Y
        change = self._turned_gap((self.R0 - ca.DM.eye(3)) + self.turn, X, other, Y)
        # |X - Y| is smooth wherever two anchors differ, so it needs no smoothing of its own
        lengths = [ca.sqrt(ca.sumsqr(v) + 1e-12) for v in (gap, gap + change)]
        return -ca.dot(change, 2 * gap + change) / (lengths[0] + lengths[1])

    def _turned_gap(self, turn: ca.SX, X: ca.SX, other: View, Y: ca.SX) -> ca.SX:
        return turn @ (X - Y) + self.turn_from(other) @ Y + self.drift_from(other)

    def transfer(self, ray: ca.SX) -> ca.SX:
        """Next-frame ray (3x1, free length) of a reference ray: the homography without K."""
        return self.R @ ray + self.t * ca.dot(self.m, ray)


def matrix_view(x: ca.SX, row: Mapping[str, ca.SX], position: int, gauge: str) -> View:
    """View of the constrained NLP's variables of one superpixel, at its position in an element.

    Args:
        x: (16x1) `lam n R t` for gauge "unit-offset", else (17x1) `lam n d R t`; R by
            columns; lam, d and t scaled by N, 1/N and 1/N so that numbers are near 1.
        row: The data row of the element: "offset_0" and so on are d in gauge "unit-offset".
    """
    lam, n, R, t = x[0], x[1:4], x[-12:-3], x[-3:]
    d = row[f"offset_{position}"] if gauge == "unit-offset" else x[4]
    return View(lam=lam, m=-n / d, n=n, turn=ca.reshape(R, 3, 3), t=t, drift=lam * t)


def tangent_view(x: ca.SX, row: Mapping[str, ca.SX], position: int, chart: str) -> View:
    """View of the presolve's variables of one superpixel, at its position in an element.

    `1 / Z(r) = (1 + s . (r - r_a) / h) / Z`, Z = lam Z0 the depth of the anchor; rotation
    `R = R0 Cayley(w)` about the anchor: `X' = R (X - Z r_a) + Z (q0 + q)`, `q0 = R0 r_a + t0`. A
    rotation about the camera centre would move the superpixel across the image, and the translation
    could undo that to first order only. Turn and shift are counted from the base: with differences
    of numbers near 1, rounding alone would hold the dual infeasibility near 1e-7.

    Args:
        x: (9x1) `lam s w q`: relative scale, slopes (2), rotation (3), shift of the moved anchor
            / Z (3); chart "inverse-depth" has `rho = 1 / lam` and `rho s`.
        row: The data row of the element: "anchor_0" and so on are (3x1) anchor rays r_a, "radius_0"
            h in ray units, "depth_0" the depths Z0 of the anchors in the base, "R0_0" (9x1) the
            base's rotations by columns, "t0_0" (3x1) its translations / Z0.
    """
    anchor, radius, depth, R0, t0 = (
        row[f"{k}_{position}"] for k in ("anchor", "radius", "depth", "R0", "t0")
    )
    lam, s, w, q = x[0], x[1:3], x[3:6], x[6:9]
    if chart == "inverse-depth":
        lam, s = 1 / lam, s / lam
    m = ca.vertcat(s / radius, 1 - ca.dot(s, anchor[0:2]) / radius)
    h = w / 2
    W = ca.skew(h)
    base = ca.reshape(R0, 3, 3)
    turn = base @ ((2 / (1 + ca.dot(h, h))) * (W + W @ W))
    shift = q - turn @ anchor
    return View(
        lam=lam * depth,
        m=m,
        n=-m / ca.norm_2(m),
        turn=turn,
        t=t0 + shift,
        drift=depth * ((lam - 1) * t0 + lam * shift),
        R0=base,
        T0=depth * t0,
        depth=lam * depth,
    )
