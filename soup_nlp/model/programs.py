"""The two programs of a pair: the constrained NLP in matrices, the presolve in coordinates."""

import casadi as ca
import numpy as np

from soup_nlp.arrays import Float
from soup_nlp.geometry.soup import Soup
from soup_nlp.model import terms
from soup_nlp.model.builder import Builder
from soup_nlp.model.elements import elements
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.layout import Chart, MatrixLayout, TangentLayout
from soup_nlp.model.nlp import NLP
from soup_nlp.model.superpixel import matrix_view, tangent_view

MIN_SCALE = 1e-4
"""Lower bound of scales and offsets."""

# --- the constrained NLP: matrix rotations, unit normals, visibility ------------------------------


def build_matrix_nlp(
    soup: Soup, data: EnergyData, weights: Weights, form: Formulation
) -> tuple[NLP, MatrixLayout]:
    """The constrained NLP from a soup, whose SO(3) and unit normals should hold, and the layout
    that turns its vectors into soups."""
    n = len(data)
    layout = MatrixLayout(data.share, form.gauge)
    b = Builder(form, layout, matrix_view, form.gauge)
    stride = layout.stride
    for name, element in elements(data, weights, layout).items():
        b.add_norms(name, element)
    _add_constraints(b, layout, data, form)
    x0 = layout.pack(soup)
    b.add_ridge(_metric(layout, x0, data))
    lbx, ubx = np.full(layout.size, -np.inf), np.full(layout.size, np.inf)
    lbx[np.arange(n) * stride] = MIN_SCALE
    if form.gauge == "unit-translation":
        lbx[np.arange(n) * stride + 4] = MIN_SCALE
        lbx[layout.tau] = 1e-8
    return b.finish("soup", x0, lbx, ubx), layout


def _add_constraints(b: Builder, layout: MatrixLayout, data: EnergyData, form: Formulation) -> None:
    """SO(3), unit normals, visibility, simplex, and the rows that fix the gauge."""
    n, stride = layout.count, layout.stride
    every = layout.of(np.arange(n))
    x = ca.SX.sym("x", stride)
    v = matrix_view(x, {"offset_0": ca.SX(1.0)}, 0, form.gauge)
    b.add_constraint("so3", x, terms.so3(v), every, lower=0.0, upper=0.0)
    b.add_constraint("normal", x, terms.unit_normal(v), every, lower=0.0, upper=0.0)
    count = data.rim_ray.shape[1]
    ray = ca.SX.sym("rays", 3 * count)
    b.add_constraint(
        "visible",
        x,
        terms.visibility(v, ray, count),
        every,
        lower=form.min_facing,
        upper=np.inf,
        row=ray,
        data=data.visibility_ray(form.depth_ratio).reshape(n, -1),
    )
    body = terms.simplex(v, 1 / n)
    b.add_constraint("simplex", x, body, every, lower=1.0, upper=1.0, total=True)
    if form.gauge == "unit-offset":
        return
    c, tau = ca.SX.sym("share"), ca.SX.sym("tau")
    body, share = terms.length_unit(v, c, x[4]), data.share[:, None]
    b.add_constraint("unit", x, body, every, lower=1.0, upper=1.0, row=c, data=share, total=True)
    index = np.column_stack([every, np.full(n, layout.tau)])
    body = terms.translation_length(v, tau)
    b.add_constraint("translation", ca.vertcat(x, tau), body, index, lower=0.0, upper=0.0)


def _metric(layout: MatrixLayout, x: Float, data: EnergyData) -> Float:
    """Ridge metric of the matrix variables that equals the presolve's at the start.

    A natural step is: relative 1 in scale and offset, a slope of 1 at the superpixel's rim in the
    normal, one radian in R, one anchor depth in the translation.
    """
    n, stride = layout.count, layout.stride
    a = x[: n * stride].reshape(n, stride)
    s = layout.unpack(x)
    facing = -np.einsum("nc,nc->n", s.n, data.anchor_ray)
    metric = np.ones((n, stride))
    metric[:, 0] = 1 / a[:, 0] ** 2
    metric[:, 1:4] = (1 / np.maximum(facing * data.radius, 1e-3) ** 2)[:, None]
    if layout.gauge != "unit-offset":
        metric[:, 4] = 1 / a[:, 4] ** 2
    depth = s.depth_at(data.anchor_ray)
    metric[:, -3:] = (a[:, 0] / depth)[:, None] ** 2
    return np.append(metric.ravel(), np.ones(layout.size - n * stride))


# --- the presolve: nine coordinates per superpixel, linear constraints and visibility -------------


def build_tangent_nlp(
    soup: Soup,
    data: EnergyData,
    weights: Weights,
    form: Formulation,
    chart: Chart = "depth",
    layout: TangentLayout | None = None,
) -> tuple[NLP, TangentLayout]:
    """The presolve from a soup: 9 coordinates per superpixel, linear constraints only; and the
    layout that turns its vectors into soups.

    The coordinates are about the soup. About the base of a given `layout` the program is the same
    for every start, and the simplex is exact.
    """
    n, base = len(data), layout
    layout = TangentLayout.about(soup, data, chart) if base is None else base
    chart = layout.chart
    b = Builder(form, layout, tangent_view, chart)
    for name, element in elements(data, weights, layout).items():
        b.add_norms(f"t_{name}", element)
    exact = base is not None or (not data.local_units and chart == "depth")
    _add_simplex(b, soup, layout, slanted=exact)
    # visibility as in the constrained NLP, divided by the anchor's facing 1 / |m| and in chart
    # "inverse-depth" multiplied by rho: the same set, so that one's solution is the other's
    count = data.rim_ray.shape[1] - 1
    off = (data.rim_ray[:, 1:] - data.rim_ray[:, :1])[..., :2] / layout.radius[:, None, None]
    plane, offsets = ca.SX.sym("plane", 2 + (chart != "depth")), ca.SX.sym("off", 2 * count)
    rho, slope = (ca.SX(1), plane) if chart == "depth" else (plane[0], plane[1:])
    ray, reach = ca.SX.sym("ray", 2), ca.SX.sym("radius")
    facing = ca.norm_2(ca.vertcat(slope / reach, rho - ca.dot(slope, ray) / reach))
    b.add_constraint(
        "t_visible",
        plane,
        ca.vertcat(*[ca.dot(slope, offsets[2 * j : 2 * j + 2]) for j in range(count)])
        + (1 - 1 / form.depth_ratio) * rho
        - form.min_facing * facing,
        np.arange(n)[:, None] * 9 + np.arange(3 - plane.numel(), 3),
        lower=0.0,
        upper=np.inf,
        row=ca.vertcat(offsets, ray, reach),
        data=np.column_stack([off.reshape(n, -1), layout.anchor[:, :2], layout.radius]),
    )
    b.add_ridge(np.ones(9 * n))
    lower, upper = np.full((n, 9), -np.inf), np.full((n, 9), np.inf)
    lower[:, 0] = 1e-3
    # wide: visibility bounds the slopes, as in the constrained NLP, which has no such box
    lower[:, 1:3], upper[:, 1:3] = -20 * form.depth_ratio, 20 * form.depth_ratio
    x0 = _visible(layout.pack(soup), off, form.depth_ratio, chart)
    return b.finish("presolve", x0, lower.ravel(), upper.ravel()), layout


def majorant(form: Formulation) -> Formulation:
    """Reweighted least squares: theta = 0 and no ridge, sum c psi / s J^T J."""
    return form.replace(hessian="gauss-newton+constraints", theta=0.0, ridge=0.0)


def exact_chart(data: EnergyData) -> Chart:
    """Chart for the exact Hessian.

    On inverse depths the superpixels of a plane move with it in straight lines; reweighting on
    depths ends at lower energies. The paper's units need a length unit that is linear.
    """
    return "inverse-depth" if data.local_units else "depth"


def _add_simplex(b: Builder, soup: Soup, layout: TangentLayout, slanted: bool) -> None:
    """The length unit as one row.

    In pixels the energy does not depend on it: the slopes are held, the row is linear in chart
    "depth", and the constrained NLP, which has it exactly, starts from the normalised answer. In
    the paper's units a plane that slants is nearer at the same depth (`slanted`), so that with held
    slopes all of them would slant to lengthen the unit.
    """
    lam, part = ca.SX.sym("lam"), ca.SX.sym("share")
    x, row = lam, part
    depth = layout.chart == "depth"
    value = part * lam if depth else part / lam
    data = soup.normalised(layout.share).lam[:, None]
    if slanted:
        s, ray, reach = ca.SX.sym("slope", 2), ca.SX.sym("ray", 2), ca.SX.sym("radius")
        m = ca.vertcat(s / reach, (1 if depth else lam) - ca.dot(s, ray) / reach)
        x, row = ca.vertcat(lam, s), ca.vertcat(part, ray, reach)
        value = part * (lam if depth else 1) / ca.norm_2(m)
        constants = layout.share * layout.depth, layout.anchor[:, :2], layout.radius
        data = np.column_stack(constants)
    index = np.arange(layout.count)[:, None] * 9 + np.arange(x.numel())
    b.add_constraint(
        "t_simplex", x, value, index, lower=1.0, upper=1.0, row=row, data=data, total=True
    )


def _visible(x: Float, off: Float, depth_ratio: float, chart: Chart) -> Float:
    """Shrink the slopes of a presolve vector until every rim pixel is visible."""
    x = x.reshape(-1, 9).copy()
    rho = np.ones(len(x)) if chart == "depth" else x[:, 0]
    least = np.einsum("nc,nvc->nv", x[:, 1:3], off).min(axis=1)
    limit = 0.95 * (1 / depth_ratio - 1) * rho
    x[:, 1:3] *= np.minimum(1.0, limit / np.minimum(least, limit))[:, None]
    return x.ravel()
