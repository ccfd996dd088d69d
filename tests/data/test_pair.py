"""Input checks of a pair and its flow."""

import numpy as np
import pytest
from PIL import Image

from soup_nlp.data.pair import Flow, Pair
from soup_nlp.errors import DataError
from soup_nlp.geometry.camera import intrinsics

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
