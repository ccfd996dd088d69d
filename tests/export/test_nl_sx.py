"""Plain CasADi SX NLPs as .nl files: textbook and random programs read back, errors."""

import casadi as ca
import numpy as np
import pytest
from helpers_nl import ReadBack, close, write_sx_nl
from hypothesis import given, settings
from hypothesis import strategies as st

from soup_nlp.errors import DataError, ExportError
from soup_nlp.export.nl import NLFile


def classes() -> dict:
    """A variable of every class, a row with every kind of bound, a constant in a linear row."""
    x = ca.SX.sym("x", 4)
    a, b, c, d = ca.vertsplit(x)
    g = ca.vertcat(a + d + 0.1, ca.sqrt(b + 2) * b - d, c - 2 * d, a - b, ca.exp(a) / 3 + c)
    return {
        "problem": {"x": x, "f": a**3 + ca.log(c) - 5 * d + 0.25, "g": g},
        "x0": np.array([0.5, 0.25, 2.0, 0.0]),
        "lbx": np.array([-1.0, -np.inf, 1e-3, 2.0]),
        "ubx": np.array([1.0, 7.0, np.inf, 2.0]),
        "lbg": np.array([-np.inf, 0.0, -1.0, 1.0, -np.inf]),
        "ubg": np.array([4.0, 0.0, 1.0, np.inf, np.inf]),
        "x_names": ["a", "b", "c", "d"],
        "g_names": ["upper", "fixed", "range", "lower", "free"],
    }


def shared() -> dict:
    """Shared parts: used by all, by several rows, by one row, by the objective."""
    x = ca.SX.sym("x", 3)
    every = ca.sqrt(x[0] ** 2 + x[1] + 1)
    rows = ca.exp(x[2] - x[0]) * 2
    one, last = abs(x[1] - x[2]) + 3, -(x[0] * x[1] + 2 * x[2])
    g = ca.vertcat(every + rows, every * rows, one * ca.exp(one) / every)
    return {"problem": {"x": x, "f": last * ca.exp(last) + every, "g": g}, "x0": np.ones(3)}


def degenerate() -> dict:
    """A linear objective; rows that are nothing, a number, a variable, and twice the same."""
    x = ca.SX.sym("x", 3)
    g = ca.vertcat(ca.SX(1, 1), 2.5, x[2], *[ca.exp(x[0] * x[1])] * 2)
    return {"problem": {"x": x, "f": 3 * x[0] - x[1] + 1.5, "g": g}, "x0": np.ones(3)}


@pytest.mark.parametrize(
    ("make", "digest"),
    [(classes, "758a9de2"), (shared, "86b9e856"), (degenerate, "fafad1b5")],
)
def test_textbook_problems_read_back_and_keep_their_bytes(make, digest, tmp_path):
    given = make()
    file = write_sx_nl(tmp_path / "p.nl", **given)
    assert file.sha256.startswith(digest)
    same_as_sx(given["problem"], file, given["x0"] + 0.1)
    back = ReadBack(file.path)
    for name in {"x0", "lbx", "ubx", "lbg", "ubg"} & given.keys():
        order = file.rows if name.endswith("g") else file.variables
        assert np.array_equal(getattr(back, name), given[name][order]), name


def same_as_sx(problem: dict, file: NLFile, at: np.ndarray) -> None:
    x, f, g = problem["x"], problem["f"], problem.get("g", ca.SX(0, 1))
    lam_f, lam_g = ca.SX.sym("lam_f"), ca.SX.sym("lam_g", g.numel())
    lagrangian = lam_f * f + (ca.dot(lam_g, g) if g.numel() else 0)
    values = ca.Function("v", [x], [f, ca.densify(g), ca.gradient(f, x), ca.jacobian(g, x)])
    hess = ca.Function("h", [x, lam_f, lam_g], [ca.hessian(lagrangian, x)[0]])
    back, v, r = ReadBack(file.path), file.variables, file.rows
    f0, g0, d0, J0 = (np.array(k) for k in values(at))
    f1, g1, d1, J1 = (np.array(k) for k in back.values(at[v]))
    close(f1, f0)
    close(g1, g0[r])
    close(d1, d0[v])
    close(J1, J0[np.ix_(r, v)])
    lam = np.linspace(-1, 2, len(r))
    H = np.array(hess(at, 0.3, lam))
    for way in np.eye(len(v)):
        close(back.hess(at[v], 0.3, lam[r], way[v]), (H @ way)[v])


def test_pounce_reads_every_function(tmp_path):
    """CasADi's reader knows neither min and max nor the inverses of hyperbolic functions."""
    pounce = pytest.importorskip("pounce", reason="pounce-solver is not installed")
    x = ca.SX.sym("x", 2)
    a, b = ca.vertsplit(x)
    of_a = [ca.exp, ca.sin, ca.cos, ca.tan, ca.asin, ca.acos, ca.atan, ca.fabs, ca.sqrt]
    of_a += [ca.sinh, ca.cosh, ca.tanh, ca.asinh, ca.atanh, ca.log]
    f = sum(k * function(a) for k, function in enumerate(of_a, 1)) + ca.acosh(b) + ca.atan2(a, b)
    f += ca.fmax(a, b) - ca.fmin(a, b**2) + a**b + b**1.5
    file, at = write_sx_nl(tmp_path / "p.nl", {"x": x, "f": f}), np.array([0.6, 1.7])
    back = pounce.read_nl(str(file.path))
    value, gradient = ca.Function("f", [x], [f, ca.gradient(f, x)])(at)
    close(back.objective(at), value)
    close(back.gradient(at), gradient)


@pytest.mark.parametrize(
    ("operation", "make"),
    [
        ("sign", lambda a, b, c: ca.sign(a) * b),
        ("floor", lambda a, b, c: ca.floor(a) * b),
        ("ceil", lambda a, b, c: b + 3 * ca.ceil(a)),
        ("not", lambda a, b, c: ca.logic_not(a) * b),
        ("fmod", lambda a, b, c: ca.fmod(a, b)),
        ("remainder", lambda a, b, c: ca.remainder(a, b)),
        ("lt", lambda a, b, c: ca.if_else(a > 0.5, b, c) ** 2),
        ("sign", lambda a, b, c: ca.exp(c) + ca.sign(ca.sqrt(a)) * 2),
    ],
)
def test_piecewise_constant_parts_are_refused(operation, make, tmp_path):
    x = ca.SX.sym("x", 3)
    bad = make(x[0], x[1], x[2])
    for problem in ({"f": bad}, {"f": x[0] ** 2, "g": ca.vertcat(x[1], bad)}):
        with pytest.raises(ExportError, match=rf"(?s)cannot be written.*: {operation}$"):
            write_sx_nl(tmp_path / "a.nl", {"x": x, **problem})
    assert not list(tmp_path.iterdir())


def test_expressions_that_cannot_be_written_are_refused(tmp_path):
    x = ca.SX.sym("x")
    with pytest.raises(ExportError, match="not finite"):
        write_sx_nl(tmp_path / "a.nl", {"x": x, "f": x**2 * np.inf})
    with pytest.raises(DataError, match="cannot be written"):
        write_sx_nl(tmp_path / "none" / "a.nl", {"x": x, "f": x**2})
    assert not list(tmp_path.rglob("*.nl"))


BINARY = (
    lambda a, b: a + b,
    lambda a, b: a - b,
    lambda a, b: a * b,
    lambda a, b: a / (b**2 + 1),
    lambda a, b: (a**2 + 1) ** (b / 8),
)


UNARY = (
    lambda a: -a,
    lambda a: a**2,
    lambda a: ca.sqrt(a**2 + 1),
    lambda a: ca.exp(a / 8),
    lambda a: ca.log(a**2 + 2),
    lambda a: 2 * a,
    lambda a: 1 / (a**2 + 3),
    ca.sin,
    ca.cos,
    ca.atan,
    ca.tanh,
    ca.fabs,
)


@st.composite
def programs(draw):
    """Random expressions of variables and numbers, which may be used repeatedly."""
    n, m = draw(st.integers(1, 4)), draw(st.integers(0, 3))
    x = ca.SX.sym("x", n)
    pool = [x[k] for k in range(n)]
    number = st.floats(-3, 3, allow_subnormal=False)
    for _ in range(draw(st.integers(1, 12))):
        a = pool[draw(st.integers(0, len(pool) - 1))]
        if draw(st.booleans()):
            b = pool[draw(st.integers(0, len(pool) - 1))]
            pool.append(draw(st.sampled_from(BINARY))(a, b))
        elif draw(st.booleans()):
            pool.append(draw(st.sampled_from(UNARY))(a))
        else:
            pool.append(a * draw(number) + draw(number))
    outputs = []
    for _ in range(m + 1):
        term = pool[draw(st.integers(0, len(pool) - 1))]
        outputs.append(term + draw(number) * x[draw(st.integers(0, n - 1))])
    at = np.array([draw(st.floats(-2, 2, allow_subnormal=False)) for _ in range(n)])
    return {"x": x, "f": outputs[0], "g": ca.vertcat(*outputs[1:])}, at


@pytest.mark.slow
@settings(max_examples=80)
@given(program=programs())
def test_random_programs_read_back(program, tmp_path_factory):
    problem, at = program
    if not problem["g"].numel():
        del problem["g"]
    values = ca.Function("v", [problem["x"]], [problem["f"], problem.get("g", ca.SX(0, 1))])
    if any(not np.abs(np.array(v)).max(initial=0.0) < 1e6 for v in values(at)):
        return
    file = write_sx_nl(tmp_path_factory.getbasetemp() / "random.nl", problem)
    same_as_sx(problem, file, at)
