"""The constrained NLP, which is the product: matrix rotations, unit normals, visibility."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from soup_nlp.errors import ModelError
from soup_nlp.geometry.soup import Soup
from soup_nlp.model import terms
from soup_nlp.model.builder import Builder
from soup_nlp.model.elements import elements
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.layout import GAUGES, MatrixLayout
from soup_nlp.model.nlp import NLP
from soup_nlp.model.superpixel import View, matrix_view

Float = NDArray[np.float64]

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
        form: Gauge, norm, truncation, Hessian, smoothing.

    Returns:
        The NLP and the layout that turns its vectors into soups.

    Raises:
        ModelError: unknown gauge.
    """
    if form.gauge not in GAUGES:
        raise ModelError("unknown gauge", found=form.gauge, expected=", ".join(GAUGES))
    n = len(data)
    layout = MatrixLayout(data.share, form.gauge)
    b = Builder(form, layout.size)
    own = layout.stride

    def view(x: ca.SX, row: dict[str, ca.SX], position: int) -> View:
        return matrix_view(x, form.gauge, row[f"offset_{position}"])

    for name, element in elements(data, weights, layout).items():
        b.add_norms(name, element.placed(layout), view, own)

    every = layout.of(np.arange(n))
    x = ca.SX.sym("x", own)
    none, empty = ca.SX.sym("none", 0), np.zeros((n, 0))
    v = matrix_view(x, form.gauge, ca.SX(1.0))
    rows = b.new_rows("so3", 6 * n, 0.0, 0.0).reshape(n, 6)
    b.add_constraint("so3", x, none, terms.so3(v), every, empty, rows)
    rows = b.new_rows("normal", n, 0.0, 0.0)[:, None]
    b.add_constraint("normal", x, none, terms.unit_normal(v), every, empty, rows)
    count = data.rim_ray.shape[1]
    ray = ca.SX.sym("rays", 3 * count)
    rows = b.new_rows("visible", count * n, form.min_facing, np.inf).reshape(n, count)
    b.add_constraint(
        "visible",
        x,
        ray,
        terms.visibility(v, ray, count),
        every,
        data.visibility_ray(form.depth_ratio).reshape(n, -1),
        rows,
    )
    row = np.tile(b.new_rows("simplex", 1, 1.0, 1.0), (n, 1))
    b.add_constraint("simplex", x, none, v.lam / n, every, empty, row)
    if form.gauge != "unit-offset":
        # the length unit: sum_i c_i D_i = 1 (in gauge unit-offset the simplex says it)
        row = np.tile(b.new_rows("unit", 1, 1.0, 1.0), (n, 1))
        c = ca.SX.sym("share")
        b.add_constraint("unit", x, c, c * v.lam * x[4], every, data.share[:, None], row)
    if form.gauge == "unit-translation":
        tau = ca.SX.sym("tau")
        both = ca.vertcat(x, tau)
        index = np.column_stack([every, np.full(n, layout.tau)])
        rows = b.new_rows("translation", n, 0.0, 0.0)[:, None]
        b.add_constraint("translation", both, none, ca.sumsqr(v.t) - tau**2, index, empty, rows)
    b.add_ridge(_metric(layout, layout.pack(soup), data))

    lbx, ubx = np.full(b.nx, -np.inf), np.full(b.nx, np.inf)
    lbx[np.arange(n) * own] = MIN_SCALE
    if form.gauge != "unit-offset":
        lbx[np.arange(n) * own + 4] = MIN_SCALE
    if form.gauge == "unit-translation":
        lbx[layout.tau] = 1e-8
    x0 = np.concatenate([layout.pack(soup), np.zeros(b.nx - layout.size)])
    return b.finish("soup", x0, lbx, ubx, layout.size, layout.names), layout


def _metric(layout: MatrixLayout, x: Float, data: EnergyData) -> Float:
    """Ridge metric of the matrix variables that equals the presolve's at the start.

    A natural step is: relative 1 in scale and offset, a slope of 1 at the superpixel's rim in the
    normal, one radian in R, one anchor depth in the translation.
    """
    n, own = layout.count, layout.stride
    a = x[: n * own].reshape(n, own)
    s = layout.unpack(x)
    facing = -np.einsum("nc,nc->n", s.n, data.anchor_ray)
    metric = np.ones((n, own))
    metric[:, 0] = 1 / a[:, 0] ** 2
    metric[:, 1:4] = (1 / np.maximum(facing * data.radius, 1e-3) ** 2)[:, None]
    if layout.gauge != "unit-offset":
        metric[:, 4] = 1 / a[:, 4] ** 2
    depth = s.depth_at(data.anchor_ray)
    metric[:, -3:] = (a[:, 0] / depth)[:, None] ** 2
    return np.append(metric.ravel(), np.ones(layout.size - n * own))
