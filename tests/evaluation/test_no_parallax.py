"""Flow without parallax or without confidence: depth is plausible and uncertain."""

import re

import numpy as np
import pytest
from helpers_start import squares

from soup_nlp.config.problem import make_problem
from soup_nlp.data.pair import Flow
from soup_nlp.geometry import camera
from soup_nlp.model import oracle
from soup_nlp.model.energy_data import build_energy_data
from soup_nlp.model.energy_options import Weights
from soup_nlp.pipeline.case import prepare
from soup_nlp.pipeline.run import make_run, run, skipped
from soup_nlp.report.verdict import verdict
from soup_nlp.start.propose import propose
from soup_nlp.start.views import FlowFit

pytestmark = pytest.mark.slow


@pytest.mark.parametrize(
    ("scene", "seed", "width", "said"),
    [
        ("still", 0, 256, True),
        ("orbit", 0, 256, False),
        # vehicles that are taken to bend, although the flow jumps between them
        ("jam", 25, 320, True),
        ("sheet", 0, 768, False),
    ],
)
def test_the_verdict_warns_where_depth_is_drawn(scene, seed, width, said, tmp_path):
    height = width * 109 // 256
    raw = {
        "input": {"kind": "scene", "scene": scene, "seed": seed, "width": width, "height": height},
        "flow": {"source": "truth"},
        "segmentation": {"superpixels": 60, "neighbours": 6},
    }
    # the start decides it
    case = prepare(make_problem(raw))
    done = make_run(case, skipped(case))
    assert done.good != said
    share = re.search(r"(\d+)% of the image is drawn", verdict(done, tmp_path, []))
    assert (share is not None and int(share[1]) > 50) == said


# --- flow that is missing ------------------------------------------------------------------------

SIZE = 320, 136


@pytest.fixture(scope="module")
def problem():
    width, height = SIZE
    scene = {"kind": "scene", "scene": "orbit", "seed": 0, "width": width, "height": height}
    raw = {"input": scene, "flow": {"source": "truth"}, "segmentation": {"superpixels": 60}}
    return make_problem(raw | {"refine": {"enabled": False}})


@pytest.fixture(scope="module")
def whole(problem):
    return run(problem)


def relative_error(done) -> np.ndarray:
    truth, depth = done.pair.truth.depth_ref, done.reconstruction.depth_ref
    return np.abs(depth * np.median(truth / depth) - truth) / truth


@pytest.mark.parametrize("kind", ["block", "side"])
def test_a_masked_part_is_sane_and_the_rest_stays(problem, whole, kind):
    """A quarter of the image without flow, MRE there against that of the best constant depth."""
    width, height = SIZE
    v, u = np.mgrid[:height, :width]
    inside = (abs(u - width / 2) < width / 4) & (abs(v - height / 2) < height / 4)
    mask = inside if kind == "block" else u < width / 4
    flow, truth = whole.pair.flow, whole.pair.truth.depth_ref
    uv, confidence = np.where(mask[..., None], 0, flow.uv), np.where(mask, 0, flow.confidence)
    masked = run(problem, pair=whole.pair.with_flow(Flow(uv, confidence, "masked")))
    before, error = (relative_error(done) for done in (whole, masked))
    constant = np.median(truth[mask])
    assert error[mask].mean() < 1.1 * np.mean(abs(constant - truth[mask]) / truth[mask])
    assert error[~mask].mean() < before[~mask].mean() + 0.005
    sigma = masked.reconstruction.sigma_ref
    assert np.median(sigma[mask]) > 3 * np.median(sigma[~mask])
    wrong = mask & (error > 0.2)
    assert np.sum(sigma[wrong] < 0.1) <= 0.15 * wrong.sum()


@pytest.fixture(scope="module")
def tiles():
    return squares(6, 8, side=20, neighbours=6)


K = camera.intrinsics(150.0, 150.0, 80.0, 60.0)


def turned(angle: float) -> np.ndarray:
    """Flow of a camera that turns about its vertical axis, pixels."""
    c, s = np.cos(angle), np.sin(angle)
    R = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    uv = camera.pixel_grid(120, 160)
    return camera.project(K, camera.rays(K, uv) @ R.T) - uv


@pytest.mark.parametrize("angle", [0.0, 0.02])
def test_a_start_without_parallax_interpolates_depth_but_fits_flow(tiles, angle):
    flow = Flow(turned(angle).astype(np.float32), np.ones((120, 160), np.float32), "turn")
    start = propose(FlowFit.of(tiles, flow, K, K))
    assert start.interpolated.all()
    data = build_energy_data(tiles, flow, K, K)
    error = oracle.values("proj", start.soup, data, Weights())
    assert error.max() < 1e-3
    np.testing.assert_allclose(error, start.error, atol=1e-3)
