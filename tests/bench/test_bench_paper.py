"""The tables and figures of the paper: sections from artificial rows, real rows of tiny pairs."""

import json
from operator import attrgetter
from pathlib import Path

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure

from soup_nlp.bench import paper_page
from soup_nlp.bench.paper import DATASETS, METHODS, make_plan, measure_paper
from soup_nlp.bench.paper_page import PICTURES
from soup_nlp.bench.studies import DEPARTURES, PAPER, STUDIES, default
from soup_nlp.bench.study import Cell, Item
from soup_nlp.cli import bench
from soup_nlp.cli.main import main
from soup_nlp.config.presets import PRESETS, leaves
from soup_nlp.config.problem import make_problem
from soup_nlp.errors import DataError
from soup_nlp.storage.rows import Row

pytestmark = pytest.mark.slow

TINY = ("segmentation.superpixels=20", "segmentation.neighbours=4")
QUICK = (*TINY, "solver.exact_iterations=0", "solver.max_iter=1", "refine.rounds=1")


def item(scene: str = "street", width: int = 128, height: int = 64) -> Item:
    raw = {"kind": "scene", "scene": scene, "width": width, "height": height}
    return Item("rendered", scene, f"{scene}-tiny", "truth", raw)


def test_departures_are_all_differences_between_preset_and_defaults():
    printed = dict(leaves(PRESETS["paper"]))
    ours = {key: default(key) for key in printed}
    same = {
        key
        for key, value in printed.items()
        if value == (list(ours[key]) if isinstance(ours[key], tuple) else ours[key])
    }
    told = [key for d in DEPARTURES for key in d.keys]
    # K, method and the like are printed as the defaults have them
    assert set(printed) - same <= set(told)
    assert len(told) == len(set(told))


@pytest.mark.parametrize("name", STUDIES)
def test_the_variants_of_a_study_are_different_problems(name):
    variants = STUDIES[name].variants
    assert len({item().problem(overrides).digest() for overrides in variants.values()}) == len(
        variants
    )


@pytest.mark.parametrize("departure", DEPARTURES, ids=lambda d: d.name)
def test_a_departure_changes_the_defaults_and_the_preset(departure):
    raw = {"input": {"kind": "motorcycle"}}
    base, paper = make_problem(raw), make_problem(raw, PAPER)
    off = make_problem(raw, departure.off_alone())
    assert off.digest() != base.digest()
    assert make_problem(raw, (*PAPER, *departure.on_alone())).digest() != paper.digest()
    further = {override.partition("=")[0] for override in departure.with_off}
    for key in set(departure.keys) - further:
        assert attrgetter(key)(off) == attrgetter(key)(paper)


def fake(cell: Cell) -> Row:
    """A row whose numbers identify its cell."""
    if any("orient" in o for o in cell.overrides) and cell.item.suite == "shared":
        raise DataError("made to fail", where=cell.item.key)
    value = 0.5 if cell.overrides[:1] == PAPER else 0.25
    told = {"mre": value, "median_relative": value / 2}
    methods = ("solution", "nlp", "start", "constant", "rigid")
    if cell.keep is not None:
        image, z = np.zeros((6, 8, 3), np.uint8), np.full((6, 8), 2.0)
        cell.keep.parent.mkdir(parents=True, exist_ok=True)
        np.savez_compressed(cell.keep, image=image, start=z, solution=z)
    return {
        "status": "Solve_Succeeded",
        "stages": {"flow": 1.0, "nlp": 2.0},
        "iterations": 7,
        "metrics": dict.fromkeys(methods, told),
        "curve": {
            "names": ["presolve"],
            "values": [[3.0, 2.0, 1.5]],
            "exact": [4.0, 2.0],
            "rounds": [2.0, 1.0],
        },
    }


@pytest.fixture
def dataset(tmp_path: Path) -> Path:
    """Two bending pairs, one of them without a truth."""
    for k in (1, 2):
        folder = tmp_path / "data" / "kinect_paper" / f"pair_00{k}"
        folder.mkdir(parents=True)
        for frame in (0, 1):
            cv2.imwrite(str(folder / f"frame_{frame}.png"), np.full((48, 64, 3), 9 * k, np.uint8))
        np.savetxt(folder / "K.txt", [[60.0, 0, 32], [0, 60.0, 24], [0, 0, 1]])
    depth = np.full((48, 64), 800, np.uint16)
    cv2.imwrite(str(tmp_path / "data" / "kinect_paper" / "pair_001" / "depth.png"), depth)
    return tmp_path / "data"


def drawn(figure: Figure, path: Path) -> None:
    """Draw a figure without pixels, which take most of the time."""
    figure.set_layout_engine("none")
    figure.draw_without_rendering()
    path.touch()


def test_a_tiny_dataset_gives_all_sections(dataset, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(bench, "measure_paper", fake)
    monkeypatch.setattr(paper_page, "save", drawn)
    out = tmp_path / "out"
    words = ["bench", "paper", "--data", str(dataset), "-o", str(out), "-q"]
    assert main(words) == 1
    text = (out / "README.md").read_text()
    for study in STUDIES.values():
        assert f"## {study.text[0].upper()}{study.text[1:]}" in text
    for section in ("Mean relative error per dataset", "Depth maps", "Time", "Convergence of E"):
        assert f"## {section}" in text
    # a family without data has no column
    assert "| departure | mean | median | worse / better | street-s0-1024x436 | room-s0" in text
    assert "tum_fr1" not in text
    assert {p.stem for p in out.glob("*.png")} == set(PICTURES)
    assert all(f"]({name}.png)" in text for name in PICTURES)
    # the pair with a truth alone, beside the published row
    published = "0.2040 | 0.0920 | 0.0322 | 0.0520 | - | 0.0472 | - | 1 | 0.5000"
    assert f"| kinect_paper | {published} |" in text
    # how each NLP ended stands beside its numbers
    assert "| preset: paper | 0.5000 | 0.5000 | 0.5000 | 0.5000 | Solve_Succeeded |" in text
    # datasets that are not there say where they come from
    missing = text[text.index("## What is not here") :]
    for name, (title, _) in DATASETS.items():
        assert (f"| {title} |" in missing) == (name != "kinect_paper")
    assert "http://sintel.is.tue.mpg.de" in missing
    assert "Back sequence" in missing
    assert "made to fail" in text
    rows = [json.loads(line) for line in (out / "README.jsonl").read_text().splitlines()]
    good = sum(row["ok"] for row in rows)
    assert good < len(rows)
    assert f"{good} of the {len(rows)} rows were measured." in text
    capsys.readouterr()
    assert "| alley_1 | 0.2248 | 0.2022 | 0.1697 | 0.1606 |" in text


def test_a_plan_measures_nothing_twice(tmp_path):
    plan = make_plan(None, tmp_path, superpixels=60, analysis=60)
    cells = plan.drop_duplicates("key")["cell"]
    names = {json.dumps(cell.identity(), sort_keys=True) for cell in cells}
    assert len(names) == len(cells) < len(plan)
    assert set(plan["dataset"]) == {""}
    assert set(plan["section"]) == {"comparison", *STUDIES, "departures"}
    assert set(plan.groupby("section")["method"].nunique()) == {len(METHODS)}


def test_a_row_has_energies_on_the_way_and_small_maps(tmp_path):
    path = tmp_path / "maps" / "a.npz"
    row = measure_paper(Cell(item(), (*PAPER, *QUICK), keep=path))
    json.dumps(row["curve"], allow_nan=False)
    assert len(row["curve"]["rounds"]) == 2
    assert row["curve"]["rounds"][1] <= row["curve"]["rounds"][0]
    assert all(row["curve"]["values"])
    with np.load(path) as maps:
        assert set(maps.files) == {"image", "truth", "start", "solution"}
        assert maps["image"].shape == (64, 128, 3)
