"""Where the depth error sits: parts of the MRE by what the flow is, and the true motion beside."""

from __future__ import annotations

from pathlib import Path

import pytest

from soup_nlp.bench.causes import KINDS, MOST, measure_causes, plot_causes, text_causes
from soup_nlp.bench.suite_pairs import Options
from soup_nlp.bench.suites import SUITES
from soup_nlp.errors import DataError

SMALL = (
    "segmentation.superpixels=80",
    "segmentation.neighbours=8",
    "refine.enabled=false",
)


def listed(word: str):
    options = Options(only=(word,), flows=("truth",), width=256)
    return next(iter(SUITES["rendered"].items(Path(), options)))


@pytest.fixture(scope="module")
def rows():
    item = listed("street")
    sources = ("truth", "truth+noise:0.5")
    made = [measure_causes(item, (*SMALL, f"flow.source={source}"), source) for source in sources]
    names = {"key": item.key, "suite": "rendered", "pair": item.name, "presets": ["paper"]}
    return [{**row, **names, "ok": True, "flow": "truth", "variant": ""} for row in made]


def test_the_parts_add_up_to_the_error(rows):
    for row in rows:
        own = row["causes"]
        assert set(own["part"]) == set(own["share"]) == set(KINDS)
        assert sum(own["part"].values()) == pytest.approx(own["mre"], rel=1e-9)
        assert sum(own["share"].values()) == pytest.approx(1.0)


def test_the_true_motion_makes_the_true_depth_of_the_true_flow(rows):
    true, noisy = (row["causes"] for row in rows)
    assert true["noise_px"] < 1e-5
    assert true["triangulated"][1] < 1e-4
    assert 10 * true["triangulated"][1] < noisy["triangulated"][1] < MOST


def test_page_and_picture_show_every_pair(rows, tmp_path):
    text = text_causes("causes", "where the error sits", rows)
    line = next(li for li in text.splitlines() if li.startswith(f"| {rows[0]['pair']} |"))
    assert f"{rows[0]['causes']['mre']:.4f}" in line
    plot_causes(tmp_path / "causes.png", rows)
    assert (tmp_path / "causes.png").stat().st_size > 1000


def test_a_pair_without_true_flow_cannot_be_measured(monkeypatch):
    item = listed("orbit")
    real = type(item.problem(SMALL)).load_pair

    def blind(problem):
        pair = real(problem)
        object.__setattr__(pair.truth, "flow", None)
        return pair

    monkeypatch.setattr(type(item.problem(SMALL)), "load_pair", blind)
    with pytest.raises(DataError, match="true flow"):
        measure_causes(item, (*SMALL, "flow.source=dis"))
