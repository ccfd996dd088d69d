"""Flow without parallax or without confidence: depth is borrowed, the flow is reproduced."""

import re

import numpy as np
import pytest
from helpers_start import squares

from soup_nlp.config.problem import make_problem
from soup_nlp.data.flow.consistency import confidence_of, round_trip_error
from soup_nlp.data.pair import Flow
from soup_nlp.geometry import camera
from soup_nlp.model import oracle
from soup_nlp.model.energy_data import build_energy_data
from soup_nlp.model.energy_options import Weights
from soup_nlp.pipeline.case import prepare
from soup_nlp.pipeline.run import make_run, skipped
from soup_nlp.report.verdict import verdict
from soup_nlp.start.propose import propose
from soup_nlp.start.views import FlowFit

pytestmark = pytest.mark.slow

K = camera.intrinsics(150.0, 150.0, 80.0, 60.0)


@pytest.fixture(scope="module")
def tiles():
    return squares(6, 8, side=20, neighbours=6)


def turned(angle: float) -> np.ndarray:
    """Flow of a camera that turns about its vertical axis, pixels."""
    c, s = np.cos(angle), np.sin(angle)
    R = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    uv = camera.pixel_grid(120, 160)
    return camera.project(K, camera.rays(K, uv) @ R.T) - uv


@pytest.mark.parametrize("angle", [0.0, 0.02])
def test_a_start_without_parallax_borrows_depth_but_fits_flow(tiles, angle):
    flow = Flow(turned(angle).astype(np.float32), np.ones((120, 160), np.float32), "turn")
    start = propose(FlowFit.of(tiles, flow, K, K))
    assert start.borrowed.all()
    data = build_energy_data(tiles, flow, K, K)
    error = oracle.values("proj", start.soup, data, Weights())
    assert error.max() < 1e-3
    np.testing.assert_allclose(error, start.error, atol=1e-3)


def test_a_pixel_without_backward_flow_affects_its_neighbourhood_alone():
    forward, backward = np.zeros((2, 40, 60, 2), np.float32)
    backward[20, 30] = np.nan
    gap = round_trip_error(forward, backward)
    assert np.isinf(gap[20, 30])
    assert not np.isnan(gap).any()
    assert (confidence_of(gap, support=5) == 1).mean() > 0.98


@pytest.mark.parametrize(
    ("scene", "width", "said"),
    [
        ("still", 256, True),
        ("orbit", 256, False),
        ("sheet", 768, False),
        # smaller ones are called a guess: a constant depth explains them to half a pixel
    ],
)
def test_the_verdict_warns_where_depth_is_a_guess(scene, width, said, tmp_path):
    height = width * 109 // 256
    raw = {
        "input": {"kind": "scene", "scene": scene, "seed": 0, "width": width, "height": height},
        "flow": {"source": "truth"},
        "segmentation": {"superpixels": 60, "neighbours": 6},
    }
    # the start decides it
    case = prepare(make_problem(raw))
    done = make_run(case, skipped(case))
    assert done.good != said
    share = re.search(r"(\d+)% is a guess", verdict(done, tmp_path, []))
    assert (share is not None and int(share[1]) > 50) == said
