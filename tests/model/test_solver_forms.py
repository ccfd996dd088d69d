"""Smooth norms against the exact energy, and worlds where that is zero."""

import casadi as ca
import numpy as np
import pytest
from helpers_model import PAPER, UNITS, WORLDS, form, tiny, weights_for, world

from soup_nlp.model import oracle
from soup_nlp.model.elements import TERMS
from soup_nlp.model.nlp import NLP
from soup_nlp.model.norms import Norm, smooth_min, solver_form

# --- norms and truncations -----------------------------------------------------------------------


@pytest.mark.parametrize("width", [1e-3, 0.1, 1.0])
def test_smooth_min_bounds_and_slope(width):
    y = ca.SX.sym("y")
    both = smooth_min(y, ca.SX(0.5), ca.SX(width))
    f = ca.Function("f", [y], [*both, ca.gradient(both[0], y)])
    at = np.linspace(0, 5, 41)
    found = np.array([[float(v) for v in f(t)] for t in at])
    assert found[0, 0] == pytest.approx(0.0, abs=1e-15)
    # shifted up by its value at 0, at most width^2 / (4 sigma)
    assert (np.abs(found[:, 0] - np.minimum(at, 0.5)) <= width / 2).all()
    np.testing.assert_allclose(found[:, 1], found[:, 2], atol=1e-12)
    assert ((found[:, 1] > 0) & (found[:, 1] < 1)).all()


def test_a_linear_residual_has_its_exact_hessian_at_theta_one():
    x, eps, theta = ca.SX.sym("x", 3), ca.SX.sym("eps"), ca.SX.sym("theta")
    A = np.random.default_rng(0).normal(size=(4, 3))
    norm = Norm(ca.SX(1.7), A @ x - [0.1, 0.2, 0.3, 0.4], eps)
    objective, curvature = solver_form(norm, x, theta)
    f = ca.Function("gap", [x, eps, theta], [ca.hessian(objective, x)[0] - curvature])
    at = [0.3, -0.2, 0.4]
    np.testing.assert_allclose(np.asarray(f(at, 0.3, 1.0)), 0, atol=1e-12)
    # with less of the curvature along the residual left out the matrix is a majorant
    assert np.linalg.eigvalsh(-np.asarray(f(at, 0.3, 0.5))).min() >= -1e-12


def test_curvature_near_a_truncation_is_kept_along_the_residual():
    x, theta = ca.SX.sym("x", 2), 0.9
    norm = Norm(ca.SX(1.0), x, ca.SX(0.1), sigma=ca.SX(0.5))
    at = np.array([0.4, 0.3])
    _, curvature = solver_form(norm, x, ca.SX(theta))
    found = np.asarray(ca.Function("c", [x], [curvature])(at))
    root = np.sqrt(at @ at + 0.01)
    slope = float(ca.evalf(smooth_min(ca.SX(root - 0.1), ca.SX(0.5), ca.SX(0.15))[1]))
    assert 0.3 < slope < 0.8
    along = theta * slope**2 * np.outer(at, at) / root**2
    np.testing.assert_allclose(found, slope / root * (np.eye(2) - along), rtol=1e-12)


# --- solver forms and the exact energy -----------------------------------------------------------


def by_term(nlp: NLP, x: np.ndarray, **theta: float) -> dict[str, float]:
    """Objective by kernel."""
    out = {}
    for group in nlp.groups:
        k = group.kernel
        if k.name not in TERMS:
            continue
        f = ca.Function("f", [k.x, k.row, k.theta], [k.objective]).map(len(group))
        shared = np.repeat(nlp.thetas(**theta)[:, None], len(group), axis=1)
        out[k.name] = float(np.asarray(f(x[group.index].T, group.data.T, shared)).sum())
    return out


@pytest.mark.parametrize("units", UNITS)
def test_the_smooth_norm_tends_to_the_exact_energy(units):
    problem = tiny(units)
    weights = weights_for(units, truncated=False).replace(sigma_cont=np.inf)
    nlp, _ = problem.nlp(weights, form())
    exact = oracle.energy(problem.soup, problem.data, weights)
    gap = []
    for eps in (1e-2, 1e-3, 1e-4, 1e-7):
        made = by_term(nlp, nlp.x0, eps=eps, eps_pixel=eps)
        gap.append([(exact[k] - made[k]) / exact[k] for k in ("arap", "proj", "cont")])
    # sqrt(v^2 + eps^2) - eps is below |v| by less than eps, and nearer with every smaller eps
    assert (np.array(gap) > 0).all()
    assert (np.diff(gap, axis=0) < 0).all()
    assert max(gap[-1]) < 1e-5
    # re-projection errors have a smoothing of their own
    one, two = (by_term(nlp, nlp.x0, eps_pixel=eps) for eps in (0.1, 0.2))
    assert [term for term in TERMS if one[term] != two[term]] == ["proj"]


@pytest.mark.parametrize("units", UNITS)
def test_the_smooth_truncation_stays_near_the_exact_energy(units):
    """Its corner is rounded by a share of sigma, whatever eps: within a fifth of sigma a norm."""
    problem, w, data = tiny(units), weights_for(units), tiny(units).data
    nlp, _ = problem.nlp(w, form(eps=1e-7, eps_pixel=1e-7))
    exact, made = oracle.energy(problem.soup, data, w), by_term(nlp, nlp.x0)
    cap = {
        "arap": 3 * w.arap * w.sigma_arap * data.edge_weight.sum(),
        "proj": w.proj * w.sigma_proj * data.pixel_weight.sum(),
        "cont": w.cont * (w.sigma_cont + w.sigma_cont_ref) * data.pair_weight.sum(),
        "orient": w.orient * w.sigma_orient * data.orient_weight.sum(),
    }
    for term in cap:
        assert abs(made[term] - exact[term]) <= 0.2 * cap[term]
    assert made["prior"] == pytest.approx(exact["prior"], rel=1e-5)


# --- zero-energy facts ---------------------------------------------------------------------------


@pytest.mark.parametrize("at_anchors", [True, False])
@pytest.mark.parametrize("units", UNITS)
@pytest.mark.parametrize("name", WORLDS)
def test_a_rigid_plane_has_no_energy_at_the_truth(name, units, at_anchors):
    soup, data = world(name, units, at_anchors)
    e = oracle.energy(soup, data, PAPER)
    unit = 1.0 if units == "paper" else 100.0  # one radian is about 100 pixels
    assert e["arap"] <= 1e-12 * unit
    assert e["cont"] <= 1e-12 * unit / 0.005  # half a pixel of parallax at the least
    assert e["orient"] <= 1e-12
    assert e["proj"] <= 1e-10  # pixels
