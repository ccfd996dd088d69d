"""bench speed: plan, exponents, page and gate on artificial rows; one tiny real run."""

from __future__ import annotations

import copy
import json
import os
from functools import partial

import numpy as np
import pandas as pd
import pytest
from helpers_rows import square
from scipy.stats import linregress

from soup_nlp.bench.processes import alone, machine
from soup_nlp.bench.speed import measure_speed, schedule, speed_cell, speed_cells
from soup_nlp.bench.speed_page import (
    LIMITS,
    baseline,
    check,
    fit,
    growth,
    plot_growth,
    read_baseline,
    speed_page,
    with_costs,
)
from soup_nlp.bench.study import frame_of
from soup_nlp.cli.main import main
from soup_nlp.errors import DataError
from soup_nlp.solve.solver_options import SolverOptions
from soup_nlp.storage.rows import read_rows

pytestmark = pytest.mark.slow

EXPONENT = 1.3
OWN = {"scene": "street", "superpixels": 250, "neighbours": 10, "seed": 0}


def made(scene: str = "street", superpixels: int = 250, neighbours: int = 10, **changes) -> dict:
    """A row like that of `measure_speed`, with costs that are powers of N."""
    cost, n = 1e-3 * superpixels**EXPONENT, superpixels
    cell = speed_cell(scene, superpixels, neighbours)
    return {
        **cell.identity(),
        **{"ok": True, "error": None, "code": "c0de", "cpu_seconds": 1.0, "n": n, "k": neighbours},
        "sizes": {"jacobian_nonzeros": 58 * n, "hessian_nonzeros": 1300 * n},
        "wall": {"nlp": 3 * cost, "build": cost, "functions": cost, "linear algebra": cost},
        "cpu": {"load": 99.0, "nlp": 3 * cost, "start": 1.0, "output": 2.0},
        "iterations": 100,
        "status": "Solve_Succeeded",
        "converged": True,
        "energy": {"total": 51.0},
        "energy_start": {"total": 90.0},
        "errors": {"start": 0.2, "solution": 0.1},
        "residuals": {"nlp_infeasibility": 1e-9, "dual_infeasibility": 1e-9},
        "peak_bytes": 2**30,
        "reference": {"energy": {"total": 50.0}, "iterations": 40, "cpu_seconds": 2 * cost},
        **changes,
    }


def test_the_plan_has_every_run_once_small_ones_first():
    settings = speed_cells(["street", "motorcycle"], [500, 250], [20, 10], [3, 4], width=512)
    assert len({json.dumps(s) for s in settings}) == len(settings) == 2 * 2 * (2 + 1)
    sizes = [s["superpixels"] for s in settings]
    assert sizes == sorted(sizes)
    assert {s["seed"] for s in settings if s["scene"] == "motorcycle"} == {3}
    cell = speed_cell("room", 300, 12, 5, 512, 218, overrides=["solver.tol=0.5"])
    p = cell.item.problem(cell.overrides)
    assert (p.input.scene, p.input.seed, p.input.width, p.seed) == ("room", 5, 512, 5)
    assert (p.segmentation.superpixels, p.segmentation.neighbours) == (300, 12)
    assert p.solver.tol == 0.5
    assert not p.refine.enabled
    assert speed_cell("motorcycle", 300, 12).item.input["kind"] == "motorcycle"


def test_work_in_a_process_of_its_own(monkeypatch):
    row = alone(partial(square, 3))
    assert row["square"] == 9
    assert row["process"] != os.getpid()
    assert row["peak_bytes"] > 1e6
    assert "out of numbers" in alone(partial(square, 4, breaks=True))["error"]
    monkeypatch.setattr("soup_nlp.bench.processes.GRACE", 0.0)
    cell = speed_cell("street", 60, 8)
    late = alone(partial(measure_speed, cell.item, cell.overrides), seconds=0.2)
    assert late["error"] == "no answer after 0.2 s"


def test_exponents_are_those_of_a_regression():
    n = np.array([250, 500, 1000, 2000])
    exact = fit(n, 3e-4 * n**1.4)
    assert exact.exponent == pytest.approx(1.4, abs=1e-12)
    assert exact.error == pytest.approx(0.0, abs=1e-9)
    noisy = n**1.4 * np.exp(np.random.default_rng(0).normal(0, 0.1, 4))
    assert fit(n, noisy).error == pytest.approx(linregress(np.log(n), np.log(noisy)).stderr)
    assert np.isnan(fit([250, 500], [1.0, 2.0]).error)
    assert fit([250, 252], [1.0, 2.0]) is None


def test_growth_is_by_scene_and_neighbours():
    rows = [made("street", n, k) for n in (250, 500, 1000) for k in (10, 20)]
    frame = with_costs(frame_of(rows))
    table = growth(frame)
    assert table.index.tolist() == [("street", "10"), ("street", "20")]
    assert table["NLP, CPU s"].iloc[0].startswith(f"{EXPONENT:.2f}")
    assert table["Hessian nonzeros"].iloc[0].startswith("1.00")
    assert growth(frame.iloc[:1]).empty
    # loading is not counted, and the NLP is not outside itself
    assert frame["outside"].iloc[0] == 3.0


def test_page_and_picture(tmp_path):
    rows = [made(scene, n) for scene in ("street", "room") for n in (250, 500)]
    rows += [made("room", 500, 20, converged=False, errors={})]
    broken = {**speed_cell("street", 250, 10).identity(), "ok": False, "error": "no answer"}
    broken |= {"code": "c", "cpu_seconds": 0.0}
    frame = frame_of([*rows, broken])
    text = speed_page(frame)
    assert "4 of 5 runs converged" in text
    assert "1.0200 to 1.0200 times" in text
    assert "1.50 to 1.50 times" in text
    assert "N 250, K 10: no answer" in text
    plot_growth(tmp_path / "growth.png", frame)
    assert (tmp_path / "growth.png").stat().st_size > 5000
    assert "No run" in speed_page(frame_of([broken]))


@pytest.fixture
def kept(tmp_path):
    path = tmp_path / "baseline.json"
    path.write_text(json.dumps(baseline(frame_of([made()]), [OWN])))
    runs = read_baseline(path)
    assert [settings for settings, _ in runs] == [OWN]
    return runs


def worse(rows: list[dict], runs: list) -> set[str]:
    found: pd.DataFrame = check(frame_of(rows), runs)
    return set(found.loc[~found["ok"].astype(bool), "value"])


def test_pages_of_failed_runs_list_them(tmp_path):
    failed = {"ok": False, "error": "out of memory", "code": "c0de", "cpu_seconds": 1.0}
    frame = frame_of([{**speed_cell("street", 250, 10).identity(), **failed}])
    assert "out of memory" in speed_page(frame)
    plot_growth(tmp_path / "growth.png", frame)
    assert (tmp_path / "growth.png").is_file()


def test_the_gate_holds_for_the_same_and_for_better(kept):
    assert set(check(frame_of([made()]), kept)["value"]) == set(LIMITS)
    assert not worse([made()], kept)
    assert not worse([made(energy={"total": 40.0}, iterations=10)], kept)


def test_the_gate_sees_what_is_worse(kept):
    assert worse([made(iterations=140)], kept) == {"iterations"}
    assert worse([made(converged=False)], kept) == {"not converged"}
    more = made(energy={"total": 51.0 * 1.01})
    assert worse([more], kept) == {"energy", "energy_to_reference"}
    dense = copy.deepcopy(made())
    dense["sizes"]["hessian_nonzeros"] *= 2
    assert worse([dense], kept) == {"nonzeros"}
    assert worse([made("room")], kept) == {"run"}
    # the gate looks at ratios: a machine that is ten times slower at everything is as good
    slow = copy.deepcopy(made())
    slow["cpu"]["nlp"] *= 10
    assert worse([slow], kept) == {"time_to_reference"}
    slow["reference"]["cpu_seconds"] *= 10
    assert not worse([slow], kept)


def test_files_that_are_no_baseline(tmp_path):
    path = tmp_path / "b.json"
    for text in ("{}", "[]", "no json", '{"version": 99, "runs": []}'):
        path.write_text(text)
        with pytest.raises(DataError, match="not a baseline"):
            read_baseline(path)
    with pytest.raises(DataError, match="not a baseline"):
        read_baseline(tmp_path / "missing.json")
    with pytest.raises(DataError, match="failed"):
        baseline(frame_of([made("room")]), [OWN])
    assert {"processor", "cores", "memory", "code"} <= machine().keys()


def test_the_reference_solver_ends_at_the_solvers_smoothing():
    assert schedule(SolverOptions(presolve_eps=(0.1, 0.03), eps=0.03)) == (0.1, 0.03)
    assert schedule(SolverOptions(presolve_eps=(0.1, 0.03), eps=0.01))[-1] == 0.01
    assert schedule(SolverOptions(presolve=False, eps=0.02)) == (0.02,)


@pytest.mark.parametrize(
    "words",
    [
        ["--scenes", "stret"],
        ["--superpixels", "many"],
        ["--superpixels", "1"],
        ["--seeds", "-1"],
        ["--neighbours", ""],
        ["--set", "solver.tolerance=1"],
        ["--check", "missing.json"],
    ],
)
def test_bad_input_ends_with_2(tmp_path, capsys, words):
    assert main(["bench", "speed", *words, "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.startswith("error:")
    assert not (tmp_path / "out").exists()


def test_a_real_run_its_table_and_its_gate(tmp_path, capsys):
    out, base = tmp_path / "out", tmp_path / "base.json"
    size = ["--scenes", "street", "--sizes", "24", "--neighbours", "4", "--seeds", "0"]
    small = ["--width", "128", "--height", "96", "--set", "solver.max_iter=5"]
    small += ["--set", "formulation.compiled=false", "--set", "solver.eps=0.3"]
    small += ["--set", "solver.presolve_eps=[0.3]"]
    words = ["bench", "speed", *size, *small, "--quiet", "--out", str(out)]
    assert main([*words, "--write-baseline", str(base)]) == 0
    (row,) = read_rows(out / "table.jsonl")
    assert row["energy"]["total"] < row["energy_start"]["total"]
    assert row["reference"]["energy"]["total"] < row["energy_start"]["total"]
    assert row["peak_bytes"] > 5e7
    parts = sum(row["wall"][k] for k in ("build", "functions", "linear algebra"))
    assert parts == pytest.approx(row["wall"]["nlp"], rel=1e-6)
    assert {"load", "flow", "segmentation", "start", "output"} <= set(row["cpu"])
    assert "| street |" in (out / "table.md").read_text()
    assert (out / "growth.png").is_file()
    capsys.readouterr()
    # stored: the gate compares the same numbers
    assert main(["bench", "speed", "--check", str(base), "--quiet", "--out", str(out)]) == 0
    assert "the gate holds" in capsys.readouterr().out
    tree = json.loads(base.read_text())
    tree["runs"][0]["values"]["energy"] *= 0.5
    base.write_text(json.dumps(tree))
    assert main(["bench", "speed", "--check", str(base), "--quiet", "--out", str(out)]) == 1
    assert "WORSE" in capsys.readouterr().out
