"""Multipliers and residuals with which answers are verified, and names of an export."""

from __future__ import annotations

from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from helpers_formulation import form, tiny
from helpers_model import PAPER
from scipy import sparse

from soup_nlp.export import verify
from soup_nlp.export.nl import readable_names
from soup_nlp.export.program import make_program
from soup_nlp.export.sol import Sol
from soup_nlp.export.verify import kind
from soup_nlp.model.kernel import Group, Kernel, Table


def program(gradient, jacobian, g, **bounds):
    """A program that is given by its numbers at a point."""
    n = len(gradient)
    every = {"lbx": np.full(n, -np.inf), "ubx": np.full(n, np.inf), **bounds}
    return SimpleNamespace(
        gradient=lambda x: np.array(gradient),
        jacobian=lambda x: sparse.csr_matrix(jacobian),
        constraints=lambda x: np.array(g),
        ng=len(g),
        **{k: np.array(v, float) for k, v in every.items()},
    )


def test_only_signs_that_a_bound_can_have_are_multipliers():
    rows = {"jacobian": np.eye(4), "g": [1.0, 2.0, 1.0, 2.0]}
    bounds = {"lbg": [1, -np.inf, 1, -np.inf], "ubg": [np.inf, 2, np.inf, 2]}
    # grad f + lam = 0: a lower bound pushes with lam < 0, an upper one with lam > 0
    nlp = program([3.0, -4.0, -5.0, 6.0], **rows, **bounds)
    lam = verify.least_squares_multipliers(nlp, np.zeros(4))
    np.testing.assert_allclose(lam, [-3, 4, 0, 0], atol=1e-9)


def test_rows_near_a_bound_of_zero_are_active():
    near, far = 0.5 * verify.ACTIVE, 2 * verify.ACTIVE
    rows = {"jacobian": np.eye(4), "g": [-near, -far, near, far]}
    bounds = {"lbg": [-np.inf, -np.inf, 0, 0], "ubg": [0, 0, np.inf, np.inf]}
    nlp = program([-1.0, -1.0, 1.0, 1.0], **rows, **bounds)
    lam = verify.least_squares_multipliers(nlp, np.zeros(4))
    np.testing.assert_allclose(lam, [1, 0, -1, 0], atol=1e-9)


def test_a_variable_at_its_bound_takes_the_whole_gradient():
    """One at each bound, one in the middle of a distance 4 to the bound that it is pushed to."""
    none = {"jacobian": np.zeros((1, 3)), "g": [0.0]}
    nlp = program([-2.0, 3.0, -5.0], **none, lbx=[-1.0, 2.0, 0.0], ubx=[3.0, 9.0, 8.0])
    lam = verify.bound_multipliers(nlp, np.array([3.0, 2.0, 4.0]), np.zeros(1))
    np.testing.assert_allclose(lam, [2.0, -3.0, 1.0], rtol=1e-15)


@pytest.mark.parametrize("place", [0, 1, 2])
def test_residuals_are_within_a_few_times_the_tolerance(place):
    limits = verify.Limits()
    bounds = np.array([limits.feasibility, limits.tol, limits.tol])
    for factor, good in ((0.5, True), (2.0, False)):
        found = np.zeros(3)
        found[place] = factor * verify.SLACK * bounds[place]
        assert verify.Residuals(*found.tolist(), "").within(limits) is good


def test_groups_without_elements_are_passed_over():
    x, none = ca.SX.sym("x"), ca.SX.sym("none", 0)
    groups = []
    for name, index in (("first", [0]), ("empty", []), ("last", [1])):
        kernel = Kernel(name, x, none, ca.SX.sym("theta", 0), objective=ca.sqrt(x))
        table = Table(
            np.array(index, int).reshape(-1, 1),
            np.zeros((len(index), 0)),
            np.zeros((len(index), 0), int),
        )
        groups.append(Group(kernel, table))
    program = make_program(groups, 2, 0, np.zeros(0))
    assert program.in_objective.tolist() == [True, True]
    assert len(program.stamped) == 2


def test_rows_of_one_superpixel_are_named_by_it_alone():
    nlp, layout = tiny().nlp(PAPER, form(gauge="unit-translation"))
    _, names = readable_names(nlp, layout)
    assert {"so3[0,1]", "so3[11,6]", "normal[3]", "visible[5,1]", "translation[4]"} <= set(names)


def test_a_row_of_residuals_says_whether_it_holds():
    violation = np.array([0.0, 2e-6])
    assert str(kind("so3", violation, 1e-5)).startswith("ok  ")
    assert str(kind("so3", violation, 1e-6)).startswith("FAIL")


def test_an_answer_does_not_print_its_numbers():
    assert "array" not in repr(Sol("done", 0, np.ones(3), np.ones(3)))
