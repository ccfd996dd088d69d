"""Machine code, numpy and CasADi's graph give the same numbers; the cache of machine code."""

import logging
import os
from dataclasses import replace
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from helpers_nl import plain_nlp

from soup_nlp.errors import ModelError
from soup_nlp.model import compile as compiling
from soup_nlp.model import vectors
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.kernel import Group, Kernel
from soup_nlp.model.lanes import LANES, Summed, compile_lanes
from soup_nlp.model.matrix import build_matrix_nlp
from soup_nlp.model.nlp import NLP
from soup_nlp.model.symbolic import Graph
from soup_nlp.model.tangent_nlp import build_tangent_nlp
from soup_nlp.pipeline.record import Case
from soup_nlp.solve.functions import Functions

pytestmark = pytest.mark.slow

needs_compiler = pytest.mark.skipif(not compiling.find_compiler(), reason="no C compiler")


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


def engine(nlp: NLP) -> type:
    """Class of the terms of f."""
    return type(nlp.evaluated()._first["f"][1][0])


def squares(elements: int, compiled: bool = True, of=lambda x: x) -> NLP:
    """sum_e 3 w_e (x_e^2 + x_e x_0 + x_0^2) subject to x_e^2 x_0 >= 0 for every element e."""
    x, row, theta = ca.SX.sym("x", 2), ca.SX.sym("w"), ca.SX.sym("theta")
    f = theta * row * (x[0] ** 2 + x[0] * x[1] + x[1] ** 2)
    kernel = Kernel("squares", x, row, theta, objective=of(f), constraints=x[0] ** 2 * x[1])
    e = np.arange(elements)
    weight = np.linspace(1.0, 2.0, elements)[:, None]
    group = Group(kernel, np.column_stack([e + 1, 0 * e]), weight, e[:, None])
    own = {"lbg": 0.0, "theta": {"theta": 3.0}, "compiled": compiled}
    return plain_nlp("squares", [group], np.linspace(0.5, 1.5, elements + 1), **own)


def assert_same(one: NLP, two: NLP, x: np.ndarray, theta: np.ndarray, rtol: float) -> None:
    lam = np.random.default_rng(0).uniform(-1, 1, one.ng)
    close(one.value(x, theta), two.value(x, theta), rtol)
    close(one.gradient(x, theta), two.gradient(x, theta), rtol)
    close(one.constraints(x, theta), two.constraints(x, theta), rtol)
    close(one.jacobian_nonzeros(x, theta), two.jacobian_nonzeros(x, theta), rtol)
    both = (n.hessian_nonzeros(x, lam, 0.5, theta) for n in (one, two))
    close(*both, rtol)


# --- the same numbers ----------------------------------------------------------------------------


@needs_compiler
@pytest.mark.parametrize("chart", ["depth", "inverse-depth"])
@pytest.mark.parametrize("kind", ["gauss-newton+constraints", "exact"])
def test_machine_code_and_numpy_give_the_same_presolve(case, chart, kind):
    own = case.soup, case.data, case.weights
    fast, slow = (
        build_tangent_nlp(*own, Formulation(compiled=compiled, hessian=kind), chart)[0]
        for compiled in (True, False)
    )
    assert (engine(fast), engine(slow)) == (Summed, vectors.Vectors)
    x = fast.x0 * (1 + 0.01 * np.random.default_rng(1).normal(size=fast.nx))
    for eps in (0.1, 0.01):
        theta = fast.thetas(eps=eps, eps_pixel=eps)
        assert fast.value(x, theta) == pytest.approx(slow.value(x, theta), rel=1e-12)
        assert_same(fast, slow, x, theta, 1e-9)


@needs_compiler
@pytest.mark.parametrize("elements", [1, LANES - 1, LANES, LANES + 1, 3 * LANES + 2])
def test_tables_of_every_size(elements):
    nlp, other = squares(elements), squares(elements, compiled=False)
    for theta in (3.0, 6.0):
        assert_same(nlp, other, nlp.x0, np.array([theta]), 1e-14)
        # f is proportional to the parameter; the program's own is 3
        found = nlp.value(nlp.x0, np.array([theta]))
        assert found == pytest.approx(theta / 3 * nlp.value(nlp.x0), rel=1e-14)


@pytest.mark.parametrize(
    ("gauge", "norm"), [("unit-offset", "smooth"), ("unit-translation", "epigraph")]
)
def test_the_functions_that_ipopt_takes_are_those_of_the_graph(case, gauge, norm):
    form = Formulation(gauge=gauge, norm=norm)
    nlp, _ = build_matrix_nlp(case.soup, case.data, case.weights, form)
    x, lam_f, lam_g = nlp.x0, 0.7, np.random.default_rng(3).normal(size=nlp.ng)
    graph, theta = Graph(nlp), nlp.thetas(eps=0.05)
    p = np.concatenate([theta, graph.p[len(theta) :]])
    names = ("oracle", "grad_f", "jac_g")
    expected = [graph.hess_lag(x, p, lam_f, lam_g)]
    expected += [value for name in names for value in getattr(graph, name)(x, p)]
    for compiled in (True, False):
        fast = Functions(replace(nlp, compiled=compiled))
        found = [fast.hess_lag(x, theta, lam_f, lam_g)]
        found += [value for name in names for value in getattr(fast, name)(x, theta)]
        for a, b in zip(found, expected, strict=True):
            assert a.sparsity() == b.sparsity()
            close(a.nonzeros(), b.nonzeros())
        assert fast.hess_lag.nnz_out(0) == nlp.nnzh
        assert fast.hess_lag.sparsity_out(0).is_triu()


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


@pytest.mark.parametrize(
    "block", [3, 4, 8, 2048, pytest.param(None, marks=needs_compiler, id="machine code")]
)
def test_every_operation_has_casadis_value(every, block, monkeypatch):
    rng, count = np.random.default_rng(2), 8
    x, data, width = rng.normal(size=count), rng.normal(size=(count, 1)), every.nnz_out(0)
    # two elements share their places
    place = (np.arange(count)[:, None] // 2) * width + np.arange(width)
    kernel = Kernel("every", ca.SX.sym("a"), ca.SX.sym("b"), ca.SX(0, 1))
    group = Group(kernel, np.arange(count)[:, None], data, np.zeros((count, 0), np.int64))
    out = np.ones(4 * width + 1)
    if block:
        monkeypatch.setattr(vectors, "BLOCK", block)
        term = vectors.Vectors(every, group, place, 4 * width)
    else:
        blocks = group.blocks(LANES, np.int32)
        term = Summed(compile_lanes([every]), every, blocks, place, 4 * width)
    term.add(out, x, np.zeros(0), 1.0, None)
    expected = np.array([np.asarray(every(*pair, [])).ravel() for pair in zip(x, data.ravel())])
    sums = 1 + expected[::2] + expected[1::2]
    np.testing.assert_allclose(out[:-1].reshape(4, width), sums, rtol=1e-14)


def test_an_unknown_operation_is_refused():
    with pytest.raises(ModelError, match="unknown operation"):
        squares(3, of=ca.erf).value(np.zeros(4))


def test_lengths_are_checked_before_machine_code_reads():
    nlp = squares(5)
    with pytest.raises(ValueError, match="x has 2 entries, expected 6"):
        nlp.value(np.zeros(2))
    with pytest.raises(ValueError, match="lam_g has 1 entries, expected 5"):
        nlp.hessian(np.zeros(6), np.zeros(1))


# --- the cache, and where there is no compiler ---------------------------------------------------


def test_kernels_serve_another_camera(case):
    """The cache of machine code goes by the expressions of a kernel, which equality compares."""
    K = case.data.K_next * np.array([[1.1], [1.2], [1.0]])
    kernels = []
    for data in (case.data, replace(case.data, K_next=K)):
        nlp, _ = build_tangent_nlp(case.soup, data, case.weights, Formulation())
        kernels.append([group.kernel for group in nlp.groups])
    assert kernels[0] == kernels[1]
    assert len(set(kernels[0])) == len(kernels[0])


@pytest.mark.parametrize("cc", ["/bin/false", "/no/such/compiler"])
def test_without_a_working_compiler_numpy_does_it(cc, own_cache, monkeypatch, caplog):
    monkeypatch.setenv("CC", cc)
    nlp = squares(5)
    with caplog.at_level(logging.INFO):
        assert engine(nlp) is vectors.Vectors
    assert "no machine code" in caplog.text
    assert_same(nlp, squares(5, compiled=False), nlp.x0, np.array([2.0]), 1e-14)
    assert not list(own_cache.glob("*"))


@needs_compiler
def test_an_unusable_cache_folder_costs_speed_only(tmp_path, monkeypatch):
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    monkeypatch.setenv("SOUP_NLP_CACHE", str(blocked))
    assert engine(squares(5)) is Summed


@needs_compiler
def test_a_library_that_does_not_load_is_replaced_by_numpy(monkeypatch, tmp_path):
    broken = tmp_path / "broken.so"
    broken.write_text("not a library")
    monkeypatch.setattr("soup_nlp.model.lanes.shared_library", lambda key, source: broken)
    assert engine(squares(5)) is vectors.Vectors


SOURCE = "double two(void) { return 2; }\n"


@needs_compiler
def test_nothing_is_compiled_where_no_program_can_run(own_cache, monkeypatch, caplog):
    caplog.set_level("INFO")
    flags, free = SimpleNamespace(f_flag=os.ST_NOEXEC), SimpleNamespace(f_flag=0)
    monkeypatch.setattr(os, "statvfs", lambda folder: flags if folder == own_cache else free)
    made = compiling.shared_library("key", lambda: SOURCE)
    assert made.parent != own_cache
    assert "noexec" in caplog.text
    monkeypatch.setattr(os, "statvfs", lambda folder: flags)
    assert engine(squares(5)) is vectors.Vectors
    assert "on the PATH" not in caplog.text


@needs_compiler
def test_a_compiler_may_have_options(own_cache, monkeypatch):
    compiler = compiling.find_compiler()[0]
    monkeypatch.setenv("CC", f"{compiler} -DTHREE=3")
    made = compiling.shared_library("key", lambda: "double three(void) { return THREE; }\n")
    assert made.is_file()
    monkeypatch.setenv("CC", "no-such-compiler")
    assert compiling.find_compiler() == []


@needs_compiler
def test_a_library_is_compiled_once(own_cache):
    made = compiling.shared_library("key", lambda: SOURCE)
    assert made.parent == own_cache
    stamp = made.stat().st_mtime_ns
    assert compiling.shared_library("key", lambda: pytest.fail("compiled again")) == made
    assert made.stat().st_mtime_ns == stamp


@needs_compiler
@pytest.mark.parametrize("mode", [0o720, 0o702])
@pytest.mark.parametrize("what", ["library", "folder"])
def test_what_others_can_write_is_not_used(what, mode, own_cache, caplog):
    own_cache.mkdir(mode=0o700)
    blocked = own_cache
    if what == "library":
        blocked = compiling.shared_library("key", lambda: SOURCE)
    blocked.chmod(mode)
    other = compiling.shared_library("key", lambda: SOURCE)
    assert other.is_file()
    assert other.parent != own_cache
    assert what == "library" or not list(own_cache.iterdir())
    assert "others can write" in caplog.text


@needs_compiler
def test_a_source_that_would_take_minutes_is_not_compiled(own_cache, caplog, monkeypatch):
    monkeypatch.setattr(compiling, "MOST_SOURCE", len(SOURCE) - 1)
    assert compiling.shared_library("key", lambda: SOURCE) is None
    assert "would take minutes" in caplog.text
