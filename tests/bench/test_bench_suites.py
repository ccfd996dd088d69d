"""Suites: lists of pairs, available pairs, and messages on the source of missing ones."""

from __future__ import annotations

import pytest

from soup_nlp.bench.suites import SUITES, Options, list_suite, spread
from soup_nlp.cli.main import main


def test_suites_list_the_papers_pairs(tmp_path):
    assert set(SUITES) == {
        *("rendered", "everyday", "shared", "sintel", "kitti2012", "kitti2015", "vkitti"),
        *("kinect_paper", "kinect_tshirt"),
    }
    rendered = list_suite("rendered", None, Options(width=320, seeds=(0, 3), flows=("dis",)))
    assert len(rendered.items) == 12
    assert len({i.key for i in rendered.items}) == 12
    problem = rendered.items[0].problem(["segmentation.superpixels=60"])
    assert (problem.input.width, problem.input.height) == (320, 136)
    everyday = list_suite("everyday", None, Options(width=320, seeds=(0, 3)))
    assert len({i.key for i in everyday.items}) == 14
    problem = everyday.items[0].problem()
    assert (problem.input.width, problem.input.height) == (200, 150)
    for name, count in (("sintel", 120), ("vkitti", 120), ("kitti2012", 194), ("kitti2015", 200)):
        suite = SUITES[name]
        items = list(suite.items(tmp_path, Options()))
        assert len({i.key for i in items}) == count
        for i in items[:: count // 5]:
            i.problem()  # is a problem that the program accepts
    assert spread(10, 3) == [1, 5, 8]
    assert spread(4, 9) == [0, 1, 2, 3]


def test_a_suite_lists_the_pairs_whose_files_exist(tmp_path):
    base = tmp_path / "data" / "sintel" / "training" / "clean" / "alley_1"
    base.mkdir(parents=True)
    suite = SUITES["sintel"]
    frames = [i.input["frame"] for i in suite.items(tmp_path, Options())][:2]
    for frame in frames:
        (base / f"frame_{frame:04d}.png").touch()
    (base / f"frame_{frames[0] + 1:04d}.png").touch()
    listing = list_suite("sintel", tmp_path / "data")
    assert [i.input["frame"] for i in listing.items] == frames[:1]
    assert "119 of the list are not in the folder" in str(listing)


def test_a_limit_counts_pairs_and_keeps_every_flow(tmp_path):
    listing = list_suite("rendered", None, Options(limit=2))
    assert len({i.name for i in listing.items}) == 2
    assert len(listing.items) == 4
    assert str(listing) == "suite rendered: 2 pairs (4 rows), 4 left out by the limit"
    base = tmp_path / "image_0"
    base.mkdir()
    for index in range(4):
        for frame in (10, 11):
            (base / f"{index:06d}_{frame}.png").touch()
    listing = list_suite("kitti2012", tmp_path, Options(limit=3, flows=("truth", "dis")))
    text = "3 pairs (6 rows), 1 left out by the limit, 190 of the list are not in the folder"
    assert str(listing) == f"suite kitti2012: {text}"


def test_sintel_needs_cameras_except_for_the_known_scene(tmp_path):
    suite = SUITES["sintel"]
    for i in suite.items(tmp_path, Options()):
        if i.sequence in ("alley_1", "temple_2"):
            for path in i.needs:
                if path.suffix == ".png":
                    path.parent.mkdir(parents=True, exist_ok=True)
                    path.touch()
    assert {i.sequence for i in list_suite("sintel", tmp_path).items} == {"alley_1"}
    camera = tmp_path / "camdata_left" / "temple_2"
    camera.mkdir(parents=True)
    for frame in range(1, 51):
        (camera / f"frame_{frame:04d}.cam").touch()
    assert len(list_suite("sintel", tmp_path).items) == 48


@pytest.mark.parametrize("name", [n for n, s in SUITES.items() if s.layout])
def test_a_missing_dataset_says_where_to_get_it(name, tmp_path, capsys):
    assert main(["bench", "accuracy", "--suite", name, "--data", str(tmp_path)]) == 2
    text = capsys.readouterr().err
    assert "get it from" in text
    assert "expected:" in text
