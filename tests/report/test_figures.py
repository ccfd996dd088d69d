import cv2
import matplotlib
import numpy as np
import pytest

from soup_nlp.report.figures import (
    UNKNOWN,
    colourise_depth,
    colourise_flow,
    colourise_normals,
    colourise_shares,
    depth_range,
    draw_superpixels,
    flow_limit,
    write_depth_png16,
)


def level(name, k):
    """Colour number k of a map of matplotlib."""
    return [round(255 * x) for x in matplotlib.colormaps[name](k)[:3]]


GREY, WHITE, BLACK = [UNKNOWN] * 3, [255] * 3, [0] * 3
NEAR, FAR = level("turbo", 255), level("turbo", 0)
BRIGHT = level("inferno", 255)


@pytest.mark.parametrize(
    ("colourise", "values", "colours"),
    [
        (
            lambda z: colourise_depth(z, 1.0, 4.0),
            [1.0, 4 / 2.5, 4.0, 0.01, 1e6, np.nan, 0.0, -1.0, np.inf],
            [NEAR, level("turbo", 128), FAR, NEAR, FAR, GREY, GREY, GREY, GREY],
        ),
        (
            lambda error: colourise_shares(error, 0.2, "inferno"),
            [0.0, 0.2, 7.0, np.nan],
            [level("inferno", 0), BRIGHT, BRIGHT, GREY],
        ),
        (
            colourise_normals,
            [[0, 0, -1.0], [1.0, 0, 0], [0, 1.0, 0], [np.nan, 0, 0]],
            [[128, 128, 255], [255, 128, 128], [128, 0, 128], GREY],
        ),
        (
            # red to the right, cyan to the left
            lambda uv: colourise_flow(uv, 1.0),
            [[1.0, 0.0], [5.0, 0.0], [-1.0, 0.0], [0.0, 0.0], [np.nan, np.nan]],
            [[255, 0, 0], [255, 0, 0], [0, 255, 255], WHITE, BLACK],
        ),
    ],
    ids=["depth", "error", "normals", "flow"],
)
def test_colours(colourise, values, colours):
    out = colourise(np.array([values]))
    assert out.dtype == np.uint8
    np.testing.assert_array_equal(out[0], colours)


def test_depth_range_is_robust():
    z = np.linspace(2.0, 3.0, 1000).reshape(25, 40)
    z[0, 0], z[0, 1], z[0, 2], z[0, 3] = 1e9, np.nan, -5.0, np.inf
    near, far = depth_range(z)
    assert 2.0 < near < 2.1
    assert 2.9 < far < 3.1
    # a constant, and a relief of 2 % as of a camera at rest; that of a paper takes all colours
    for last, low, high in ((5.0, 1.0999, 1.1001), (5.1, 1.0999, 1.1001), (5.8, 1.1001, 1.16)):
        near, far = depth_range(np.linspace(5.0, last, 100)[None])
        assert near < (5.0 + last) / 2 < far
        assert low < far / near < high
    assert depth_range(np.full((2, 2), np.nan)) == (1.0, 2.0)


@pytest.mark.parametrize("name", ["turbo", "inferno", "viridis"])
def test_no_scale_has_the_grey_of_the_unknown(name):
    """Not even nearly: "no truth" must not be taken for "exact", nor for any number."""
    scale = 255 * matplotlib.colormaps[name](np.arange(256))[:, :3]
    assert np.abs(scale - UNKNOWN).max(axis=1).min() > 20


def test_the_limit_of_a_flow_ignores_outliers():
    uv = np.zeros((10, 100, 2))
    uv[..., 0] = np.linspace(0, 10, 1000).reshape(10, 100)
    assert flow_limit(uv) == pytest.approx(10)
    uv[0, 0] = (300, 400)
    assert flow_limit(uv) == pytest.approx(15, rel=0.02)
    assert flow_limit(np.full((2, 2, 2), np.nan)) == 1.0
    still = np.zeros((2, 2, 2))
    assert (colourise_flow(still, flow_limit(still)) == 255).all()


def test_superpixel_boundaries():
    image = np.full((4, 6, 3), 9, np.uint8)
    labels = np.repeat([[0, 0, 0, 1, 1, 1]], 4, axis=0)
    labels[3] = 2
    want = np.zeros((4, 6), bool)
    want[:3, 2] = want[2] = True
    edge = (draw_superpixels(image, labels) == [255, 255, 0]).all(axis=2)
    np.testing.assert_array_equal(edge, want)
    assert (image == 9).all()


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e5])
def test_depth_png(tmp_path, unit):
    z = unit * np.array([[1.0, 2.5, np.nan], [1e-9, 1e9, -1.0]])
    assert write_depth_png16(tmp_path / "d.png", z, 1000 / unit) == 1000 / unit
    back = cv2.imread(str(tmp_path / "d.png"), cv2.IMREAD_UNCHANGED)
    assert back.dtype == np.uint16
    np.testing.assert_array_equal(back, [[1000, 2500, 0], [1, 0, 0]])
    # a scale of its own
    z = unit * np.random.default_rng(0).uniform(1, 10, (20, 30))
    scale = write_depth_png16(tmp_path / "d.png", z)
    back = cv2.imread(str(tmp_path / "d.png"), cv2.IMREAD_UNCHANGED)
    assert np.log2(scale) == round(np.log2(scale))
    np.testing.assert_allclose(back / scale, z, atol=0.51 / scale, rtol=1e-3)
    assert back.max() > 32767
    assert write_depth_png16(tmp_path / "d.png", np.full((2, 2), np.nan)) > 0
