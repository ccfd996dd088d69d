"""Suites: lists of pairs, available pairs, and messages on the source of missing ones."""

import pytest

from benchmarks.__main__ import main
from benchmarks.suites import SUITES, Options, every_pair, list_suite, spread

pytestmark = pytest.mark.slow


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
