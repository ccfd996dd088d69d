"""bench speed: plan, store, fit, table, gate on made records; and one tiny real run."""

from __future__ import annotations

import copy
import json
from dataclasses import asdict

import numpy as np
import pytest
from scipy.stats import linregress

from soup_nlp.bench import speed, speed_fit, speed_gate, speed_report
from soup_nlp.bench.processes import machine
from soup_nlp.bench.rows import read_rows
from soup_nlp.bench.speed import Spec, problem_of, schedule
from soup_nlp.cli.main import main
from soup_nlp.errors import DataError
from soup_nlp.solve.solver_options import SolverOptions

EXPONENT = 1.3


def made(spec: Spec, **changes) -> dict:
    """A record as `timed.measure` writes it, its costs a power of N."""
    n = spec.superpixels
    cost = 1e-3 * n**EXPONENT
    y = {
        "name": "levenberg-marquardt (CHOLMOD)",
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
        "stages": [
            {
                "name": "presolve 0.1",
                "status": "Stagnated",
                "iterations": 100,
                "seconds": cost,
                "inf_du": None,
                "inf_pr": 1e-9,
            }
        ],
        "status": "Solve_Succeeded",
        "converged": True,
        "delivered": "constrained NLP",
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
        "reference": dict.fromkeys(spec.references, y),
    }
    record |= changes
    return {"key": spec.key, "code": "c0de", "spec": asdict(spec), **record}


def test_the_plan_has_every_run_once_small_ones_first():
    specs = speed.plan(["street", "motorcycle"], [500, 250], [20, 10], [3, 4], width=512)
    assert len({s.key for s in specs}) == len(specs) == 2 * 2 * (2 + 1)
    assert [s.superpixels for s in specs] == sorted(s.superpixels for s in specs)
    assert {s.seed for s in specs if s.scene == "motorcycle"} == {3}
    assert {s.width for s in specs} == {512}
    for spec in specs:
        assert Spec.from_dict(json.loads(json.dumps(asdict(spec)))) == spec


def test_measurements_resume(tmp_path):
    path = tmp_path / "records.jsonl"
    calls = []

    def measure(spec):
        calls.append(spec.key)
        if spec.superpixels == 500:
            return {"error": "broke"}
        return {k: v for k, v in made(spec).items() if k not in ("key", "code", "spec")}

    specs = speed.plan(["street"], [250, 500], [10], [0])
    first = speed.measure_specs(specs, path, work=measure)
    assert [r["key"] for r in first] == [s.key for s in specs]
    assert first[1]["error"] == "broke"
    calls.clear()
    again = speed.measure_specs(specs, path, work=measure)
    assert again[0] == json.loads(json.dumps(first[0]))
    # what failed is tried again, another reference solver is another run
    assert calls == [specs[1].key]
    both = Spec.from_dict({**asdict(specs[0]), "references": ["same", "wide"]})
    speed.measure_specs([both], path, work=measure)
    assert calls[1:] == [both.key]
    calls.clear()
    speed.measure_specs(specs, path, fresh=True, work=measure)
    assert len(calls) == 2


def test_a_run_that_fails_says_why(monkeypatch):
    record = speed.run_alone(Spec("nowhere", 100, 8))
    assert "nowhere" in record["error"]
    assert "street" in record["error"]
    monkeypatch.setattr("soup_nlp.bench.processes.GRACE", 0.0)
    late = speed.run_alone(Spec("street", 60, 8), seconds=0.2)
    assert late["error"] == "no answer after 0.2 s"


def test_exponents_are_found():
    n = np.array([250, 500, 1000, 2000])
    exact = speed_fit.fit(n, 3e-4 * n**1.4)
    assert exact.exponent == pytest.approx(1.4, abs=1e-12)
    assert exact.error == pytest.approx(0.0, abs=1e-9)
    assert (exact.low, exact.high, exact.count) == (250, 2000, 4)
    rng = np.random.default_rng(0)
    noisy = speed_fit.fit(n, n**1.4 * np.exp(rng.normal(0, 0.1, 4)))
    assert 0.01 < noisy.error < 0.2
    assert noisy.exponent == pytest.approx(1.4, abs=3 * noisy.error)
    assert np.isnan(speed_fit.fit([250, 500], [1.0, 2.0]).error)
    assert speed_fit.fit([250, 252], [1.0, 2.0]) is None
    assert speed_fit.fit([250], [1.0]) is None


def test_the_error_of_an_exponent_is_the_regressions():
    rng = np.random.default_rng(1)
    n = np.array([250, 250, 500, 1000, 1000, 2000, 4000])
    cost = n**1.2 * np.exp(rng.normal(0, 0.3, len(n)))
    line = linregress(np.log(n), np.log(cost))
    growth = speed_fit.fit(n, cost)
    assert growth.exponent == pytest.approx(line.slope, rel=1e-12)
    assert growth.error == pytest.approx(line.stderr, rel=1e-9)


def test_growth_is_by_scene_and_neighbours():
    records = [made(s) for s in speed.plan(["street"], [250, 500, 1000], [10], [0, 1])]
    records.append({"key": "x", "spec": asdict(Spec("street", 2000, 10)), "error": "broke"})
    fits = speed_fit.growth(records)
    assert set(fits) == {("street", 10)}
    assert fits["street", 10]["NLP, CPU s"].exponent == pytest.approx(EXPONENT)
    assert fits["street", 10]["Hessian nonzeros"].exponent == pytest.approx(1.0)
    assert speed_fit.growth(records, least=500)["street", 10]["NLP, CPU s"].low == 500
    assert speed_fit.growth(records, least=1000) == {}
    # loading a frame is nobody's fault, and the NLP is not outside itself
    assert speed_fit.outside(records[0]) == 3.0


def test_growth_of_all_scenes_has_a_factor_for_each():
    """One exponent, as by least squares with an indicator of every scene."""
    rng = np.random.default_rng(2)
    scene = np.array(["a", "a", "a", "b", "b", "b", "b"])
    n = np.array([500, 1000, 2000, 500, 700, 1000, 2000])
    cost = np.where(scene == "a", 1.0, 30.0) * n**1.3 * np.exp(rng.normal(0, 0.1, len(n)))
    X = np.column_stack([np.log(n), scene == "a", scene == "b"]).astype(float)
    solution, rest, *_ = np.linalg.lstsq(X, np.log(cost), rcond=None)
    error = np.sqrt(rest[0] / (len(n) - 3) * np.linalg.inv(X.T @ X)[0, 0])
    found = speed_fit.fit(n, cost, list(scene))
    assert found.exponent == pytest.approx(solution[0], rel=1e-10)
    assert found.error == pytest.approx(error, rel=1e-8)
    # sizes that differ between scenes alone say nothing
    assert speed_fit.fit([500, 2000], [1.0, 4.0], ["a", "b"]) is None
    records = [made(s) for s in speed.plan(["street", "room"], [500, 1000], [10], [0])]
    assert set(speed_fit.growth(records)) == {("street", 10), ("room", 10), ("all", 10)}
    assert speed_report.growth_lines(records)[-1].startswith("| all | 10 |")


def test_table_and_plots(tmp_path):
    specs = speed.plan(["street", "room"], [250, 500], [10], [0], references=("same", "wide"))
    records = [made(s) for s in specs]
    bare = made(Spec("room", 500, 20, references=()), converged=False, mre={})
    broken = {"key": "b-key", "spec": asdict(specs[0]), "error": "no answer"}
    text = speed_report.report([*records, bare, broken], machine(), "2026-01-01")
    assert "4 of 5 runs converged" in text
    assert "1.0200 to 1.0200 times" in text
    assert "1.50 to 1.50 times" in text
    assert "b-key failed: no answer" in text
    assert f"| street | 10 | 250 to 500 | {EXPONENT:.2f} |" in text
    assert text.count("2026-01-01") == 1
    assert "No run" in speed_report.report([broken], machine(), "d")
    for name, plot in (
        ("growth", speed_report.plot_growth),
        ("phases", speed_report.plot_phases),
        ("energy", speed_report.plot_energy),
    ):
        plot(tmp_path / f"{name}.png", [*records, bare])
        assert (tmp_path / f"{name}.png").stat().st_size > 5000


@pytest.fixture
def kept(tmp_path):
    spec = Spec("street", 250, 10)
    path = tmp_path / "baseline.json"
    path.write_text(json.dumps(speed_gate.baseline([made(spec)], machine())))
    specs, values = speed_gate.read_baseline(path)
    assert specs == [spec]
    return spec, values


def worse(findings) -> set[str]:
    return {f.name for f in findings if not f.ok}


def test_the_gate_holds_for_the_same_and_for_better(kept):
    spec, values = kept
    findings = speed_gate.check([made(spec)], values)
    assert not worse(findings)
    assert {f.name for f in findings} == {*speed_gate.LIMITS, "converged"}
    better = made(spec, energy={"total": 40.0}, iterations=10)
    assert not worse(speed_gate.check([better], values))


def test_the_gate_sees_what_is_worse(kept):
    spec, values = kept
    cases = {
        "iterations": {"iterations": 140},
        "converged": {"converged": False},
    }
    for name, change in cases.items():
        assert worse(speed_gate.check([made(spec, **change)], values)) == {name}
    more = made(spec, energy={"total": 51.0 * 1.01})
    assert worse(speed_gate.check([more], values)) == {"energy", "energy_to_reference"}
    dense = copy.deepcopy(made(spec))
    dense["sizes"]["hessian_nonzeros"] *= 2
    assert worse(speed_gate.check([dense], values)) == {"nonzeros"}
    lost = made(spec, reference={})
    assert worse(speed_gate.check([lost], values)) == {"energy_to_reference", "time_to_reference"}
    assert worse(speed_gate.check([], values)) == {"run"}
    failed = {"key": spec.key, "error": "broke"}
    assert worse(speed_gate.check([failed], values)) == {"run"}


def test_the_gate_looks_at_ratios_not_at_seconds(kept):
    spec, values = kept
    slow = copy.deepcopy(made(spec))
    slow["cpu"]["nlp"] *= 10
    assert worse(speed_gate.check([slow], values)) == {"time_to_reference"}
    # a machine that is ten times slower at everything
    slow["reference"]["same"]["cpu_seconds"] *= 10
    assert not worse(speed_gate.check([slow], values))


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


def test_the_spec_becomes_the_problem():
    p = problem_of(Spec("room", 300, 12, 5, 512, 218, overrides=("solver.tol=0.5",)))
    assert (p.input.scene, p.input.seed, p.input.width, p.seed) == ("room", 5, 512, 5)
    assert (p.segmentation.superpixels, p.segmentation.neighbours) == (300, 12)
    assert p.solver.tol == 0.5
    assert not p.refine.enabled
    assert problem_of(Spec("motorcycle", 300, 12)).input.kind == "motorcycle"


def test_the_reference_solver_ends_at_the_solvers_smoothing():
    o = SolverOptions(presolve_eps=(0.1, 0.03), eps=0.03)
    assert schedule("same", o) == (0.1, 0.03)
    assert schedule("same", SolverOptions(presolve_eps=(0.1, 0.03), eps=0.01))[-1] == 0.01
    assert schedule("same", SolverOptions(presolve=False, eps=0.02)) == (0.02,)
    assert schedule("wide", o)[0] == 1.0


@pytest.mark.parametrize(
    "words",
    [
        ["--scenes", "stret"],
        ["--sizes", "many"],
        ["--sizes", "1"],
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
    small += ["--set", "formulation.compiled=false"]
    words = ["bench", "speed", *size, *small, "--quiet", "--out", str(out)]
    assert main([*words, "--write-baseline", str(base)]) == 0
    (record,) = read_rows(out / "records.jsonl")
    assert record["energy"]["total"] < record["energy_start"]["total"]
    assert record["reference"]["same"]["energy"]["total"] < record["energy_start"]["total"]
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
