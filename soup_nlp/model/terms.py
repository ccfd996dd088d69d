"""The whole nonlinear program in symbols, in the paper's order: every term and every constraint.

    min   E_arap + a1 E_proj + a2 E_cont + a3 E_orient   (+ a4 E_prior + a5 E_depth + E_order)
    s.t.  R_i in SO(3),   |n_i| = 1,   sum_i lam_i = 1, lam_i > 0,   planes that face the camera

Each function is one element: an edge (a, b) of the K-NN graph, a sampled pixel, a pair (a, b) of
neighbours, or a superpixel a. A term takes the views of its superpixels and its row of data, and
returns norms; "eps" and, of pixels of the next frame, "eps_pixel" in the row are their smoothing
widths. E is the sum of `weight * ((1 - leak) min(|vector|, sigma) + leak |vector|)` over all of
them. A row without "sigma" has no truncation; with "pixel", the size of a pixel, lengths are in
the paper's unit instead of pixels. `elements` has the rows, `oracle` the same energy in numpy.
"""

from collections.abc import Mapping, Sequence

import casadi as ca

from soup_nlp.model.energy_data import HINGE
from soup_nlp.model.norms import Norm
from soup_nlp.model.superpixel import View

Row = Mapping[str, ca.SX]

# --- the energy, equation 7 ----------------------------------------------------------------------


def arap(a: View, b: View, row: Row, at_anchors: bool) -> list[Norm]:
    """E_arap of an edge, Eq. 1: rotation, translation and distance of the anchors."""
    Xa, Xb = a.anchor(row["ray_i"]), b.anchor(row["ray_k"])
    unit, length_eps, angle_eps = row["unit"], row["eps"], row["eps"]
    if "pixel" in row:
        length_eps, angle_eps = row["eps"] * row["pixel"], row["eps"] * row["angle"]
    else:
        unit = unit / _nearness(Xa, Xb)
    rotation = row["turn"] * ca.vec(a.turn_from(b))
    translation = a.drift_from(b)
    if at_anchors:
        translation = translation + a.turn_from(b) @ ((Xa + Xb) / 2)
    lengths = translation / unit, a.stretch(Xa, b, Xb) / unit
    weight, cut = row["weight"], {"sigma": row.get("sigma"), "leak": row["leak"]}
    return [
        Norm(weight, rotation, angle_eps, **cut),
        *(Norm(weight, length, length_eps, **cut) for length in lengths),
    ]


def reprojection(a: View, row: Row, places: Sequence[tuple[int, int]]) -> list[Norm]:
    """E_proj of one pixel, Eq. 3: distance of homography and flow target, pixels.

    `places` is where the first two rows of the next frame's intrinsics are not 0, column by column;
    "K" their values.
    """
    y = a.transfer(row["ray"])
    K = ca.SX(ca.Sparsity.triplet(2, 3, *map(list, zip(*places))), row["K"])
    error = K @ (y / y[2]) - row["target"]
    return [Norm(row["weight"], error, row["eps_pixel"], row.get("sigma"))]


def continuity(a: View, b: View, row: Row) -> list[Norm]:
    """E_cont of a neighbour pair, Eq. 4: boundary gaps in both frames."""
    points = [(a.point(ray), b.point(ray)) for ray in ca.vertsplit(row["rays"], 3)]
    before = ca.vertcat(*(Xa - Xb for Xa, Xb in points))
    after = ca.vertcat(*(a.next_gap(Xa, b, Xb) for Xa, Xb in points))
    f, eps = row["factor"], row["eps"]
    if "pixel" in row:
        eps = eps * row["pixel"]
    else:
        f = f * _nearness(a.anchor(row["ray_i"]), b.anchor(row["ray_k"]))
    return [
        Norm(row["weight"], f * before, eps, row.get("sigma_ref")),
        Norm(row["weight"], f * after, eps, row.get("sigma")),
    ]


def orientation(a: View, b: View, row: Row) -> list[Norm]:
    """E_orient of a neighbour pair, Eq. 6.

    `1 - n_i . n_k = |n_i - n_k|^2 / 2` on the unit sphere; the square is convex off it too. A given
    difference `row["turn"]` costs nothing.
    """
    turn = a.n - b.n - row["turn"] if "turn" in row else a.n - b.n
    return [Norm(row["weight"], turn, row["eps"], row.get("sigma"), kind="half_square")]


def prior(a: View, b: View, row: Row) -> list[Norm]:
    """E_prior of an edge: slope of the inverse depth between two anchors, relative to it.

    A given difference `row["relief"]` costs nothing.
    """
    Xa, Xb = a.anchor(row["ray_i"]), b.anchor(row["ray_k"])
    change = (1 / Xa[2] - 1 / Xb[2]) / _nearness(Xa, Xb)
    change = change - row["relief"] if "relief" in row else change
    return [Norm(row["weight"], change / row["reach"], row["eps"])]


def depth(a: View, b: View, row: Row) -> list[Norm]:
    """E_depth of an edge: difference of the anchors' log depths from that of a depth prior."""
    Za, Zb = a.anchor(row["ray_i"])[2], b.anchor(row["ray_k"])[2]
    return [Norm(row["weight"], ca.log(Za / Zb) - row["change"], row["eps"])]


def order(a: View, b: View, row: Row) -> list[Norm]:
    """E_order of a neighbour pair whose second superpixel, b, covers the first, a.

    It is a smooth hinge on the amount by which the inverse depth of b on their boundary is below
    `1 + step` times that of a, relative to the inverse depth of the anchors.
    """
    near = _nearness(a.anchor(row["ray_i"]), b.anchor(row["ray_k"]))
    behind, front = 1 / a.point(row["ray"])[2], 1 / b.point(row["ray"])[2]
    lack = ((1 + row["step"]) * behind - front) / near
    return [Norm(row["weight"], (lack + ca.sqrt(lack**2 + HINGE**2)) / 2, row["eps"])]


def _nearness(Xa: ca.SX, Xb: ca.SX) -> ca.SX:
    """Power mean of the inverse depths of two points, close to that of the nearer point."""
    a, b = 1 / (Xa[2] * Xa[2]), 1 / (Xb[2] * Xb[2])
    return ca.sqrt(ca.sqrt((a * a + b * b) / 2))


# --- the constraints of equation 7, and visibility -----------------------------------------------


def so3(a: View) -> ca.SX:
    """(6x1) upper triangle of `R^T R - I` = 0; det R = 1 holds at the start (a row breaks LICQ)."""
    gram = a.R.T @ a.R
    return ca.vertcat(*[gram[r, c] - (1 if r == c else 0) for c in range(3) for r in range(c + 1)])


def unit_normal(a: View) -> ca.SX:
    """(1x1) `|n|^2 - 1` = 0."""
    return ca.sumsqr(a.n) - 1


def simplex(a: View, share: ca.SX | float) -> ca.SX:
    """(1x1) `share * lam`, which adds up to 1 over all superpixels."""
    return share * a.lam


def visibility(a: View, rays: ca.SX, count: int) -> ca.SX:
    """(count x 1) `-n . r` at the anchor and rim rays, at least c > 0."""
    return ca.vertcat(*[-ca.dot(a.n, rays[3 * j : 3 * j + 3]) for j in range(count)])


# --- what fixes the gauge of (lam, d, t) where d is a variable -----------------------------------


def length_unit(a: View, share: ca.SX, offset: ca.SX) -> ca.SX:
    """(1x1) `share * lam d`, which adds up to 1: the mean distance of the planes."""
    return share * a.lam * offset


def translation_length(a: View, tau: ca.SX) -> ca.SX:
    """(1x1) `|t|^2 - tau^2` = 0: all translations of unit scale are equally long."""
    return ca.sumsqr(a.t) - tau**2
