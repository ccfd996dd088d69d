"""Accuracy of pairs: contents of rows, the page."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest

from soup_nlp.bench.accuracy import BASELINES, METHODS, measure_pair, moving
from soup_nlp.bench.accuracy_page import suite_page, write_suite
from soup_nlp.bench.study import Cell, Item, frame_of
from soup_nlp.bench.suites import SUITES
from soup_nlp.cli import bench
from soup_nlp.cli.main import main
from soup_nlp.data.pair import Pair, Truth
from soup_nlp.errors import ConfigError, DataError
from soup_nlp.storage.rows import Row

pytestmark = pytest.mark.slow

QUICK = (
    "segmentation.superpixels=20",
    "segmentation.neighbours=4",
    "solver.presolve=false",
    "solver.max_iter=5",
    "refine.rounds=1",
    "refine.particles=6",
)
K = np.array([[100.0, 0, 32], [0, 100.0, 24], [0, 0, 1]])


def item(scene: str = "orbit", flow: str = "truth", seed: int = 0) -> Item:
    raw = {"kind": "scene", "scene": scene, "seed": seed, "width": 128, "height": 64}
    return Item("rendered", scene, f"{scene}-{seed}", flow, raw)


def row_of(item: Item, overrides: tuple[str, ...] = QUICK) -> Row:
    job = Cell(item, overrides).job(measure_pair)
    return {**job.name, **job.work(), "code": "c"}


def text_of(*rows: Row) -> str:
    return suite_page("T", frame_of(rows))


@pytest.fixture(scope="module")
def orbit_row():
    return row_of(item())


def test_a_row_has_every_number(orbit_row):
    row = orbit_row
    assert row["ok"], row["error"]
    json.dumps(row, allow_nan=False)
    table = row["metrics"]
    assert set(table) == set(METHODS)
    assert table["constant"]["skill"] == 0.0
    # one rigid motion with the true flow is exact on a scene of one component
    assert table["rigid"]["mre"] < 1e-3
    assert row["flow_error"]["mean"] < 1e-5
    assert row["scene_flow"]["coverage"] == 1.0
    assert 0 <= row["guess"] <= 1
    assert 0 <= row["within"][0] <= row["within"][1] <= 1
    assert row["sparsification"]["curve"][0][0] == 1.0


def test_a_pair_that_cannot_be_measured_has_a_reason(tmp_path):
    row = row_of(item(), (*QUICK, "segmentation.neighbours=99"))
    assert not row["ok"]
    assert "K-NN" in row["error"]
    text = text_of(row)
    assert "0 of 1 pairs measured" in text
    assert "K-NN" in text
    with pytest.raises(ConfigError, match="superpixel"):
        Cell(item(), ("segmentation.superpixel=3",)).identity()
    # a pair without a truth is not solved
    for k in (0, 1):
        cv2.imwrite(str(tmp_path / f"frame_{k}.png"), np.zeros((48, 64, 3), np.uint8))
    np.savetxt(tmp_path / "K.txt", K)
    raw = {"kind": "folder", "path": str(tmp_path)}
    row = row_of(Item("kinect_paper", "s", "p", "dis", raw))
    assert not row["ok"]
    suite = SUITES["kinect_paper"]
    for words in ("pair has no true depth", suite.layout, suite.source):
        assert words in row["error"]


def test_a_row_is_identified_by_settings_and_input(tmp_path):
    def identity(root: str, *overrides: str) -> Row:
        raw = {"kind": "sintel", "root": root, "scene": "alley_1", "frame": 2}
        return Cell(Item("sintel", "alley_1", "alley_1-0002", "dis", raw), overrides).identity()

    here, final = identity("/a"), identity("/a", "input.render=final")
    assert here == identity("/b")
    assert here["settings"] == final["settings"]
    assert here["input"] != final["input"]
    assert here["settings"] == Cell(item(), ("flow.source=dis",)).identity()["settings"]
    assert here["settings"] != Cell(item()).identity()["settings"]
    assert here["settings"] != identity("/a", "energy.weights.cont=9.0")["settings"]
    first, second = (
        Cell(Item("vkitti", "w", "w", "dis", {"kind": k, "root": "r", "scene": s, "frame": 1}))
        for k, s in (("vkitti1", "0001"), ("vkitti2", "Scene01"))
    )
    assert first.identity()["input"] != second.identity()["input"]
    # a row whose folder is gone is measured again
    stale = [Cell(item(), keep=p).job(measure_pair).stale for p in (None, tmp_path, tmp_path / "x")]
    assert stale == [False, False, True]


def test_moving_pixels_are_told_apart_under_one_scale():
    label = np.zeros((40, 60), np.int32)
    label[5:15, 5:25], label[30:, 50:] = 1, 2
    label[:, 0] = -1
    depth = np.full((40, 60), 4.0)
    # the first component comes out at half of its depth, the second is exact
    estimate = np.where(label == 1, 2.0, 4.0) / 7
    pair = Pair(
        *(np.zeros((40, 60, 3), np.uint8) for _ in range(2)),
        *(np.array([[50.0, 0, 30], [0, 50.0, 20], [0, 0, 1]]) for _ in range(2)),
        truth=Truth(depth_ref=depth, components=label),
    )
    errors = moving(pair, estimate)
    assert errors == pytest.approx({"mre": 0.5 * 200 / 300, "rest": 0.0}, abs=1e-12)
    still = replace(pair, truth=Truth(depth_ref=depth, components=0 * label))
    assert moving(still, estimate) is None


def broken(cell: Cell) -> Row:
    raise DataError("image is missing", where="a/0.png", found="nothing", expected="a file")


def interrupted(cell: Cell) -> Row:
    raise KeyboardInterrupt


def test_command_line(tmp_path, capsys, monkeypatch):
    words = ["bench", "accuracy", "--suite", "rendered", "--only", "orbit", "--flow", "truth"]
    words += ["--width", "128", "--out", str(tmp_path)]
    words += [w for o in QUICK for w in ("--set", o)]
    assert main(words) == 0
    out = capsys.readouterr()
    listed, measured = out.err.splitlines()
    assert listed == "suite rendered: 1 of 1 pairs found"
    assert measured.startswith("1/1  rendered/orbit-s0-128x54/truth  MRE 0.")
    assert f"{tmp_path}/: rendered.md, rendered.png\n" in out.out
    assert "one median scale per image, no cap" in out.out
    assert (tmp_path / "rendered.md").read_text() in out.out
    # nothing is measured twice
    before = (tmp_path / "rendered.jsonl").read_text()
    assert main([*words, "-q"]) == 0
    assert capsys.readouterr().err == ""
    assert (tmp_path / "rendered.jsonl").read_text() == before
    assert main(["bench", "accuracy"]) == 2
    assert main(["bench", "accuracy", "--suite", "imagenet"]) == 2
    assert main([*words, "--suite", "everyday", "--name", "both"]) == 2
    assert main(["bench", "accuracy", "--suite", "rendered", "--seeds", "a"]) == 2
    # Ctrl-C keeps the rows
    monkeypatch.setattr(bench, "measure_pair", interrupted)
    assert main([*words, "--width", "96", "-q"]) == 130
    assert "the rows that were measured are kept" in capsys.readouterr().err
    assert (tmp_path / "rendered.jsonl").read_text() == before
    monkeypatch.setattr(bench, "measure_pair", broken)
    assert main([*words, "--width", "64", "-q"]) == 1
    assert "image is missing, where: a/0.png, found: nothing" in capsys.readouterr().out


def solved(suite: str, pair: str = "p") -> Row:
    """A row without a solve."""
    metrics = {
        "solution": {"mre": 0.03, "skill": 0.25, "coverage": 1.0},
        "constant": {"mre": 0.04, "coverage": 1.0},
    }
    return {
        **{"key": pair, "ok": True, "good": True, "suite": suite, "pair": pair, "error": None},
        **{"sequence": "s", "flow": "dis", "status": "x", "code": "c"},
        **{"metrics": metrics, "cpu_seconds": 1.0, "settings": "0"},
    }


def test_pairs_of_one_name_are_told_apart_by_their_suite():
    text = text_of(solved("kitti2012"), solved("kitti2015"))
    assert all(f"| kitti{year} p, dis |" in text for year in (2012, 2015))


def test_one_rigid_motion_is_compared_on_its_own_pixels():
    row = solved("shared")
    metrics = row["metrics"]
    metrics |= {"rigid": {"mre": 0.025, "coverage": 0.6}, "solution_rigid": {"mre": 0.02}}
    assert "beats every baseline on 1 of 1" in text_of(row)
    metrics["solution_rigid"]["mre"] = 0.026
    text = text_of(row)
    assert "beats every baseline on 0 of 1" in text
    assert "| p, dis | rigid | 0.0250 | 0.0260 | 60.0% | -0.0010 |" in text
    assert set(BASELINES) <= set(METHODS)


def test_sigma_has_columns_and_a_picture_of_its_curves(tmp_path):
    rows = [solved("shared", p) | {"sequence": p, "guess": 0.1} for p in ("a", "b")]
    write_suite(tmp_path / "without.md", frame_of(rows))
    assert not (tmp_path / "without.png").exists()
    for row in rows:
        curve = [[1.0, 0.5], [0.05, 0.02], [0.05, 0.01]]
        row |= {"within": [0.7, 0.9], "sparsification": {"ause": 0.2, "curve": curve}}
    write_suite(tmp_path / "shared.md", frame_of(rows))
    text = (tmp_path / "shared.md").read_text()
    assert "| AUSE | guess | within 1 | within 2 | worst pair |" in text
    assert "| 0.2000 | 0.1000 | 0.7000 | 0.9000 | a, dis |" in text
    assert "](shared.png)" in text
    assert (tmp_path / "shared.png").stat().st_size > 5000
