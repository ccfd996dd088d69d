"""Smooth, epigraph and lifted forms against the exact energy, and worlds where that is zero."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from helpers_formulation import FORMS, UNITS, WORLDS, form, tiny, world
from helpers_model import GAUGES, PAPER, gradient, value, weights_for

from soup_nlp.geometry import rotation
from soup_nlp.model import oracle
from soup_nlp.model.energy_data import TERMS
from soup_nlp.model.matrix import build_matrix_nlp
from soup_nlp.model.nlp import NLP

# --- solver forms and the exact energy -----------------------------------------------------------


def by_term(nlp: NLP, x: np.ndarray, p: np.ndarray) -> dict[str, float]:
    """Objective by kernel."""
    out = {}
    for group in nlp.groups:
        k, t = group.kernel, group.table
        if k.name not in TERMS:
            continue
        f = ca.Function("f", [k.x, k.row, k.theta], [k.objective]).map(len(t))
        theta = np.repeat(p[: len(nlp.theta), None], len(t), axis=1)
        out[k.name] = float(np.asarray(f(x[t.index].T, t.data.T, theta)).sum())
    return out


@pytest.mark.parametrize("units", UNITS)
def test_the_smooth_norm_tends_to_the_exact_energy(units):
    problem = tiny(units)
    weights = weights_for(units, truncated=False).replace(sigma_cont=np.inf)
    nlp, _ = problem.nlp(weights, form(truncation="smooth"))
    exact = oracle.energy(problem.soup, problem.data, weights)
    gap = []
    for eps in (1e-2, 1e-3, 1e-4, 1e-7):
        made = by_term(nlp, nlp.x0, nlp.with_theta(eps=eps, eps_pixel=eps))
        gap.append([(exact[k] - made[k]) / exact[k] for k in ("arap", "proj", "cont")])
    # sqrt(v^2 + eps^2) - eps is below |v| by less than eps, and nearer with every smaller eps
    assert (np.array(gap) > 0).all()
    assert (np.diff(gap, axis=0) < 0).all()
    assert max(gap[-1]) < 1e-5


@pytest.mark.parametrize("units", UNITS)
def test_the_smooth_truncation_stays_near_the_exact_energy(units):
    """Its corner is rounded by a share of sigma, whatever eps: within a fifth of sigma a norm."""
    problem, weights, data = tiny(units), weights_for(units), tiny(units).data
    nlp, _ = problem.nlp(weights, form(truncation="smooth", eps=1e-7, eps_pixel=1e-7))
    exact, made = oracle.energy(problem.soup, data, weights), by_term(nlp, nlp.x0, nlp.p)
    w = weights
    cap = {
        "arap": 3 * w.arap * w.sigma_arap * data.edge_weight.sum(),
        "proj": w.proj * w.sigma_proj * data.pixel_weight.sum(),
        "cont": w.cont * (w.sigma_cont + w.sigma_cont_ref) * data.pair_weight.sum(),
        "orient": w.orient * w.sigma_orient * data.orient_weight.sum(),
    }
    for term in cap:
        assert abs(made[term] - exact[term]) <= 0.2 * cap[term]
    assert made["prior"] == pytest.approx(exact["prior"], rel=1e-5)


def parts(nlp: NLP, letter: str) -> dict[str, int]:
    """Index of every slack ("s") or switch ("z") by what it belongs to."""
    return {name[2:]: i for i, name in enumerate(nlp.x_names()) if name.startswith(f"{letter}_")}


def optimal_extras(nlp: NLP) -> np.ndarray:
    """x0 with the smallest feasible slacks and the better end of every switch."""
    x = nlp.x0.copy()
    slack, switch = parts(nlp, "s"), parts(nlp, "z")
    x[list(slack.values())] = 0.0
    g = dict(zip(nlp.g_names(), value(nlp, x)[1]))
    for name, i in slack.items():
        # s^2 - |v|^2 - eps^2 at s = 0
        x[i] = np.sqrt(max(0.0, -g[f"epigraph_{name}"]))
    index = list(switch.values())
    x[index] = (gradient(nlp, x)[index] < 0).astype(float)
    return x


@pytest.mark.parametrize("truncated", [True, False])
@pytest.mark.parametrize("units", UNITS)
@pytest.mark.parametrize("gauge", GAUGES)
def test_epigraph_and_lifted_at_their_optimum_are_the_exact_energy(gauge, units, truncated):
    problem, weights = tiny(units), weights_for(units, truncated)
    sharp = form(gauge=gauge, norm="epigraph", truncation="lifted", eps=0.0, eps_pixel=0.0)
    nlp, _ = problem.nlp(weights, sharp)
    exact = oracle.energy(problem.soup, problem.data, weights)
    x = optimal_extras(nlp)
    f, g = value(nlp, x)
    assert f == pytest.approx(exact["total"], rel=1e-10)
    assert np.maximum(nlp.lbg - g, g - nlp.ubg).max() <= 1e-9
    for term, e in by_term(nlp, x, nlp.p).items():
        assert e == pytest.approx(exact[term], rel=1e-10)
    # whatever else the slacks and switches are, as long as they are feasible, f is not lower
    rng = np.random.default_rng(0)
    slack, switch = list(parts(nlp, "s").values()), list(parts(nlp, "z").values())
    for _ in range(10):
        y = x.copy()
        y[slack] += rng.exponential(0.1, len(slack)) * (rng.random(len(slack)) < 0.5)
        y[switch] = rng.uniform(0, 1, len(switch))
        assert value(nlp, y)[0] > f
    # and the start is nearly there
    assert f <= value(nlp, nlp.x0)[0] <= 1.5 * f


@pytest.mark.parametrize("units", UNITS)
def test_lifted_optimum_tends_to_the_exact_energy(units):
    problem, weights = tiny(units), weights_for(units)
    nlp, _ = problem.nlp(weights, form(truncation="lifted", eps=1e-9, eps_pixel=1e-9))
    exact = oracle.energy(problem.soup, problem.data, weights)["total"]
    assert value(nlp, optimal_extras(nlp))[0] == pytest.approx(exact, rel=1e-7)


def test_epigraph_optimum_is_the_exact_energy_without_truncations():
    problem = tiny()
    weights = PAPER.replace(sigma_cont=np.inf, orient=0.0)
    nlp, _ = problem.nlp(weights, form(norm="epigraph", eps=0.0, eps_pixel=0.0))
    exact = oracle.energy(problem.soup, problem.data, weights)["total"]
    assert value(nlp, optimal_extras(nlp))[0] == pytest.approx(exact, rel=1e-10)


@pytest.mark.parametrize("units", UNITS)
def test_epigraph_at_its_optimum_is_the_smooth_form(units):
    problem, weights = tiny(units), weights_for(units)
    one, _ = problem.nlp(weights, form(norm="epigraph", eps=0.2, eps_pixel=0.1))
    two, _ = problem.nlp(weights, form(eps=0.2, eps_pixel=0.1))
    smooth = value(two, two.x0)[0]
    assert value(one, optimal_extras(one))[0] == pytest.approx(smooth, rel=1e-12)
    # the slacks start there
    assert value(one, one.x0)[0] == pytest.approx(smooth, rel=1e-12)


def test_orientation_can_do_without_truncation():
    problem, weights = tiny(), PAPER.replace(sigma_orient=np.inf)
    nlp, _ = problem.nlp(weights, form())
    exact = oracle.energy(problem.soup, problem.data, weights)["orient"]
    assert by_term(nlp, nlp.x0, nlp.p)["orient"] == pytest.approx(exact, rel=1e-12)


@pytest.mark.parametrize("name", ["arap", "proj", "cont", "orient"])
def test_a_weight_scales_its_term_alone(name):
    problem = tiny()
    nlp, _ = problem.nlp(PAPER, form())
    twice, _ = problem.nlp(PAPER.replace(**{name: 2 * getattr(PAPER, name)}), form())
    a, b = by_term(nlp, nlp.x0, nlp.p), by_term(twice, nlp.x0, twice.p)
    for term in TERMS:
        assert b[term] == pytest.approx((2 if term == name else 1) * a[term], rel=1e-12)


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


@pytest.mark.parametrize(("norm", "truncation"), FORMS)
@pytest.mark.parametrize("name", ["fronto-parallel, turning", "slanted"])
def test_a_rigid_planes_truth_is_stationary_in_every_form(name, norm, truncation):
    soup, data = world(name, "pixels", False)
    # a plane that is slanted has relief
    flat = PAPER.replace(prior=0.0)
    for gauge in GAUGES:
        nlp, layout = build_matrix_nlp(
            soup, data, flat, form(gauge=gauge, norm=norm, truncation=truncation, eps=0.03)
        )
        x = optimal_extras(nlp) if norm == "epigraph" or truncation == "lifted" else nlp.x0
        assert value(nlp, x)[0] <= 1e-9
        if norm == "smooth":
            assert np.abs(gradient(nlp, x)[: layout.size]).max() <= 1e-5


def test_energy_is_positive_off_the_truth_and_each_term_reacts():
    soup, data = world("slanted", "paper", False)
    rng = np.random.default_rng(0)

    def terms(**change) -> dict[str, float]:
        return oracle.energy(replace(soup, **change), data, PAPER)

    turned = rotation.exp(rng.normal(0, 0.01, (12, 3))) @ soup.R
    e = terms(R=turned)
    assert min(e["arap"], e["proj"], e["cont"]) > 1e-3
    assert e["orient"] <= 1e-12
    n = soup.n + rng.normal(0, 0.05, (12, 3))
    e = terms(n=n / np.linalg.norm(n, axis=1, keepdims=True))
    assert min(e["proj"], e["cont"], e["orient"]) > 1e-3
    # one rigid motion stays rigid, whatever the shape
    assert e["arap"] <= 1e-12
    # scale alone does not change the flow (the homography knows t / d only), but all gaps
    e = terms(lam=soup.lam * rng.uniform(0.8, 1.2, 12))
    assert e["proj"] <= 1e-10
    assert e["orient"] <= 1e-12
    assert min(e["arap"], e["cont"]) > 1e-3
