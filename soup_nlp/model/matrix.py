"""The constrained NLP: matrix rotations, unit normals, visibility."""

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
from soup_nlp.model.layout import MatrixLayout
from soup_nlp.model.nlp import NLP
from soup_nlp.model.superpixel import matrix_view

MIN_SCALE = 1e-4
"""Lower bound of scales and offsets."""


def build_matrix_nlp(
    soup: Soup, data: EnergyData, weights: Weights, form: Formulation
) -> tuple[NLP, MatrixLayout]:
    """The constrained NLP: matrix rotations with SO(3), unit normals, simplex, visibility.

    Args:
        soup: Start; SO(3) and unit normals should hold.
        data: Pixels, graphs and weights of the pair.
        weights: Constants of the energy.
        form: Gauge, norm, Hessian, smoothing.

    Returns:
        The NLP and the layout that turns its vectors into soups.
    """
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
