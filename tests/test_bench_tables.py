"""Tables of accuracy: the information beside every number."""

from __future__ import annotations

from soup_nlp.bench.accuracy_table import report
from soup_nlp.bench.depth_maps import BASELINES, METHODS
from soup_nlp.bench.published import COMPARISON, published


def solved(suite: str, convention: str = "paper") -> dict:
    """A row of one convention, without a solve."""
    return {
        **{"key": "k", "ok": True, "good": True, "suite": suite, "pair": "p"},
        **{"sequence": "s", "flow": "dis", "presets": [convention], "status": "x", "code": "c"},
        **{"metrics": {convention: {"solution": {"mre": 0.03}, "constant": {"mre": 0.04}}}},
        **{"flow_error": None, "scene_flow": None, "cpu_seconds": 1.0},
        "energy": {"solution": {"total": 1.0}},
    }


def test_every_pair_is_in_the_detail_of_its_own_convention():
    text = report("T", [solved("shared"), {**solved("shared", "kitti"), "pair": "q"}])
    detail = text.split("## The solution, ")[1:]
    assert [part.partition(":")[0] for part in detail] == ["paper", "kitti"]
    assert "| p | dis |" in detail[0]
    assert "| q | dis |" in detail[1]


def test_a_table_says_what_its_planes_are_fitted_to():
    for convention, said in (("paper", False), ("near20", True), ("eigen80", True)):
        row = solved("shared", convention)
        row["metrics"][convention]["plane"] = {"mre": 0.05}
        assert ("`plane`: fitted to all true pixels" in report("T", [row])) is said


def test_a_table_says_where_its_convention_is_not_the_usual_one():
    assert "the scale is the median of z_gt / z" in report("T", [solved("kitti2015", "eigen80")])


def test_published_numbers_are_marked():
    assert published("kitti2015")[0] == dict(COMPARISON["kitti"])
    assert published("rendered") == ({}, "")
    row = solved("kinect_paper")
    text = report("T", [row])
    assert "| BMM (published) | 0.0322 |" in text
    assert "(measured) | 0.0300 |" in text
    assert "beats every baseline on 1 of 1" in text
    # of the pairs that have a number, under the name of the convention, on what data
    bare = {**solved("kitti2015", "kitti"), "metrics": {}}
    failed = {**bare, "ok": False, "error": "out of luck"}
    text = report("T", [solved("kitti2015", "kitti"), bare, failed])
    assert "| this program, flow dis, kitti, 1 pair (measured) | 0.0300 |" in text
    assert "odometry set 00-09 with LiDAR truth" in text
    assert "\n\n## Failed\n" in text
    # one rigid motion is met on its own pixels
    metrics = row["metrics"]["paper"]
    metrics |= {"rigid": {"mre": 0.025, "coverage": 0.6}, "solution_rigid": {"mre": 0.02}}
    assert "beats every baseline on 1 of 1" in report("T", [row])
    metrics["solution_rigid"]["mre"] = 0.026
    text = report("T", [row])
    assert "beats every baseline on 0 of 1" in text
    assert "| p | dis | paper | rigid | 0.0250 | 0.0260 | 60.0% | -0.0010 |" in text
    assert set(BASELINES) <= set(METHODS)
