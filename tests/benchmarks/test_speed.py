"""Speed: plan and page on artificial rows; one tiny real run."""

import pytest
from helpers_files import sets

from benchmarks.__main__ import main
from benchmarks.speed import speed_cells
from soup_nlp.storage.each import read_rows

pytestmark = pytest.mark.slow


def test_the_plan_has_every_run_once_small_ones_first():
    pairs = ["street", "motorcycle"], [3, 4], [512]
    cells = speed_cells(*pairs, [500, 250], [20, 10], ["solver.eps=0.5"])
    assert len({c.identity()["key"] for c in cells}) == len(cells) == 2 * 2 * (2 + 1)
    problems = [c.item.problem(c.overrides) for c in cells]
    sizes = [p.segmentation.superpixels for p in problems]
    assert sizes == sorted(sizes)
    assert [c.item.family for c in cells[:3]] == ["street", "street", "motorcycle"]
    assert [(p.input.seed, p.seed, p.input.width) for p in problems[:2]] == [
        (3, 3, 512), (4, 4, 512),
    ]  # fmt: skip
    assert (problems[0].segmentation.neighbours, problems[0].solver.eps) == (10, 0.5)
    assert not problems[0].refine.enabled


def test_bad_input_ends_with_2(tmp_path, capsys):
    for words in (["--superpixels", "many"], ["--set", "solver.tolerance=1"]):
        assert main(["speed", *words, "--out", str(tmp_path / "out")]) == 2
        assert capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_real_run_and_its_table(tmp_path):
    size = ["--scenes", "street", "--superpixels", "12", "--neighbours", "4", "--widths", "64"]
    small = sets("solver.presolve_eps=[0.3] solver.presolve_iterations=3 solver.max_iter=1")
    assert main(["speed", *size, *small, "--out", str(tmp_path)]) == 0
    (row,) = read_rows(tmp_path / "table.jsonl")
    assert row["energy"]["total"] < row["energy_start"]["total"]
    assert row["peak_bytes"] > 5e7
    assert {"load", "flow", "segmentation", "start", "output"} <= set(row["cpu"])
    assert "| street-s0-64x48 |" in (tmp_path / "table.md").read_text()
