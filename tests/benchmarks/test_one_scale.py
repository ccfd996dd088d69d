"""The error of one scale for a sequence: a tiny chain and its page."""

import pytest

from benchmarks.chain import chain_page, measure_chain, sequences
from benchmarks.table import Cell, frame_of

SMALL = (
    "input.width=160",
    "input.height=108",
    "segmentation.superpixels=40",
    "segmentation.neighbours=6",
    "refine.enabled=false",
)


@pytest.mark.slow
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
