"""The .nl file equals the NLP: read back by CasADi, ASL, POUNCE and SCIP."""

import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers_model import GAUGES, PAPER, TRUNCATED, tiny, wiggle
from helpers_nl import ReadBack, close, defined_variables
from helpers_start import scene_problem

from soup_nlp.data.scenes.catalogue import render_scene
from soup_nlp.errors import ExportError
from soup_nlp.export.nl import NLFile, write_nl
from soup_nlp.export.sol import read_sol
from soup_nlp.model import oracle
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.nlp import NLP
from soup_nlp.model.programs import build_matrix_nlp, build_tangent_nlp
from soup_nlp.pipeline.case import prepare
from soup_nlp.pipeline.record import Case

pytestmark = pytest.mark.usefixtures("simple_starts")

FORMS = [*(Formulation(gauge=gauge) for gauge in GAUGES), Formulation(coordinates="tangent")]


def agrees(nlp: NLP, file: NLFile, back: ReadBack, x: np.ndarray, seed: int) -> None:
    """Everything that CasADi reads equals the NLP, after the order of the file."""
    v, r = file.variables, file.rows
    for name in ("x0", "lbx", "ubx"):
        assert np.array_equal(getattr(back, name), getattr(nlp, name)[v]), name
    for name in ("lbg", "ubg"):
        assert np.array_equal(getattr(back, name), getattr(nlp, name)[r]), name
    f, g, grad, J = back.values(x[v])
    f0, g0 = nlp.value(x), nlp.constraints(x)
    close(f, f0)
    close(g, g0[r])
    close(grad, nlp.gradient(x)[v])
    close(J, nlp.jacobian(x).toarray()[np.ix_(r, v)])
    rng = np.random.default_rng(seed)
    lam_f, lam_g = rng.normal(), rng.normal(size=nlp.ng)
    H = nlp.hessian(x, lam_g, lam_f)
    for way in rng.normal(size=(2, nlp.nx)):
        close(back.hess(x[v], lam_f, lam_g[r], way[v]), (H @ way)[v])


# --- the soup ------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS, ids=(*GAUGES, "tangent"))
def test_casadi_reads_back_every_formulation(form, tmp_path):
    build = build_tangent_nlp if form == FORMS[-1] else build_matrix_nlp
    weights = PAPER if form == FORMS[0] else TRUNCATED
    nlp, _ = build(tiny().soup, tiny().data, weights, form)
    file = write_nl(tmp_path / "soup.nl", nlp)
    back = ReadBack(file.path)
    for seed, size in ((0, 0.02), (1, 0.2)):
        agrees(nlp, file, back, wiggle(nlp, seed, size), seed)
    assert file.size == file.path.stat().st_size
    nonzeros = file.path.read_text().splitlines()[7]
    counted = nlp.sizes()["jacobian_nonzeros"], file.counts["gradient_nonzeros"]
    assert nonzeros.split()[:2] == [str(n) for n in counted]


def test_shared_expressions_are_written_once(tmp_path):
    nlp, layout = tiny().nlp(PAPER, FORMS[0])
    file = write_nl(tmp_path / "soup.nl", nlp)
    # smooth norms live in the objective alone; lam / (m . r) of an anchor is one of them
    assert defined_variables(file)[:4] == [0, 0, 0, 0]
    bodies = file.path.read_text().split("\nV")[1:]
    texts = [b.partition("\n")[2].partition("\nO0")[0] for b in bodies]
    assert len(texts) == file.counts["defined_variables"]
    assert len(set(texts)) == len(texts)
    scales = {int(np.flatnonzero(file.variables == v)[0]) for v in layout.of(np.arange(12))[:, 0]}
    depths = [t for t in texts if t.startswith("o3\nv") and int(t.split("\n")[1][1:]) in scales]
    # every anchor once, and one more for each end of each boundary point
    assert len(depths) == 12 + 2 * 2 * 17


def test_variables_and_rows_are_ordered_by_class(tmp_path):
    nlp, _ = tiny().nlp(PAPER, FORMS[0])
    file = write_nl(tmp_path / "soup.nl", nlp)
    in_rows, in_objective, both = file.counts["nonlinear_variables"].values()
    names = np.array((tmp_path / "soup.col").read_text().split())
    # n and R are in SO(3) and |n| = 1 and in the energy; lam (simplex: linear) and t in the energy
    assert {n[0] for n in names[:both]} == {"n", "R"}
    assert both == in_rows == 12 * 12
    assert {n[0] for n in names[both:]} == {"l", "t"}
    assert in_objective == nlp.nx
    rows = (tmp_path / "soup.row").read_text().split()
    curved = file.counts["nonlinear_rows"]
    assert {n.partition("[")[0] for n in rows[:curved]} == {"so3", "normal"}
    assert {n.partition("[")[0] for n in rows[curved:]} == {"visible", "simplex", "E"}


# --- foreign readers -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    nlp, layout = tiny().nlp(TRUNCATED, FORMS[1])
    folder = tmp_path_factory.mktemp("foreign")
    lam_g = np.full(nlp.ng, -1.0)
    return nlp, layout, write_nl(folder / "soup.nl", nlp, lam_g)


def pounce_agrees(nlp: NLP, file: NLFile, x: np.ndarray) -> None:
    """Everything that POUNCE reads equals the NLP at x, after the order of the file."""
    pounce = pytest.importorskip("pounce", reason="pounce-solver is not installed")
    back = pounce.read_nl(str(file.path))
    v, r = file.variables, file.rows
    assert (back.n, back.m, back.nnz_jac) == (nlp.nx, nlp.ng, nlp.sizes()["jacobian_nonzeros"])
    assert np.array_equal(back.x0, nlp.x0[v])
    f, g = nlp.value(x), nlp.constraints(x)
    close(back.objective(x[v]), f)
    close(np.array(back.constraints(x[v])), g[r])
    close(np.array(back.gradient(x[v])), nlp.gradient(x)[v])
    J = np.zeros((nlp.ng, nlp.nx))
    i, j = back.jacobian_structure()
    J[np.array(i), np.array(j)] = back.jacobian(x[v])
    close(J, nlp.jacobian(x).toarray()[np.ix_(r, v)])
    lam = np.random.default_rng(0).normal(size=nlp.ng)
    H = np.zeros((nlp.nx, nlp.nx))
    i, j = (np.array(k) for k in back.hessian_structure())
    H[i, j] = back.hessian(x[v], lam[r], 0.7)
    close(H + np.tril(H, -1).T, nlp.hessian(x, lam, 0.7).toarray()[np.ix_(v, v)])


@pytest.mark.slow
def test_pounce_agrees(written):
    pounce = pytest.importorskip("pounce", reason="pounce-solver is not installed")
    nlp, _, file = written
    pounce_agrees(nlp, file, wiggle(nlp, 3, 0.1))
    back = pounce.read_nl(str(file.path))
    x_names, g_names = nlp.x_names(), nlp.g_names()
    assert list(back.var_names) == [x_names[k] for k in file.variables]
    assert list(back.con_names) == [g_names[k] for k in file.rows]


def structure(path: Path) -> set[tuple[int, int]]:
    """Rows and variables of the `J` segments."""
    lines, found = iter(path.read_text().splitlines()), set()
    for line in lines:
        if line[0] == "J":
            row, count = map(int, line[1:].split())
            found |= {(row, int(next(lines).split()[0])) for _ in range(count)}
    return found


def test_lifted_expressions_are_variables_with_rows(tmp_path):
    nlp, _ = tiny().nlp(TRUNCATED, FORMS[0])
    plain = write_nl(tmp_path / "plain.nl", nlp)
    file = write_nl(tmp_path / "soup.nl", nlp, np.ones(nlp.ng), lift=True)
    assert plain.lifted == 0
    assert defined_variables(file) == [0] * 5
    k, v, r = file.lifted, file.variables, file.rows
    assert k == plain.counts["defined_variables"] > 0
    back = ReadBack(file.path)
    f, g, grad, J = map(np.asarray, back.values(back.x0))
    # the start is on their rows
    close(f, nlp.value(nlp.x0))
    close(g, np.append(np.zeros(k), nlp.constraints(nlp.x0)[r])[:, None])
    assert {*zip(*map(np.ndarray.tolist, np.nonzero(J)))} <= structure(file.path)
    # without them the derivatives are those of the program
    way = np.linalg.solve(J[:k, :k], -J[:k, k:])
    close(grad[k:] + way.T @ grad[:k], nlp.gradient(nlp.x0)[v][:, None])
    close(J[k:, k:] + J[k:, :k] @ way, nlp.jacobian(nlp.x0).toarray()[np.ix_(r, v)])
    # and an answer has the point and the multipliers of the program behind those of the rows
    sizes = [len(g), len(g), len(back.x0), len(back.x0)]
    duals = np.append(np.full(k, 7.0), -np.arange(float(nlp.ng))[r])
    numbers = ["Options", 3, 1, 1, 0, *sizes, *duals.tolist(), *back.x0.tolist()]
    (tmp_path / "a.sol").write_text("\n".join(["done", "", *map(str, numbers)]))
    sol = read_sol(tmp_path / "a.sol", v, r, k)
    assert np.array_equal(sol.x, nlp.x0)
    assert np.array_equal(sol.lam_g, np.arange(nlp.ng))
    with pytest.raises(ExportError, match="another problem"):
        read_sol(tmp_path / "a.sol", v, r)


# --- terms that only some pairs have -------------------------------------------------------------


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
        == file.counts["nonlinear_variables"]["both"]
    )
    assert stats["no. of nonzeros in constraints' Jacobian"] == nlp.sizes()["jacobian_nonzeros"]
    cols = stub.with_suffix(".col").read_text().split()
    rows = stub.with_suffix(".row").read_text().split()

    def matrix(section: str, down: list[str]) -> np.ndarray:
        """Entries whose names are those of a row and of a variable."""
        place = {f"{r}_{c}": (i, j) for i, r in enumerate(down) for j, c in enumerate(cols)}
        out = np.zeros((len(down), len(cols)))
        for key, number in _section(said, section).items():
            out[place[key]] = number
        return out

    v, r = file.variables, file.rows
    J = nlp.jacobian(nlp.x0).toarray()[np.ix_(r, v)]
    np.testing.assert_allclose(matrix("constraints' jacobian", rows[:-1]), J, 1e-10, 1e-10)
    gradient = nlp.gradient(nlp.x0)[None, v]
    np.testing.assert_allclose(matrix("gradient", ["E"]), gradient, 1e-10, 1e-10)
    # the Hessian of f + y g at the duals of the file
    assert said["supplied starting points"]["dual"] == dict.fromkeys(rows[:-1], 1)
    H = matrix("lagrangian hessian", cols)
    H = np.where(H, H, H.T)
    expected = nlp.hessian(nlp.x0, np.ones(nlp.ng)).toarray()[np.ix_(v, v)]
    np.testing.assert_allclose(H, expected, rtol=1e-8, atol=1e-8)


@pytest.mark.slow
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


@pytest.fixture(scope="module")
def swinging(tmp_path_factory) -> Case:
    """A box that swings before a room: occlusion shows its order, and its true depth is given."""
    folder = tmp_path_factory.mktemp("swing")
    np.save(folder / "depth.npy", render_scene("swing", 0, 160, 120).truth.depth_ref)
    few = "segmentation.neighbours=2", "segmentation.boundary_samples=1", "energy.pixel_samples=1"
    prior = f"depth_prior.source={folder / 'depth.npy'}"
    return prepare(scene_problem("swing", 160, 120, 32, *few, prior))


@pytest.mark.slow
def test_two_readers_agree_on_a_depth_prior_and_an_order(swinging, tmp_path):
    data, eps = swinging.data, 2e-5
    form = swinging.formulation(hessian="exact", eps=eps, eps_pixel=eps)
    nlp, _ = swinging.nlp(form)
    file = write_nl(tmp_path / "soup.nl", nlp)
    back = ReadBack(file.path)
    x = wiggle(nlp, 0, 0.02)
    agrees(nlp, file, back, x, 0)
    pounce_agrees(nlp, file, x)
    # at the start the file has both terms, up to their smoothing
    exact = oracle.energy(swinging.soup, data, swinging.weights)
    f = float(back.values(nlp.x0[file.variables])[0])
    for term in ("depth", "order"):
        weight = getattr(data, f"{term}_weight")
        less = replace(data, **{f"{term}_weight": np.zeros_like(weight)})
        other = build_matrix_nlp(swinging.soup, less, swinging.weights, form)[0]
        within = eps * getattr(swinging.weights, term) * np.abs(weight).sum()
        assert exact[term] - within <= f - other.value(other.x0) <= exact[term] + 1e-9
        assert exact[term] > 2 * within
