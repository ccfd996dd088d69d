"""Motions that the flow leaves open have the least relief; flow corrects a guessed focal length."""

from dataclasses import replace

import numpy as np
import pytest
from helpers_start import scene_problem

from soup_nlp.data.formats.cameras import GUESS_SIGMA
from soup_nlp.data.pair import Pair
from soup_nlp.geometry import rotation
from soup_nlp.pipeline import case
from soup_nlp.start.camera_error import camera_error
from soup_nlp.start.epipolar import (
    MOST_RELIEF,
    Matches,
    Motion,
    around,
    cauchy,
    most_probable,
    relief,
    relief_spread,
)

FOCAL = 500.0
TRUE = Motion(rotation.exp(np.array([0.004, -0.006, 0.002])), np.array([0.6, 0.0, 0.8]))


def flow(shift: float, bias: float = 0.0, count: int = 400) -> tuple[Matches, np.ndarray]:
    """Correspondences and true log depths; `shift` is |t| over the median depth.

    `bias` is a smooth error of the flow, pixels: a radial distortion.
    """
    rng = np.random.default_rng(0)
    r = np.column_stack([rng.uniform(-0.6, 0.6, (count, 2)), np.ones(count)])
    log_z = 0.3 * rng.standard_normal(count)
    q = np.exp(log_z)[:, None] * r @ TRUE.R.T + shift * TRUE.t
    q = q / q[:, 2:]
    radius = np.sum(r[:, :2] ** 2, axis=1, keepdims=True) / 0.36
    q[:, :2] += bias / FOCAL * radius * r[:, :2] / 0.6
    return Matches(r, q, np.ones(count), FOCAL), log_z


def relief_error(motion: Motion, matches: Matches, log_z: np.ndarray) -> float:
    return float(np.std(relief(motion, matches.ray, matches.target) - log_z))


def test_a_motion_that_parallax_determines_is_kept():
    found, _ = most_probable([TRUE], flow(0.3)[0], 0.05)
    np.testing.assert_allclose(found.R, TRUE.R, atol=2e-4)
    np.testing.assert_allclose(found.t, TRUE.t, atol=5e-3)


def test_depth_survives_little_parallax_and_biased_flow():
    """The motion of the least residual follows the bias, and distant points recede."""
    matches, log_z = flow(0.006, bias=0.4)
    least, _ = most_probable([TRUE], matches, 1e-4)
    found, _ = most_probable([least], matches, 0.15)
    assert relief_error(found, matches, log_z) < 0.7 * relief_error(least, matches, log_z)


def test_the_spread_of_relief_is_that_of_depths_under_random_motions():
    matches, _ = flow(0.3)
    motion, covariance = most_probable([TRUE], matches, 0.05)
    spread = relief_spread(motion, covariance, matches.ray, matches.target)
    changes = np.random.default_rng(0).multivariate_normal(np.zeros(5), covariance, 300)
    drawn = np.array([relief(around(motion)(x), matches.ray, matches.target) for x in changes])
    # the median of a draw is that of one of its points
    drawn = (drawn - drawn.mean(axis=1, keepdims=True)).std(axis=0)
    assert np.sqrt(np.mean(drawn**2)) == pytest.approx(np.sqrt(np.mean(spread**2)), rel=0.1)
    assert np.corrcoef(drawn, spread)[0, 1] > 0.95


@pytest.mark.parametrize("bias", [0.0, 0.1])
def test_relief_is_less_sure_with_less_parallax_and_not_more_wrong_than_told(bias):
    spreads = []
    for shift in (0.1, 0.03, 0.01):
        matches, log_z = flow(shift, bias)
        motion, covariance = most_probable([TRUE], matches, 0.1)
        spread = relief_spread(motion, covariance, matches.ray, matches.target)
        spreads.append(float(np.sqrt(np.mean(spread**2))))
        assert relief_error(motion, matches, log_z) < 2 * spreads[-1]
    assert spreads[0] < spreads[1] < spreads[2]


def test_points_behind_the_camera_have_the_largest_relief():
    r, q, _, _ = flow(0.3)[0]
    backwards = Motion(TRUE.R, -TRUE.t)
    np.testing.assert_array_equal(relief(backwards, r, q), MOST_RELIEF)
    assert np.abs(relief(TRUE, r, q)).max() < MOST_RELIEF


@pytest.mark.parametrize("scale", [0.3, 0.5])
def test_squares_are_cauchy_losses(scale):
    x = np.array([-2.0, 1e-4, 0.1, 30.0])
    np.testing.assert_allclose(cauchy(x, scale) ** 2, scale**2 * np.log1p((x / scale) ** 2))


# --- a guessed focal length -----------------------------------------------------------------------


@pytest.mark.slow
def test_a_shift_without_a_turn_keeps_the_focal_length():
    """A longer lens and as much deeper a scene have the same flow."""
    rng, wrong = np.random.default_rng(0), 1.25
    r = np.column_stack([rng.uniform(-0.6, 0.6, (400, 2)), np.ones(400)])
    q = rng.uniform(2, 6, 400)[:, None] * r + [0.4, 0.0, 0.0]
    q /= q[:, 2:]
    q[:, :2] += 0.05 / FOCAL * rng.standard_normal((400, 2))
    r, q = (v / [wrong, wrong, 1.0] for v in (r, q))
    error = camera_error(Matches(r, q, np.ones(400), FOCAL * wrong), "focal length", GUESS_SIGMA)
    assert error.mean == pytest.approx(0.0, abs=0.05)
    assert error.deviation > 0.85 * GUESS_SIGMA


@pytest.mark.slow
def test_only_a_guess_is_corrected():
    problem = scene_problem("orbit", 480, 204, 60)
    right = problem.load_pair()
    wrong = right.with_focal(1.3, 0.0)

    def observed(pair: Pair) -> Pair:
        return case._observed(problem, pair)[1]

    kept = observed(wrong)
    np.testing.assert_array_equal(kept.K_ref, wrong.K_ref)
    assert kept.focal_sigma == 0
    corrected = observed(replace(wrong, focal_sigma=GUESS_SIGMA))
    np.testing.assert_allclose(corrected.K_ref, right.K_ref, rtol=0.08)
    np.testing.assert_array_equal(corrected.K_ref[:2, 2], right.K_ref[:2, 2])
    assert corrected.focal_sigma < 0.15
