"""The tables of the paper, from artificial rows."""

import json
from operator import attrgetter
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks import __main__ as program
from benchmarks.paper import METHODS, NO_EFFECT, STUDIES, departures, make_plan, printed
from benchmarks.table import Cell, Item
from soup_nlp import make_problem
from soup_nlp.errors import DataError
from soup_nlp.storage.each import Row

PAPER = ("preset=paper",)
RAW = {"input": {"kind": "motorcycle"}}


def item(scene: str = "street") -> Item:
    raw = {"kind": "scene", "scene": scene, "width": 128, "height": 64}
    return Item("rendered", scene, f"{scene}-tiny", "truth", raw)


@pytest.mark.parametrize("name", STUDIES)
def test_the_variants_of_a_study_are_different_problems(name):
    variants = STUDIES[name][1].values()
    assert len({item().problem(overrides).digest() for overrides in variants}) == len(variants)


def test_undone_departures_have_the_values_of_the_preset():
    paper, base, known = make_problem(RAW, PAPER), make_problem(RAW), departures()
    assert "start.method" in known
    assert "refine.stagnation" not in known
    for overrides in known.values():
        off = make_problem(RAW, overrides)
        assert off.digest() != base.digest()
        for key in (override.partition("=")[0] for override in overrides):
            assert attrgetter(key)(off) == attrgetter(key)(paper)
    # all of them together are the preset, but for what has no effect here
    undone = {o.partition("=")[0] for overrides in known.values() for o in overrides}
    rest = printed().keys() - undone
    both = [key for key in rest if attrgetter(key)(paper) != attrgetter(key)(base)]
    assert set(both) <= NO_EFFECT


def fake(cell: Cell) -> Row:
    """A row whose numbers identify its cell."""
    if any("orient" in o for o in cell.overrides) and cell.item.suite == "shared":
        raise DataError("made to fail", where=cell.item.key)
    value = 0.5 if cell.overrides[:1] == PAPER else 0.25
    methods = ("solution", "nlp", "start", "constant", "rigid")
    return {"status": "Solve_Succeeded", "metrics": {m: {"mre": value} for m in methods}}


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    """Two bending pairs, one of them without a truth."""
    for k in (1, 2):
        folder = tmp_path / "data" / "kinect_paper" / f"pair_00{k}"
        folder.mkdir(parents=True)
        for frame in (0, 1):
            cv2.imwrite(str(folder / f"frame_{frame}.png"), np.full((48, 64, 3), 9 * k, np.uint8))
        np.savetxt(folder / "K.txt", [[60.0, 0, 32], [0, 60.0, 24], [0, 0, 1]])
    depth = np.full((48, 64), 800.0)
    np.save(tmp_path / "data" / "kinect_paper" / "pair_001" / "depth.npy", depth)
    return tmp_path / "data"


@pytest.mark.slow
def test_a_tiny_dataset_gives_all_sections(dataset, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(program, "measure_pair", fake)
    out = tmp_path / "out"
    assert program.main(["paper", "--data", str(dataset), "-o", str(out)]) == 1
    text = (out / "README.md").read_text()
    for title, _ in STUDIES.values():
        assert f"## {title}" in text
    # a family without data is not named
    assert "one departure undone, on street-s0-1024x436, room-s0" in text
    assert "tum_fr1" not in text
    # the pair with a truth alone, beside the published row
    published = "0.2040 | 0.0920 | 0.0322 | 0.0520 | - | 0.0472 | 0.2500 | 0.5000"
    assert f"| kinect_paper | {published} |" in text
    # how each NLP ended stands beside its numbers
    assert "| preset: paper | 0.5000 | 0.5000 | 0.5000 | 0.5000 | Solve_Succeeded |" in text
    assert "made to fail" in text
    rows = [json.loads(line) for line in (out / "README.jsonl").read_text().splitlines()]
    good = sum(row["ok"] for row in rows)
    assert good < len(rows)
    assert f"{good} of the {len(rows)} rows were measured." in text
    assert "| alley_1 | 0.2248 | 0.2022 | 0.1697 | 0.1606 |" in text


def test_a_plan_measures_nothing_twice():
    plan = make_plan(None, superpixels=60, analysis=60)
    cells = plan.drop_duplicates("key")["cell"]
    names = {json.dumps(cell.identity(), sort_keys=True) for cell in cells}
    assert len(names) == len(cells) < len(plan)
    assert set(plan["section"]) == {*STUDIES, "departures"}
    assert set(plan["method"]) == set(METHODS)
