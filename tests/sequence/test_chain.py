"""Common scale, poses and tracks of the pairs of a sequence, of which few are in memory."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers_result import CAMERA, K, small_result, toy_pairs

from soup_nlp.config.problem import make_problem
from soup_nlp.errors import DataError
from soup_nlp.geometry.rotation import exp
from soup_nlp.report import folder as stored
from soup_nlp.report import page as report_page
from soup_nlp.report.chain import NEAR, Lazy, Link
from soup_nlp.report.formats import write_formats
from soup_nlp.report.result import Result
from soup_nlp.sequence.folder import write_chain
from soup_nlp.sequence.links import chained_scales, follow, link, make_chain, number
from soup_nlp.sequence.score import path_errors, read_path, similarity
from soup_nlp.storage.each import append_row
from soup_nlp.storage.files import write_text
from soup_nlp.storage.folders import staged


def test_the_link_of_two_maps_is_their_median_ratio():
    rng = np.random.default_rng(0)
    one = rng.uniform(1, 5, (30, 40))
    other = one / 1.3 * np.exp(rng.normal(0, 0.02, one.shape))
    # a fifth is far off, some is unknown
    other[:6] *= 3
    other[6:8] = np.nan
    found = link((2, 3), one, other, np.ones(one.shape, bool))
    assert (found.first, found.second, found.pixels) == (2, 3, 28 * 40)
    # the median of noise of 0.02, moved by the fifth on one side: less than one of its deviations
    assert found.log_ratio == pytest.approx(np.log(1.3), abs=0.02)
    assert 0.02 < found.spread < 0.04
    assert not found.flagged
    assert link((0, 1), one, other, np.zeros(one.shape, bool)) is None
    few = np.zeros(one.shape, bool)
    few[10, :20] = True
    assert link((0, 1), one, other, few).flagged


def test_scales_follow_their_links():
    true = np.array([1.0, 1.2, 0.7, 0.9])

    def between(a, b, error=0.0, **marks):
        return Link(a, b, float(np.log(true[b] / true[a]) + error), 0.02, 5000, **marks)

    chain = [between(0, 1), between(1, 2), between(2, 3)]
    np.testing.assert_allclose(chained_scales(4, chain), true, rtol=1e-9)
    assert chained_scales(1, []) == [1.0]
    # a guess gives way to a bridge
    guess = [*chain[:2], between(2, 3, error=0.5, flagged=True), between(1, 3, bridge=True)]
    np.testing.assert_allclose(chained_scales(4, guess), true, rtol=1e-9)
    with pytest.raises(DataError, match="pair 3"):
        chained_scales(4, chain[:2])


def test_components_are_followed_by_overlap():
    before = np.zeros((10, 20), int)
    before[2:6, 2:8], before[2:6, 12:16] = 1, 2
    before[0] = -1
    after = np.zeros((10, 20), int)
    after[3:7, 2:8], after[7:9, 10:19] = 2, 1
    assert follow(before, after) == {1: 2}
    assert follow(before, np.zeros((10, 20), int)) == {}
    tracks = number([{1: 2}, {2: 1}], [3, 3, 2])
    assert [own.tolist() for own in tracks] == [[0, 1, 2], [0, 3, 1], [0, 1]]


def test_a_chain_has_one_scale_and_one_frame_of_reference():
    chain = make_chain(toy_pairs())
    np.testing.assert_allclose(chain.scales, [1, 2], rtol=1e-9)
    np.testing.assert_allclose(chain.depth(1), 2 * toy_pairs()[1].depths[0])
    for k in (1, 2):
        pose = np.linalg.inv(np.linalg.matrix_power(CAMERA.matrix, k))
        np.testing.assert_allclose(chain.world_from_camera[k].matrix, pose, atol=1e-9)
    # the static scene stands still in the world
    np.testing.assert_allclose(chain.motion(1, 0).matrix, np.eye(4), atol=1e-9)


def test_a_pair_without_parallax_is_bridged():
    first, second = toy_pairs()
    # in between nothing moves, and its depth is nonsense
    still = small_result()
    rest = tuple(replace(c, interpolated=1.0) for c in still.components)
    identity = np.arange(60 * 80).reshape(60, 80)
    rec = replace(
        still.reconstruction,
        depth_ref=np.full((60, 80), 7.0),
        depth_next=np.full((60, 80), 7.0),
        source_next=identity,
    )
    middle = replace(still, reconstruction=rec, components=replace(still.components, members=rest))
    # also before the first and after the last motion
    chain = make_chain([middle, first, middle, second, middle])
    ends = [(k.first, k.second) for k in chain.links]
    assert ends == [(0, 1), (1, 2), (2, 3), (3, 4), (1, 3)]
    assert [k.flagged for k in chain.links] == [True] * 4 + [False]
    assert [k.bridge for k in chain.links] == [False] * 4 + [True]
    assert chain.scales[3] / chain.scales[1] == pytest.approx(2, rel=0.01)


def test_frames_of_a_chain_have_all_that_is_known_of_them():
    chain = make_chain(toy_pairs())
    for k, frame in enumerate(chain):
        seen = np.isfinite(frame.depth)
        assert seen.mean() > 0.9
        assert set(np.unique(frame.components[seen])) == {0, 1}
        # of what only the last frame shows, nothing is known
        assert k < 2 or (frame.components[~seen] == -1).all()
        assert np.isfinite(frame.sigma[seen]).all()
        np.testing.assert_allclose(frame.points, chain.points(k), equal_nan=True)
        np.testing.assert_array_equal(frame.K, K)
    np.testing.assert_allclose(chain.points(0), chain.pairs[0].reconstruction.points_ref)
    for wrong in (3, -1, None):
        with pytest.raises(IndexError, match="0 to 2"):
            chain[wrong]
        with pytest.raises(DataError):
            chain.depth(wrong)


def test_errors_of_a_path_are_those_of_evo(tmp_path):
    """ATE and RPE of a path that differs by a similarity and by one turn of known size."""
    chain = make_chain(toy_pairs())
    found = np.array([m.matrix for m in chain.world_from_camera])
    world = np.eye(4)
    world[:3, :3], world[:3, 3] = exp([0.1, 0.2, -0.3]), (1, 2, 3)
    true = world @ (found * np.array([[1, 1, 1, 5.0]] * 3 + [[1, 1, 1, 1]]))
    errors = path_errors(chain, true)
    assert max(errors[k] for k in ("ate", "rpe", "rpe_degrees", "share")) < 1e-6
    # the last camera turns by one degree in place: one of two steps differs by it
    true[2, :3, :3] = true[2, :3, :3] @ exp([0, 0, np.radians(1)])
    errors = path_errors(chain, true)
    assert errors["ate"] < 1e-6
    assert errors["rpe_degrees"] == pytest.approx(np.sqrt(0.5), rel=1e-6)
    np.savetxt(tmp_path / "kitti.txt", true[:, :3].reshape(3, 12))
    np.testing.assert_allclose(read_path(tmp_path / "kitti.txt"), true)
    rows = write_formats(tmp_path, chain, ["tum"])
    np.testing.assert_allclose(read_path(tmp_path / rows[-1]), found, atol=1e-8)
    with pytest.raises(DataError, match="length"):
        path_errors(chain, true[:2])
    (tmp_path / "bad.txt").write_text("1 2 3")
    with pytest.raises(DataError, match="TUM"):
        read_path(tmp_path / "bad.txt")


def test_a_mirror_image_is_no_rotation():
    points = np.random.default_rng(3).normal(size=(6, 3))
    assert np.linalg.det(similarity(points * [1, 1, -1], points)[1]) == pytest.approx(1)


def test_items_are_made_when_they_are_needed_and_few_stay():
    made = []
    items = Lazy(lambda k: made.append(k) or k, 100)
    assert (len(items), list(items), made) == (100, list(range(100)), list(range(100)))
    assert items[-1] == 99
    assert items[97:] == [97, 98, 99]
    assert made == list(range(100))
    # the last few stay
    assert items[-NEAR:] == [*range(100)][-NEAR:]
    assert items[-NEAR - 1] == 100 - NEAR - 1
    assert made[100:] == [100 - NEAR - 1]
    with pytest.raises(IndexError):
        items[100]


def test_a_long_chain_reads_few_pairs_at_once(tmp_path, monkeypatch):
    first, count, alive, most = toy_pairs()[0], 8, 0, 0

    class Counted(Result):
        def __del__(self) -> None:
            nonlocal alive
            alive -= 1

    def read(k: int) -> Result:
        nonlocal alive, most
        alive += 1
        most = max(most, alive)
        return Counted(**vars(first))

    lazy = make_chain(Lazy(read, count))
    assert most <= NEAR + 2
    sources = [f"{k}.png" for k in range(count + 1)]
    many = write_chain(tmp_path, make_chain([first] * count), "toy", sources)
    np.testing.assert_allclose(lazy.scales, many.scales)
    assert '["6.png", "7.png"], ["7.png", "8.png"]]' in (tmp_path / "report.html").read_text()
    # a page does not grow with the number of pairs
    monkeypatch.setattr(report_page, "MOST_PAIRS", 3)
    scene = report_page.make_scene(many)
    assert scene["names"] == [["0.png", "1.png"], ["3.png", "4.png"], ["7.png", "8.png"]]
    ends = [many.world_from_camera[k].matrix for k in (3, 4)]
    np.testing.assert_allclose(scene["cameras"][1], ends)


def test_a_result_that_another_run_left_is_not_that_of_a_row(tmp_path: Path):
    def solved(name: str, seed: int, told: bool) -> dict:
        problem = make_problem({"input": {"kind": "scene", "scene": "orbit"}, "seed": seed})
        head = stored.head(problem.replace(name=name))
        place = tmp_path / "pairs" / name
        with staged(place, whole=True) as new:
            write_text(new / "result.h5", f"{seed}")
        if told:
            append_row(tmp_path / "pairs.jsonl", {**head, "result": stored._result(place)})
        return head

    one = solved("a", 1, told=True)
    assert stored.kept_rows(tmp_path, {"a": one})
    # killed between the result and its row
    solved("a", 2, told=False)
    assert not stored.kept_rows(tmp_path, {"a": one})
    # and what an earlier row says does not count
    two = solved("a", 2, told=True)
    assert stored.kept_rows(tmp_path, {"a": two})
    assert not stored.kept_rows(tmp_path, {"a": one})


@pytest.mark.parametrize("wrong", [[], {}, True, "text", 5, [1], {"a": 1}])
def test_a_row_with_an_entry_of_another_type_is_none(wrong, tmp_path):
    own = stored.head(make_problem({"input": {"kind": "scene", "scene": "orbit"}, "name": "a"}))
    good = {**own, "error": "no flow", "mre": 0.5, "exit_code": 1}
    for key, value in good.items():
        fits = isinstance(wrong, type(value)) and key not in own
        (tmp_path / "pairs.jsonl").unlink(missing_ok=True)
        append_row(tmp_path / "pairs.jsonl", good | {key: wrong})
        if not (fits or (key == "mre" and wrong == 5)):
            assert not stored.kept_rows(tmp_path, {"a": own}), key
