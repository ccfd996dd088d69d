"""Formulas of the start on exact rays: motions, planes, interpolated depths and affine flows."""

import numpy as np
import pytest
from scipy.optimize import OptimizeResult

from soup_nlp.geometry import rotation
from soup_nlp.geometry.plane import PlaneFit
from soup_nlp.start import bending, epipolar
from soup_nlp.start.bending import constant_depth, displaced, fit_robustly, turned
from soup_nlp.start.epipolar import Matches, Motion, fit_translation, refine_near
from soup_nlp.start.views import Views, affine_flow

FOCAL = 200.0
TURN, SHIFT = np.array([0.02, -0.03, 0.01]), np.array([0.5, 0.1, 0.2])


def rigid(count: int, seed: int = 0, shift: np.ndarray = SHIFT) -> tuple[Motion, np.ndarray, ...]:
    """A motion and the rays of points at depths 2 to 6 in both frames, exact."""
    rng = np.random.default_rng(seed)
    r = np.column_stack([rng.uniform(-0.5, 0.5, (count, 2)), np.ones(count)])
    m = Motion(rotation.exp(TURN), shift / np.linalg.norm(shift))
    Y = rng.uniform(2, 6, (count, 1)) * r @ m.R.T + m.t
    return m, r, Y / Y[:, 2:]


def off(m: Motion, other: Motion) -> tuple[float, float]:
    """Angles in radians between motions, of rotation and of translation."""
    turn = float(np.linalg.norm(rotation.log(m.R.T @ other.R)))
    return turn, float(np.arctan2(np.linalg.norm(np.cross(m.t, other.t)), m.t @ other.t))


def perturbed(m: Motion, turn: float, tilt: float, seed: int = 1) -> Motion:
    """The motion, its rotation off by `turn` and its translation by `tilt`, radians."""
    a, b = np.random.default_rng(seed).normal(size=(2, 3))
    side = np.cross(m.t, b)
    t = np.cos(tilt) * m.t + np.sin(tilt) * side / np.linalg.norm(side)
    return Motion(rotation.exp(turn * a / np.linalg.norm(a)) @ m.R, t)


# --- motions of groups -------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(4))
def test_refinement_finds_the_motion_of_exact_rays(seed):
    m, r, q = rigid(200, seed)
    begin = perturbed(m, 0.009, 0.05, seed)
    turn, tilt = off(m, refine_near(begin, Matches(r, q, np.ones(200), FOCAL), 0.1))
    assert turn < 2e-5
    assert tilt < 1e-4


@pytest.mark.parametrize(
    ("wrong", "priors", "weight"),
    [((0.01, 0.0), (1e-4, 1e-6), 10.0), ((0.0, 0.05), (1e-6, 1e-3), 0.1)],
)
def test_a_prior_holds_directions_that_pixels_hardly_determine(monkeypatch, wrong, priors, weight):
    """The prior pulls towards the initial motion, however many steps are made."""
    monkeypatch.setattr(epipolar, "MOTION_SIGMA", np.repeat(priors, (3, 2)))
    m, r, q = rigid(200)
    begin = perturbed(m, *wrong)
    moved = []
    for rounds in (30, 600):
        motion = refine_near(begin, Matches(r, q, np.full(200, weight), FOCAL), 5.0, rounds)
        moved.append(sum(off(begin, motion)) / sum(wrong))
    # the pull of the pixels is not zero, and does not add up over rounds
    assert 1e-4 < moved[1] < 0.2
    assert moved[1] == pytest.approx(moved[0], rel=0.1)


def test_translations_are_weighed_in_pixels_not_in_algebraic_distances():
    """Near a forward epipole a pixel of noise is a small algebraic distance, far from it a large.

    Weighed by it, the few pixels far away would decide alone.
    """
    rng = np.random.default_rng(0)
    m, r, _ = rigid(60, shift=np.array([0.05, 0.0, 1.0]))
    r[:55, :2] *= 0.1
    Y = 3.0 * r @ m.R.T + m.t
    many = 100
    noisy = np.tile(Y / Y[:, 2:], (many, 1, 1))
    noisy[..., :2] += rng.normal(0, 0.1 / FOCAL, (many, 60, 2))
    t = [fit_translation(m.R, Matches(r, q, np.ones(60), FOCAL), 0.1).t for q in noisy]
    normal = np.cross(r @ m.R.T, noisy)
    plain = np.linalg.eigh(normal.transpose(0, 2, 1) @ normal)[1][:, :, 0]
    plain *= np.sign(plain @ m.t)[:, None]
    error, algebraic = (np.median([off(m, Motion(m.R, v))[1] for v in ts]) for ts in (t, plain))
    assert error < 0.7 * algebraic


def test_a_translation_puts_points_in_front():
    for sign in (1.0, -1.0):
        m, r, q = rigid(40, shift=sign * SHIFT)
        assert off(m, fit_translation(m.R, Matches(r, q, np.ones(40), FOCAL), 0.1))[1] < 1e-6


# --- motions of the whole image ------------------------------------------------------------------


def test_flow_without_confidence_does_not_change_a_motion():
    """Errors of half a pixel are within the noise: only the confidence separates them."""
    m, r, q = rigid(200)
    wrong = np.arange(200) % 2 == 0
    q = q + np.where(wrong[:, None], [0.0, 0.5 / FOCAL, 0.0], 0.0)
    weight = np.where(wrong, 1e-12, 1.0)
    motion = epipolar.refine(perturbed(m, 0.002, 0.01), Matches(r, q, weight, FOCAL))
    turn, tilt = off(m, motion)
    assert turn < 1e-6
    assert tilt < 1e-5


@pytest.mark.parametrize("size", [0.0, 0.3])
def test_the_derivative_of_the_distance_is_that_of_differences(size):
    m, r, q = rigid(50)
    rng = np.random.default_rng(2)
    noisy = q + np.column_stack([rng.normal(0, 0.05, (50, 2)), np.zeros(50)])
    matches, moved = Matches(r, noisy, np.ones(50), FOCAL), epipolar.around(m)
    x, step = size * rng.normal(size=5), 1e-5
    by_x = epipolar.essential_slope(m, x) @ matches.slope(moved(x))
    for k, way in enumerate(step * np.eye(5)):
        change = matches.distance(moved(x + way)) - matches.distance(moved(x - way))
        np.testing.assert_allclose(by_x[k], change / (2 * step), atol=1e-6 * np.abs(by_x).max())


@pytest.mark.parametrize(("matrix", "size"), [(turned, 4), (turned, 7), (displaced, 7)])
def test_the_derivative_of_a_robust_fit_is_that_of_differences(monkeypatch, matrix, size):
    rng, seen = np.random.default_rng(3), {}

    def derived(miss, x, slope, **options):
        seen["by_x"], seen["miss"] = slope(x + way), miss
        return OptimizeResult(x=x)

    way, step = 0.1 * rng.normal(size=size), 1e-6
    monkeypatch.setattr(bending, "least_squares", derived)
    _, r, q = rigid(50)
    point = r if matrix is turned else np.column_stack([r, rng.uniform(0.2, 1.0, 50)])
    scale = FOCAL * rng.uniform(0.5, 1.0, (50, 2))
    x, miss = fit_robustly(matrix, size, point, q[:, :2], scale)
    moved = point @ matrix(x).T
    np.testing.assert_allclose(miss, scale * (moved[:, :2] / moved[:, 2:] - q[:, :2]), atol=1e-9)
    for k, along in enumerate(step * np.eye(size)):
        change = (seen["miss"](way + along) - seen["miss"](way - along)) / (2 * step)
        np.testing.assert_allclose(seen["by_x"][:, k], change, atol=1e-6 * np.abs(change).max())


# --- planes --------------------------------------------------------------------------------------


def test_a_plane_behind_the_camera_costs_more_than_its_error():
    mu = np.array([[0.5, -0.01, -0.5, -1e-8]])
    fit = PlaneFit(mu, np.zeros((1, 4, 2)), np.full((1, 4), 0.2), np.full((1, 4), 10.0))
    cost = fit.penalised()[0]
    assert cost[0] == 0.2
    assert (cost[1:3] >= 0.2 + 0.5).all()
    # the cost grows with the pixels by which the plane is behind the camera
    assert cost[2] > cost[1] + 1.0
    # a superpixel that stands still is at infinity, whatever the sign of its rounding
    assert cost[3] == 0.2


# --- surfaces that bend --------------------------------------------------------------------------


def flat_views(target: np.ndarray, off_centre: np.ndarray, weight: np.ndarray) -> Views:
    """One superpixel around the optical axis, offsets and targets (S, 2) in ray units."""
    one = np.ones((len(target), 1))
    ray, targets = np.hstack([off_centre, one]), np.hstack([target, one])
    anchor, radius = np.array([[0.0, 0.0, 1.0]]), np.array([0.1])
    return Views(ray[None], targets[None], weight[None], anchor, radius, np.full(2, FOCAL))


def test_constant_depth_turns_with_the_image():
    rng = np.random.default_rng(0)
    at = rng.uniform(-0.1, 0.1, (40, 2))
    c, s = np.cos(0.3), np.sin(0.3)
    views = flat_views(at @ np.array([[c, s], [-s, c]]) + [0.05, -0.02], at, np.ones(40))
    soup, error = constant_depth(views)
    np.testing.assert_allclose(rotation.log(soup.R[0]), [0, 0, 0.3], atol=1e-9)
    np.testing.assert_allclose(soup.translation[0], [0.05, -0.02, 0], atol=1e-9)
    assert error[0] < 1e-9


def test_an_affine_flow_is_not_pulled_by_some_wrong_pixels():
    rng = np.random.default_rng(0)
    at = rng.uniform(-0.1, 0.1, (40, 2))
    M = np.array([[1.1, 0.2], [-0.1, 0.9]])
    wrong = np.arange(40) % 5 == 0
    target = at @ M + [0.02, 0.01] + np.where(wrong[:, None], 5 / FOCAL, 0.0)
    fit = affine_flow(flat_views(target, at, np.ones(40)))[0][0]
    np.testing.assert_allclose(fit[0], FOCAL * np.array([0.02, 0.01]), atol=0.1)
    np.testing.assert_allclose(fit[1:], 0.1 * FOCAL * M, atol=0.1)
    # pixels without confidence do not count at all
    far = at @ M + [0.02, 0.01] + np.where(wrong[:, None], 0.5, 0.0)
    fit = affine_flow(flat_views(far, at, np.where(wrong, 0.0, 1.0)))[0][0]
    np.testing.assert_allclose(fit[1:], 0.1 * FOCAL * M, atol=1e-3)
