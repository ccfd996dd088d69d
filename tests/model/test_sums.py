"""Sums of kernels in numpy have the values of CasADi's graph."""

import casadi as ca
import numpy as np
import pytest
from helpers_model import GAUGES, Tiny, weights_for
from helpers_nl import plain_nlp

from soup_nlp.errors import ModelError
from soup_nlp.export.symbolic import make_oracle
from soup_nlp.model import operations
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.kernel import Group, Kernel
from soup_nlp.model.nlp import NLP
from soup_nlp.model.programs import build_tangent_nlp
from soup_nlp.solve.functions import Functions


def close(a, b, rtol=1e-9):
    a, b = np.asarray(a), np.asarray(b)
    np.testing.assert_allclose(a, b, rtol=0, atol=rtol * np.abs(b).max(initial=1e-300))


def squares(elements: int, of=lambda x: x) -> NLP:
    """sum_e 3 w_e (x_e^2 + x_e x_0 + x_0^2) subject to x_e^2 x_0 >= 0 for every element e."""
    x, row, theta = ca.SX.sym("x", 2), ca.SX.sym("w"), ca.SX.sym("theta")
    f = theta * row * (x[0] ** 2 + x[0] * x[1] + x[1] ** 2)
    kernel = Kernel("squares", x, row, theta, objective=of(f), constraints=x[0] ** 2 * x[1])
    e = np.arange(elements)
    weight = np.linspace(1.0, 2.0, elements)[:, None]
    group = Group(kernel, np.column_stack([e + 1, 0 * e]), weight, e[:, None])
    own = {"lbg": 0.0, "theta": {"theta": 3.0}}
    return plain_nlp("squares", [group], np.linspace(0.5, 1.5, elements + 1), **own)


@pytest.mark.parametrize("elements", [1, 7, 8, 9, 26])
def test_sums_of_every_size_have_the_values_of_their_formula(elements, monkeypatch):
    monkeypatch.setattr("soup_nlp.model.kernel.BLOCK", 8)
    nlp = squares(elements)
    x, e = nlp.x0, np.arange(elements) + 1
    weight = np.linspace(1.0, 2.0, elements)
    for theta in (3.0, 6.0):
        f = theta * np.sum(weight * (x[e] ** 2 + x[e] * x[0] + x[0] ** 2))
        assert nlp.value(x, np.array([theta])) == pytest.approx(f, rel=1e-14)
    gradient = 3 * weight * (2 * x[e] + x[0])
    np.testing.assert_allclose(nlp.gradient(x)[1:], gradient, rtol=1e-14)
    np.testing.assert_allclose(nlp.constraints(x), x[e] ** 2 * x[0], rtol=1e-14)
    hessian = nlp.hessian(x, np.ones(elements), 0.5)
    diagonal = 3 * weight + 2 * x[0]
    np.testing.assert_allclose(hessian.diagonal()[1:], diagonal, rtol=1e-14)


@pytest.mark.slow
@pytest.mark.parametrize("gauge", [*GAUGES, "tangent"])
def test_the_functions_that_ipopt_takes_are_casadis_derivatives(gauge):
    tiny, weights = Tiny("pixels"), weights_for("pixels")
    if gauge == "tangent":
        nlp, _ = build_tangent_nlp(tiny.soup, tiny.data, weights, Formulation())
    else:
        nlp, _ = tiny.nlp(weights, Formulation(gauge=gauge))
    at, lam_f, lam_g = nlp.x0, 0.7, np.random.default_rng(3).normal(size=nlp.ng)
    oracle, values = make_oracle(nlp)
    theta = nlp.thetas(eps=0.05)
    x, fast = ca.MX.sym("x", nlp.nx), Functions(nlp).derivatives
    f, g = oracle(x, np.concatenate([theta, values[len(theta) :]]))
    H = ca.hessian(lam_f * f + ca.dot(lam_g, g), x)[0]
    expected = ca.Function("e", [x], [f, ca.gradient(f, x), g, ca.jacobian(g, x), ca.triu(H)])(at)
    found = [
        *fast["grad_f"](at, theta),
        *fast["jac_g"](at, theta),
        fast["hess_lag"](at, theta, lam_f, lam_g),
    ]
    for a, b in zip(found, expected, strict=True):
        close(ca.densify(a), ca.densify(b))
    assert fast["hess_lag"].nnz_out(0) == nlp.sizes()["hessian_nonzeros"]
    assert fast["hess_lag"].sparsity_out(0).is_triu()


@pytest.fixture(scope="module")
def every() -> ca.Function:
    """Every operation that kernels may have, of one variable and one number of data."""
    a, b = ca.SX.sym("a"), ca.SX.sym("b")
    small = 0.9 * a / (1 + ca.fabs(a))
    values = [
        a + b - a * b / (2 + b**2),
        -a,
        a**2 + 2 * a + 1 / (9 + a),
        ca.sqrt(9 + a),
        ca.fmax(a, b) - ca.fmin(a, 0.5),
        ca.if_else(a < b, a, b),
        ca.if_else(a <= b, 1, a),
        ca.logic_not(a < b),
        1.5,
        ca.log(9 + a) + ca.exp(b) + ca.sin(a) + ca.cos(a) + ca.tan(small) + ca.atan(a),
        ca.asin(small) + ca.acos(small) + ca.atanh(small) + ca.asinh(a) + ca.acosh(2 + a**2),
        ca.sinh(b) + ca.cosh(b) + ca.tanh(b) + (2 + a**2) ** b + (9 + a) ** 1.5 + ca.atan2(a, b),
    ]
    return ca.Function("every", [a, b, ca.SX(0, 1)], [ca.vertcat(*values)])


@pytest.mark.parametrize("block", [3, 4, 8, 2048])
def test_every_operation_has_casadis_value(every, block, monkeypatch):
    rng, count = np.random.default_rng(2), 8
    x, data, width = rng.normal(size=count), rng.normal(size=(count, 1)), every.nnz_out(0)
    # two elements share their places
    place = (np.arange(count)[:, None] // 2) * width + np.arange(width)
    kernel = Kernel("every", ca.SX.sym("a"), ca.SX.sym("b"), ca.SX(0, 1))
    group = Group(kernel, np.arange(count)[:, None], data, np.zeros((count, 0), np.int64))
    monkeypatch.setattr("soup_nlp.model.kernel.BLOCK", block)
    term = operations.Vectors(every, group)
    entries = np.empty(term.entries)
    term.evaluate(entries, x, np.zeros(0), 1.0, None)
    out = np.bincount(term.ordered(place, 4 * width), entries, 4 * width + 1)
    expected = np.array([np.asarray(every(*pair, [])).ravel() for pair in zip(x, data.ravel())])
    sums = expected[::2] + expected[1::2]
    np.testing.assert_allclose(out[:-1].reshape(4, width), sums, rtol=1e-14)


def test_an_unknown_operation_is_refused():
    with pytest.raises(ModelError, match="unknown operation"):
        squares(3, of=ca.erf).value(np.zeros(4))


def test_lengths_are_checked():
    nlp = squares(5)
    with pytest.raises(ValueError, match="x has 2 entries, expected 6"):
        nlp.value(np.zeros(2))
    with pytest.raises(ValueError, match="lam_g has 1 entries, expected 5"):
        nlp.hessian(np.zeros(6), np.zeros(1))
