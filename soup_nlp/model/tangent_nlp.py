"""The tangent presolve: nine coordinates per superpixel, linear constraints and visibility."""

import casadi as ca
import numpy as np

from soup_nlp.arrays import Float
from soup_nlp.geometry.soup import Soup
from soup_nlp.model.builder import Builder
from soup_nlp.model.elements import elements
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.layout import Chart, TangentLayout
from soup_nlp.model.nlp import NLP
from soup_nlp.model.superpixel import tangent_view


def build_tangent_nlp(
    soup: Soup,
    data: EnergyData,
    weights: Weights,
    form: Formulation,
    chart: Chart = "depth",
    layout: TangentLayout | None = None,
) -> tuple[NLP, TangentLayout]:
    """The presolve: 9 coordinates per superpixel about the soup, linear constraints only.

    Args:
        soup: Start.
        data: Pixels, graphs and weights of the pair.
        weights: Constants of the energy.
        form: Smoothing and Hessian; gauge is not used.
        chart: See TangentLayout.
        layout: Base; default one about the start. With a base of its own the program is the same
            for every start, and the simplex is exact.

    Returns:
        The NLP and the layout that turns its vectors into soups.
    """
    n = len(data)
    base = layout
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
    return form.replace(norm="smooth", hessian="gauss-newton+constraints", theta=0.0, ridge=0.0)


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
