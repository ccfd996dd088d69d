"""Motions that the flow leaves open are settled by the least relief; the others are not moved."""

import numpy as np
import pytest

from soup_nlp.geometry import rotation
from soup_nlp.start.epipolar import Matches, Motion
from soup_nlp.start.settle import MOST_RELIEF, cauchy, most_probable, relief

FOCAL = 500.0
TRUE = Motion(rotation.exp(np.array([0.004, -0.006, 0.002])), np.array([0.6, 0.0, 0.8]))


def flow(shift: float, spread: float = 0.3, bias: float = 0.0, count: int = 400):
    """Rays of both frames and true log depths; `shift` is |t| over the median depth.

    `bias` is a smooth error of the flow, pixels: a radial distortion.
    """
    rng = np.random.default_rng(0)
    r = np.column_stack([rng.uniform(-0.6, 0.6, (count, 2)), np.ones(count)])
    log_z = spread * rng.standard_normal(count)
    q = np.exp(log_z)[:, None] * r @ TRUE.R.T + shift * TRUE.t
    q = q / q[:, 2:]
    radius = np.sum(r[:, :2] ** 2, axis=1, keepdims=True) / 0.36
    q[:, :2] += bias / FOCAL * radius * r[:, :2] / 0.6
    return r, q, log_z


def relief_error(motion: Motion, r: np.ndarray, q: np.ndarray, log_z: np.ndarray) -> float:
    error = relief(motion, r, q) - log_z
    return float(np.std(error))


def test_a_motion_that_parallax_determines_is_kept():
    r, q, _ = flow(0.3)
    found = most_probable([TRUE], Matches(r, q, np.ones(len(r)), FOCAL), 0.05)
    np.testing.assert_allclose(found.R, TRUE.R, atol=2e-4)
    np.testing.assert_allclose(found.t, TRUE.t, atol=5e-3)


def test_depth_survives_little_parallax_and_biased_flow():
    """The motion of the least residual follows the bias, and distant points recede."""
    r, q, log_z = flow(0.006, bias=0.4)
    least = most_probable([TRUE], Matches(r, q, np.ones(len(r)), FOCAL), 1e-4)
    found = most_probable([least], Matches(r, q, np.ones(len(r)), FOCAL), 0.15)
    assert relief_error(found, r, q, log_z) < 0.7 * relief_error(least, r, q, log_z)


def test_points_behind_the_camera_have_the_largest_relief():
    r, q, _ = flow(0.3)
    backwards = Motion(TRUE.R, -TRUE.t)
    np.testing.assert_array_equal(relief(backwards, r, q), MOST_RELIEF)
    assert np.abs(relief(TRUE, r, q)).max() < MOST_RELIEF


@pytest.mark.parametrize("scale", [0.3, 0.5])
def test_squares_are_cauchy_losses(scale):
    x = np.array([-2.0, 1e-4, 0.1, 30.0])
    np.testing.assert_allclose(cauchy(x, scale) ** 2, scale**2 * np.log1p((x / scale) ** 2))
