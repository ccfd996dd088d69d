"""`solve` refines by default; each half can be left out; the history is stored and checked."""

import json
import shutil
import threading
from pathlib import Path

import h5py
import numpy as np
import pytest
from helpers_files import sets

from soup_nlp.cli.main import main
from soup_nlp.config.problem import load_problem
from soup_nlp.evaluation.metrics import depth_metrics
from soup_nlp.geometry.soup import reconstruct
from soup_nlp.pipeline.run import run
from soup_nlp.report.check import check_folder
from soup_nlp.report.result import load

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("simple_starts")]

SMALL = (
    "input.width=160 input.height=96 segmentation.superpixels=30 segmentation.neighbours=6"
    " flow.source=truth refine.rounds=3 refine.particles=20 refine.stagnation=0"
)


def solve(folder: Path, *options: str) -> tuple[int, dict]:
    code = main(["solve", "orbit", "--out", str(folder), "-q", *sets(SMALL), *options])
    return code, json.loads((folder / "summary.json").read_text())


@pytest.fixture(scope="module")
def result(tmp_path_factory) -> Path:
    """A result folder."""
    out = tmp_path_factory.mktemp("both")
    # a noise that the images contradict (otherwise one round is enough), too large for depth
    assert solve(out, "--set", "flow.source=truth+noise:1")[1]["converged"]
    return out


def test_solve_delivers_the_refined_soup_and_keeps_the_nlps(result):
    summary = json.loads((result / "summary.json").read_text())
    E = summary["energy"]
    assert E["nlp"]["total"] < E["start"]["total"]
    assert set(summary["metrics"]) >= {"start", "nlp", "solution", "constant"}
    assert summary["residuals"]["so3"] < 1e-12
    r = summary["refinement"]
    assert r["status"] == "rounds"
    assert len(r["rounds"]) == 3
    assert r["end"]["total"] < r["begin"]["total"]
    assert r["rounds"][-1]["energy"] == r["end"]
    # the objective has E_photo and a weaker E_proj, but the smooth terms of E
    smooth = {term: E["solution"][term] for term in ("arap", "cont", "orient")}
    assert {term: r["end"][term] for term in smooth} == pytest.approx(smooth, rel=1e-9)
    assert r["end"]["photo"] < r["begin"]["photo"]
    assert r["start"]["total"] > r["begin"]["total"]
    assert 0 < r["contradicted"] <= summary["sizes"]["superpixels"]
    assert r["end"].keys() >= {"total", "arap", "proj", "cont", "orient", "prior"}
    with h5py.File(result / "result.h5") as file:
        assert file["depth/nlp_ref"].shape == file["depth/ref"].shape
        assert np.abs(file["nlp/R"][:] - file["solution/R"][:]).max() > 0
    assert check_folder(result).ok


def test_the_depth_of_the_solution_has_detail(result, tmp_path):
    stored = load(result)
    rec = stored.reconstruction
    planes = reconstruct(rec.soup, rec.labels, stored.K, stored.K_next)
    assert 0 < np.abs(rec.detail).max() <= np.log(2)
    np.testing.assert_allclose(rec.depth_ref, planes.depth_ref * np.exp(rec.detail), rtol=1e-12)
    np.testing.assert_array_equal(rec.depth_ref, stored.depth_maps["solution"])
    # the planes alone are less exact than flow of 1 px allows
    gt = stored.true_depth
    with_it, without = (depth_metrics(x.depth_ref, gt).mre for x in (rec, planes))
    assert with_it < without
    damaged = tmp_path / "damaged"
    shutil.copytree(result, damaged)
    with h5py.File(damaged / "result.h5", "a") as file:
        file["depth/ref"][:] = planes.depth_ref
    assert "depth map solution" in {row.name for row in check_folder(damaged).rows if not row.ok}


def test_without_the_nlp_the_start_is_refined(tmp_path):
    folder = tmp_path / "start"
    code, summary = solve(folder, "--no-nlp", "--set", "refine.detail=false")
    assert code == 0
    assert "Ipopt" not in (folder / "log.txt").read_text()
    assert summary["status"] == "Skipped"
    assert summary["delivered"] == "start"
    assert summary["iterations"] == {}
    r = summary["refinement"]
    assert r["end"]["total"] < r["begin"]["total"]
    assert "nlp" not in summary["metrics"]
    assert load(folder).reconstruction.detail is None
    assert check_folder(folder).ok
    # the solve can be repeated from the folder alone
    again = load_problem(folder / "config.yaml")
    assert again.digest() == summary["problem_hash"]
    assert again.refine.from_start


def test_both_halves_cannot_be_left_out(tmp_path, capsys):
    assert main(["solve", "orbit", "-o", str(tmp_path), "--no-nlp", "--no-refine"]) == 2
    assert "nothing is left to do" in capsys.readouterr().err


def test_an_interrupted_refinement_keeps_its_best_and_exits_with_1(tmp_path):
    stop = threading.Event()

    def log(line: str) -> None:
        if line.startswith("refine 1"):
            stop.set()

    problem = load_problem("orbit", [*SMALL.split(), "refine.from_start=true"])
    done = run(problem, stop=stop, log=log)
    assert done.refined is not None
    assert done.refined.status == "interrupted"
    assert len(done.refined.rounds) == 1
    assert not done.good
    assert done.refined.energy["total"] < done.refined.energy_begin["total"]
