"""Accuracy of pairs: suites, contents of rows, scores of sigma, the page, two pages compared."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers_files import sets

from benchmarks.__main__ import main
from benchmarks.accuracy import comparison, read_pages, suite_page
from benchmarks.scores import LAST, METHODS, STEPS, measure_pair, sigma_scores, sparsification
from benchmarks.suites import SUITES, Options, every_pair, list_suite, spread
from benchmarks.table import Cell, Item, frame_of
from soup_nlp.errors import ConfigError
from soup_nlp.storage.each import Row, attempt, read_rows

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("simple_starts")]


def test_suites_list_the_papers_pairs(tmp_path):
    assert set(SUITES) == {
        *("rendered", "everyday", "shared", "sintel", "kitti2012", "kitti2015", "vkitti"),
        *("kinect_paper", "kinect_tshirt"),
    }
    for name, size in (("rendered", (320, 136)), ("everyday", (200, 150))):
        items = list_suite(name, None, Options(width=320, seeds=(0, 3), flows=("dis",)))
        assert len({i.key for i in items}) == len(items) == (12 if name == "rendered" else 14)
        problem = items[0].problem(["segmentation.superpixels=60"])
        assert (problem.input.width, problem.input.height) == size
    for name, count in (("sintel", 120), ("vkitti", 120), ("kitti2012", 194), ("kitti2015", 200)):
        items = list(every_pair(name, tmp_path, Options()))
        assert len({i.key for i in items}) == count
        for i in items[:: count // 5]:
            i.problem()  # is a problem that the program accepts
    assert spread(10, 3) == [1, 5, 8]
    assert spread(4, 9) == [0, 1, 2, 3]


def test_a_suite_lists_the_pairs_whose_files_exist(tmp_path):
    base = tmp_path / "data" / "sintel" / "training" / "clean" / "alley_1"
    base.mkdir(parents=True)
    frames = [i.input["frame"] for i in every_pair("sintel", tmp_path, Options())][:2]
    for frame in frames:
        (base / f"frame_{frame:04d}.png").touch()
    (base / f"frame_{frames[0] + 1:04d}.png").touch()
    told = []
    listed = list_suite("sintel", tmp_path / "data", say=told.append)
    assert told == ["suite sintel: 1 of 120 pairs found"]
    assert [i.input["frame"] for i in listed] == frames[:1]


@pytest.mark.parametrize("name", [n for n, s in SUITES.items() if s.layout])
def test_a_missing_dataset_says_where_to_get_it(name, tmp_path, capsys):
    assert main(["accuracy", "--suite", name, "--data", str(tmp_path)]) == 2
    text = capsys.readouterr().err
    assert "get it from" in text
    assert "expected:" in text


QUICK = (
    "segmentation.superpixels=20",
    "segmentation.neighbours=4",
    "solver.presolve_iterations=0",
    "solver.max_iter=5",
    "refine.rounds=1",
    "refine.particles=6",
)
K = np.array([[100.0, 0, 32], [0, 100.0, 24], [0, 0, 1]])


def test_a_pair_that_cannot_be_measured_has_a_reason(tmp_path):
    with pytest.raises(ConfigError, match="superpixel"):
        Cell(Item("s", "p", {"kind": "motorcycle"}), ("segmentation.superpixel=3",)).identity()
    # a pair without a truth is not solved
    for k in (0, 1):
        cv2.imwrite(str(tmp_path / f"frame_{k}.png"), np.zeros((48, 64, 3), np.uint8))
    np.savetxt(tmp_path / "K.txt", K)
    raw = {"kind": "folder", "path": str(tmp_path)}
    cell = Cell(Item("s", "p", raw, suite="kinect_paper"), QUICK)
    row = {**cell.identity(), **attempt(lambda: measure_pair(cell)), "code": "c"}
    assert not row["ok"]
    suite = SUITES["kinect_paper"]
    for words in ("pair has no true depth", suite.layout, suite.source):
        assert words in row["error"]
    text = suite_page(Path("T.md"), frame_of([row]))
    assert "0 of 1 pairs measured" in text
    assert "## Failed" in text


def test_sigma_is_scored_by_what_it_says():
    # half of the pixels are exact and sure, half are off by a factor of 2
    error = np.repeat([0.0, np.log(2.0)], 50)
    honest = sigma_scores(error, np.where(error > 0, 1.0, 0.05))
    assert honest["sure_wrong"] == honest["wrong_sure"] == honest["right_unsure"] == 0.0
    assert honest["nll"] == pytest.approx(0.25 * np.log(2) ** 2 + 0.5 * np.log(0.05))
    assert honest["nll"] < honest["flat"] == pytest.approx(0.5 + 0.5 * np.log(np.log(2) ** 2 / 2))
    assert honest["ause"] == pytest.approx(0.0, abs=1e-9)
    assert [len(honest["reliability"]), honest["reliability"][-1][0]] == [10, 1.0]
    false = sigma_scores(error, np.where(error > 0, 0.05, 1.0))
    assert (false["sure_wrong"], false["wrong_sure"], false["right_unsure"]) == (1.0, 1.0, 1.0)
    assert false["nll"] > honest["flat"]
    flat = sigma_scores(error, np.full(100, np.sqrt(np.mean(error**2))))
    assert flat["nll"] == pytest.approx(flat["flat"])
    assert sigma_scores(np.zeros(20), np.ones(20))["wrong_sure"] is None
    within = sigma_scores(np.array([0.5, -1.5, 2.5, 1.0]), np.ones(4))
    assert (within["within1"], within["within2"]) == (0.5, 0.75)


ERROR = np.linspace(0.0, 1.0, 1001)


def test_the_errors_themselves_are_a_perfect_uncertainty():
    (kept, error, oracle), ause = sparsification(ERROR[::-1], 3 * ERROR[::-1])
    assert ause == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(error, oracle)
    assert (kept[0], kept[-1], len(kept)) == (1.0, LAST, STEPS)


def test_equal_uncertainties_are_chance_in_whatever_order_they_come():
    constant, chance = sparsification(ERROR, np.ones(len(ERROR)))
    np.testing.assert_allclose(constant[1], ERROR.mean())
    half = ERROR > 0.5
    forward, backward = (sparsification(ERROR[::k], half[::k]) for k in (1, -1))
    np.testing.assert_allclose(forward[0], backward[0])
    assert 0 < forward[1] < chance


def solved(suite: str, pair: str = "p", family: str = "s", mre: float = 0.03) -> Row:
    """A row without a solve."""
    metrics = {
        "solution": {"mre": mre, "skill": 0.25, "coverage": 1.0},
        "constant": {"mre": 0.04, "coverage": 1.0},
    }
    return {
        **{"key": pair, "ok": True, "good": True, "suite": suite, "pair": pair, "error": None},
        **{"family": family, "flow": "dis", "status": "x", "code": "c", "overrides": []},
        **{"metrics": metrics, "cpu_seconds": 1.0, "settings": "0"},
    }


def test_two_pages_are_compared_by_family_and_half(tmp_path):
    before = [solved("shared", p, f) for p, f in (("a", "street"), ("b", "street"), ("c", "room"))]
    before.append(solved("shared", "d", "flying3d"))
    after = [row | solved("shared", row["pair"], row["family"], 0.06) for row in before]
    after[1]["metrics"]["solution"]["mre"] = after[2]["metrics"]["solution"]["mre"] = 0.03
    after.append(solved("shared", "new", "sheet"))
    for name, rows in (("before", before), ("after", after)):
        (tmp_path / name).mkdir()
        page = tmp_path / name / "shared.md"
        page.write_text(suite_page(page, frame_of(rows)))
    text = comparison(read_pages(tmp_path / "before"), read_pages(tmp_path / "after"))
    assert "| street | dis | 2 | 0.0300 | 0.0450 | 1.4142 |" in text
    assert "half A, dis: 1.1892 over 2; worse by 10 %: 1, better: 0" in text
    assert "half B, dis: 2.0000 over 1; worse by 10 %: 1, better: 0" in text
    assert main(["compare", str(tmp_path / "before"), str(tmp_path / "before/shared.md")]) == 0
    table = (tmp_path / "before/shared.csv").read_text().splitlines()
    assert table[0] == "pair,flow,family,solution,constant,CPU s"
    assert table[1] == "a,dis,street,0.0300,0.0400,1"
    assert "[The table by pair](shared.csv)" in page.read_text()
    assert main(["compare", str(tmp_path), str(tmp_path)]) == 2


def test_a_suite_is_measured_once_with_every_number(tmp_path, capsys):
    words = ["accuracy", "--suite", "rendered", "--only", "orbit", "--flow", "truth"]
    words += ["--width", "128", "--out", str(tmp_path)]
    words += sets(" ".join(QUICK))
    assert main(words) == 0
    out = capsys.readouterr()
    listed, measured = out.err.splitlines()
    assert listed == "suite rendered: 1 of 1 pairs found"
    assert measured.startswith("1/1  rendered/orbit-s0-128x54/truth  MRE 0.")
    assert (tmp_path / "rendered.md").read_text() in out.out
    (row,) = read_rows(tmp_path / "rendered.jsonl")
    found = row["metrics"]
    assert set(found) == set(METHODS)
    assert found["constant"]["skill"] == 0.0
    # one rigid motion with the true flow is exact on a scene of one component
    assert found["rigid"]["mre"] < 1e-3
    # the true flow has confidence everywhere
    assert row["seen"] == {"share": 1.0, "mre": found["solution"]["mre"], "rest": None}
    assert 0 <= row["sigma"]["within1"] <= row["sigma"]["within2"] <= 1
    assert row["sigma"]["curve"][0][0] == 1.0
    # nothing is measured twice
    before = (tmp_path / "rendered.jsonl").read_text()
    assert main(words) == 0
    assert (tmp_path / "rendered.jsonl").read_text() == before
    assert main([*words, "--set", "segmentation.neighbours=99"]) == 1
    assert "K-NN" in capsys.readouterr().out
    assert main(["accuracy", "--suite", "imagenet"]) == 2
    assert "kinect_tshirt" in capsys.readouterr().err
