"""Input checks of a pair and its flow; a resized pair shows the same scene."""

from contextlib import nullcontext

import numpy as np
import pytest
from PIL import Image

from soup_nlp.config.problem import make_problem
from soup_nlp.data.pair import Flow, Pair, Truth
from soup_nlp.data.scenes.catalogue import render_scene
from soup_nlp.data.working_size import full_depth, working_size
from soup_nlp.errors import DataError
from soup_nlp.geometry.camera import intrinsics, pixel_grid, project, rays
from soup_nlp.pipeline.case import prepare
from soup_nlp.pipeline.run import make_run, skipped
from soup_nlp.refine.records import Refined
from soup_nlp.report.verdict import facts

pytestmark = pytest.mark.usefixtures("simple_starts")

IMAGE = np.zeros((40, 60, 3), np.uint8)
K = intrinsics(60, 60, 30, 20)


@pytest.mark.parametrize("focal", [(0.5, 0.8), (60, 0.8), (2.9, 60)])
def test_normalised_intrinsics_are_refused_with_a_hint(focal):
    with pytest.raises(DataError, match="normalised"):
        Pair(IMAGE, IMAGE, K, intrinsics(*focal, 0.5, 0.5))
    Pair(IMAGE, IMAGE, K, intrinsics(3.1, 2.1, 30, 20))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -0.1, 1.1])
def test_a_confidence_is_between_0_and_1(bad):
    confidence = np.ones((4, 5), np.float32)
    Flow(np.zeros((4, 5, 2), np.float32), confidence)
    confidence[2, 3] = bad
    with pytest.raises(DataError, match="confidence is out of range"):
        Flow(np.zeros((4, 5, 2), np.float32), confidence)


def test_images_are_taken_as_arrays_files_and_pictures(tmp_path):
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (40, 60, 3)).astype(np.uint8)
    grey = rgb[:, :, 0]
    path = tmp_path / "a.png"
    Image.fromarray(rgb).save(path)
    for source in (rgb, rgb.tolist(), path, str(path), Image.fromarray(rgb)):
        source = np.array(source, np.uint8) if isinstance(source, list) else source
        np.testing.assert_array_equal(Pair(source, source, K).image_next, rgb)
    for source in (grey, grey[:, :, None], Image.fromarray(grey)):
        image = Pair(source, rgb, K).image_ref
        np.testing.assert_array_equal(image, np.repeat(grey[:, :, None], 3, axis=2))
    with_alpha = np.dstack([rgb, grey])
    np.testing.assert_array_equal(Pair(with_alpha, rgb, K).image_ref, rgb)
    np.testing.assert_array_equal(Pair(Image.fromarray(with_alpha), rgb, K).image_ref, rgb)


def test_cameras_are_taken_as_matrices_numbers_and_files(tmp_path):
    np.savetxt(tmp_path / "K.txt", K)
    for camera in (K, K.tolist(), K.astype(np.float32), (60, 60, 30, 20), tmp_path / "K.txt"):
        pair = Pair(IMAGE, IMAGE, camera)
        for made in (pair.K_ref, pair.K_next, Pair(IMAGE, IMAGE, K, camera).K_next):
            np.testing.assert_array_equal(made, K)
            assert made.dtype == np.float64


def test_flows_are_taken_in_both_layouts_and_from_files(tmp_path):
    uv = np.random.default_rng(0).normal(size=(40, 60, 2)).astype(np.float32)
    uv[3, 4] = np.nan
    np.save(tmp_path / "uv.npy", uv)
    valid = np.ones((40, 60))
    valid[3, 4] = 0
    filled = np.where(valid[..., None] > 0, uv, 0)
    np.save(tmp_path / "turned.npy", np.moveaxis(uv, 2, 0))
    files = tmp_path / "uv.npy", str(tmp_path / "uv.npy"), tmp_path / "turned.npy"
    for source in (uv, np.moveaxis(uv, 2, 0), *files):
        for flow in (Flow(source), Pair(IMAGE, IMAGE, K, flow=source).flow):
            np.testing.assert_array_equal(flow.uv, filled)
            np.testing.assert_array_equal(flow.confidence, valid)
    assert Flow(tmp_path / "uv.npy").source == str(tmp_path / "uv.npy")
    assert Flow(np.zeros((4, 5, 2), int), np.ones((4, 5), bool)).uv.dtype == np.float32
    # two rows: the last axis decides
    assert Flow(np.zeros((2, 5, 2))).confidence.shape == (2, 5)


WRONG = 3, "missing.png", {}, [], [[1, [2]]], [["a"] * 3] * 3, [1, 2, 3], object(), b"x"
WRONG_IMAGES = IMAGE + 1.5, IMAGE.astype(np.uint16), IMAGE[:0], IMAGE[..., [0] * 5]


@pytest.mark.parametrize("bad", [*WRONG, *WRONG_IMAGES])
def test_arguments_of_other_types_are_refused(bad):
    for make in (
        lambda: Pair(IMAGE, bad, K),
        lambda: Pair(IMAGE, IMAGE, K, bad),
        lambda: Pair(IMAGE, IMAGE, K, flow=bad),
        lambda: Pair(IMAGE, IMAGE, K, truth=bad),
        lambda: Flow(bad),
        lambda: Flow(np.zeros((4, 5, 2)), bad),
    ):
        with pytest.raises(DataError):
            make()


# --- working size ---------------------------------------------------------------------------------

CAMERA = intrinsics(90.0, 80.0, 47.3, 30.1)
N, T = np.array([0.1, 0.2, -1.0]), np.array([0.3, -0.1, 0.2])
"""Normal of a plane, translation of the camera."""


def plane(camera: np.ndarray, height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Depth and flow of the plane in an image."""
    ray = rays(camera, pixel_grid(height, width))
    depth = 5.0 / -(ray @ N)
    return depth, project(camera, depth[..., None] * ray + T) - pixel_grid(height, width)


def plane_pair(height=60, width=96) -> Pair:
    """The plane seen by two cameras: flow and depth follow from it exactly."""
    depth, flow = plane(CAMERA, height, width)
    confidence = np.ones((height, width), np.float32)
    # unusable displacements must not be averaged into usable ones
    flow[20:23, 20:23], confidence[20:23, 20:23] = 1e4, 0.0
    image = np.full((height, width, 3), 128, np.uint8)
    points = np.array([[10.0, 20.0, depth[20, 10]]])
    truth = Truth(depth_ref=depth, flow=flow, points=points)
    return Pair(image, image, CAMERA, CAMERA, Flow(flow.astype(np.float32), confidence), truth)


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
    z = full_depth(labels, pair.size, N[None], np.array([5.0]), CAMERA)
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
    start = skipped(case)
    done = make_run(case, start, Refined(start.soup, {}, {}, {}, (), "rounds", 0.0))
    assert done.pair.size[0] * done.pair.size[1] <= 12_500
    assert done.full.depth_ref.shape == (128, 256)
    covered = np.isfinite(done.full.depth_next)
    assert covered.mean() > 0.9
    # the error of planes does not grow at full size, and detail lowers it at both
    planes = make_run(case, start)
    assert planes.full.metrics.mre < 1.1 * planes.metrics["solution"].mre
    assert done.full.metrics.mre < 0.8 * planes.full.metrics.mre
    assert done.metrics["solution"].mre < 0.2 * planes.metrics["solution"].mre
    assert "brought to 256x128" in facts(done)
    assert prepare(make_problem({**settings, "max_size": None})).original is None


def test_a_truth_whose_squares_overflow_is_refused():
    for most, wrong in ((0.9e100, False), (1.1e100, True)):
        depth = np.array([[1.0, np.nan], [2.0, most]])
        with pytest.raises(DataError, match="squares overflow") if wrong else nullcontext():
            Truth(depth_ref=depth)
