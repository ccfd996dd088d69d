from __future__ import annotations

import dataclasses
import os

import cv2
import matplotlib
import numpy as np
import pytest

from soup_nlp.data.pair import Flow, Pair, Truth
from soup_nlp.errors import DataError
from soup_nlp.evaluate.metrics import depth_metrics
from soup_nlp.report import figures
from soup_nlp.report.colour import (
    colour_wheel,
    colourise_depth,
    colourise_error,
    colourise_flow,
    colourise_normals,
    depth_range,
    draw_superpixels,
)
from soup_nlp.report.figures import overview, overview_strip, write_clipped_depth_png16, write_png


def turbo(level):
    return (np.array(matplotlib.colormaps["turbo"](level)[:3]) * 255).round().astype(np.uint8)


def test_depth_colours():
    z = np.array([[1.0, 4 / 2.5, 4.0], [0.01, 1e6, np.nan], [0.0, -1.0, np.inf]])
    out = colourise_depth(z, 1.0, 4.0)
    assert (out.dtype, out.shape) == (np.uint8, (3, 3, 3))
    np.testing.assert_array_equal(out[0, 0], turbo(255))
    np.testing.assert_array_equal(out[0, 2], turbo(0))
    np.testing.assert_array_equal(out[1, 0], turbo(255))
    np.testing.assert_array_equal(out[1, 1], turbo(0))
    np.testing.assert_array_equal(out[0, 1], turbo(128))
    assert not out[1, 2].any()
    assert not out[2].any()


def test_depth_range_is_robust():
    z = np.linspace(2.0, 3.0, 1000).reshape(25, 40)
    z[0, 0], z[0, 1], z[0, 2], z[0, 3] = 1e9, np.nan, -5.0, np.inf
    near, far = depth_range(z)
    assert 2.0 < near < 2.1
    assert 2.9 < far < 3.1
    near, far = depth_range(np.full((2, 2), 5.0))
    assert near < 5.0 < far
    assert depth_range(np.full((2, 2), np.nan)) == (1.0, 2.0)
    assert not colourise_depth(np.full((2, 2), np.nan)).any()
    assert colourise_depth(np.full((2, 2), 5.0)).any()


def test_flow_wheel():
    assert colour_wheel().shape == (55, 3)
    right, down, left, up = (
        colourise_flow(np.array([[uv]], float), 1.0)[0, 0].astype(int)
        for uv in ((1, 0), (0, 1), (-1, 0), (0, -1))
    )
    np.testing.assert_array_equal(right, [255, 0, 0])
    assert down[1] > 200  # yellow
    assert down[0] > 200
    assert left[2] > 200  # cyan
    assert left[1] > 200
    assert up[2] > 200  # blue to violet
    assert up[1] < 50
    assert (colourise_flow(np.zeros((2, 2, 2))) == 255).all()
    unknown = np.full((1, 2, 2), np.nan)
    assert not colourise_flow(unknown).any()
    beyond = colourise_flow(np.array([[[5.0, 0.0]]]), 1.0)[0, 0]
    np.testing.assert_array_equal(beyond, [191, 0, 0])


def test_flow_colour_is_continuous_but_for_the_seam_of_the_wheel():
    """The published wheel has a seam of 43 grey levels in blue, between its last and first."""
    angle = np.linspace(-np.pi, np.pi, 2000)
    uv = np.stack([np.cos(angle), np.sin(angle)], axis=-1)[None]
    out = colourise_flow(uv, 1.01).astype(int)[0]
    step = np.abs(np.diff(out, axis=0))
    assert (step.max(axis=1) > 12).sum() == 1
    assert step.max() <= 43
    assert step[:, :2].max() < 12
    assert np.abs(out[0] - out[-1]).max() < 12


def test_error_colours():
    out = colourise_error(np.array([[0.0, 0.2, 7.0, np.nan]])).astype(int)[0]
    assert out[0].any()  # a small error is not the black of the unknown
    np.testing.assert_array_equal(out[1], out[2])
    assert out[1].sum() > out[0].sum()
    assert not out[3].any()


def test_normal_colours():
    n = np.array([[[0, 0, -1.0], [1.0, 0, 0], [0, 1.0, 0], [np.nan, 0, 0]]])
    np.testing.assert_array_equal(
        colourise_normals(n)[0], [[128, 128, 255], [255, 128, 128], [128, 0, 128], [0, 0, 0]]
    )


def test_superpixel_boundaries():
    image = np.full((4, 6, 3), 9, np.uint8)
    labels = np.repeat([[0, 0, 0, 1, 1, 1]], 4, axis=0)
    labels[3] = 2
    out = draw_superpixels(image, labels)
    edge = (out == [255, 255, 0]).all(axis=2)
    want = np.zeros((4, 6), bool)
    want[:3, 2] = want[2] = True
    np.testing.assert_array_equal(edge, want)
    assert (image == 9).all()


def panels():
    flat = np.full((30, 60, 3), (200, 30, 30), np.uint8)
    tall = np.full((80, 40, 3), (30, 30, 200), np.uint8)
    return [("a red panel, 5 $ and 6 $", flat), ("blue", tall), ("red again", flat)]


def test_overview(tmp_path):
    path = tmp_path / "overview.png"
    overview_strip(path, panels(), "title with $x_1$", columns=2, panel_width=2.0)
    image = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
    assert abs(image.shape[1] - (2 * 2.08 + 0.08) * 100) <= 2
    assert abs(image.shape[0] - (0.42 + 4.0 + 1.0 + 2 * 0.36) * 100) <= 2
    for colour, area in (((200, 30, 30), 2 * 200 * 100), ((30, 30, 200), 200 * 400)):
        found = (np.abs(image.astype(int) - colour).max(axis=2) < 3).sum()
        assert found == pytest.approx(area, rel=0.05)
    assert os.listdir(tmp_path) == ["overview.png"]


def test_overview_does_not_touch_global_state(tmp_path):
    import sys

    before = dict(matplotlib.rcParams)
    overview_strip(tmp_path / "a.png", panels()[:1], "")
    assert dict(matplotlib.rcParams) == before
    if "matplotlib.pyplot" in sys.modules:
        assert not sys.modules["matplotlib.pyplot"].get_fignums()


def small_pair(**known):
    """8 x 6 pair with a flow that half of the pixels trust."""
    image = np.full((6, 8, 3), 90, np.uint8)
    confidence = np.tile(np.array([0, 1] * 4, np.float32), (6, 1))
    flow = Flow(np.ones((6, 8, 2), np.float32), confidence, "made")
    K = np.array([[9.0, 0, 4], [0, 9.0, 3], [0, 0, 1]])
    truth = Truth(**known) if known else None
    return Pair(image, image[:5], K, K, flow, truth, "small")


ONE, FLAT = np.zeros((6, 8), int), np.tile([0.0, 0.0, -1.0], (6, 8, 1))


def drawn(monkeypatch, pair, depths, labels=ONE):
    """Arguments of `overview_strip` in `overview`: panels by caption, and the title."""
    seen = {}

    def catch(path, panels, title):
        seen.update(panels={p[0]: p[1:] for p in panels}, title=title)

    monkeypatch.setattr(figures, "overview_strip", catch)
    overview("unused.png", pair, labels, depths, FLAT, "a title")
    return seen["panels"], seen["title"]


def test_overview_of_everything(monkeypatch):
    truth = np.linspace(2, 4, 48).reshape(6, 8)
    truth[0, 0] = np.nan
    start, solution = np.ones((6, 8)), 10 * truth
    solution[:, 4:] = np.nan
    solution[5, 0] *= 1.5
    panels, title = drawn(
        monkeypatch,
        small_pair(depth_ref=truth),
        {"start": start, "solution": solution},
        np.arange(48).reshape(6, 8) // 24,
    )
    assert title == "a title"
    # 47 true pixels, 23 with an estimate, one of them 50 % too deep: 0.5 / 23
    mre = depth_metrics(start, truth).mre
    assert list(panels) == [
        "reference frame",
        "next frame",
        "2 superpixels",
        "flow (made)",
        "confidence, 50% above 0 (black)",
        f"start, MRE {mre:.3f} (median), coverage 100%",
        "solution, MRE 0.022 (median), coverage 49%",
        "true depth (m)",
        "relative error, solution",
        "normals",
    ]
    flow = panels["flow (made)"][0]
    assert not flow[:, ::2].any()
    assert flow[:, 1::2].any(axis=2).all()
    # one colour range: where the solution is right it has the colours of the truth
    right = panels["solution, MRE 0.022 (median), coverage 49%"][0][:5, 1:4]
    np.testing.assert_array_equal(right, panels["true depth (m)"][0][:5, 1:4])
    error, (bar, low, high) = panels["relative error, solution"]
    assert (low, high) == ("0", "0.2")
    np.testing.assert_array_equal(error[1, 1], bar[0, 0])
    np.testing.assert_array_equal(error[5, 0], bar[0, -1])  # 0.5 is beyond the bar
    assert not error[0, 0].any()
    assert not error[:, 4:].any()


def test_overview_leaves_out_what_is_unknown(monkeypatch):
    bare = dataclasses.replace(small_pair(), flow=None)
    panels, _ = drawn(monkeypatch, bare, {"a": np.full((6, 8), 2.0)})
    assert list(panels) == ["reference frame", "next frame", "1 superpixels", "a", "normals"]
    panels, _ = drawn(monkeypatch, bare, {"nothing": np.full((6, 8), np.nan)})
    assert not panels["nothing"][0].any()
    points = np.array([[0.0, 0, 3.0], [1.2, 2, 3.0], [7, 5, 6.0]])
    panels, _ = drawn(monkeypatch, small_pair(points=points), {"a": np.full((6, 8), 2.0)})
    # scale 3/2 at the median; |6 - 3| / 6 at one point of three
    assert list(panels)[-2] == "a, MRE 0.167 (median), coverage 100%"


def test_overview_file(tmp_path):
    truth = np.linspace(2, 4, 48).reshape(6, 8)
    given = {"labels": ONE, "normals": FLAT, "title": "t"}
    overview(tmp_path / "o.png", small_pair(depth_ref=truth), depths={"solution": truth}, **given)
    image = cv2.imread(str(tmp_path / "o.png"))
    # three rows, the second and third with bars: panels 4.2 in wide, 4.2 * 6 / 8 in high
    assert image.shape[1] == pytest.approx(100 * (3 * 4.28 + 0.08), abs=2)
    rows = 3 * (3.15 + 0.36)
    assert image.shape[0] == pytest.approx(100 * (0.42 + rows + 2 * 0.2), abs=2)
    assert os.listdir(tmp_path) == ["o.png"]


def test_a_white_panel_has_a_frame(tmp_path):
    white = np.full((60, 100, 3), 255, np.uint8)
    overview_strip(tmp_path / "o.png", [("", white)], "")
    picture = cv2.imread(str(tmp_path / "o.png"))
    dark = (picture < 230).all(2)
    rows, columns = np.flatnonzero(dark.any(1)), np.flatnonzero(dark.any(0))
    # as wide and high as the panel, and nothing within
    assert abs(np.ptp(columns) - 420) < 4
    assert abs(np.ptp(rows) - 252) < 4
    assert not dark[rows[0] + 3 : rows[-1] - 2, columns[0] + 3 : columns[-1] - 2].any()


def test_png_round_trip(tmp_path):
    rgb = np.random.default_rng(0).integers(0, 256, (5, 7, 3)).astype(np.uint8)
    write_png(tmp_path / "a.png", rgb)
    back = cv2.cvtColor(cv2.imread(str(tmp_path / "a.png")), cv2.COLOR_BGR2RGB)
    np.testing.assert_array_equal(back, rgb)
    with pytest.raises(DataError, match="does not exist"):
        write_png(tmp_path / "no" / "a.png", rgb)


def test_depth_png(tmp_path):
    path = tmp_path / "d.png"
    z = np.array([[1.0, 2.5, np.nan], [1e-9, 1e9, -1.0]])
    assert write_clipped_depth_png16(path, z, 1000) == 1000.0
    back = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert back.dtype == np.uint16
    np.testing.assert_array_equal(back, [[1000, 2500, 0], [1, 65535, 0]])


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e5])
def test_depth_png_chooses_a_scale(tmp_path, unit):
    z = unit * np.random.default_rng(0).uniform(1, 10, (20, 30))
    scale = write_clipped_depth_png16(tmp_path / "d.png", z)
    back = cv2.imread(str(tmp_path / "d.png"), cv2.IMREAD_UNCHANGED)
    assert np.log2(scale) == round(np.log2(scale))
    np.testing.assert_allclose(back / scale, z, atol=0.51 / scale, rtol=1e-3)
    assert back.max() > 32767
    assert write_clipped_depth_png16(tmp_path / "d.png", np.full((2, 2), np.nan)) > 0
