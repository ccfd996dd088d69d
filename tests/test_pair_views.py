"""Mirrored and cropped pairs: their truth is consistent with their pixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers_files import write_flo

from soup_nlp.bench.analyses_measures import VIEWS, measure_view
from soup_nlp.bench.pair_views import backwards, cropped, mirrored
from soup_nlp.bench.suite_pairs import Options
from soup_nlp.bench.suites import list_suite
from soup_nlp.data.flow.consistency import leaves
from soup_nlp.data.pair import Flow, Pair, Truth
from soup_nlp.data.scenes.catalogue import render_scene
from soup_nlp.errors import DataError
from soup_nlp.geometry.camera import pixel_grid, project, rays

pytestmark = pytest.mark.slow

CHANGED = [v for v in VIEWS.values() if v not in (None, backwards)]


@pytest.fixture(scope="module")
def pair() -> Pair:
    found = render_scene("street", 1, 128, 96)
    v, u = np.nonzero(np.isfinite(found.truth.depth_ref))
    some = slice(None, None, 97)
    points = np.column_stack([u, v, found.truth.depth_ref[v, u]])[some]
    # anywhere in their pixels
    points[:, :2] += np.random.default_rng(0).uniform(-0.49, 0.49, (len(points), 2))
    uv = np.nan_to_num(found.truth.flow).astype(np.float32)
    known = np.isfinite(found.truth.flow).all(-1).astype(np.float32)
    return replace(found, truth=replace(found.truth, points=points), flow=Flow(uv, known, "truth"))


@pytest.mark.parametrize("view", CHANGED)
def test_the_truth_explains_the_flow(view, pair):
    """Depth, motions and intrinsics give the flow and the scene flow, as in the pair itself."""
    seen = view(pair)
    t = seen.truth
    uv = pixel_grid(*seen.size)
    X = t.depth_ref[..., None] * rays(seen.K_ref, uv)
    M = t.motions[t.components]
    moved = np.einsum("hwij,hwj->hwi", M[..., :3, :3], X) + M[..., :3, 3]
    known = (t.components >= 0) & np.isfinite(t.depth_ref)
    assert known.mean() > 0.5
    np.testing.assert_allclose((moved - X)[known], t.scene_flow[known], atol=1e-9)
    np.testing.assert_allclose((project(seen.K_next, moved) - uv)[known], t.flow[known], atol=1e-6)
    np.testing.assert_allclose(seen.flow.uv[known], t.flow[known], atol=1e-4)


def test_backwards_the_truth_explains_the_true_points(pair):
    """The motions map points of the next frame to their pixels in the reference frame."""
    seen = backwards(pair)
    t = seen.truth
    np.testing.assert_array_equal(seen.image_ref, pair.image_next)
    np.testing.assert_array_equal(t.depth_ref, pair.truth.depth_next)
    assert seen.flow is None
    assert t.known() == ["depth_ref", "depth_next", "motions"]
    np.testing.assert_allclose(
        t.motions @ pair.truth.motions, np.tile(np.eye(4), (3, 1, 1)), atol=1e-12
    )
    with pytest.raises(DataError, match="next"):
        backwards(replace(pair, truth=Truth(depth_ref=pair.truth.depth_ref)))


@pytest.mark.parametrize("view", CHANGED)
def test_points_stay_with_their_pixels(view, pair):
    """A crop removes exactly the points of the removed pixels."""
    number = np.arange(96 * 128, dtype=np.int32).reshape(96, 128)
    points = pair.truth.points
    seen = view(replace(pair, truth=Truth(components=number, points=points))).truth

    def pixels(of: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        u, v = np.floor(of[:, :2].T + 0.5).astype(int)
        assert min(u.min(), v.min()) >= 0
        return v, u

    before = number[pixels(points)]
    left = np.isin(before, seen.components)
    assert left.sum() > 10
    np.testing.assert_array_equal(seen.components[pixels(seen.points)], before[left])
    np.testing.assert_array_equal(seen.points[:, 2], points[left, 2])


def test_a_crop_is_a_part_of_every_image(pair):
    seen, part = cropped(pair, 16, 11, 9, 6), np.s_[11:90, 16:119]
    for name in ("image_ref", "image_next"):
        np.testing.assert_array_equal(getattr(seen, name), getattr(pair, name)[part])
    for name in ("depth_ref", "depth_next", "components"):
        np.testing.assert_array_equal(getattr(seen.truth, name), getattr(pair.truth, name)[part])
    np.testing.assert_array_equal(seen.flow.confidence, pair.flow.confidence[part])
    # what the crop hides is hidden: where the flow leads out of what is left
    gone = leaves(seen.truth.flow, seen.size)
    hidden = pair.truth.occluded[part] | gone
    np.testing.assert_array_equal(seen.truth.occluded, hidden)
    assert (gone & ~pair.truth.occluded[part]).any()


def test_unknown_truth_stays_unknown(pair):
    depth = Truth(depth_ref=pair.truth.depth_ref)
    for view in CHANGED:
        seen = view(replace(pair, flow=None, truth=depth))
        known = [k for k, v in vars(seen.truth).items() if v is not None]
        assert known == ["depth_ref", "unit"]
        assert seen.flow is None
        assert view(replace(pair, truth=None)).truth is None


def test_mirroring_twice_gives_the_pair_back(pair):
    K = pair.K_ref.copy()
    K[0, 1] = 0.3
    skewed = replace(pair, K_ref=K)
    once = mirrored(skewed)
    assert once.K_ref[0, 1] == -0.3
    assert not np.array_equal(once.image_ref, skewed.image_ref)
    twice = mirrored(once)
    for name in ("image_ref", "image_next", "K_ref", "K_next"):
        np.testing.assert_allclose(getattr(twice, name), getattr(skewed, name), err_msg=name)
    np.testing.assert_array_equal(twice.flow.confidence, skewed.flow.confidence)
    # what is not known is 0 in a flow
    known = skewed.flow.confidence > 0
    np.testing.assert_allclose(twice.flow.uv[known], skewed.flow.uv[known], atol=1e-4)
    names = ("depth_ref", "depth_next", "flow", "occluded", "components", "motions", "points")
    for name in (*names, "scene_flow"):
        np.testing.assert_allclose(
            getattr(twice.truth, name), getattr(skewed.truth, name), atol=1e-12, err_msg=name
        )


def test_frames_of_two_widths_have_two_mirrors():
    """Column 0 goes to column 3 of the wider image: its mirror image 39 goes to 46."""
    K = np.array([[50.0, 0, 20], [0, 50, 10], [0, 0, 1]])
    uv = np.full((20, 40, 2), [3.0, 1.0], np.float32)
    confidence = np.ones((20, 40), np.float32)
    confidence[0, 1] = 0
    pair = Pair(
        image_ref=np.zeros((20, 40, 3), np.uint8),
        image_next=np.zeros((20, 50, 3), np.uint8),
        K_ref=K,
        K_next=K,
        flow=Flow(uv, confidence),
    )
    seen = mirrored(pair)
    np.testing.assert_array_equal(seen.flow.uv[0, 39], [7.0, 1.0])
    # what is not known is 0 in a flow
    np.testing.assert_array_equal(seen.flow.uv[0, 38], [0.0, 0.0])
    assert seen.flow.confidence[0, 38] == 0
    assert (seen.K_ref[0, 2], seen.K_next[0, 2]) == (19.0, 29.0)


def test_margins_that_leave_nothing_are_rejected(pair):
    with pytest.raises(DataError, match="margins do not fit"):
        cropped(pair, 100, 0, 28)
    assert cropped(pair, 100, 0, 18).size == (96, 10)
    with pytest.raises(DataError, match=r"margins do not fit(.|\n)*\(0, 0, -3, 0\)"):
        cropped(pair, 0, 0, -3)


def test_views_are_measured_with_their_own_flow(tmp_path):
    """A view of a pair has the same score as the pair, with true flow and with a flow file."""
    listed = list_suite("rendered", options=Options(("truth",), width=160, only=("orbit",)))
    over = ("segmentation.superpixels=24", "segmentation.neighbours=6", "refine.enabled=false")
    path = tmp_path / "flow.flo"
    write_flo(path, render_scene("orbit", 0, 160, 68).truth.flow)
    for view, more in (
        ("mirrored and cropped 7x5", ()),
        ("mirrored", (f"flow.source={path}",)),
        ("cropped 7x5", (f"flow.source={path}",)),
    ):
        row = measure_view(listed.items[0], (*over, *more), view)
        assert row["size"] == ([63, 153] if "cropped" in view else [68, 160])
        assert row["flow_error"]["mean"] < 1e-3
        assert row["metrics"]["paper"]["solution"]["mre"] < 0.02
