"""Commands export, import and check: exported folders, and answers of other solvers."""

import json
import shutil
from functools import cache
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from helpers_files import sets
from helpers_nl import ReadBack, close

from benchmarks.family.sol import write_sol
from soup_nlp.cli.main import main
from soup_nlp.config.problem import Problem, load_problem
from soup_nlp.errors import ExportError
from soup_nlp.export import foreign
from soup_nlp.export.foreign import import_sol, sol_table
from soup_nlp.export.program import file_orders
from soup_nlp.export.verify import Limits, examine, violations
from soup_nlp.geometry.constraints import kind, table
from soup_nlp.model import oracle
from soup_nlp.pipeline.case import prepare
from soup_nlp.pipeline.record import Case
from soup_nlp.solve.stages import solve_soup
from soup_nlp.storage.folders import SUMS

pytestmark = pytest.mark.usefixtures("simple_starts")

KNOWN: dict[str, Case] = {}


def prepared(problem: Problem) -> Case:
    key = problem.digest()
    KNOWN[key] = KNOWN.get(key) or prepare(problem)
    return KNOWN[key]


@pytest.fixture(autouse=True)
def exports_are_prepared_once(monkeypatch):
    """For reading answers; the commands that write exports prepare them as they always do."""
    monkeypatch.setattr(foreign, "prepare", prepared)


TINY = sets(
    "input.width=96 input.height=64 flow.source=truth segmentation.neighbours=4"
    " energy.pixel_samples=4 output.page=false"
)


def write(out: Path, *words: str) -> int:
    return main(["export", "orbit", "-o", str(out), *TINY, *words])


@pytest.fixture(scope="module")
def exported(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("exported")
    assert write(out, "--superpixels", "16") == 0
    return out


@cache
def problem_of(folder: Path):
    """NLP, layout, names and order of the files of an exported folder."""
    manifest = json.loads((folder / "manifest.json").read_text())
    case = prepared(load_problem(folder / "problem.yaml"))
    nlp, layout = case.nlp(case.formulation(coordinates=manifest["coordinates"]))
    return case, nlp, layout, file_orders(nlp), manifest


def answer(folder: Path, name: str, move: float = 0.0) -> Path:
    """A .sol with a perturbed start as its point."""
    _, nlp, _, (v, r), _ = problem_of(folder)
    x = nlp.x0 + move * np.random.default_rng(1).normal(size=nlp.nx)
    write_sol(folder / name, x, None, v, r, "hand made", 0)
    return folder / name


@pytest.fixture(scope="module")
def solved(exported):
    """A local minimum of the exported problem, by presolve and Ipopt."""
    case, _, _, _, _ = problem_of(exported)
    form = case.formulation(hessian="exact")
    found = solve_soup(case.start.soup, case.data, case.weights, form, case.options)
    assert found.converged, found.status
    return found


@pytest.fixture(scope="module")
def optimum(solved):
    """Point and multipliers of it."""
    return solved.stages[-1].x, solved.stages[-1].lam_g


@pytest.mark.slow
def test_a_foreign_solution_becomes_a_result_folder(exported, optimum, tmp_path, capsys):
    _, _, _, (v, r), _ = problem_of(exported)
    sol = exported / "good.sol"
    write_sol(sol, *optimum, v, r, "hand made", 0)
    out = tmp_path / "result"
    assert main(["import", str(exported), str(sol), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "hand made (solved, code 0): verified" in said
    assert main(["check", str(sol)]) == 0
    for name in ("depth_ref.png", "points_ref.ply", "overview.png", "result.h5", "config.yaml"):
        assert (out / name).stat().st_size > 0
    assert main(["check", str(out)]) == 0
    said = capsys.readouterr().out
    assert "worst superpixels" in said
    assert "every claim holds" in said


@pytest.mark.slow
def test_verified_means_optimal(exported, optimum, capsys):
    _, nlp, _, (v, r), _ = problem_of(exported)
    x, lam = optimum
    # feasible, and nothing else
    start = import_sol(exported, answer(exported, "start.sol"))
    assert "(solved, code 0): not verified" in str(start)
    assert start.run.solution.stages[-1].objective != 0
    assert main(["check", str(exported / "start.sol")]) == 3
    assert "every constraint holds, and the point is not stationary" in capsys.readouterr().out
    # the point is what counts: multipliers that are wrong, or none, make it no worse
    for given in (None, np.full(nlp.ng, 1e300)):
        write_sol(exported / "x.sol", x, given, v, r, "hand made", 0)
        assert import_sol(exported, exported / "x.sol").run.solution.converged
    write_sol(exported / "x.sol", x, lam, v, r, "hand made", 400)
    # a limit of a solver is no success
    limit = import_sol(exported, exported / "x.sol")
    assert not limit.run.solution.converged
    assert "no success claimed" in str(limit)
    write_sol(exported / "x.sol", x, np.full(nlp.ng, np.nan), v, r, "hand made", 0)
    with pytest.raises(ExportError, match="not finite"):
        import_sol(exported, exported / "x.sol")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:sigma. no uncertainty can be computed")
@pytest.mark.parametrize(
    ("size", "code", "words"),
    [
        (None, 1, ["FAIL so3", "a constraint does not hold"]),
        # with an energy that is a number it is a result, if a bad one
        (1e20, 1, ["FAIL rows"]),
        (1e300, 2, ["FAIL rows"]),
    ],
)
def test_a_false_claim_of_success_is_not_verified(size, code, words, exported, tmp_path, capsys):
    """A start moved by 1e-3, and huge ones, of which the last makes no result."""
    _, nlp, _, (v, r), _ = problem_of(exported)
    before = (exported / "manifest.json").read_text()
    sol = answer(exported, "false.sol", move=1e-3)
    if size is not None:
        write_sol(sol, nlp.x0 * size, None, v, r, "hand made", 0)
    assert main(["check", str(sol)]) == 1
    said = capsys.readouterr().out
    assert all(word in said for word in [*words, "not verified"])
    assert main(["import", str(exported), str(sol), "--out", str(tmp_path / "r")]) == code
    assert (tmp_path / "r").exists() == (code == 1)
    assert (exported / "manifest.json").read_text() == before


@pytest.mark.slow
def test_a_changed_export_is_refused(exported, tmp_path):
    sol = answer(exported, "good.sol")
    other = Path(shutil.copytree(exported, tmp_path / "other"))
    path = other / "problem.yaml"
    path.write_text(path.read_text().replace("\nseed: 0", "\nseed: 1"))
    with pytest.raises(ExportError, match="not the one that was exported"):
        import_sol(other, sol)
    shutil.copy(exported / "problem.yaml", path)
    (other / "manifest.json").write_text("{}")
    with pytest.raises(ExportError, match="cannot be used"):
        import_sol(other, sol)
    assert main(["import", str(tmp_path), str(sol)]) == 2


def test_options_are_checked(tmp_path):
    assert write(tmp_path, "--set", "formulation.gauge=nothing") == 2
    assert write(tmp_path, "--coordinates", "euler") == 2
    assert not list(tmp_path.rglob("manifest.json"))


@pytest.mark.slow
def test_a_presolved_start_has_multipliers(tmp_path, capsys):
    assert write(tmp_path, "--presolve", "--superpixels", "16") == 0
    _, nlp, _, (v, r), manifest = problem_of(tmp_path)
    assert manifest["initial_duals"]
    builder = ca.NlpBuilder()
    builder.import_nl(str(tmp_path / "soup.nl"), {})
    x, lam = np.empty(nlp.nx), np.empty(nlp.ng)
    x[v], lam[r] = builder.x_init, builder.lambda_init
    # the multipliers make the start stationary, in AMPL's sign
    gradient = nlp.gradient(x)
    assert np.abs(gradient - nlp.jacobian(x).T @ lam).max() < 1e-3 < np.abs(gradient).max()
    # solvers start there, although the case of the folder is prepared without a presolve
    write_sol(tmp_path / "start.sol", x, None, v, r, "start", 400)
    main(["check", str(tmp_path / "start.sol")])
    line = next(s for s in capsys.readouterr().out.splitlines() if s.startswith("energy"))
    energy = f"{manifest['exact_energy_at_start']['total']:.6g}"
    assert line == f"energy      start {energy}  solution {energy}"


@pytest.mark.slow
def test_the_file_and_its_manifest_are_those_of_the_nlp(exported):
    case, nlp, _, (v, r), manifest = problem_of(exported)
    back = ReadBack(exported / "soup.nl")
    assert manifest["start"] == "proposal"
    assert not manifest["initial_duals"]
    # a start that is not stationary has no multipliers
    assert not any(line[0] in "dS" for line in (exported / "soup.nl").read_text().splitlines())
    assert manifest["sizes"]["variables"] == len(back.x0) == nlp.nx
    assert manifest["sizes"]["jacobian_nonzeros"] == nlp.sizes()["jacobian_nonzeros"]
    close(back.x0, nlp.x0[v])
    rng = np.random.default_rng(0)
    x = np.clip(nlp.x0 + 0.05 * rng.normal(size=nlp.nx), nlp.lbx, nlp.ubx)
    close(back.values(x[v])[0], nlp.value(x))
    close(back.values(x[v])[1], nlp.constraints(x)[r])
    close(back.values(x[v])[2], nlp.gradient(x)[v])
    assert manifest["objective_at_start"] == nlp.value(nlp.x0)
    exact = oracle.energy(case.soup, case.data, case.weights)["total"]
    assert manifest["exact_energy_at_start"]["total"] == pytest.approx(exact, rel=1e-12)


@pytest.mark.slow
def test_a_point_with_nan_is_not_verified(exported, optimum):
    _, nlp, _, _, _ = problem_of(exported)
    x, lam = optimum
    assert examine(nlp, x, lam).within(Limits())
    # multipliers that are not numbers are not used
    assert examine(nlp, x, np.nan * lam).multipliers == "least squares"
    bad = x.copy()
    bad[3] = np.nan
    assert violations(nlp, bad)["bounds"].max() == np.inf
    found = examine(nlp, bad, lam)
    assert (found.primal, found.dual, found.multipliers) == (np.inf, np.inf, "none")
    assert not found.within(Limits())


# --- exported folders -----------------------------------------------------------------------------


@pytest.mark.slow
def test_a_second_export_removes_the_files_of_the_first(tmp_path):
    assert write(tmp_path, "--superpixels", "9", "-q") == 0
    (tmp_path / "mine.txt").write_text("not of the export")
    (tmp_path / "manifest.json").write_text("{}")
    # it was changed, so it is the user's now
    assert write(tmp_path, "--superpixels", "12", "-q") == 2
    assert write(tmp_path, "--superpixels", "12", "-q", "--overwrite") == 0
    names = {p.name for p in tmp_path.iterdir()}
    own = {"soup.nl", "soup.col", "soup.row", "problem.yaml", "manifest.json"}
    assert names == own | {"mine.txt", SUMS}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("fingerprint", []),
        ("fingerprint", ["many", 0.0]),
        ("fingerprint", None),
        ("coordinates", ["matrix"]),
        ("coordinates", "euler"),
        ("exact_energy_at_start", {"total": None}),
    ],
)
def test_a_broken_manifest_is_refused(key, value, exported, tmp_path, capsys):
    answer(exported, "a.sol")
    other = Path(shutil.copytree(exported, tmp_path / "other"))
    manifest = json.loads((other / "manifest.json").read_text())
    (other / "manifest.json").write_text(json.dumps(manifest | {key: value}))
    with pytest.raises(ExportError, match=f"(?s)cannot be used.*{key}"):
        import_sol(other, other / "a.sol")
    assert main(["check", str(other / "a.sol")]) == 2
    assert "manifest.json" in capsys.readouterr().err
    (other / "manifest.json").write_text("[1]")
    assert main(["check", str(other / "a.sol")]) == 2


# --- programs in tangent coordinates --------------------------------------------------------------


@pytest.fixture(scope="module")
def tangent(tmp_path_factory):
    out = tmp_path_factory.mktemp("tangent")
    assert write(out, "--superpixels", "16", "--coordinates", "tangent") == 0
    return out


@pytest.mark.slow
def test_an_answer_in_tangent_coordinates_becomes_a_result(tangent, solved, tmp_path, capsys):
    case, nlp, layout, order, manifest = problem_of(tangent)
    assert manifest["coordinates"] == "tangent"
    # eight rim rays a superpixel and the length unit; SO(3) and unit normals hold by construction
    assert (nlp.nx, nlp.ng) == (9 * len(case), 8 * len(case) + 1)
    path = tmp_path / "good.sol"
    write_sol(path, layout.pack(solved.soup), None, *order, "elsewhere", 0)
    assert main(["check", str(path), "--export", str(tangent)]) == 0
    text = capsys.readouterr().out
    assert "R'R = I" in text
    out = tmp_path / "out"
    assert main(["import", str(tangent), str(path), "-o", str(out)]) == 0
    assert main(["check", str(out)]) == 0
    # the same answer to the file with lifted variables
    lifted = tmp_path / "lifted"
    words = ["--superpixels", "16", "--coordinates", "tangent", "--lift"]
    assert write(lifted, *words) == 0
    write_sol(path, layout.pack(solved.soup), None, *file_orders(nlp, lift=True), "elsewhere", 0)
    lines, more = path.read_text().splitlines(), problem_of(lifted)[-1]["lifted"]
    at = lines.index("Options") + 5
    lines[at : at + 4] = [str(nlp.ng + more), "0", *[str(nlp.nx + more)] * 2]
    lines[at + 4 : at + 4] = ["0"] * more
    path.write_text("\n".join(lines))
    assert main(["check", str(path), "--export", str(lifted)]) == 0
    assert main(["check", str(path), "--export", str(tangent)]) == 2
    # a point that moves the length unit is refused
    bad = layout.pack(solved.soup)
    bad[::9] *= 1.5
    write_sol(path, bad, None, *order, "elsewhere", 0)
    assert main(["check", str(path), "--export", str(tangent)]) == 1


@pytest.mark.slow
def test_the_worst_superpixel_is_named(exported):
    _, nlp, layout, (v, r), _ = problem_of(exported)
    x = nlp.x0.copy()
    x[layout.of(np.array([7]))[0, 5]] += 1e-2
    write_sol(exported / "seven.sol", x, None, v, r)
    imported = import_sol(exported, exported / "seven.sol")
    rows = sol_table(imported)
    so3 = next(row for row in rows if row.name == "so3")
    assert so3.worst[0][0] == 7
    assert so3.beyond == 1
    assert not so3.ok
    assert "7 (" in table(rows)
    assert kind("normal", np.array([0.0, np.nan]), 1e-6).largest == np.inf
