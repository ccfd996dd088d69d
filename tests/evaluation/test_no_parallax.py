"""Flow without parallax or without confidence: depth is plausible and uncertain."""

import re

import numpy as np
import pytest
from helpers_start import scene_problem

from soup_nlp.data.pair import Flow
from soup_nlp.pipeline.case import prepare
from soup_nlp.pipeline.run import make_run, run, skipped
from soup_nlp.report.verdict import verdict

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("simple_starts")]


@pytest.mark.parametrize(
    ("scene", "seed", "width", "least", "most"),
    [
        ("still", 0, 256, 80, 100),
        ("orbit", 0, 256, 0, 20),
        # vehicles that are taken to bend, although the flow jumps between them
        ("jam", 25, 320, 51, 100),
        ("sheet", 0, 768, 0, 50),
    ],
)
def test_the_verdict_warns_where_depth_is_drawn(scene, seed, width, least, most, tmp_path):
    size = width, width * 109 // 256, 60
    # the start decides it
    case = prepare(scene_problem(scene, *size, "segmentation.neighbours=6", seed=seed))
    done = make_run(case, skipped(case))
    assert done.good == (most <= 50)
    share = re.search(r"(\d+)% of the image is drawn", verdict(done, tmp_path, []))
    assert least <= (0 if share is None else int(share[1])) <= most


# --- flow that is missing ------------------------------------------------------------------------

SIZE = 320, 136


@pytest.fixture(scope="module")
def problem():
    return scene_problem("orbit", *SIZE, 60, "refine.enabled=false")


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
