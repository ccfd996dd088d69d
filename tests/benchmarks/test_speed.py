"""Speed: plan and page on artificial rows; one tiny real run."""

import pytest
from helpers_files import sets

from benchmarks.__main__ import main
from benchmarks.speed import speed_cells, speed_page
from benchmarks.table import Cell, frame_of
from soup_nlp.storage.rows import read_rows


def speed_cell(scene: str = "street", superpixels: int = 250, neighbours: int = 10) -> Cell:
    return speed_cells([scene], [0], [1024], [superpixels], [neighbours])[0]


def made(scene: str = "street", superpixels: int = 250, neighbours: int = 10, **changes) -> dict:
    """A row like that of `measure_speed`."""
    return {
        **speed_cell(scene, superpixels, neighbours).identity(),
        **{"ok": True, "error": None, "code": "c0de", "cpu_seconds": 1.0},
        **{"n": superpixels, "k": neighbours, "iterations": 100, "status": "Solve_Succeeded"},
        "cpu": {"load": 99.0, "nlp": 7.0, "start": 1.0, "output": 2.0},
        "energy": {"total": 51.0},
        "energy_start": {"total": 90.0},
        "metrics": {"start": {"mre": 0.2}, "solution": {"mre": 0.1}},
        "peak_bytes": 2**30,
        **changes,
    }


def failed(reason: str) -> dict:
    identity = speed_cell().identity()
    return {**identity, "ok": False, "error": reason, "code": "c0de", "cpu_seconds": 1.0}


def test_the_plan_has_every_run_once_small_ones_first():
    pairs = ["street", "motorcycle"], [3, 4], [512]
    cells = speed_cells(*pairs, [500, 250], [20, 10], ["solver.tol=0.5"])
    assert len({c.identity()["key"] for c in cells}) == len(cells) == 2 * 2 * (2 + 1)
    problems = [c.item.problem(c.overrides) for c in cells]
    sizes = [p.segmentation.superpixels for p in problems]
    assert sizes == sorted(sizes)
    assert [c.item.family for c in cells[:3]] == ["street", "street", "motorcycle"]
    assert [(p.input.seed, p.seed, p.input.width) for p in problems[:2]] == [
        (3, 3, 512), (4, 4, 512),
    ]  # fmt: skip
    assert (problems[0].segmentation.neighbours, problems[0].solver.tol) == (10, 0.5)
    assert not problems[0].refine.enabled


def test_the_page_of_runs():
    rows = [made(scene, n) for scene in ("street", "room") for n in (250, 500)]
    rows += [made("room", 500, 20, metrics={}), failed("no answer")]
    text = speed_page(frame_of(rows))
    # no MRE where there is no metric; loading is no part of the whole
    assert text.count("| 51.000 | 0.1000 | 1.00 | 3.0 | 10 |") == 4
    assert text.count("| 51.000 | - | 1.00 |") == 1
    # N and K differ, and the seed is that of the scene
    assert "code c0de; overrides of every row: `seed=0`, `refine.enabled=false`." in text
    assert "N 250, K 10: no answer" in text
    assert "N 250, K 10: no answer" in speed_page(frame_of(rows[-1:]))
    # of two overrides of a key the later one counts
    twice = made(overrides=["seed=0", "refine.enabled=false", "refine.enabled=true"])
    assert "every row: `seed=0`, `refine.enabled=true`." in speed_page(frame_of([twice]))


def test_bad_input_ends_with_2(tmp_path, capsys):
    for words in (["--superpixels", "many"], ["--set", "solver.tolerance=1"]):
        assert main(["speed", *words, "--out", str(tmp_path / "out")]) == 2
        assert capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_real_run_and_its_table(tmp_path):
    size = ["--scenes", "street", "--superpixels", "12", "--neighbours", "4", "--widths", "64"]
    small = sets(
        "solver.presolve_eps=[0.3] solver.presolve_iterations=3"
        " solver.exact_iterations=0 solver.max_iter=1"
    )
    assert main(["speed", *size, *small, "--out", str(tmp_path)]) == 0
    (row,) = read_rows(tmp_path / "table.jsonl")
    assert row["energy"]["total"] < row["energy_start"]["total"]
    assert row["peak_bytes"] > 5e7
    assert {"load", "flow", "segmentation", "start", "output"} <= set(row["cpu"])
    assert "| street-s0-64x48 |" in (tmp_path / "table.md").read_text()
