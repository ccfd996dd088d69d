"""Rigid motions and rigid components of a solved soup."""

from dataclasses import replace

import numpy as np
import pytest
from helpers_start import facing, squares

from soup_nlp.geometry.camera import intrinsics
from soup_nlp.geometry.components import find_components
from soup_nlp.geometry.rotation import RigidMotion, exp, fit_motion

K = intrinsics(100.0, 100.0, 39.5, 29.5)
CAMERA = RigidMotion(exp([0.0, 0.02, 0.0]), np.array([0.05, 0.0, -0.1]))
CAR = RigidMotion(exp([0.0, -0.05, 0.0]), np.array([-0.2, 0.0, 0.1]))
ROUNDING = 1e-9
"""Rounding error of some thousand float64 operations on numbers of the order of 1."""


@pytest.fixture(scope="module")
def seg():
    """60 x 80 pixels in 12 superpixels."""
    return squares(3, 4, side=20, neighbours=3)


def soup_of(motions):
    """Planes at depth 2, parallel to the image, with these motions."""
    R, t = (np.array([getattr(m, name) for m in motions]) for name in ("R", "t"))
    return replace(facing(np.full(len(motions), 2.0), t), R=R)


def test_motions_are_chained_and_inverted():
    both = CAR @ CAMERA
    x = np.random.default_rng(0).normal(size=(5, 3))
    np.testing.assert_allclose(both(x), CAR(CAMERA(x)), atol=ROUNDING)
    np.testing.assert_allclose(both.matrix, CAR.matrix @ CAMERA.matrix, atol=ROUNDING)
    np.testing.assert_allclose(both.inverse(both(x)), x, atol=ROUNDING)
    np.testing.assert_allclose(CAR(CAR.centre), 0, atol=ROUNDING)
    # a turn of 0.05 about -y
    assert CAR.angle == pytest.approx(np.degrees(0.05))
    np.testing.assert_allclose(CAR.quaternion, [0, -np.sin(0.025), 0, np.cos(0.025)], atol=ROUNDING)
    fitted = fit_motion(x, CAR(x), np.arange(5.0))
    np.testing.assert_allclose(fitted.matrix, CAR.matrix, atol=ROUNDING)


def test_groups_of_one_motion_are_one_component(seg):
    # the last group has the camera's motion again
    group = np.array([0, 0, 0, 0, 0, 0, 5, 5, 0, 0, 0, 7])
    soup = soup_of([CAR if g == 5 else CAMERA for g in group])
    guess = group == 7
    components = find_components(soup, seg, group, K, K, guess)
    assert len(components) == 2
    np.testing.assert_array_equal(components.of_superpixel, group == 5)
    np.testing.assert_array_equal(components.of_pixel, (group == 5)[seg.labels])
    np.testing.assert_allclose(components.camera.matrix, CAMERA.matrix, atol=ROUNDING)
    np.testing.assert_allclose(components[1].motion.matrix, CAR.matrix, atol=ROUNDING)
    np.testing.assert_allclose(components.own_motion(0).matrix, np.eye(4), atol=ROUNDING)
    still = components.own_motion(1)(np.ones(3))
    np.testing.assert_allclose(CAMERA(still), CAR(np.ones(3)), atol=ROUNDING)
    assert [c.superpixels for c in components] == [10, 2]
    assert [c.pixels for c in components] == [4000, 800]
    assert components[0].interpolated == pytest.approx(0.1)
    assert max(c.residual_px for c in components) < 1e-6
    assert components[1].centre[2] == pytest.approx(2)


def test_one_stray_superpixel_keeps_its_components_motion(seg):
    soup = soup_of([*[CAMERA] * 11, CAR])
    components = find_components(soup, seg, np.zeros(12, int), K, K)
    assert len(components) == 1
    # the re-weighted fit is that of the majority, up to its least distance of 0.05 px
    np.testing.assert_allclose(components.camera.matrix, CAMERA.matrix, atol=1e-3)


def test_the_first_group_is_the_background_and_large_ones_follow(seg):
    group = np.repeat([0, 1, 2], [4, 3, 5])
    soup = soup_of([(CAMERA, CAR, CAR.inverse)[g] for g in group])
    components = find_components(soup, seg, group, K, K)
    np.testing.assert_array_equal(components.of_superpixel, np.array([0, 2, 1])[group])
    np.testing.assert_allclose(components.camera.matrix, CAMERA.matrix, atol=ROUNDING)


def test_a_component_that_is_not_rigid_has_a_large_residual(seg):
    rng = np.random.default_rng(1)
    motions = [RigidMotion(np.eye(3), t) for t in rng.normal(0, 0.1, (12, 3))]
    components = find_components(soup_of(motions), seg, np.zeros(12, int), K, K)
    # translations of 0.1 at depth 2 are 5 pixels
    assert 1 < components[0].residual_px < 15


def test_a_component_behind_the_camera_takes_its_first_motion(seg):
    group = np.r_[np.zeros(11, int), 1]
    back = RigidMotion(np.eye(3), np.array([0.0, 0.0, -5.0]))
    components = find_components(soup_of([*[CAMERA] * 11, back]), seg, group, K, K)
    np.testing.assert_allclose(components[1].motion.matrix, back.matrix)
    assert np.isnan(components[1].residual_px)
