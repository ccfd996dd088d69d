"""Speed, the fit of the factors of sigma, the error of one scale for a sequence."""

import numpy as np
import pytest
from helpers_files import sets

from benchmarks.__main__ import main
from benchmarks.chain import chain_page, measure_chain, sequences
from benchmarks.sigma import fitted
from benchmarks.speed import speed_cells, speed_page
from benchmarks.table import Cell, frame_of
from soup_nlp.evaluation.confidence import ADDED, FACTORS
from soup_nlp.storage.each import append_row, read_rows

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("simple_starts")]


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


@pytest.mark.usefixtures("one_process")
def test_a_real_run_and_its_table(tmp_path):
    size = ["--scenes", "street", "--superpixels", "12", "--neighbours", "4", "--widths", "64"]
    small = sets("solver.presolve_eps=[0.3] solver.presolve_iterations=3 solver.max_iter=1")
    assert main(["speed", *size, *small, "--out", str(tmp_path)]) == 0
    (row,) = read_rows(tmp_path / "table.jsonl")
    assert row["energy"]["total"] < row["energy_start"]["total"]
    assert row["peak_bytes"] > 5e7
    assert {"load", "flow", "segmentation", "start", "output"} <= set(row["cpu"])
    page = (tmp_path / "table.md").read_text()
    assert "| street-s0-64x48 |" in page
    stages = (tmp_path / "table.csv").read_text().splitlines()
    assert stages[0].startswith("pair,N,load,flow,segmentation,start,nlp,")
    assert stages[1].startswith("street-s0-64x48,")
    assert "| K |" not in page
    # what a run does not share with the others is a column
    failed = {**row, "k": 5, "status": "Invalid_Number_Detected"}
    good = {**row, "status": "Solve_Succeeded"}
    page = speed_page(tmp_path / "table.md", frame_of([good, failed]))
    assert "| K |" in page
    assert page.count("Invalid_Number_Detected") == page.count("Solve_Succeeded") == 1
    page = speed_page(tmp_path / "table.md", frame_of([good]))
    assert "status" not in page.splitlines()[4]


def no_terms(count):
    return dict.fromkeys((*ADDED, "drawn"), np.zeros(count))


def test_the_fit_finds_the_factor_of_normal_errors():
    rng = np.random.default_rng(0)
    terms = no_terms(4000)
    terms["flow"] = np.exp(rng.normal(-4, 0.5, 4000))
    factor = fitted({"family": [(rng.normal(0, 1.0 * terms["flow"]), terms)]})
    assert factor["flow"] == pytest.approx(1.0, rel=0.05)
    assert factor["scale"] == pytest.approx(FACTORS["scale"], rel=0.05)


def test_the_page_of_sigma_is_made_from_the_rows_of_accuracy(tmp_path):
    rng = np.random.default_rng(1)
    for family, flow in (("a", "dis"), ("b", "dis"), ("c", "truth")):
        terms = {k: v.tolist() for k, v in no_terms(50).items()}
        terms["flow"] = [0.01] * 50
        pixels = {"error": rng.normal(0, 0.02, 50).tolist(), "terms": terms}
        about = {"key": family, "suite": "s", "family": family, "pair": family, "flow": flow}
        other = {"overrides": [], "ok": True, "code": "1", "cpu_seconds": 1.0}
        append_row(tmp_path / "s.jsonl", {**about, **other, "pixels": pixels})
    assert main(["sigma", str(tmp_path)]) == 0
    text = (tmp_path / "sigma.md").read_text()
    assert "2 pairs of 2 families" in text
    table = (tmp_path / "sigma.csv").read_text().splitlines()
    assert [line.partition(",")[0] for line in table] == ["family", "a", "b"]
    assert "| mean |" in text
    assert (tmp_path / "sigma.png").exists()


SMALL = (
    "input.width=160",
    "input.height=108",
    "segmentation.superpixels=40",
    "segmentation.neighbours=6",
    "refine.enabled=false",
    "solver.presolve_iterations=0",
    "solver.max_iter=1",
)


def test_a_chain_costs_the_difference_of_its_scales():
    cell = Cell(sequences(None)[0], SMALL)
    row = measure_chain(cell, frames=3)
    assert row["frames"] == 3
    expected = row["mre_one_scale"] / row["mre_own_scale"] - 1
    assert row["cost"] == pytest.approx(expected)
    row = {**cell.identity(), "ok": True, "cpu_seconds": 1.0, "code": "c", **row}
    text = chain_page(frame_of([row]))
    assert "| street | 3 |" in text
    assert f"code c; overrides of every row: `{SMALL[0]}`" in text
