"""Three faces of one NLP agree: plain numpy, kernels in tables, finite differences."""

import itertools

import numpy as np
import pytest
from helpers_model import (
    GAUGES,
    K_NEXT,
    UNITS,
    directional,
    exact_terms,
    lagrangian_gradient,
    random_soup,
    tiny,
    weights_for,
    wiggle,
)

from soup_nlp.model import oracle
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.kernel import HESSIANS
from soup_nlp.model.nlp import NLP
from soup_nlp.model.programs import build_tangent_nlp

EXACT = {
    "arap": 1e-11,
    **dict.fromkeys(("proj", "cont", "orient", "prior", "depth", "order"), 1e-12),
}
"""Relative. Symbolic distances of anchors are sqrt(|v|^2 + 1e-12): 2e-12 of E_arap."""
DATA = list(itertools.product(UNITS, (False, True)))
EVERY = [
    (coordinates, *data)
    for k, coordinates in enumerate((*GAUGES, "tangent"))
    for data in (DATA[k % 2], DATA[3 - k % 2])
]
"""All coordinates, each with both units and both ways to compare motions."""


def form(units: str = "paper", **options) -> Formulation:
    """Smoothing wide enough that finite differences see a smooth function."""
    wide = {"paper": (0.1 * K_NEXT[0, 0], 0.5), "pixels": (3.0, 0.5)}[units]
    return Formulation(**{"eps": wide[0], "eps_pixel": wide[1], "hessian": "exact", **options})


def program(coordinates, units, at_anchors, truncated=True, **options):
    """The NLP and its layout in matrices of a gauge, or in tangent coordinates."""
    problem, weights = tiny(units, at_anchors), weights_for(units, truncated)
    if coordinates == "tangent":
        own = form(units, **options)
        return build_tangent_nlp(problem.soup, problem.data, weights, own)
    return problem.nlp(weights, form(units, gauge=coordinates, **options))


# --- plain numpy and symbolic terms --------------------------------------------------------------


@pytest.mark.parametrize(("at_anchors", "truncated"), [(True, True), (False, False)])
@pytest.mark.parametrize("units", UNITS)
@pytest.mark.parametrize("gauge", GAUGES)
def test_symbolic_terms_equal_plain_numpy(gauge, units, at_anchors, truncated):
    problem, weights = tiny(units, at_anchors), weights_for(units, truncated)
    _, layout = problem.nlp(weights, form(units, gauge=gauge))
    for seed in range(3):
        soup = random_soup(seed, len(problem.seg))
        expected = oracle.energy(soup, problem.data, weights)
        found = exact_terms(layout.pack(soup), problem.data, weights, layout)
        assert found.keys() == expected.keys() - {"total"}
        for term, e in found.items():
            assert e > 0
            assert e == pytest.approx(expected[term], rel=EXACT[term]), term


@pytest.mark.parametrize("chart", ["depth", "inverse-depth"])
@pytest.mark.parametrize("units", UNITS)
def test_terms_in_tangent_coordinates_equal_plain_numpy(units, chart):
    problem, weights = tiny(units), weights_for(units)
    own = problem.soup, problem.data, weights, form(units)
    _, layout = build_tangent_nlp(*own, chart)
    rng = np.random.default_rng(0)
    for size in (0.0, 0.05):
        x = layout.pack(problem.soup)
        x *= 1 + size * rng.normal(size=x.size)
        expected = oracle.energy(layout.unpack(x), problem.data, weights)
        # lengths are in the base's unit, in numpy in the soup's: equal at the base, and
        # everywhere once units are local
        for term, e in exact_terms(x, problem.data, weights, layout).items():
            if size == 0 or units == "pixels" or term in ("proj", "orient"):
                assert e == pytest.approx(expected[term], rel=EXACT[term]), term


# --- finite differences --------------------------------------------------------------------------


def assert_derivatives(nlp: NLP, x: np.ndarray, seed: int) -> None:
    """Gradient, Jacobian and Lagrangian Hessian along a random dense direction."""
    rng = np.random.default_rng(seed)
    lam_f, lam_g = rng.uniform(0.5, 2.0), rng.normal(size=nlp.ng)
    grad, jac, H = nlp.gradient(x), nlp.jacobian(x), nlp.hessian(x, lam_g, lam_f)
    v = rng.uniform(-1, 1, nlp.nx)
    scale = np.abs(grad) @ np.abs(v)
    found = directional(nlp.value, x, v)
    assert found == pytest.approx(grad @ v, abs=1e-8 * (1 + scale))
    found = directional(nlp.constraints, x, v)
    np.testing.assert_allclose(found, jac @ v, atol=1e-8)
    found = directional(lambda y: lagrangian_gradient(nlp, y, lam_f, lam_g), x, v)
    scale = 1 + np.abs(H) @ np.abs(v)
    np.testing.assert_allclose(found / scale, H @ v / scale, atol=1e-7)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("coordinates", "units", "at_anchors", "truncated"),
    # with truncations and without in turn, which changes with the coordinates
    [(*kind, (k + k // 2) % 2 == 0) for k, kind in enumerate(EVERY)],
)
def test_derivatives_equal_finite_differences(coordinates, units, at_anchors, truncated):
    nlp, _ = program(coordinates, units, at_anchors, truncated)
    assert_derivatives(nlp, wiggle(nlp, 3, 0.05), 4)


# --- kinds of Hessian ----------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(("coordinates", "units", "at_anchors"), EVERY)
def test_gauss_newton_is_positive_semidefinite_whatever_the_multipliers(
    coordinates, units, at_anchors
):
    nlp, _ = program(coordinates, units, at_anchors, hessian="gauss-newton")
    x = wiggle(nlp, 0, 0.05)
    lam_g = np.random.default_rng(0).normal(size=nlp.ng)
    H = nlp.hessian(x, lam_g).toarray()
    eigen = np.linalg.eigvalsh(H)
    # the ridge makes it definite in tangent coordinates
    positive = coordinates == "tangent"
    assert eigen[0] >= (0.99 * form().ridge if positive else -1e-12 * eigen[-1])
    assert eigen[-1] > 0
    np.testing.assert_array_equal(H, nlp.hessian(x, np.zeros(nlp.ng)).toarray())


@pytest.mark.slow
@pytest.mark.parametrize("gauge", GAUGES)
def test_kinds_of_hessian_share_the_curvature_of_the_constraints(gauge):
    H = {}
    for kind in HESSIANS:
        nlp, _ = program(gauge, "paper", False, hessian=kind)
        x = wiggle(nlp, 1, 0.03)
        lam_g = np.random.default_rng(2).normal(size=nlp.ng)
        H[kind] = nlp.hessian(x, lam_g), nlp.hessian(x, 0 * lam_g)
    v = np.random.default_rng(0).normal(size=nlp.nx)
    curvature = (H["exact"][0] - H["exact"][1]) @ v
    found = (H["gauss-newton+constraints"][0] - H["gauss-newton"][0]) @ v
    np.testing.assert_allclose(found, curvature, atol=1e-9)
    assert np.abs(curvature).max() > 1


@pytest.mark.parametrize("gauge", GAUGES[:1])
def test_the_ridge_is_its_factor_times_a_natural_step(gauge):
    """Relative 1 in scale and offset, one radian in R, one anchor depth in the translation."""
    found = {}
    for ridge in (0.0, 0.5):
        nlp, layout = program(gauge, "pixels", False, hessian="gauss-newton", ridge=ridge)
        x = wiggle(nlp, 1, 0.01)
        found[ridge] = nlp.hessian(x, np.zeros(nlp.ng)).diagonal()
    count, stride = layout.count, layout.stride
    metric = (found[0.5] - found[0.0])[: count * stride].reshape(count, stride) / 0.5
    own = nlp.x0[: count * stride].reshape(metric.shape)
    np.testing.assert_allclose(metric[:, 0] * own[:, 0] ** 2, 1, rtol=1e-6)
    np.testing.assert_allclose(metric[:, -12:-3], 1, rtol=1e-6)
    step = layout.unpack(nlp.x0).depth_at(tiny("pixels").data.anchor_ray) / own[:, 0]
    np.testing.assert_allclose(metric[:, -3:] * step[:, None] ** 2, 1, rtol=1e-6)


def test_theta_is_the_share_of_curvature_left_out():
    found = []
    for theta in (0.0, 0.45, 0.9):
        own = {"hessian": "gauss-newton", "ridge": 0.0, "theta": theta}
        nlp, _ = program("tangent", "pixels", False, truncated=False, **own)
        found.append(nlp.hessian(nlp.x0, np.zeros(nlp.ng)).toarray())
    whole, half, less = found
    scale = np.abs(whole).max()
    assert np.abs(whole - less).max() > 1e-3 * scale
    np.testing.assert_allclose(half, (whole + less) / 2, atol=1e-12 * scale)
    assert np.linalg.eigvalsh(whole - less)[0] >= -1e-12 * scale
