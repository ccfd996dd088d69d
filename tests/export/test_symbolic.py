"""The NLP in CasADi's words: `nlpsol` solves it from a few lines and finds the same minimum."""

import re
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import soup_nlp
from soup_nlp.errors import ModelError
from soup_nlp.export.symbolic import SymbolicNLP
from soup_nlp.geometry.constraints import constraints
from soup_nlp.model import oracle
from soup_nlp.solve.functions import Functions
from soup_nlp.solve.stages import solve_soup

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("simple_starts")]

ROOT = Path(__file__).resolve().parents[2]
SMALL = [
    "input.width=192", "input.height=96", "flow.source=truth",
    "segmentation.neighbours=6", "energy.pixel_samples=4",
]  # fmt: skip
QUIET = {"ipopt.print_level": 0, "ipopt.sb": "yes", "print_time": False}


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


@pytest.fixture(scope="module")
def nlp() -> SymbolicNLP:
    """At the presolve's answer."""
    return soup_nlp.nlp("orbit", superpixels=9, overrides=SMALL, presolve=True)


def test_the_sensitivity_of_the_guide_is_that_of_a_second_solve(nlp):
    def solved(program, x0):
        functions = Functions(program)
        close = {"ipopt.mu_init": 1e-9, "ipopt.tol": 1e-10, "ipopt.bound_push": 1e-9}
        own = {**functions.derivatives, "no_nlp_grad": True, "calc_lam_p": False}
        options = {**QUIET, **close, **own}
        solver = ca.nlpsol("s", "ipopt", functions.oracle, options)
        answer = solver(**{**nlp.start, "x0": x0})
        assert solver.stats()["success"]
        return answer

    answer = solved(nlp.record, nlp.record.x0)
    names = {"nlp": nlp, "np": np, "answer": answer}
    section = (ROOT / "docs/python.md").read_text().partition("### Sensitivity")[2]
    exec(re.search(r"```python\n(.*?)```", section, re.DOTALL)[1], names)
    depth = [nlp.soup(answer["x"]).depth_at(nlp.case.data.anchor_ray)]
    factor = 1 + 1e-4
    groups = [
        replace(g, data=g.data * np.where(np.arange(g.data.shape[1]) == 0, factor, 1.0))
        if g.kernel.name == "prior"
        else g
        for g in nlp.record.groups
    ]
    other = solved(replace(nlp.record, groups=tuple(groups)), answer["x"])
    depth.append(nlp.soup(other["x"]).depth_at(nlp.case.data.anchor_ray))
    change = np.log(depth[1] / depth[0]) / np.log(factor)
    largest = np.abs(change).max()
    assert largest > 1e-3
    np.testing.assert_allclose(names["change"], change, atol=0.02 * largest)


def test_the_symbols_are_the_program(nlp):
    n = len(nlp.case)
    assert nlp.x.numel() == nlp.record.nx == 16 * n
    f = ca.Function("f", [nlp.x, nlp.p], [nlp.f, nlp.g])
    value, g = f(nlp.start["x0"], nlp.start["p"])
    assert float(value) == pytest.approx(nlp.record.value(nlp.start["x0"]), rel=1e-12)
    rows = nlp.record.constraints(nlp.start["x0"])
    np.testing.assert_allclose(np.asarray(g).ravel(), rows, atol=1e-12)
    with pytest.raises(ModelError, match="unknown parameter"):
        nlp.parameters(width=0.1)


def test_casadi_derives_the_constrained_nlp_by_itself(nlp):
    careful = {"ipopt.mu_init": 1e-6, "ipopt.bound_push": 1e-8, "ipopt.nlp_scaling_method": "none"}
    solver = ca.nlpsol("s", "ipopt", nlp.problem, {**QUIET, **careful})
    answer = solver(**nlp.start)
    assert solver.stats()["success"]
    found = constraints(nlp.soup(answer["x"]), nlp.case.data.rim_ray, 1e-3).largest
    assert max(found.values()) < 1e-6
    first = nlp.record.value(nlp.record.x0)
    assert float(answer["f"]) == pytest.approx(first, rel=1e-4)
