"""bench speed: plan, costs and page on artificial rows; one tiny real run."""

import pickle
from pathlib import Path

import pytest
from helpers_files import sets

from soup_nlp.bench.processes import machine
from soup_nlp.bench.speed import speed_cells, speed_page, timed_pairs, with_costs
from soup_nlp.bench.study import Cell, frame_of
from soup_nlp.cli import bench
from soup_nlp.cli.main import main
from soup_nlp.storage.rows import Job, Row, Say, measure_all, read_rows

pytestmark = pytest.mark.slow

EXPONENT = 1.3


def speed_cell(scene: str = "street", superpixels: int = 250, neighbours: int = 10) -> Cell:
    return speed_cells(timed_pairs([scene], [0]), [superpixels], [neighbours])[0]


def made(scene: str = "street", superpixels: int = 250, neighbours: int = 10, **changes) -> dict:
    """A row like that of `measure_speed`, with costs that are powers of N."""
    cost, n = 1e-3 * superpixels**EXPONENT, superpixels
    return {
        **speed_cell(scene, superpixels, neighbours).identity(),
        **{"ok": True, "error": None, "code": "c0de", "cpu_seconds": 1.0, "n": n, "k": neighbours},
        "sizes": {"jacobian_nonzeros": 58 * n, "hessian_nonzeros": 1300 * n},
        "stages": {"nlp": 3 * cost, "build": cost, "functions": cost, "linear algebra": cost},
        "cpu": {"load": 99.0, "nlp": 3 * cost, "start": 1.0, "output": 2.0},
        "iterations": 100,
        "status": "Solve_Succeeded",
        "energy": {"total": 51.0},
        "energy_start": {"total": 90.0},
        "metrics": {"start": {"mre": 0.2}, "solution": {"mre": 0.1}},
        "residuals": {"nlp_infeasibility": 1e-9, "dual_infeasibility": 1e-9},
        "peak_bytes": 2**30,
        **changes,
    }


def failed(reason: str) -> dict:
    identity = speed_cell().identity()
    return {**identity, "ok": False, "error": reason, "code": "c0de", "cpu_seconds": 1.0}


def test_the_plan_has_every_run_once_small_ones_first():
    items = timed_pairs(["street", "motorcycle"], [3, 4], [512])
    cells = speed_cells(items, [500, 250], [20, 10], ["solver.tol=0.5"])
    assert len({c.identity()["key"] for c in cells}) == len(cells) == 2 * 2 * (2 + 1)
    problems = [c.item.problem(c.overrides) for c in cells]
    sizes = [p.segmentation.superpixels for p in problems]
    assert sizes == sorted(sizes)
    assert [c.item.sequence for c in cells[:3]] == ["street", "street", "motorcycle"]
    assert [(p.input.seed, p.seed, p.input.width) for p in problems[:2]] == [
        (3, 3, 512), (4, 4, 512),
    ]  # fmt: skip
    assert (problems[0].segmentation.neighbours, problems[0].solver.tol) == (10, 0.5)
    assert not problems[0].refine.enabled


def test_costs_outside_the_nlp_and_of_the_whole_solve():
    frame = with_costs(frame_of([made("street", 250)]))
    # loading is not counted, and the NLP is not outside itself
    assert frame["outside"].iloc[0] == 3.0
    stages = {"load": 50.0, "flow": 2.0, "nlp": 7.0, "nlp_presolve": 6.0, "refine": 1.0}
    assert with_costs(frame_of([made(stages=stages)]))["whole"].iloc[0] == 10.0


def test_the_page_of_runs():
    rows = [made(scene, n) for scene in ("street", "room") for n in (250, 500)]
    rows += [made("room", 500, 20, metrics={}), failed("no answer")]
    text = speed_page(frame_of(rows))
    assert {"processor", "cores", "memory", "code"} <= machine().keys()
    # E of start and answer, with no MRE where there is no metric
    assert text.count("| 90.00 | 51.000 | 0.2000 | 0.1000 |") == 4
    assert text.count("| 90.00 | 51.000 | - | - |") == 1
    # N and K differ, and the seed is that of the scene
    assert "code c0de; overrides of every row: `seed=0`, `refine.enabled=false`." in text
    assert "N 250, K 10: no answer" in text
    assert "N 250, K 10: no answer" in speed_page(frame_of(rows[-1:]))


def test_the_page_names_the_last_override_of_a_key():
    twice = made(overrides=["seed=0", "refine.enabled=false", "refine.enabled=true"])
    assert "every row: `seed=0`, `refine.enabled=true`." in speed_page(frame_of([twice]))


@pytest.mark.parametrize(
    "words",
    [
        ["--scenes", "stret"],
        ["--superpixels", "many"],
        ["--superpixels", "1"],
        ["--seeds", "-1"],
        ["--neighbours", ""],
        ["--set", "solver.tolerance=1"],
    ],
)
def test_bad_input_ends_with_2(tmp_path, capsys, words):
    assert main(["bench", "speed", *words, "--out", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.startswith("error:")
    assert not (tmp_path / "out").exists()


def test_a_real_run_and_its_table(tmp_path, monkeypatch):
    out = tmp_path / "out"

    def here(jobs: list[Job], path: Path, say: Say, fresh: bool) -> list[Row]:
        assert fresh
        return measure_all(pickle.loads(pickle.dumps(jobs)), path, say=say)

    # `test_rows.py` measures rows in new processes
    monkeypatch.setattr(bench, "measure_all", here)
    size = ["--scenes", "street", "--sizes", "12", "--neighbours", "4", "--seeds", "0"]
    small = sets(
        "formulation.compiled=false solver.presolve_eps=[0.3] solver.presolve_iterations=3"
        " solver.exact_iterations=0 solver.max_iter=1"
    )
    small += ["--width", "64"]
    words = ["bench", "speed", *size, *small, "--quiet", "--out", str(out)]
    assert main(words) == 0
    (row,) = read_rows(out / "table.jsonl")
    assert row["energy"]["total"] < row["energy_start"]["total"]
    assert row["peak_bytes"] > 5e7
    parts = sum(row["stages"][k] for k in ("build", "functions", "linear algebra"))
    assert parts == pytest.approx(row["stages"]["nlp"], rel=1e-6)
    assert row["stages"]["output"] > 0
    assert {"load", "flow", "segmentation", "start", "output"} <= set(row["cpu"])
    assert "| street-s0-64x48 |" in (out / "table.md").read_text()
