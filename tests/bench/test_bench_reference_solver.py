"""The reference solver without Ipopt: same energy, similar minima, correct records."""

from __future__ import annotations

import numpy as np
import pytest

from soup_nlp.bench.reference_solver import Descent, ReferenceSolve, levenberg_marquardt
from soup_nlp.config.problem import make_problem
from soup_nlp.model import oracle
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.formulation import Formulation
from soup_nlp.pipeline.case import prepare
from soup_nlp.pipeline.record import Case
from soup_nlp.solve.kkt import constraint_residuals
from soup_nlp.solve.solver_options import SolverOptions
from soup_nlp.solve.stages import solve_soup

pytestmark = pytest.mark.slow

SCHEDULE = (0.1, 0.03)
# so small a problem is solved before its kernels are compiled
FORM = Formulation(compiled=False)


@pytest.fixture(scope="module")
def case() -> Case:
    scene = {"kind": "scene", "scene": "street", "seed": 0, "width": 256, "height": 128}
    return prepare(
        make_problem({"input": scene, "segmentation": {"superpixels": 30, "neighbours": 6}})
    )


@pytest.fixture(scope="module")
def lm(case: Case) -> ReferenceSolve:
    return levenberg_marquardt(case.soup, case.data, case.weights, FORM, eps=SCHEDULE)


def check(case: Case, y: ReferenceSolve) -> None:
    """Assertions for every record."""
    exact = oracle.energy(y.soup, case.data, case.weights)
    assert dict(y.energy) == pytest.approx(exact, rel=1e-12)
    assert y.iterations > 1
    worst = constraint_residuals(y.soup, case.data.rim_ray, 0.0)
    assert max(worst.values()) < 1e-9


def test_levenberg_marquardt_lowers_the_energy(case, lm):
    check(case, lm)
    before = oracle.energy(case.soup, case.data, case.weights)["total"]
    assert lm.energy["total"] < 0.9 * before


def test_ipopt_and_levenberg_marquardt_agree(case, lm):
    options = SolverOptions(presolve_eps=SCHEDULE, eps=SCHEDULE[-1], max_iter=20)
    s = solve_soup(case.soup, case.data, case.weights, FORM, options)
    assert lm.energy["total"] == pytest.approx(s.energy["total"], rel=0.04)


def test_it_is_the_same_energy(case):
    # without truncations the smoothed energy tends to the exact one
    free = Weights().replace(
        sigma_cont=np.inf, sigma_orient=np.inf, sigma_arap=np.inf, sigma_proj=np.inf
    )
    problem = Descent(case.soup, case.data, free, FORM)
    x = problem.project(problem.nlp.x0)
    exact = oracle.energy(problem.layout.unpack(x), case.data, free)["total"]
    problem.smoothing(1e-7)
    assert problem.value(x) == pytest.approx(exact, rel=1e-5)
    problem.smoothing(1.0)
    assert problem.value(x) < exact


def test_projection_keeps_bounds_and_visibility(case):
    problem = Descent(case.soup, case.data, case.weights, FORM)
    inside = problem.project(problem.nlp.x0)
    np.testing.assert_allclose(problem.project(inside), inside, rtol=1e-12, atol=1e-12)
    rng = np.random.default_rng(0)
    wild = inside + rng.normal(0, 3.0, inside.shape)
    assert (problem.rows @ wild < problem.lower).any()
    kept = problem.project(wild)
    assert (problem.rows @ kept >= problem.lower - 1e-12).all()
    assert (kept >= problem.nlp.lbx).all()
    assert (kept <= problem.nlp.ubx).all()
    # nothing but scales and slopes moves
    np.testing.assert_array_equal(kept.reshape(-1, 9)[:, 3:], wild.reshape(-1, 9)[:, 3:])


def test_a_time_limit_ends_with_the_best_iterate(case):
    late = levenberg_marquardt(case.soup, case.data, case.weights, FORM, seconds=0.0)
    assert late.status == "Time_Limit"
    assert late.iterations <= 1


def test_an_iteration_limit_is_told(case):
    y = levenberg_marquardt(case.soup, case.data, case.weights, FORM, eps=(0.1,), iterations=5)
    assert y.status == "Iteration_Limit"
    assert y.iterations == 5
