"""The fit of the factors of sigma; the error of one scale for a sequence."""

import numpy as np
import pytest

from benchmarks.chain import chain_page, measure_chain, sequences
from benchmarks.sigma import fitted
from benchmarks.table import Cell, frame_of
from soup_nlp.evaluation.confidence import ADDED, FACTORS

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
