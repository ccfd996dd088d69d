"""Three faces of one NLP agree: plain numpy, CasADi kernels in tables, finite differences."""

from __future__ import annotations

import itertools
import logging
from functools import cache

import casadi as ca
import numpy as np
import pytest
from helpers_model import (
    GAUGES,
    K_NEXT,
    Tiny,
    directional,
    gradient,
    hessian,
    jacobian,
    kernel_exact,
    lagrangian_gradient,
    random_soup,
    value,
    weights_for,
    wiggle,
)

from soup_nlp.model import compile as compiling
from soup_nlp.model import oracle
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.kernel import HESSIANS, Kernel
from soup_nlp.model.matrix import build_matrix_nlp
from soup_nlp.model.nlp import NLP, to_scipy
from soup_nlp.model.norms import Norm, smooth_min, solver_form
from soup_nlp.model.superpixel import tangent_view
from soup_nlp.model.tangent_nlp import build_tangent_nlp

pytestmark = pytest.mark.slow

UNITS = ("paper", "pixels")
NORMS = ("smooth", "epigraph")
TRUNCATIONS = ("smooth", "lifted")
EXACT = {
    "arap": 1e-11,
    "proj": 1e-12,
    "cont": 1e-12,
    "orient": 1e-12,
    "prior": 1e-12,
    "depth": 1e-12,
}
"""Relative. The kernel takes distances of anchors as sqrt(|v|^2 + 1e-12): 2e-12 of E_arap."""
FORMS = list(itertools.product(GAUGES, NORMS, TRUNCATIONS))
DATA = list(itertools.product(UNITS, (False, True)))
EVERY = [(*form, *DATA[(k + k // 4) % 4]) for k, form in enumerate(FORMS)]
"""Every formulation, and every value of two of the five choices together: 12 of 48."""


@cache
def tiny(units: str, at_anchors: bool = False) -> Tiny:
    return Tiny(units, at_anchors)


def form(units: str = "paper", **options) -> Formulation:
    """Smoothing wide enough that finite differences see a smooth function."""
    wide = {"paper": (0.1 * K_NEXT[0, 0], 0.5), "pixels": (3.0, 0.5)}[units]
    return Formulation(
        **{"eps": wide[0], "eps_pixel": wide[1], "compiled": False, "hessian": "exact", **options}
    )


def assert_derivatives(nlp: NLP, x: np.ndarray, seed: int, exact_hessian: bool = True) -> None:
    """Gradient, Jacobian and Lagrangian Hessian along random dense directions."""
    rng = np.random.default_rng(seed)
    lam_f, lam_g = rng.uniform(0.5, 2.0), rng.normal(size=nlp.ng)
    grad, jac = gradient(nlp, x), jacobian(nlp, x)
    f, g = value(nlp, x)
    assert float(nlp.grad_f(x, nlp.p)[0]) == pytest.approx(f, rel=1e-13)
    np.testing.assert_array_equal(np.asarray(nlp.jac_g(x, nlp.p)[0]).ravel(), g)
    H = hessian(nlp, x, lam_f, lam_g) if exact_hessian else None
    for _ in range(2):
        v = rng.uniform(-1, 1, nlp.nx)
        scale = np.abs(grad) @ np.abs(v)
        found = directional(lambda y: value(nlp, y)[0], x, v)
        assert found == pytest.approx(grad @ v, abs=1e-8 * (1 + scale))
        found = directional(lambda y: value(nlp, y)[1], x, v)
        np.testing.assert_allclose(found, jac @ v, atol=1e-8)
        if H is not None:
            found = directional(lambda y: lagrangian_gradient(nlp, y, lam_f, lam_g), x, v)
            scale = 1 + np.abs(H) @ np.abs(v)
            np.testing.assert_allclose(found / scale, H @ v / scale, atol=1e-7)


# --- plain numpy and exact kernels ---------------------------------------------------------------


@pytest.mark.parametrize("truncated", [True, False])
@pytest.mark.parametrize("at_anchors", [True, False])
@pytest.mark.parametrize("units", UNITS)
@pytest.mark.parametrize("gauge", GAUGES)
def test_exact_kernels_equal_plain_numpy_term_by_term(gauge, units, at_anchors, truncated):
    problem, weights = tiny(units, at_anchors), weights_for(units, truncated)
    nlp, layout = problem.nlp(weights, form(units, gauge=gauge, truncation="lifted"))
    for seed in range(3):
        soup = random_soup(seed, len(problem.seg))
        expected = oracle.energy(soup, problem.data, weights)
        x = np.concatenate([layout.pack(soup), np.zeros(nlp.nx - layout.size)])
        found = kernel_exact(nlp, x)
        assert found.keys() == expected.keys() - {"total"}
        for term, e in found.items():
            assert e > 0
            assert e == pytest.approx(expected[term], rel=EXACT[term]), term


@pytest.mark.parametrize("chart", ["depth", "inverse-depth"])
@pytest.mark.parametrize("units", UNITS)
def test_tangent_kernels_equal_plain_numpy_term_by_term(units, chart):
    problem, weights = tiny(units), weights_for(units)
    lifted = form(units, truncation="lifted")
    nlp, layout = build_tangent_nlp(problem.soup, problem.data, weights, lifted, chart)
    rng = np.random.default_rng(0)
    for size in (0.0, 0.05):
        own = layout.pack(problem.soup)
        own *= 1 + size * rng.normal(size=own.size)
        x = np.append(own, np.zeros(nlp.nx - own.size))
        expected = oracle.energy(layout.unpack(own), problem.data, weights)
        # kernels measure in the base's unit, plain in the soup's own: equal at the base, and
        # everywhere once units are local
        found = kernel_exact(nlp, x)
        for term, e in found.items():
            if size == 0 or units == "pixels" or term in ("proj", "orient"):
                assert e == pytest.approx(expected[term], rel=EXACT[term]), term


def test_truncations_of_the_tiny_problem_cut_some_and_spare_some():
    # or the tests above would not see them
    for units in UNITS:
        problem, weights = tiny(units), weights_for(units)
        wide = weights_for(units, truncated=False)
        for term in (oracle.arap, oracle.reprojection, oracle.continuity):
            cut = term(problem.soup, problem.data, weights)
            free = term(problem.soup, problem.data, wide)
            assert np.mean(cut < free) > 0.05, term.__name__
            assert (cut <= free * (1 + 1e-12)).all()
        turn = oracle.orientation(problem.soup, problem.data, weights) / problem.data.orient_weight
        assert 0.05 < np.mean(turn < weights.sigma_orient) < 0.95


# --- finite differences --------------------------------------------------------------------------


@pytest.mark.parametrize(("gauge", "norm", "truncation", "units", "at_anchors"), EVERY)
def test_derivatives_equal_finite_differences(gauge, norm, truncation, units, at_anchors):
    problem = tiny(units, at_anchors)
    nlp, layout = problem.nlp(
        weights_for(units), form(units, gauge=gauge, norm=norm, truncation=truncation)
    )
    assert_derivatives(nlp, wiggle(nlp, layout.size, 1, 0.0), 2)
    assert_derivatives(nlp, wiggle(nlp, layout.size, 3, 0.05), 4)


@pytest.mark.parametrize("units", UNITS)
@pytest.mark.parametrize("truncation", TRUNCATIONS)
@pytest.mark.parametrize("norm", NORMS)
def test_untruncated_derivatives_equal_finite_differences(norm, truncation, units):
    nlp, layout = tiny(units).nlp(
        weights_for(units, truncated=False), form(units, norm=norm, truncation=truncation)
    )
    assert_derivatives(nlp, wiggle(nlp, layout.size, 5, 0.05), 6)


@pytest.mark.parametrize("at_anchors", [True, False])
@pytest.mark.parametrize("units", UNITS)
@pytest.mark.parametrize("truncation", TRUNCATIONS)
@pytest.mark.parametrize("norm", NORMS)
def test_derivatives_of_the_presolve_equal_finite_differences(norm, truncation, units, at_anchors):
    problem = tiny(units, at_anchors)
    nlp, layout = build_tangent_nlp(
        problem.soup,
        problem.data,
        weights_for(units),
        form(units, norm=norm, truncation=truncation),
    )
    own = 9 * layout.count
    assert_derivatives(nlp, wiggle(nlp, own, 1, 0.0), 2)
    assert_derivatives(nlp, wiggle(nlp, own, 3, 0.05), 4)


@pytest.mark.parametrize("gauge", GAUGES)
def test_every_entry_of_jacobian_and_hessian(gauge):
    """Column by column, with the name of the entry that disagrees."""
    problem = tiny("pixels", True)
    nlp, layout = problem.nlp(
        weights_for("pixels"), form("pixels", gauge=gauge, truncation="lifted")
    )
    x = wiggle(nlp, layout.size, 7, 0.03)
    lam_g = np.random.default_rng(8).normal(size=nlp.ng)
    J, H = jacobian(nlp, x), hessian(nlp, x, 1.0, lam_g)
    names, rows = nlp.x_names(), nlp.g_names()
    scale = 1 + np.abs(H).max()

    def both(y: np.ndarray) -> np.ndarray:
        """Constraints, then the gradient of the Lagrangian."""
        g, jac = nlp.jac_g(y, nlp.p)
        return np.append(np.asarray(g), gradient(nlp, y) + to_scipy(jac).T @ lam_g)

    for j in range(0, nlp.nx, 3):
        v = np.zeros(nlp.nx)
        v[j] = 1.0
        column, slope = np.split(directional(both, x, v), [nlp.ng])
        wrong = np.flatnonzero(np.abs(column - J[:, j]) > 1e-8)
        assert not len(wrong), f"d {rows[wrong[0]]} / d {names[j]}"
        wrong = np.flatnonzero(np.abs(slope - H[:, j]) > 1e-8 * scale)
        assert not len(wrong), f"d2 / d {names[wrong[0]]} d {names[j]}"


# --- kinds of Hessian ----------------------------------------------------------------------------


@pytest.mark.parametrize(("gauge", "norm", "truncation", "units", "at_anchors"), EVERY)
def test_gauss_newton_is_positive_semidefinite_whatever_the_multipliers(
    gauge, norm, truncation, units, at_anchors
):
    problem = tiny(units, at_anchors)
    nlp, layout = problem.nlp(
        weights_for(units),
        form(units, gauge=gauge, norm=norm, truncation=truncation, hessian="gauss-newton"),
    )
    for seed in range(2):
        x = wiggle(nlp, layout.size, seed, 0.05)
        lam_g = np.random.default_rng(seed).normal(size=nlp.ng)
        H = hessian(nlp, x, 1.0, lam_g)
        # slacks and switches have empty rows, over which LAPACK takes seconds
        some = H.any(axis=0)
        eigen = np.linalg.eigvalsh(H[np.ix_(some, some)])
        assert eigen[0] >= -1e-12 * eigen[-1]
        assert eigen[-1] > 0
        np.testing.assert_array_equal(H, hessian(nlp, x, 1.0, np.zeros(nlp.ng)))


@pytest.mark.parametrize("units", UNITS)
def test_gauss_newton_of_the_presolve_is_positive_definite(units):
    problem = tiny(units)
    nlp, layout = build_tangent_nlp(
        problem.soup, problem.data, weights_for(units), form(units, hessian="gauss-newton")
    )
    for seed in range(3):
        x = wiggle(nlp, 9 * layout.count, seed, 0.05)
        ridge = form().ridge
        assert np.linalg.eigvalsh(hessian(nlp, x, 1.0, np.zeros(nlp.ng)))[0] >= 0.99 * ridge


@pytest.mark.parametrize("gauge", GAUGES)
def test_kinds_of_hessian_share_the_curvature_of_the_constraints(gauge):
    problem, H = tiny("paper"), {}
    rng = np.random.default_rng(0)
    for kind in HESSIANS:
        nlp, layout = problem.nlp(weights_for("paper"), form(gauge=gauge, hessian=kind))
        assert nlp.hessian == kind
        x = wiggle(nlp, layout.size, 1, 0.03)
        lam_g = np.random.default_rng(2).normal(size=nlp.ng)
        H[kind] = hessian(nlp, x, 1.0, lam_g), hessian(nlp, x, 1.0, 0 * lam_g)
    v = rng.normal(size=nlp.nx)
    curvature = (H["exact"][0] - H["exact"][1]) @ v
    found = (H["gauss-newton+constraints"][0] - H["gauss-newton"][0]) @ v
    np.testing.assert_allclose(found, curvature, atol=1e-9)
    assert np.abs(curvature).max() > 1


def test_a_linear_residual_has_its_exact_hessian_at_theta_one():
    x, eps, theta = ca.SX.sym("x", 3), ca.SX.sym("eps"), ca.SX.sym("theta")
    A = np.random.default_rng(0).normal(size=(4, 3))
    norm = Norm("linear", ca.SX(1.7), A @ x - [0.1, 0.2, 0.3, 0.4], eps)
    made = solver_form(norm, x, theta, None, None)
    gap = ca.hessian(made.objective, x)[0] - made.curvature
    f = ca.Function("gap", [x, eps, theta], [gap, made.curvature])
    at = [0.3, -0.2, 0.4]
    np.testing.assert_allclose(np.asarray(f(at, 0.3, 1.0)[0]), 0, atol=1e-12)
    # less than Newton's along the residual is taken out below theta = 1: the majorant is larger
    assert np.linalg.eigvalsh(-np.asarray(f(at, 0.3, 0.5)[0])).min() >= -1e-12


@pytest.mark.parametrize("width", [1e-3, 0.1, 1.0])
def test_smooth_min_bounds_and_slope(width):
    y = ca.SX.sym("y")
    f = ca.Function(
        "f",
        [y],
        [
            *smooth_min(y, ca.SX(0.5), ca.SX(width)),
            ca.gradient(smooth_min(y, ca.SX(0.5), ca.SX(width))[0], y),
        ],
    )
    assert float(f(0.0)[0]) == pytest.approx(0.0, abs=1e-15)
    values = np.array([[float(v) for v in f(t)] for t in np.linspace(0, 5, 41)])
    exact = np.minimum(np.linspace(0, 5, 41), 0.5)
    # shifted up by its value at 0, at most width^2 / (4 sigma)
    assert (np.abs(values[:, 0] - exact) <= width / 2).all()
    np.testing.assert_allclose(values[:, 1], values[:, 2], atol=1e-12)
    assert ((values[:, 1] > 0) & (values[:, 1] < 1)).all()


# --- machine code and virtual machine ------------------------------------------------------------


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("SOUP_NLP_CACHE", str(tmp_path / "kernels"))
    return tmp_path / "kernels"


def assert_twins(a: NLP, b: NLP, x: np.ndarray) -> None:
    lam_g = np.random.default_rng(0).normal(size=a.ng)
    for one, two in (
        (value(a, x), value(b, x)),
        ((gradient(a, x), jacobian(a, x)), (gradient(b, x), jacobian(b, x))),
        ((hessian(a, x, 1.0, lam_g), 0), (hessian(b, x, 1.0, lam_g), 0)),
    ):
        for p, q in zip(one, two):
            np.testing.assert_allclose(p, q, rtol=1e-12, atol=1e-12 * np.abs(q).max())


@pytest.mark.skipif(compiling.find_compiler() is None, reason="no C compiler")
def test_machine_code_equals_the_virtual_machine():
    problem, weights = tiny("pixels"), weights_for("pixels")
    options = {"gauge": "unit-translation", "norm": "epigraph", "truncation": "lifted"}
    slow, layout = problem.nlp(weights, form("pixels", **options))
    fast, _ = problem.nlp(weights, form("pixels", **options, compiled=True))
    assert_twins(fast, slow, wiggle(slow, layout.size, 1, 0.05))


@pytest.mark.skipif(compiling.find_compiler() is None, reason="no C compiler")
def test_machine_code_of_the_presolve_equals_the_virtual_machine():
    problem, weights = tiny("pixels"), weights_for("pixels")
    args = problem.soup, problem.data, weights
    kind = {"hessian": "gauss-newton"}
    slow, layout = build_tangent_nlp(*args, form("pixels", **kind))
    fast, _ = build_tangent_nlp(*args, form("pixels", **kind, compiled=True))
    assert_twins(fast, slow, wiggle(slow, 9 * layout.count, 1, 0.05))


CUTS = [0, 3, 4, 5, 14, 17]
"""Of the base of a tangent view: anchor, radius, depth, R0, t0."""


def squares() -> Kernel:
    x, theta = ca.SX.sym("x", 2), ca.SX.sym("theta", 0)
    return Kernel("squares", x, ca.SX.sym("row", 0), theta, objective=ca.sumsqr(x))


@pytest.mark.skipif(compiling.find_compiler() is None, reason="no C compiler")
def test_machine_code_is_cached(own_cache):
    functions, stamps = list(squares().first_order().values()), []
    for _ in range(2):
        made = compiling.compile_functions(functions)
        assert float(made["squares_f"]([3.0, 4.0], [], [])) == 25.0
        stamps.append({p: p.stat().st_mtime_ns for p in own_cache.glob("*.so")})
    assert len(stamps[0]) == 1
    assert stamps[0] == stamps[1]


@pytest.mark.parametrize("cc", ["/bin/false", "/no/such/compiler"])
def test_without_a_working_compiler_kernels_run_in_the_virtual_machine(
    cc, own_cache, monkeypatch, caplog
):
    monkeypatch.setenv("CC", cc)
    with caplog.at_level(logging.DEBUG):
        functions = list(squares().first_order().values())
        made = compiling.compile_functions(functions)
    assert set(made) == {f.name() for f in functions}
    assert float(made["squares_f"]([3.0, 4.0], [], [])) == 25.0
    assert "virtual machine" in caplog.text
    assert not list(own_cache.glob("*"))


def test_an_unusable_cache_folder_costs_speed_only(tmp_path, monkeypatch, caplog):
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    monkeypatch.setenv("SOUP_NLP_CACHE", str(blocked))
    made = compiling.compile_functions(list(squares().first_order().values()), "/bin/false")
    assert float(made["squares_f"]([3.0, 4.0], [], [])) == 25.0
    assert "failed" in caplog.text


def test_a_whole_nlp_is_built_without_a_compiler(own_cache, monkeypatch):
    monkeypatch.setenv("CC", "/bin/false")
    problem, weights = tiny("paper"), weights_for("paper")
    nlp, layout = build_matrix_nlp(problem.soup, problem.data, weights, form(compiled=True))
    other, _ = build_matrix_nlp(problem.soup, problem.data, weights, form(compiled=False))
    assert_twins(nlp, other, wiggle(nlp, layout.size, 1, 0.02))


# --- views ---------------------------------------------------------------------------------------


def test_what_two_views_differ_by_is_the_difference_of_both():
    x, base = ca.SX.sym("x", 18), ca.SX.sym("base", 34)
    views = [
        tangent_view(x[9 * a : 9 * a + 9], *ca.vertsplit(base[17 * a : 17 * a + 17], CUTS))
        for a in range(2)
    ]
    a, b = views
    points = a.point(ca.SX([0.1, 0.2, 1])), b.point(ca.SX([0.3, -0.1, 1]))
    pairs = [
        (a.turn_from(b), a.R - b.R),
        (a.drift_from(b), a.lam * a.t - b.lam * b.t),
        (a.apart(points[0], b, points[1]), a.move(points[0]) - b.move(points[1])),
    ]
    rng = np.random.default_rng(8)
    turns = [np.linalg.qr(rng.normal(size=(3, 3)))[0].ravel() for _ in range(2)]
    bases = [np.concatenate([[0.1, -0.2, 1, 0.05, 2.0], R, rng.normal(size=3)]) for R in turns]
    values = np.tile([1.1, 0.2, -0.1] + [0.3] * 6, 2), np.concatenate(bases)
    for one, other in pairs:
        f = ca.Function("f", [x, base], [one, other])
        p, q = f(*values)
        np.testing.assert_allclose(np.asarray(p), np.asarray(q), atol=1e-13)
