"""Curvature, slack variables, ridge and coordinates of the programs."""

from __future__ import annotations

from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from helpers_formulation import form, tiny
from helpers_model import GAUGES, hessian, value, weights_for, wiggle

from soup_nlp.model.formulation import Formulation
from soup_nlp.model.layout import TangentLayout
from soup_nlp.model.norms import Norm, smooth_min, solver_form
from soup_nlp.model.reweighting import across_components, across_discontinuities
from soup_nlp.model.sums import Sums
from soup_nlp.model.tangent_nlp import build_tangent_nlp
from soup_nlp.solve.stages import _near


@pytest.mark.parametrize("lifted", [False, True])
def test_curvature_near_a_truncation_is_kept_along_the_residual(lifted):
    x, z, theta = ca.SX.sym("x", 2), ca.SX.sym("z"), 0.9
    norm = Norm("cut", ca.SX(1.0), x, ca.SX(0.1), sigma=ca.SX(0.5))
    made = solver_form(norm, x, ca.SX(theta), None, z if lifted else None)
    at = np.array([0.4, 0.3])
    found = np.asarray(ca.Function("c", [x, z], [made.curvature])(at, 1.0))
    root = np.sqrt(at @ at + 0.01)
    slope = float(ca.evalf(smooth_min(ca.SX(root - 0.1), ca.SX(0.5), ca.SX(0.15))[1]))
    assert 0.3 < slope < 0.8
    share, factor = (theta, 1.0) if lifted else (theta * slope**2, slope)
    expected = factor / root * (np.eye(2) - share * np.outer(at, at) / root**2)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize("truncation", ["smooth", "lifted"])
def test_slack_variables_start_at_the_norms(truncation):
    """s = sqrt(|v|^2 + eps^2): every row of the epigraph form is then 0."""
    problem = tiny("pixels")
    options = form(norm="epigraph", truncation=truncation)
    nlp, _ = problem.nlp(weights_for("pixels"), options)
    g, names = value(nlp, nlp.x0)[1], nlp.g_names()
    rows = [k for k, name in enumerate(names) if name.startswith("epigraph")]
    slacks = [k for k, name in enumerate(nlp.x_names()) if name.startswith("s_")]
    assert len(rows) == len(slacks) > 100
    scale = float(np.square(nlp.x0[slacks]).max())
    np.testing.assert_allclose(g[rows], 0, atol=1e-12 * scale)


@pytest.mark.parametrize("gauge", GAUGES)
def test_the_ridge_is_its_factor_times_a_natural_step(gauge):
    """Relative 1 in scale and offset, one radian in R, one anchor depth in the translation."""
    problem, found = tiny("pixels"), {}
    for ridge in (0.0, 0.5):
        options = form(gauge=gauge, hessian="gauss-newton", ridge=ridge)
        nlp, layout = problem.nlp(weights_for("pixels"), options)
        x = wiggle(nlp, layout.size, 1, 0.01)
        found[ridge] = hessian(nlp, x, 1.0, np.zeros(nlp.ng))
    metric = np.diag(found[0.5] - found[0.0])[: layout.count * layout.stride] / 0.5
    metric = metric.reshape(layout.count, layout.stride)
    own = nlp.x0[: layout.count * layout.stride].reshape(metric.shape)
    close = {"rtol": 1e-6}
    np.testing.assert_allclose(metric[:, 0] * own[:, 0] ** 2, 1, **close)
    np.testing.assert_allclose(metric[:, -12:-3], 1, **close)
    depth = layout.unpack(nlp.x0).depth_at(problem.data.anchor_ray)
    step = depth / own[:, 0]
    np.testing.assert_allclose(metric[:, -3:] * step[:, None] ** 2, 1, **close)


def test_the_presolve_starts_feasible_on_inverse_depth_too():
    problem = tiny("pixels")
    own = problem.soup, problem.data, weights_for("pixels"), form()
    nlp, layout = build_tangent_nlp(*own, chart="inverse-depth")
    assert nlp.x_names()[:3] == layout.names()[:3] == ["rho[0]", "g1[0]", "g2[0]"]
    # away from the base of the chart, where rho is 1 and 1 / rho too
    x = nlp.x0.copy()
    x[::9] *= np.linspace(0.8, 1.25, layout.count)
    row = nlp.g_names().index("simplex[0]")
    share = problem.soup.normalised(layout.share).lam
    assert value(nlp, x)[1][row] == pytest.approx((share / x[::9]).sum(), rel=1e-12)
    assert TangentLayout.about(problem.soup, problem.data).names()[0] == "lam[0]"


def test_ties_across_components_keep_a_share_of_weight():
    data, count = tiny("pixels").data, len(tiny().soup)
    part = np.arange(count) % 2
    (a, b), (i, k) = data.edges.T, data.pairs.T
    apart, split = part[a] != part[b], part[i] != part[k]
    one = across_components(data, part, 0.3)
    two = across_discontinuities(data, part, arap=0.3, cont=0.2, orient=0.1)
    for found in (one, two):
        expected = np.where(apart, 0.3, 1.0) * data.edge_weight
        np.testing.assert_allclose(found.edge_weight, expected, rtol=1e-14)
    np.testing.assert_allclose(two.pair_weight, np.where(split, 0.2, 1.0) * data.pair_weight)
    np.testing.assert_allclose(two.orient_weight, np.where(split, 0.1, 1.0) * data.orient_weight)


# --- the export ----------------------------------------------------------------------------------


def test_an_ipopt_without_iterations_is_not_near():
    assert not _near(SimpleNamespace(converged=False, history={}))
    assert _near(SimpleNamespace(converged=False, history={"inf_du": np.array([2.0, 0.5])}))


# --- the check -----------------------------------------------------------------------------------


def test_theta_is_the_share_of_curvature_left_out(small_room):
    own = small_room.soup, small_room.data, small_room.weights
    form = Formulation(compiled=False, hessian="gauss-newton", ridge=0.0)
    found = []
    for theta in (0.0, 0.9):
        nlp, _ = build_tangent_nlp(*own, form.replace(theta=theta))
        found.append(Sums(nlp, first_order=False, second_order=True))
    whole, less = (s.hessian(nlp.x0, np.zeros(nlp.ng)) for s in found)
    assert np.abs(whole - less).max() > 1e-3 * np.abs(whole).max()
