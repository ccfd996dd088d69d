"""The NLP in CasADi's words: `nlpsol` solves it from a few lines and finds the same minimum."""

import casadi as ca
import numpy as np
import pytest

import soup_nlp
from soup_nlp.errors import ModelError
from soup_nlp.geometry.constraints import constraints
from soup_nlp.model import oracle
from soup_nlp.solve.stages import solve_soup

SMALL = [
    "input.width=192", "input.height=96", "flow.source=truth",
    "segmentation.neighbours=6", "energy.pixel_samples=4",
]  # fmt: skip
QUIET = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False}


@pytest.mark.slow
def test_nlpsol_finds_the_minimum_of_solve():
    nlp = soup_nlp.nlp(
        "orbit", superpixels=9, overrides=SMALL, coordinates="tangent", hessian="gauss-newton"
    )
    options = {**QUIET, "ipopt.mu_init": 1e-6, **nlp.derivatives}
    solver, start = ca.nlpsol("s", "ipopt", nlp.problem, options), nlp.start
    for eps in (0.3, 0.03, 0.01):
        p = nlp.parameters(eps=eps, eps_pixel=eps, theta=0.0, ridge=0.0)
        answer = solver(**{**start, "p": p})
        start["x0"] = answer["x"]
    case = nlp.case
    soup = nlp.soup(answer["x"]).normalised(case.data.share)
    reached = oracle.energy(soup, case.data, case.weights)["total"]
    own = solve_soup(case.soup, case.data, case.weights, case.formulation(), case.options)
    assert own.converged
    assert reached == pytest.approx(own.energy["total"], rel=1e-4)
    assert reached < 0.9 * own.energy_start["total"]


@pytest.mark.slow
def test_casadi_derives_the_constrained_nlp_by_itself():
    nlp = soup_nlp.nlp("orbit", superpixels=9, overrides=SMALL, presolve=True)
    careful = {"ipopt.mu_init": 1e-6, "ipopt.bound_push": 1e-8, "ipopt.nlp_scaling_method": "none"}
    solver = ca.nlpsol("s", "ipopt", nlp.problem, {**QUIET, **careful})
    answer = solver(**nlp.start)
    assert solver.stats()["success"]
    found = constraints(nlp.soup(answer["x"]), nlp.case.data.rim_ray, 1e-3).largest
    assert max(found.values()) < 1e-6
    first = nlp.record.value(nlp.record.x0)
    assert float(answer["f"]) == pytest.approx(first, rel=1e-4)


def test_the_symbols_are_the_program():
    nlp = soup_nlp.nlp("orbit", superpixels=9, overrides=SMALL)
    n = len(nlp.case)
    assert nlp.x.numel() == nlp.record.nx == 16 * n
    f = ca.Function("f", [nlp.x, nlp.p], [nlp.f, nlp.g])
    value, g = f(nlp.start["x0"], nlp.start["p"])
    assert float(value) == pytest.approx(nlp.record.value(nlp.start["x0"]), rel=1e-12)
    rows = nlp.record.constraints(nlp.start["x0"])
    np.testing.assert_allclose(np.asarray(g).ravel(), rows, atol=1e-12)
    with pytest.raises(ModelError, match="unknown parameter"):
        nlp.parameters(width=0.1)
