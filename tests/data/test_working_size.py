"""Large images: a resized pair shows the same scene; depth comes back at full size."""

import numpy as np
import pytest

from soup_nlp.config.problem import make_problem
from soup_nlp.data.pair import Flow, Pair, Truth
from soup_nlp.data.scenes.catalogue import render_scene
from soup_nlp.data.working_size import full_depth, working_size
from soup_nlp.geometry.camera import intrinsics, pixel_grid, project, rays
from soup_nlp.pipeline.case import prepare
from soup_nlp.pipeline.run import make_run, skipped
from soup_nlp.report.verdict import facts

K = intrinsics(90.0, 80.0, 47.3, 30.1)


N, T = np.array([0.1, 0.2, -1.0]), np.array([0.3, -0.1, 0.2])
"""Normal of a plane, translation of the camera."""


def plane(camera: np.ndarray, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Depth and flow of the plane in an image."""
    ray = rays(camera, pixel_grid(height, width))
    depth = 5.0 / -(ray @ N)
    return depth, project(camera, depth[..., None] * ray + T) - pixel_grid(height, width)


def plane_pair(height=60, width=96) -> Pair:
    """The plane seen by two cameras: flow and depth follow from it exactly."""
    depth, flow = plane(K, height, width)
    confidence = np.ones((height, width), np.float32)
    # unusable displacements must not be averaged into usable ones
    flow[20:23, 20:23], confidence[20:23, 20:23] = 1e4, 0.0
    image = np.full((height, width, 3), 128, np.uint8)
    points = np.array([[10.0, 20.0, depth[20, 10]]])
    truth = Truth(depth_ref=depth, flow=flow, points=points)
    return Pair(image, image, K, K, Flow(flow.astype(np.float32), confidence), truth)


def test_a_smaller_pair_sees_the_same_plane():
    pair = plane_pair()
    small = working_size(pair, 0.0026)
    height, width = small.size
    assert height * width <= 2600 * 1.02
    depth, flow = plane(small.K_ref, height, width)
    np.testing.assert_array_equal(small.K_next, small.K_ref)
    # the average over a pixel differs from its centre by the second order of the flow
    good = small.flow.confidence == 1
    assert good.mean() > 0.95
    np.testing.assert_allclose(small.flow.uv[good], flow[good], atol=0.02)
    # the truth is that of the nearest pixel, half a pixel away at most
    np.testing.assert_allclose(small.truth.depth_ref, depth, rtol=0.02)
    at = small.truth.points[0]
    assert 5.0 / -(rays(small.K_ref, at[:2]) @ N) == pytest.approx(at[2], rel=1e-12)


def test_what_is_small_enough_is_not_touched():
    pair = plane_pair()
    assert working_size(pair, None) is pair
    assert working_size(pair, 60 * 96 / 1e6) is pair


def test_planes_are_exact_at_every_pixel():
    pair = plane_pair()
    labels = np.zeros(pair.size, np.int32)
    labels[:5] = -1
    z = full_depth(labels, pair.size, N[None], np.array([5.0]), K)
    assert np.isnan(z[:5]).all()
    np.testing.assert_allclose(z[5:], pair.truth.depth_ref[5:], rtol=1e-6)


@pytest.mark.slow
def test_a_large_pair_comes_back_at_its_size():
    pair = render_scene("orbit", 0, 256, 128)
    settings = {
        "input": {"kind": "scene", "scene": "orbit", "width": 256, "height": 128},
        "max_size": 0.012,
        "flow": {"source": "truth"},
        "segmentation": {"superpixels": 60, "neighbours": 6},
    }
    case = prepare(make_problem(settings), pair=pair)
    done = make_run(case, skipped(case))
    assert done.pair.size[0] * done.pair.size[1] <= 12_500
    assert done.full.depth_ref.shape == (128, 256)
    covered = np.isfinite(done.full.depth_next)
    assert covered.mean() > 0.9
    # the error does not grow at full size
    assert done.full.metrics.mre < 1.1 * done.metrics["solution"].mre
    assert "brought to 256x128" in facts(done)
    assert prepare(make_problem({**settings, "max_size": None})).original is None
