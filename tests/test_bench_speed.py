"""bench speed: plan, store, fit, table and gate on artificial records; one tiny real run."""

from __future__ import annotations

import copy
import json
from functools import partial

import numpy as np
import pytest
from scipy.stats import linregress

from soup_nlp.bench import speed, speed_gate, speed_report
from soup_nlp.bench.processes import alone, machine
from soup_nlp.bench.speed import problem_of, schedule
from soup_nlp.bench.speed_report import SPEED
from soup_nlp.cli.main import main
from soup_nlp.errors import DataError
from soup_nlp.solve.solver_options import SolverOptions
from soup_nlp.storage.rows import read_rows

pytestmark = pytest.mark.slow

EXPONENT = 1.3


def run_settings(scene: str, superpixels: int, neighbours: int) -> dict:
    return {"scene": scene, "superpixels": superpixels, "neighbours": neighbours, "seed": 0}


def made(settings: dict, **changes) -> dict:
    """A record like that of `speed.measure`, with costs that are powers of N."""
    n = settings["superpixels"]
    cost = 1e-3 * n**EXPONENT
    y = {
        "status": "Converged",
        "energy": {"total": 50.0},
        "iterations": 40,
        "seconds": 2 * cost,
        "cpu_seconds": 2 * cost,
        "mre": 0.1,
        "history": [[0.0, 90.0], [1.0, 50.0]],
    }
    record = {
        "sizes": {
            "superpixels": n,
            "knn_edges": 9 * n,
            "pairs": 3 * n,
            "variables": 16 * n,
            "constraints": 17 * n,
            "equalities": 7 * n,
            "inequalities": 10 * n,
            "jacobian_nonzeros": 58 * n,
            "hessian_nonzeros": 1300 * n,
        },
        "wall": {"nlp": 3 * cost, "build": cost, "functions": cost, "linear algebra": cost},
        "cpu": {"load": 99.0, "nlp": 3 * cost, "start": 1.0, "output": 2.0},
        "iterations": 100,
        "status": "Solve_Succeeded",
        "converged": True,
        "energy": {"total": 51.0},
        "energy_start": {"total": 90.0},
        "mre": {"start": 0.2, "solution": 0.1},
        "residuals": dict.fromkeys(
            (
                "so3",
                "normal",
                "simplex",
                "positive",
                "visible",
                "det",
                "nlp_infeasibility",
                "dual_infeasibility",
                "complementarity",
            ),
            1e-9,
        ),
        "peak_bytes": 2**30,
        "reference": y,
    }
    record |= changes
    return {"key": f"table {n}", "code": "c0de", "settings": settings, **record}


def test_the_plan_has_every_run_once_small_ones_first():
    settings = speed.plan(["street", "motorcycle"], [500, 250], [20, 10], [3, 4], width=512)
    assert len({json.dumps(s) for s in settings}) == len(settings) == 2 * 2 * (2 + 1)
    sizes = [s["superpixels"] for s in settings]
    assert sizes == sorted(sizes)
    assert {s["seed"] for s in settings if s["scene"] == "motorcycle"} == {3}
    assert {s["width"] for s in settings} == {512}


def test_a_run_that_fails_says_why(monkeypatch):
    record = alone(partial(SPEED.measure, **run_settings("nowhere", 100, 8)))
    assert "nowhere" in record["error"]
    assert "street" in record["error"]
    monkeypatch.setattr("soup_nlp.bench.processes.GRACE", 0.0)
    late = alone(partial(SPEED.measure, **run_settings("street", 60, 8)), seconds=0.2)
    assert late["error"] == "no answer after 0.2 s"


def test_exponents_are_found():
    n = np.array([250, 500, 1000, 2000])
    exact = speed_report.fit(n, 3e-4 * n**1.4)
    assert exact.exponent == pytest.approx(1.4, abs=1e-12)
    assert exact.error == pytest.approx(0.0, abs=1e-9)
    rng = np.random.default_rng(0)
    noisy = speed_report.fit(n, n**1.4 * np.exp(rng.normal(0, 0.1, 4)))
    assert 0.01 < noisy.error < 0.2
    assert noisy.exponent == pytest.approx(1.4, abs=3 * noisy.error)
    assert np.isnan(speed_report.fit([250, 500], [1.0, 2.0]).error)
    assert speed_report.fit([250, 252], [1.0, 2.0]) is None
    assert speed_report.fit([250], [1.0]) is None


def test_the_error_of_an_exponent_is_the_regressions():
    rng = np.random.default_rng(1)
    n = np.array([250, 250, 500, 1000, 1000, 2000, 4000])
    cost = n**1.2 * np.exp(rng.normal(0, 0.3, len(n)))
    line = linregress(np.log(n), np.log(cost))
    growth = speed_report.fit(n, cost)
    assert growth.exponent == pytest.approx(line.slope, rel=1e-12)
    assert growth.error == pytest.approx(line.stderr, rel=1e-9)


def test_growth_is_by_scene_and_neighbours():
    records = [made(s) for s in speed.plan(["street"], [250, 500, 1000], [10, 20], [0, 1])]
    lines = speed_report.growth_lines(records)
    assert [line[:18] for line in lines[2:]] == ["| street | 10 | 25", "| street | 20 | 25"]
    cells = dict(zip(lines[0].split(" | "), lines[2].split(" | "), strict=True))
    assert cells["NLP, CPU s"].startswith(f"{EXPONENT:.2f}")
    assert cells["Hessian nonzeros"].startswith("1.00")
    assert speed_report.growth_lines(records[:1]) == []
    # loading is not counted, and the NLP is not outside itself
    assert speed_report.outside(records[0]) == 3.0


def test_growth_of_all_scenes_has_a_factor_for_each():
    """One common exponent, equal to least squares with an indicator for every scene."""
    rng = np.random.default_rng(2)
    scene = np.array(["a", "a", "a", "b", "b", "b", "b"])
    n = np.array([500, 1000, 2000, 500, 700, 1000, 2000])
    cost = np.where(scene == "a", 1.0, 30.0) * n**1.3 * np.exp(rng.normal(0, 0.1, len(n)))
    X = np.column_stack([np.log(n), scene == "a", scene == "b"]).astype(float)
    solution, rest, *_ = np.linalg.lstsq(X, np.log(cost), rcond=None)
    error = np.sqrt(rest[0] / (len(n) - 3) * np.linalg.inv(X.T @ X)[0, 0])
    found = speed_report.fit(n, cost, list(scene))
    assert found.exponent == pytest.approx(solution[0], rel=1e-10)
    assert found.error == pytest.approx(error, rel=1e-8)
    # sizes that differ between scenes alone say nothing
    assert speed_report.fit([500, 2000], [1.0, 4.0], ["a", "b"]) is None
    records = [made(s) for s in speed.plan(["street", "room"], [500, 1000], [10], [0])]
    scenes = [line.split(" ")[1] for line in speed_report.growth_lines(records)[2:]]
    assert scenes == ["room", "street", "all"]


def test_table_and_plots(tmp_path):
    records = [made(s) for s in speed.plan(["street", "room"], [250, 500], [10], [0])]
    bare = made(run_settings("room", 500, 20), converged=False, mre={})
    broken = {"key": "b-key", "settings": run_settings("street", 250, 10), "error": "no answer"}
    SPEED.write(tmp_path, [*records, bare, broken])
    text = (tmp_path / "table.md").read_text()
    assert "4 of 5 runs converged" in text
    assert "1.0200 to 1.0200 times" in text
    assert "1.50 to 1.50 times" in text
    assert "- b-key: no answer" in text
    assert f"| street | 10 | 250 to 500 | {EXPONENT:.2f} |" in text
    for name in ("growth", "phases", "energy"):
        assert (tmp_path / f"{name}.png").stat().st_size > 5000
    SPEED.write(tmp_path, [broken])
    assert "No run" in (tmp_path / "table.md").read_text()


@pytest.fixture
def kept(tmp_path):
    own = run_settings("street", 250, 10)
    path = tmp_path / "baseline.json"
    path.write_text(json.dumps(speed_gate.baseline([made(own)], machine())))
    runs = speed_gate.read_baseline(path)
    assert [run.settings for run in runs] == [own]
    return own, runs


def worse(findings) -> set[str]:
    return {f.name for f in findings if not f.ok}


def test_the_gate_holds_for_the_same_and_for_better(kept):
    own, runs = kept
    findings = list(speed_gate.check([made(own)], runs))
    assert not worse(findings)
    assert {f.name for f in findings} == {*speed_gate.LIMITS, "converged"}
    better = made(own, energy={"total": 40.0}, iterations=10)
    assert not worse(speed_gate.check([better], runs))


def test_the_gate_sees_what_is_worse(kept):
    own, runs = kept
    cases = {
        "iterations": {"iterations": 140},
        "converged": {"converged": False},
    }
    for name, change in cases.items():
        assert worse(speed_gate.check([made(own, **change)], runs)) == {name}
    more = made(own, energy={"total": 51.0 * 1.01})
    assert worse(speed_gate.check([more], runs)) == {"energy", "energy_to_reference"}
    dense = copy.deepcopy(made(own))
    dense["sizes"]["hessian_nonzeros"] *= 2
    assert worse(speed_gate.check([dense], runs)) == {"nonzeros"}
    assert worse(speed_gate.check([], runs)) == {"run"}
    failed = {"key": "x", "settings": own, "error": "broke"}
    assert worse(speed_gate.check([failed], runs)) == {"run"}


def test_the_gate_looks_at_ratios_not_at_seconds(kept):
    own, runs = kept
    slow = copy.deepcopy(made(own))
    slow["cpu"]["nlp"] *= 10
    assert worse(speed_gate.check([slow], runs)) == {"time_to_reference"}
    # a machine that is ten times slower at everything
    slow["reference"]["cpu_seconds"] *= 10
    assert not worse(speed_gate.check([slow], runs))


def test_files_that_are_no_baseline(tmp_path):
    path = tmp_path / "b.json"
    for text in ("{}", "[]", "no json", '{"version": 99, "runs": []}'):
        path.write_text(text)
        with pytest.raises(DataError, match="not a baseline"):
            speed_gate.read_baseline(path)
    with pytest.raises(DataError, match="not a baseline"):
        speed_gate.read_baseline(tmp_path / "missing.json")
    with pytest.raises(DataError, match="failed"):
        speed_gate.baseline([{"key": "x", "error": "broke"}], {})


def test_settings_become_the_problem():
    p = problem_of("room", 300, 12, 5, 512, 218, overrides=["solver.tol=0.5"])
    assert (p.input.scene, p.input.seed, p.input.width, p.seed) == ("room", 5, 512, 5)
    assert (p.segmentation.superpixels, p.segmentation.neighbours) == (300, 12)
    assert p.solver.tol == 0.5
    assert not p.refine.enabled
    assert problem_of("motorcycle", 300, 12).input.kind == "motorcycle"


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
    (record,) = read_rows(out / "table.jsonl")
    assert record["energy"]["total"] < record["energy_start"]["total"]
    assert record["reference"]["energy"]["total"] < record["energy_start"]["total"]
    assert record["peak_bytes"] > 5e7
    assert record["sizes"]["variables"] == 16 * record["sizes"]["superpixels"]
    parts = sum(record["wall"][k] for k in ("build", "functions", "linear algebra"))
    assert parts == pytest.approx(record["wall"]["nlp"], rel=1e-6)
    assert {"load", "flow", "segmentation", "start", "output"} <= set(record["cpu"])
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
