"""The fit of the factors of sigma; the error of one scale for a sequence."""

import numpy as np
import pytest

from benchmarks.chain import chain_page, measure_chain, sequences
from benchmarks.sigma import fitted, write_sigma
from benchmarks.table import Cell, frame_of
from soup_nlp.evaluation.confidence import ADDED, FACTORS

pytestmark = pytest.mark.slow


def no_terms(count):
    return dict.fromkeys((*ADDED, "camera", "drawn"), np.zeros(count))


def test_the_fit_finds_the_factor_of_normal_errors():
    rng = np.random.default_rng(0)
    terms = no_terms(4000)
    terms["flow"] = np.exp(rng.normal(-4, 0.5, 4000))
    factor = fitted({"family": [(rng.normal(0, 1.0 * terms["flow"]), terms)]})
    assert factor["flow"] == pytest.approx(1.0, rel=0.05)
    assert factor["pace"] == pytest.approx(FACTORS["pace"], rel=0.05)


def test_the_page_has_the_scores_of_families_by_the_factors_of_the_others(tmp_path):
    rng, rows = np.random.default_rng(1), []
    for family, spread in (("one", 0.1), ("two", 0.2)):
        terms = no_terms(300)
        terms["drawn"] = np.ones(300)
        row = {"error": rng.normal(0, spread, 300).tolist(), "terms": terms}
        about = {"ok": True, "family": family, "pair": family, "code": "c", "cpu_seconds": 1.0}
        rows.append({**Cell(sequences(None)[0]).identity(), **about, **row})
    page = write_sigma(tmp_path / "sigma.md", frame_of(rows))
    assert (tmp_path / "sigma.png").stat().st_size > 1000
    today, others = page.split("## By ")[1:]
    (drawn,) = (line.split("|") for line in page.splitlines() if line.startswith("| drawn"))
    assert float(drawn[4]) == pytest.approx(0.1, rel=0.2)
    assert float(drawn[5]) == pytest.approx(0.2, rel=0.2)
    assert today.startswith("today's factors")
    # the other family has half of the errors
    within = {}
    for line in others.splitlines():
        if line.startswith(("| one", "| two")):
            cells = [cell.strip() for cell in line.split("|")]
            within[cells[1]] = float(cells[4])
    assert within["one"] > 0.9
    assert within["two"] < 0.5


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
