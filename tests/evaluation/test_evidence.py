"""Evidence of the flow for the camera: its errors, and what they leave open of the depth."""

from dataclasses import replace

import numpy as np
import pytest
from helpers_start import facing, scene_problem

from soup_nlp.config.problem import make_problem
from soup_nlp.data.pair import Pair
from soup_nlp.evaluation.evidence import Evidence, evidence
from soup_nlp.geometry import rotation
from soup_nlp.geometry.camera import project, rays
from soup_nlp.geometry.soup import Soup
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.pipeline import case as pipeline_case
from soup_nlp.pipeline.case import prepare
from soup_nlp.pipeline.run import make_run, skipped
from soup_nlp.report.findings import hints
from soup_nlp.start.bending import ANY_TURN, PLAIN_TURN, fit_robustly, turned
from soup_nlp.start.camera_error import (
    CameraError,
    better_camera,
    camera_errors,
    corrected,
)
from soup_nlp.start.epipolar import Matches, Motion, estimate, triangulate


def scene(case, depth: float, t: tuple[float, float, float], turn: float = 0.02):
    """A soup of planes that face the camera, and the data with exactly its flow.

    `depth` is the standard deviation of log depth.
    """
    n = len(case.data)
    z = np.exp(depth * np.random.default_rng(0).standard_normal(n))
    R = rotation.exp(np.array([0.3 * turn, turn, 0.1 * turn]))
    soup = replace(facing(z, np.array(t)), R=np.tile(R, (n, 1, 1)))
    target = project(case.data.K_next, soup.moved(soup.points(case.data.pixel_ray)))
    weight = np.full_like(case.data.pixel_weight, 1 / case.data.pixel_weight.shape[1])
    return soup, replace(case.data, pixel_target=target, pixel_weight=weight)


def of_one(soup: Soup, data: EnergyData, *focal_sigma: float) -> Evidence:
    """Evidence for a soup that is one component."""
    return evidence(soup, data, np.zeros(len(soup), np.int64), *focal_sigma)


def test_a_turn_explains_a_stabilised_flow_with_all_parameters_only(small_room):
    _, data = scene(small_room, 0.4, (0.0, 0.0, 0.0), turn=0.1)
    # stabilisation moves the next image back, and crops it
    target = 1.03 * data.pixel_target - 0.08 * data.K_next[0, 0]
    ray, seen = (v.reshape(-1, 3) for v in (data.pixel_ray, rays(data.K_next, target)))
    scale = np.tile(np.diag(data.K_next)[:2], (len(ray), 1))

    def error(size: int) -> float:
        miss = fit_robustly(turned, size, ray, seen[:, :2], scale)[1]
        return float(np.mean(np.abs(miss)))

    assert error(PLAIN_TURN) > 0.3
    assert error(ANY_TURN) < 0.02


@pytest.mark.slow
def test_an_uncertain_focal_length_counts_by_its_size(small_room):
    soup, data = scene(small_room, 0.3, (0.3, 0.0, 0.1))
    uncertain, doubled = (of_one(soup, data, x).sigma for x in (0.2, 0.4))
    assert np.median(uncertain) > 0.001
    assert 1.5 < np.median(doubled) / np.median(uncertain) < 4


def test_a_depth_that_is_no_number_leaves_the_others_theirs(small_room):
    soup, data = scene(small_room, 0.3, (0.3, 0.0, 0.1))
    broken = replace(soup, d=np.where(np.arange(len(soup)) == 3, np.nan, soup.d))
    found, whole = (of_one(s, data, 0.2).sigma for s in (broken, soup))
    assert np.isfinite(found).all()
    assert np.median(found) == pytest.approx(np.median(whole), rel=0.5)


def test_a_component_without_flow_has_no_depth(small_room):
    soup, data = scene(small_room, 0.4, (0.3, 0.0, 0.1))
    component = (np.arange(len(soup)) >= len(soup) - 5).astype(np.int64)
    weight = np.where(component[:, None] == 1, 0.0, data.pixel_weight)
    result = evidence(soup, replace(data, pixel_weight=weight), component)
    assert np.isinf(result.sigma[component == 1]).all()
    assert not result.sigma[component == 0].any()


# --- errors of a given camera that the flow of a rigid scene shows --------------------------------

FOCAL = 400.0


def matches(seed: int = 0) -> Matches:
    """Correspondences of points with relief, seen by a camera that turns and shifts."""
    rng = np.random.default_rng(seed)
    place = np.column_stack([rng.uniform(-0.6, 0.6, 600), rng.uniform(-0.4, 0.4, 600)])
    ray = np.pad(place, [(0, 0), (0, 1)], constant_values=1.0)
    X = ray * rng.uniform(2.0, 8.0, (600, 1))
    moved = X @ rotation.exp(np.array([0.02, 0.04, 0.01])).T + [0.3, 0.05, 0.1]
    target = moved / moved[:, 2:]
    target[:, :2] += rng.normal(0.0, 0.03 / FOCAL, (600, 2))
    return Matches(ray, target, np.ones(len(ray)), FOCAL)


def seen_by(kind: str, x: float, exact: Matches) -> Matches:
    """Correspondences by a camera that does not know its error x; inverts `corrected`."""
    # the inverse itself but for distortion
    a, b = corrected(kind, -x, exact.ray, exact.target)
    for _ in range(50 * (kind == "lens distortion")):
        back = corrected(kind, x, a, b)
        a, b = a + (exact.ray - back[0]), b + (exact.target - back[1])
    return exact._replace(ray=a, target=b)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "x"),
    [
        ("focal length", 0.3),
        ("focal length", np.log(0.25)),
        ("focal length", np.log(2.0)),
        ("principal point in x", 0.1),
        ("principal point in y", -0.1),
        ("lens distortion", -0.2),
        ("zoom between the frames", 0.05),
    ],
)
def test_the_error_of_a_camera_is_found(kind, x):
    exact = matches()
    seen = seen_by(kind, x, exact)
    found = camera_errors(seen)
    assert Evidence(np.zeros(0), found).camera == kind
    assert found[kind].mean == pytest.approx(x, rel=0.3)
    # what it says of depth is what the error does to it, also where it is large
    wrong, right = (triangulate(estimate(m), m.ray, m.target)[0] for m in (seen, exact))
    change = np.log(wrong / right)
    change = np.abs(change - np.median(change))
    said = np.sqrt(found[kind].squares(seen.ray, seen.target, wrong))
    assert np.median(said) == pytest.approx(np.median(change), rel=0.25)
    assert np.mean(change < 2 * said + 0.02) > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1])
def test_a_right_camera_is_believed(seed):
    found = camera_errors(matches(seed))
    assert Evidence(np.zeros(0), found).camera is None
    nothing = np.ones((9, 3)), np.ones((9, 3)), np.ones(9)
    assert not any(error.squares(*nothing).any() for error in found.values())


def test_an_error_counts_unless_the_flow_excludes_it():
    seen, along = matches(), Motion(np.eye(3), np.array([1.0, 0.0, 0.0]))
    turned = Motion(rotation.exp(np.array([0.0, 0.02, 0.0])), along.t)
    tried = (-0.8, 0.0, 0.8), (0.5, 0.0, 0.5), (turned, along, turned)
    rays = seen.ray, seen.target, np.ones(len(seen.ray))
    even, half, excluded = (
        CameraError("zoom between the frames", 0.0, 0.8, odds, *tried).squares(*rays)
        for odds in (50.0, 0.0, -3.1)
    )
    assert np.median(even) > 0
    np.testing.assert_allclose(half, even / 2)
    assert not excluded.any()


def test_a_better_camera_has_square_pixels():
    K = np.array([[720.0, 0, 310], [0, 722, 93], [0, 0, 1]])
    fits = better_camera(K, "focal length", np.log(0.5))
    np.testing.assert_allclose(np.diag(fits)[:2], np.sqrt(720 * 722) / 2)
    np.testing.assert_array_equal(fits[:2, 2], K[:2, 2])
    shifted = better_camera(K, "principal point in y", 0.1)
    np.testing.assert_allclose(shifted[:2, 2], [310, 93 + 0.1 * np.sqrt(720 * 722)])
    assert better_camera(K, "lens distortion", 0.1) is None


def test_too_few_matches_show_no_error():
    seen = matches()
    few = Matches(seen.ray[:7], seen.target[:7], seen.weight[:7], FOCAL)
    assert Evidence(np.zeros(0), camera_errors(few)).camera is None


def started(pair: Pair, monkeypatch):
    """One start of a pair as a run, and what is said of it."""
    monkeypatch.setattr(pipeline_case, "STARTS", 1)
    raw = {"input": {"kind": "motorcycle"}, "segmentation": {"superpixels": 50}}
    case = prepare(make_problem(raw), pair=pair)
    done = make_run(case, skipped(case))
    return done, "; ".join(hints(done))


@pytest.mark.slow
def test_a_wrong_principal_point_makes_depth_unsure(monkeypatch):
    orbit = scene_problem("orbit", 320, 136, 50).load_pair()
    K = orbit.K_ref.copy()
    K[0, 2] += 32
    exact, told = started(replace(orbit, flow=None), monkeypatch)
    assert exact.good
    assert exact.confidence.evidence.camera is None
    assert "intrinsics" not in told
    wrong, told = started(replace(orbit, flow=None, K_ref=K, K_next=K), monkeypatch)
    assert "intrinsics" in told
    sigma = np.median(wrong.confidence.sigma), np.median(exact.confidence.sigma)
    assert sigma[0] > 1.3 * sigma[1]
    truth, depth = orbit.truth.depth_ref, wrong.reconstruction.depth_ref
    error = np.abs(np.log(depth * np.median(truth / depth) / truth))
    assert np.mean(error < 2 * wrong.confidence.sigma) > 0.88


@pytest.mark.slow
def test_two_scenes_are_drawn(monkeypatch):
    one, other = (scene_problem(name, 320, 136, 50).load_pair() for name in ("room", "street"))
    done, told = started(replace(one, flow=None, image_next=other.image_next), monkeypatch)
    assert not done.good
    assert "same scene" in told
