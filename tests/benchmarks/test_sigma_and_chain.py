"""The fit of the factors of sigma; the error of one scale for a sequence."""

import numpy as np
import pytest

from benchmarks.__main__ import main
from benchmarks.chain import chain_page, measure_chain, sequences
from benchmarks.sigma import fitted
from benchmarks.table import Cell, frame_of
from soup_nlp.evaluation.confidence import ADDED, FACTORS
from soup_nlp.storage.each import append_row

pytestmark = pytest.mark.slow


def no_terms(count):
    return dict.fromkeys((*ADDED, "starts", "camera", "drawn"), np.zeros(count))


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
    assert "| a |" in text
    assert "| c |" not in text
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
