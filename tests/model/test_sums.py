"""Sums on vectors of elements: equal to CasADi's, at every size, and honest where impossible."""

from __future__ import annotations

import ctypes
import logging
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from soup_nlp.model import compile as compiling
from soup_nlp.model import vectors
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.kernel import Group, Kernel, Table
from soup_nlp.model.lanes import LANES, NoLanesError, compile_lanes, in_lanes
from soup_nlp.model.layout import Chart
from soup_nlp.model.mapped import Mapped
from soup_nlp.model.matrix import build_matrix_nlp
from soup_nlp.model.nlp import NLP
from soup_nlp.model.sums import Sums, interpreted
from soup_nlp.model.tangent_nlp import build_tangent_nlp
from soup_nlp.pipeline.case import Case
from soup_nlp.solve.functions import Functions
from soup_nlp.solve.ipopt import Ipopt

pytestmark = pytest.mark.slow

needs_compiler = pytest.mark.skipif(compiling.find_compiler() is None, reason="no C compiler")


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("SOUP_NLP_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture(scope="module")
def case(small_room: Case) -> Case:
    return small_room


def close(a, b, rtol=1e-9):
    a, b = np.asarray(a), np.asarray(b)
    np.testing.assert_allclose(a, b, rtol=0, atol=rtol * np.abs(b).max(initial=1e-300))


def squares(elements: int, compiled: bool = True) -> NLP:
    """sum_e 3 w_e (x_e^2 + x_e x_0 + x_0^2) subject to x_e^2 x_0 >= 0 for every element e."""
    x, row, theta = ca.SX.sym("x", 2), ca.SX.sym("w"), ca.SX.sym("theta")
    kernel = Kernel(
        "squares",
        x,
        row,
        theta,
        objective=theta * row * (x[0] ** 2 + x[0] * x[1] + x[1] ** 2),
        constraints=x[0] ** 2 * x[1],
    )
    e = np.arange(elements)
    table = Table(
        np.column_stack([e + 1, 0 * e]), np.linspace(1.0, 2.0, elements)[:, None], e[:, None]
    )
    n = elements + 1
    return NLP(
        "squares",
        (Group(kernel, table),),
        x0=np.linspace(0.5, 1.5, n),
        lbx=np.full(n, -np.inf),
        ubx=np.full(n, np.inf),
        lbg=np.zeros(elements),
        ubg=np.full(elements, np.inf),
        theta={"theta": 3.0},
        hessian="exact",
        x_names=lambda: [f"x[{i}]" for i in range(n)],
        g_names=lambda: [f"g[{i}]" for i in range(elements)],
        compiled=compiled,
    )


# --- the same numbers ----------------------------------------------------------------------------


@needs_compiler
@pytest.mark.parametrize("chart", ["depth", "inverse-depth"])
@pytest.mark.parametrize("kind", ["gauss-newton+constraints", "exact"])
def test_vectors_and_functions_give_the_same_presolve(case, chart: Chart, kind):
    fast, slow = (
        build_tangent_nlp(
            case.soup,
            case.data,
            case.weights,
            Formulation(compiled=compiled, hessian=kind),
            chart,
        )[0]
        for compiled in (True, False)
    )
    rng = np.random.default_rng(1)
    x = fast.x0 * (1 + 0.01 * rng.normal(size=fast.nx))
    lam = rng.uniform(0.1, 1.0, fast.ng)
    one, two = Sums(fast, second_order=True), Sums(slow, second_order=True)
    assert one.vectorised
    assert not two.vectorised
    for eps in (0.1, 0.01):
        one.theta = two.theta = fast.thetas(eps=eps, eps_pixel=eps)
        assert one.value(x) == pytest.approx(two.value(x), rel=1e-12)
        close(one.gradient(x), two.gradient(x))
        for a, b in zip(one.constraints(x), two.constraints(x)):
            close(a, b)
        close(one.hessian(x, lam), two.hessian(x, lam))


@needs_compiler
@pytest.mark.parametrize("elements", [1, LANES - 1, LANES, LANES + 1, 3 * LANES + 2])
def test_tables_of_every_size(elements):
    nlp, other = squares(elements), squares(elements, compiled=False)
    fast, slow = Sums(nlp, second_order=True), Sums(other, second_order=True)
    x, lam = nlp.x0, np.linspace(-1, 1, elements)
    assert fast.value(x) == pytest.approx(slow.value(x), rel=1e-14)
    close(fast.gradient(x), slow.gradient(x), 1e-14)
    for a, b in zip(fast.constraints(x), slow.constraints(x)):
        close(a, b, 1e-14)
    close(fast.hessian(x, lam, 0.5), slow.hessian(x, lam, 0.5), 1e-14)
    assert all(seconds > 0 for seconds in fast.seconds.values())


@needs_compiler
def test_other_parameters_are_used():
    nlp = squares(5)
    sums = Sums(nlp, second_order=True)
    before = sums.value(nlp.x0)
    sums.theta = np.array([6.0])
    assert sums.value(nlp.x0) == pytest.approx(2 * before, rel=1e-14)


@needs_compiler
def test_lengths_are_checked_before_machine_code_reads():
    sums = Sums(squares(5), second_order=True)
    with pytest.raises(ValueError, match="x has 2 entries, expected 6"):
        sums.value(np.zeros(2))
    with pytest.raises(ValueError, match="lam_g has 1 entries, expected 5"):
        sums.hessian(np.zeros(6), np.zeros(1))


@pytest.fixture(scope="module")
def every() -> ca.Function:
    """Every operation that kernels may have, of one variable and one number of data."""
    a, b = ca.SX.sym("a"), ca.SX.sym("b")
    component = ca.vertcat(
        a + b - a * b / (2 + b),
        -a,
        a**2 + 2 * a + 1 / (3 + a),
        ca.sqrt(4 + a),
        ca.fmax(a, b) - ca.fmin(a, 0.5),
        ca.fabs(b),
        ca.if_else(a < b, a, b),
        ca.if_else(a <= b, 1, a),
        ca.logic_not(a < b),
        1.5,
    )
    return ca.Function("every", [a, b, ca.SX(0, 1)], [component])


@pytest.mark.parametrize("block", [3, 4, 8, 2048])
def test_numpy_has_casadis_value_of_every_operation(every, block, monkeypatch):
    monkeypatch.setattr(vectors, "BLOCK", block)
    rng = np.random.default_rng(2)
    x, data, count = rng.normal(size=8), rng.normal(size=(8, 1)), 8
    # two elements share their places
    place = (np.arange(count)[:, None] // 2) * 10 + np.arange(10)
    table = Table(np.arange(count)[:, None], data, np.zeros((0, 0), np.int64))
    out = np.ones(40)
    vectors.Vectors(every, table, place).add(out, x, np.zeros(0), 1.0, None)
    expected = np.array([np.asarray(every(*pair, [])).ravel() for pair in zip(x, data.ravel())])
    np.testing.assert_allclose(out.reshape(4, 10), 1 + expected[::2] + expected[1::2], rtol=1e-14)


def test_an_operation_without_a_twin_goes_to_casadi():
    x, w = ca.SX.sym("x"), ca.SX.sym("w")
    f = ca.Function("sine", [x, w, ca.SX(0, 1)], [w * ca.sin(x)])
    table = Table(np.arange(3)[:, None], np.ones((3, 1)), np.zeros((0, 0), np.int64))
    term = interpreted(f, table, np.zeros((3, 1), int))
    assert isinstance(term, Mapped)
    out = np.zeros(1)
    term.add(out, np.array([0.1, 0.2, 0.3]), np.zeros(0), 1.0, None)
    assert out[0] == pytest.approx(np.sin([0.1, 0.2, 0.3]).sum(), rel=1e-14)


@needs_compiler
def test_every_operation_has_casadis_value(every):
    f = every
    library = compile_lanes([f])
    rng = np.random.default_rng(2)
    x, data = rng.normal(size=(LANES, 1)), rng.normal(size=(LANES, 1))
    place = np.arange(LANES * 10).reshape(LANES, 10)
    index, places = in_lanes(np.arange(LANES)[:, None], np.int32), in_lanes(place, np.int32)
    out, none, lanes = np.zeros(LANES * 10), np.zeros(1), in_lanes(data)
    pointers = [ctypes.c_void_p(q.ctypes.data) for q in (x, index, lanes, none)]
    rest = [ctypes.c_void_p(q.ctypes.data) for q in (none, index, places, out)]
    library.every_sum(ctypes.c_long(1), *pointers, ctypes.c_double(1.0), *rest)
    expected = [np.asarray(f(*pair, [])).ravel() for pair in zip(x.ravel(), data.ravel())]
    np.testing.assert_allclose(out.reshape(LANES, 10), expected, rtol=1e-14)


@pytest.mark.parametrize("compiled", [True, False])
def test_the_functions_that_ipopt_takes_are_the_programs(case, compiled):
    form = Formulation(compiled=compiled)
    nlp, _ = build_matrix_nlp(case.soup, case.data, case.weights, form)
    rng = np.random.default_rng(3)
    x, lam_f, lam_g = nlp.x0, 0.7, rng.normal(size=nlp.ng)
    fast, theta, p = Functions(nlp), nlp.thetas(eps=0.05), nlp.with_theta(eps=0.05)
    one = [fast.hess_lag(x, theta, lam_f, lam_g)]
    two = [nlp.hess_lag(x, p, lam_f, lam_g)]
    for name in ("oracle", "grad_f", "jac_g"):
        one += getattr(fast, name)(x, theta)
        two += getattr(nlp, name)(x, p)
    for a, b in zip(one, two, strict=True):
        assert a.sparsity() == b.sparsity()
        close(a.nonzeros(), b.nonzeros())
    assert fast.hess_lag.nnz_out(0) == nlp.nnzh
    # another theta in Ipopt leaves that of the program
    assert nlp.sums.value(x) == pytest.approx(float(nlp.oracle(x, nlp.p)[0]), rel=1e-12)


@needs_compiler
def test_ipopt_converges_with_it():
    stage = Ipopt(squares(9))(x0=np.full(10, 0.7), tol=1e-8)
    assert stage.converged
    assert stage.objective == pytest.approx(0.0, abs=1e-6)


def test_an_assembled_program_is_not_assembled_again(monkeypatch):
    nlp = squares(3, compiled=False).assembled()
    oracle, hessian = nlp.oracle, nlp.hess_lag
    monkeypatch.setattr("soup_nlp.model.nlp.assemble_functions", None)
    monkeypatch.setattr("soup_nlp.model.nlp.assemble_hessian", None)
    assert nlp.oracle is oracle
    assert nlp.hess_lag is hessian


# --- the cache, and where there is no way --------------------------------------------------------


def test_kernels_serve_another_camera(case):
    """The cache of machine code goes by the expressions of a kernel, which equality compares."""
    K = case.data.K_next * np.array([[1.1], [1.2], [1.0]])
    kernels = []
    for data in (case.data, replace(case.data, K_next=K)):
        nlp, _ = build_tangent_nlp(case.soup, data, case.weights, Formulation())
        kernels.append([group.kernel for group in nlp.groups])
    assert kernels[0] == kernels[1]
    assert len(set(kernels[0])) == len(kernels[0])


@needs_compiler
def test_an_operation_without_a_twin_is_refused(own_cache):
    x, nothing = ca.SX.sym("x"), ca.SX(0, 1)
    with pytest.raises(NoLanesError, match="waves: operation"):
        compile_lanes([ca.Function("waves", [x, nothing, nothing], [ca.sin(x)])])


def test_without_a_compiler_functions_do_it(own_cache, monkeypatch, caplog):
    monkeypatch.setenv("CC", "/bin/false")
    nlp = squares(5)
    with caplog.at_level(logging.INFO):
        sums = Sums(nlp, second_order=True)
    assert not sums.vectorised
    assert "no machine code on vectors" in caplog.text
    assert sums.value(nlp.x0) == pytest.approx(float(nlp.oracle(nlp.x0, nlp.p)[0]), rel=1e-14)


@needs_compiler
def test_a_library_that_does_not_load_is_no_way(monkeypatch, tmp_path):
    broken = tmp_path / "broken.so"
    broken.write_text("not a library")
    monkeypatch.setattr("soup_nlp.model.lanes.shared_library", lambda key, source: broken)
    assert not Sums(squares(5), second_order=True).vectorised
