"""The .nl file says exactly what the NLP says: read back by CasADi, ASL, POUNCE and SCIP."""

from __future__ import annotations

import itertools
import json
import os
import shutil
import subprocess
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from helpers_model import (
    GAUGES,
    PAPER,
    TRUNCATED,
    Tiny,
    gradient,
    hessian,
    jacobian,
    value,
    wiggle,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from soup_nlp.errors import DataError, ExportError
from soup_nlp.export.names import readable_names
from soup_nlp.export.nl import NLFile, write_nl, write_sx_nl
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.nlp import NLP

FORMS = [
    Formulation(gauge=g, norm=n, truncation=t, hessian="exact", compiled=False)
    for g, n, t in itertools.product(GAUGES, ("smooth", "epigraph"), ("smooth", "lifted"))
]
GOLDEN = Path(__file__).parent / "golden_nl"


def form_id(form: Formulation) -> str:
    return f"{form.gauge}-{form.norm}-{form.truncation}"


class ReadBack:
    """A .nl file as CasADi reads it: sizes, bounds, start and derivatives of its own."""

    def __init__(self, path: Path) -> None:
        builder = ca.NlpBuilder()
        builder.import_nl(str(path), {})
        self.x0 = np.array(builder.x_init)
        self.lbx, self.ubx = np.array(builder.x_lb), np.array(builder.x_ub)
        self.lbg, self.ubg = np.array(builder.g_lb), np.array(builder.g_ub)
        x = ca.vertcat(*builder.x)
        f, g = builder.f, ca.vertcat(*builder.g)
        # SX is quicker to differentiate
        plain = ca.Function("nl", [x], [f, ca.densify(g)]).expand()
        s = ca.SX.sym("x", x.numel())
        lam_f, lam_g = ca.SX.sym("lam_f"), ca.SX.sym("lam_g", g.numel())
        f, g = plain(s)
        self._inputs = [s, lam_f, lam_g]
        self._lagrangian = lam_f * f + (ca.dot(lam_g, g) if g.numel() else 0)
        self.values = ca.Function("v", [s], [f, g, ca.gradient(f, s), ca.jacobian(g, s)])

    def hess(self, *at: object) -> ca.DM:
        """Lagrangian's Hessian at (x, lam_f, lam_g)."""
        H = ca.hessian(self._lagrangian, self._inputs[0])[0]
        return ca.Function("h", self._inputs, [H])(*at)


def close(found: object, expected: object) -> None:
    """Equal to 1e-12 of the largest number."""
    a = np.asarray(found, float)
    b = np.asarray(expected, float).reshape(a.shape)
    assert np.isfinite(a).all()
    assert np.abs(a - b).max(initial=0.0) <= 1e-12 * max(1.0, np.abs(b).max(initial=0.0))


def agrees(nlp: NLP, file: NLFile, back: ReadBack, x: np.ndarray, seed: int) -> None:
    """Everything that CasADi reads equals the NLP, after the order of the file."""
    v, r = file.variables, file.rows
    for name in ("x0", "lbx", "ubx"):
        assert np.array_equal(getattr(back, name), getattr(nlp, name)[v]), name
    for name in ("lbg", "ubg"):
        assert np.array_equal(getattr(back, name), getattr(nlp, name)[r]), name
    f, g, grad, J = back.values(x[v])
    f0, g0 = value(nlp, x)
    close(f, f0)
    close(g, g0[r])
    close(grad, gradient(nlp, x)[v])
    close(J, jacobian(nlp, x)[np.ix_(r, v)])
    rng = np.random.default_rng(seed)
    lam_f, lam_g = rng.normal(), rng.normal(size=nlp.ng)
    close(back.hess(x[v], lam_f, lam_g[r]), hessian(nlp, x, lam_f, lam_g)[np.ix_(v, v)])


# --- the soup ------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", FORMS, ids=form_id)
def test_casadi_reads_back_every_formulation(form, tmp_path):
    tiny = Tiny()
    nlp, layout = tiny.nlp(TRUNCATED if form.truncation == "lifted" else PAPER, form)
    file = write_nl(tmp_path / "soup.nl", nlp, names=readable_names(nlp, layout))
    back = ReadBack(file.path)
    for seed, size in ((0, 0.02), (1, 0.2)):
        agrees(nlp, file, back, wiggle(nlp, layout.size, seed, size), seed)
    assert file.jacobian_nonzeros == nlp.nnzj
    assert file.size == file.path.stat().st_size


def test_parameters_decide_the_numbers_of_the_file(tmp_path):
    nlp, _ = Tiny().nlp(PAPER, FORMS[0])
    p = nlp.with_theta(eps=0.5)
    back = ReadBack(write_nl(tmp_path / "a.nl", nlp, p=p, x0=nlp.x0 + 0.25).path)
    file = write_nl(tmp_path / "b.nl", nlp)
    assert np.array_equal(back.x0, (nlp.x0 + 0.25)[file.variables])
    f = float(back.values(nlp.x0[file.variables])[0])
    assert f == pytest.approx(float(nlp.oracle(nlp.x0, p)[0]), rel=1e-13)
    assert abs(f - value(nlp, nlp.x0)[0]) > 1e-3


def test_what_superpixels_share_is_written_once(tmp_path):
    nlp, layout = Tiny().nlp(PAPER, FORMS[0])
    file = write_nl(tmp_path / "soup.nl", nlp)
    # smooth norms live in the objective alone; lam / (m . r) of an anchor is one of them
    assert file.defined[:4] == (0, 0, 0, 0)
    bodies = file.path.read_text().split("\nV")[1:]
    texts = [b.partition("\n")[2].partition("\nO0")[0] for b in bodies]
    assert len(texts) == file.defined[4]
    assert len(set(texts)) == len(texts)
    scales = {int(np.flatnonzero(file.variables == v)[0]) for v in layout.of(np.arange(12))[:, 0]}
    depths = [t for t in texts if t.startswith("o3\nv") and int(t.split("\n")[1][1:]) in scales]
    # every anchor once, and at most one more for each end of each boundary point
    assert len(depths) <= 12 + 2 * 2 * 17
    epigraph, _ = Tiny().nlp(TRUNCATED, Formulation(norm="epigraph", compiled=False))
    both, rows, _, one_row, objective = write_nl(tmp_path / "e.nl", epigraph).defined
    assert both == 0
    assert rows > 0
    assert one_row > 0
    assert objective > 0


def test_classes_are_those_of_the_format(tmp_path):
    nlp, layout = Tiny().nlp(PAPER, FORMS[0])
    file = write_nl(tmp_path / "soup.nl", nlp, names=readable_names(nlp, layout))
    in_rows, in_objective, both = file.nonlinear
    names = np.array((tmp_path / "soup.col").read_text().split())
    # n and R are in SO(3) and |n| = 1 and in the energy; lam (simplex: linear) and t in the energy
    assert {n[0] for n in names[:both]} == {"n", "R"}
    assert both == in_rows == 12 * 12
    assert {n[0] for n in names[both:]} == {"l", "t"}
    assert in_objective == nlp.nx
    rows = (tmp_path / "soup.row").read_text().split()
    assert {n.partition("[")[0] for n in rows[: file.nonlinear_rows]} == {"so3", "normal"}
    assert {n.partition("[")[0] for n in rows[file.nonlinear_rows :]} == {"visible", "simplex", "E"}
    slack, _ = Tiny().nlp(PAPER, Formulation(norm="epigraph", compiled=False))
    file = write_nl(tmp_path / "e.nl", slack)
    # slacks of untruncated norms are linear in the objective
    assert file.nonlinear[2] < file.nonlinear[0]


@pytest.mark.parametrize("form", FORMS, ids=form_id)
def test_names_are_unique_and_point_to_their_rows(form):
    nlp, layout = Tiny().nlp(TRUNCATED, form)
    x_names, g_names = readable_names(nlp, layout)
    assert len(set(x_names)) == nlp.nx
    assert len(set(g_names)) == nlp.ng
    assert {"R[7,2,1]", "lam[3]", "n[11,3]"} <= set(x_names)
    # moving R[7] changes rows of superpixel 7 alone, but for edges
    column = x_names.index("R[7,2,1]")
    hit = np.flatnonzero(jacobian(nlp, nlp.x0)[:, column])
    touched = [g_names[k] for k in hit]
    assert {"so3[7,1]", "so3[7,2]", "so3[7,4]"} <= set(touched)
    for name in touched:
        owners = name.partition("[")[2].rstrip("]").split(",")
        assert "7" in owners[:2], name
    assert "simplex" in g_names


# --- foreign readers -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    form = Formulation(gauge="free", norm="epigraph", truncation="lifted", hessian="exact")
    nlp, layout = Tiny().nlp(TRUNCATED, form)
    folder = tmp_path_factory.mktemp("foreign")
    return nlp, layout, write_nl(folder / "soup.nl", nlp, names=readable_names(nlp, layout))


def test_ampls_own_library_agrees(written):
    """ASL, the reader behind most solvers, through gjh_asl_json: derivatives at the start."""
    tool = shutil.which("gjh_asl_json")
    if tool is None:
        pytest.skip("gjh_asl_json (Debian package gjh-asl-json) is not installed")
    nlp, _, file = written
    stub = file.path.with_suffix("")
    args = ["rows=soup.row", "cols=soup.col", "json=soup.json"]
    subprocess.run([tool, stub.name, *args], cwd=stub.parent, check=True, capture_output=True)
    # ASL counts names from the files; the JSON is keyed by them
    said = json.loads(stub.with_suffix(".json").read_text())
    stats = said["problem statistics"]
    assert stats["total no. of variables"] == nlp.nx
    assert stats["total no. of constraints"] == nlp.ng
    assert (
        stats["no. of nonlinear variables in both constraints and objectives"]
        == (file.nonlinear[2])
    )
    assert stats["no. of nonzeros in constraints' Jacobian"] == nlp.nnzj
    cols = stub.with_suffix(".col").read_text().split()
    rows = stub.with_suffix(".row").read_text().split()
    J = jacobian(nlp, nlp.x0)[np.ix_(file.rows, file.variables)]
    grad = gradient(nlp, nlp.x0)[file.variables]
    found = np.zeros_like(J)
    place = {f"{r}_{c}": (i, j) for i, r in enumerate(rows[:-1]) for j, c in enumerate(cols)}
    flat = _section(said, "constraints' jacobian")
    for key, v in flat.items():
        found[place[key]] = v
    np.testing.assert_allclose(found, J, rtol=1e-10, atol=1e-10)
    g = np.zeros(nlp.nx)
    for key, v in _section(said, "gradient").items():
        g[cols.index(key.removeprefix("E_"))] = v
    np.testing.assert_allclose(g, grad, rtol=1e-10, atol=1e-10)


def _section(tree: dict, name: str) -> dict:
    """First mapping of that name anywhere in a tree."""
    todo = [tree]
    while todo:
        node = todo.pop()
        for key, child in node.items():
            if isinstance(child, dict):
                if key == name:
                    return child
                todo.append(child)
    raise KeyError(name)


def test_pounce_agrees(written):
    pounce = pytest.importorskip("pounce", reason="pounce-solver is not installed")
    nlp, layout, file = written
    back = pounce.read_nl(str(file.path))
    v, r = file.variables, file.rows
    assert (back.n, back.m, back.nnz_jac) == (nlp.nx, nlp.ng, nlp.nnzj)
    assert np.array_equal(back.x0, nlp.x0[v])
    x_names, g_names = readable_names(nlp, layout)
    assert list(back.var_names) == [x_names[k] for k in v]
    assert list(back.con_names) == [g_names[k] for k in r]
    x = wiggle(nlp, layout.size, 3, 0.1)
    f, g = value(nlp, x)
    close(back.objective(x[v]), f)
    close(np.array(back.constraints(x[v])), g[r])
    close(np.array(back.gradient(x[v])), gradient(nlp, x)[v])
    J = np.zeros((nlp.ng, nlp.nx))
    i, j = back.jacobian_structure()
    J[np.array(i), np.array(j)] = back.jacobian(x[v])
    close(J, jacobian(nlp, x)[np.ix_(r, v)])
    lam = np.random.default_rng(0).normal(size=nlp.ng)
    H = np.zeros((nlp.nx, nlp.nx))
    i, j = (np.array(k) for k in back.hessian_structure())
    H[i, j] = back.hessian(x[v], lam[r], 0.7)
    close(H + np.tril(H, -1).T, hessian(nlp, x, 0.7, lam)[np.ix_(v, v)])


def test_scip_reads_it(written):
    scip = pytest.importorskip("pyscipopt", reason="PySCIPOpt is not installed")
    nlp, _, file = written
    model = scip.Model()
    model.hideOutput()
    model.readProblem(str(file.path))
    named = {v.name: v for v in model.getVars()}
    # SCIP turns a nonlinear objective into a variable and a row
    assert model.getNVars() == nlp.nx + 1
    assert model.getNConss() == nlp.ng + 1
    at = file.variables.tolist().index(0)
    name = file.path.with_suffix(".col").read_text().split()[at]
    assert named[name].getLbOriginal() == pytest.approx(nlp.lbx[0])


# --- plain SX NLPs -------------------------------------------------------------------------------


def rosenbrock() -> dict:
    x = ca.SX.sym("x", 2)
    return {
        "problem": {"x": x, "f": (1 - x[0]) ** 2 + 100 * (x[1] - x[0] ** 2) ** 2},
        "x0": np.array([-1.2, 1.0]),
        "x_names": ["x", "y"],
    }


def classes() -> dict:
    """A variable of every class, a row of every bound, a constant in a linear row."""
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
        "lam_g0": np.array([0.1, 0.2, 0.3, 0.4, 0.5]),
        "x_names": ["a", "b", "c", "d"],
        "g_names": ["upper", "fixed", "range", "lower", "free"],
    }


def shared() -> dict:
    """One part that everything uses, one for rows, one for a row, one for the objective."""
    x = ca.SX.sym("x", 3)
    every = ca.sqrt(x[0] ** 2 + x[1] + 1)
    rows = ca.exp(x[2] - x[0]) * 2
    one, last = abs(x[1] - x[2]) + 3, -(x[0] * x[1] + 2 * x[2])
    g = ca.vertcat(every + rows, every * rows, one * ca.exp(one) / every)
    return {"problem": {"x": x, "f": last * ca.exp(last) + every, "g": g}, "x0": np.ones(3)}


@pytest.mark.parametrize("make", [rosenbrock, classes, shared])
def test_golden_files(make, tmp_path):
    file = write_sx_nl(tmp_path / f"{make.__name__}.nl", **make())
    for suffix in (".nl", ".col", ".row"):
        path = file.path.with_suffix(suffix)
        kept = GOLDEN / path.name
        if os.environ.get("SOUP_NLP_RENEW_GOLDEN") and path.is_file():
            GOLDEN.mkdir(exist_ok=True)
            kept.write_bytes(path.read_bytes())
        assert path.is_file() == kept.is_file()
        if path.is_file():
            assert path.read_text() == kept.read_text()


@pytest.mark.parametrize("make", [rosenbrock, classes, shared])
def test_golden_problems_read_back(make, tmp_path):
    given = make()
    file = write_sx_nl(tmp_path / "p.nl", **given)
    same_as_sx(given["problem"], file, given["x0"] + 0.1)
    back = ReadBack(file.path)
    for name in ("lbx", "ubx"):
        if name in given:
            assert np.array_equal(getattr(back, name), given[name][file.variables])
    for name in ("lbg", "ubg"):
        if name in given:
            assert np.array_equal(getattr(back, name), given[name][file.rows])
    assert np.array_equal(back.x0, given["x0"][file.variables])


def test_defined_variables_know_their_users(tmp_path):
    assert write_sx_nl(tmp_path / "p.nl", **shared()).defined == (1, 1, 0, 1, 1)


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
    close(back.hess(at[v], 0.3, lam[r]), np.array(hess(at, 0.3, lam))[np.ix_(v, v)])


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
BINARY = (
    lambda a, b: a + b,
    lambda a, b: a - b,
    lambda a, b: a * b,
    lambda a, b: a / (b**2 + 1),
    lambda a, b: (a**2 + 1) ** (b / 8),
)


@st.composite
def programs(draw):
    """Expressions grown from variables and numbers; every one may be used again."""
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


@settings(max_examples=120)
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


def test_without_constraints_and_without_names(tmp_path):
    x = ca.SX.sym("x", 3)
    file = write_sx_nl(tmp_path / "linear.nl", {"x": x, "f": x[0] - 2 * x[2] + 1})
    assert file.nonlinear == (0, 0, 0)
    assert not list(tmp_path.glob("*.col"))
    back = ReadBack(file.path)
    assert np.array_equal(back.values([1, 5, 7])[2].full().ravel(), [1, 0, -2])
    assert float(back.values([1, 5, 7])[0]) == -12


def test_long_sums_do_not_nest(tmp_path):
    x = ca.SX.sym("x", 4000)
    file = write_sx_nl(tmp_path / "sum.nl", {"x": x, "f": ca.sum1(ca.sqrt(x**2 + 1))})
    assert "\no54\n4000\n" in file.path.read_text()
    assert float(ReadBack(file.path).values(np.zeros(4000))[0]) == 4000


def test_what_cannot_be_written_is_said(tmp_path):
    x, p = ca.SX.sym("x"), ca.SX.sym("p")
    with pytest.raises(ExportError, match=r"(?s)cannot be written.*floor"):
        write_sx_nl(tmp_path / "a.nl", {"x": x, "f": ca.floor(x) * x})
    with pytest.raises(ExportError, match="not variables"):
        write_sx_nl(tmp_path / "a.nl", {"x": x, "f": x * p})
    with pytest.raises(ExportError, match="not finite"):
        write_sx_nl(tmp_path / "a.nl", {"x": x, "f": x**2 * np.inf})
    with pytest.raises(DataError, match="folder"):
        write_sx_nl(tmp_path / "none" / "a.nl", {"x": x, "f": x**2})
    assert not list(tmp_path.rglob("*.nl"))
