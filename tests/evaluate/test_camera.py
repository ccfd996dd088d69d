"""Errors of a given camera that the flow of a rigid scene shows."""

from dataclasses import replace

import numpy as np
import pytest

from soup_nlp.config.problem import make_problem
from soup_nlp.data.pair import Pair
from soup_nlp.evaluate.camera import KINDS, camera_errors, corrected
from soup_nlp.geometry import rotation
from soup_nlp.pipeline.case import prepare
from soup_nlp.pipeline.run import make_run, skipped
from soup_nlp.report.findings import hints
from soup_nlp.report.summary import certainty
from soup_nlp.start.epipolar import Matches

FOCAL = 400.0
ORBIT = {"kind": "scene", "scene": "orbit", "width": 320, "height": 136}


def matches(seed: int = 0) -> Matches:
    """Correspondences of points with relief, seen by a camera that turns and shifts."""
    rng = np.random.default_rng(seed)
    place = np.column_stack([rng.uniform(-0.6, 0.6, 1500), rng.uniform(-0.4, 0.4, 1500)])
    ray = np.pad(place, [(0, 0), (0, 1)], constant_values=1.0)
    X = ray * rng.uniform(2.0, 8.0, (1500, 1))
    moved = X @ rotation.exp(np.array([0.02, 0.04, 0.01])).T + [0.3, 0.05, 0.1]
    target = moved / moved[:, 2:]
    target[:, :2] += rng.normal(0.0, 0.03 / FOCAL, (1500, 2))
    return Matches(ray, target, np.ones(len(ray)), FOCAL)


def seen_by(kind: str, x: float, exact: Matches) -> Matches:
    """Correspondences by a camera that does not know its error x; inverts `corrected`."""
    a, b = exact.ray, exact.target
    for _ in range(50):
        back = corrected(kind, x, a, b)
        a, b = a + (exact.ray - back[0]), b + (exact.target - back[1])
    return exact._replace(ray=a, target=b)


@pytest.mark.parametrize(
    ("kind", "x"),
    [
        ("focal length", 0.3),
        ("principal point in x", 0.1),
        ("principal point in y", -0.1),
        ("lens distortion", -0.2),
        ("zoom between the frames", 0.05),
    ],
)
def test_the_error_of_a_camera_is_found(kind, x):
    size, found = camera_errors(seen_by(kind, x, matches()))
    assert found == kind
    assert size[list(KINDS).index(kind)] == pytest.approx(x, rel=0.3)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_right_camera_is_believed(seed):
    size, found = camera_errors(matches(seed))
    assert found is None
    np.testing.assert_array_equal(size, 0.0)


def test_too_few_matches_show_no_error():
    assert camera_errors(matches().at(slice(7)))[1] is None


def started(pair: Pair):
    """The start of a pair as a run, and what is said of it."""
    raw = {"input": ORBIT, "segmentation": {"superpixels": 50}, "refine": {"enabled": False}}
    case = prepare(make_problem(raw), pair=pair)
    done = make_run(case, skipped(case))
    return done, "; ".join(hints(done, certainty(done)))


@pytest.fixture(scope="module")
def orbit():
    return make_problem({"input": ORBIT, "flow": {"source": "truth"}}).load_pair()


@pytest.mark.slow
def test_a_wrong_principal_point_makes_depth_unsure(orbit):
    K = orbit.K_ref.copy()
    K[0, 2] += 32
    exact, told = started(replace(orbit, flow=None))
    assert exact.good
    assert exact.confidence.evidence.camera is None
    assert "intrinsics" not in told
    wrong, told = started(replace(orbit, flow=None, K_ref=K, K_next=K))
    assert "intrinsics" in told
    sigma = np.median(wrong.confidence.sigma), np.median(exact.confidence.sigma)
    assert sigma[0] > 1.3 * sigma[1]
    truth, depth = orbit.truth.depth_ref, wrong.reconstruction.depth_ref
    error = np.abs(np.log(depth * np.median(truth / depth) / truth))
    assert np.mean(error < 2 * wrong.confidence.sigma) > 0.88


@pytest.mark.slow
def test_two_scenes_are_a_guess():
    one, other = (
        make_problem({"input": {**ORBIT, "scene": name}}).load_pair() for name in ("room", "street")
    )
    done, told = started(replace(one, flow=None, image_next=other.image_next))
    assert not done.good
    assert "same scene" in told


@pytest.mark.slow
def test_a_repeated_frame_is_a_guess(orbit):
    done, told = started(replace(orbit, flow=None, image_next=orbit.image_ref))
    assert not done.good
    assert done.confidence.guessed == 1
    assert "nearly the same" in told
