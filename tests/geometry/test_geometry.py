"""Cameras, rotations, homographies, soups and reconstructions against hand answers and truth."""

import numpy as np
import pytest
from helpers_model import K_REF, motion, plane_soup, plane_world, random_soup
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from soup_nlp.data.scenes.catalogue import placed
from soup_nlp.geometry import camera, rotation
from soup_nlp.geometry.plane import (
    about_anchor,
    at_anchor,
    inverse_depth,
    normal_and_distance,
    tilt_to_camera,
)
from soup_nlp.geometry.soup import Soup, nearest_on_top, reconstruct
from soup_nlp.geometry.surface import at_jumps, joined

unit = st.floats(-1.0, 1.0)
vectors = hnp.arrays(float, (5, 3), elements=unit)
pixels = hnp.arrays(float, (6, 2), elements=st.floats(-50, 700))
focals = st.floats(20.0, 2000.0)


# --- camera ------------------------------------------------------------------------------------


@given(pixels, focals, focals, st.floats(-100, 900), st.floats(-100, 900), st.floats(-5, 5))
def test_rays_and_project_are_inverse_of_each_other(uv, fx, fy, cx, cy, skew):
    K = camera.intrinsics(fx, fy, cx, cy)
    K[0, 1] = skew
    r = camera.rays(K, uv)
    assert (r[..., 2] == 1).all()
    np.testing.assert_allclose(r @ K.T, np.column_stack([uv, np.ones(6)]), atol=1e-9)
    for depth in (0.1, 7.0):
        np.testing.assert_allclose(camera.project(K, depth * r), uv, atol=1e-9)


# --- rotation ----------------------------------------------------------------------------------


def assert_rotations(R, tolerance=1e-12):
    np.testing.assert_allclose(
        np.swapaxes(R, -1, -2) @ R, np.broadcast_to(np.eye(3), R.shape), atol=tolerance
    )
    np.testing.assert_allclose(np.linalg.det(R), 1.0, atol=tolerance)


@given(vectors, st.floats(0.0, 3.1))
def test_exp_and_log_are_inverse_of_each_other(w, angle):
    length = np.linalg.norm(w, axis=1, keepdims=True)
    w = np.where(length > 1e-6, angle * w / np.maximum(length, 1e-6), 0.0)
    R = rotation.exp(w)
    assert_rotations(R)
    np.testing.assert_allclose(rotation.log(R), w, atol=1e-6)
    np.testing.assert_allclose(rotation.exp(rotation.log(R)), R, atol=1e-9)


@given(vectors)
def test_cayley_rotates_by_twice_the_arc_tangent(w):
    length = np.linalg.norm(w, axis=1, keepdims=True)
    axis = w / np.where(length > 0, length, 1.0)
    np.testing.assert_allclose(
        rotation.cayley(2 * w), rotation.exp(2 * np.arctan(length) * axis), atol=1e-12
    )


@pytest.mark.parametrize("angle", [0.0, 0.3, 2.0])
def test_the_right_jacobian_is_the_derivative_of_exp(angle):
    w, d = angle * np.array([0.6, -0.48, 0.64]), 1e-6 * np.array([1.0, 2.0, -1.5])
    step = rotation.log(rotation.exp(w).T @ rotation.exp(w + d))
    np.testing.assert_allclose(step, rotation.right_jacobian(w) @ d, rtol=0, atol=1e-11)


@given(hnp.arrays(float, (4, 3, 3), elements=unit), hnp.arrays(float, (8, 3), elements=unit))
def test_nearest_is_a_rotation_and_no_other_is_nearer(M, w):
    R = rotation.nearest(M)
    assert_rotations(R)
    gap = np.linalg.norm(M - R, axis=(1, 2))
    turned = rotation.exp(3 * w)[:, None] @ R[None]
    assert (np.linalg.norm(M[None] - turned, axis=(2, 3)) >= gap - 1e-9).all()


# --- planes ------------------------------------------------------------------------------------


def test_forms_of_a_plane_invert_and_give_depth():
    soup, ray = random_soup(0, 7), np.tile(camera.rays(K_REF, [20.0, 11.0]), (7, 1))
    anchor = camera.rays(K_REF, np.random.default_rng(1).uniform(0, 48, (7, 2)))
    m = inverse_depth(soup.n, soup.distance)
    np.testing.assert_allclose(1 / np.sum(m * ray, axis=1), soup.depth_at(ray), rtol=1e-12)
    for back, expected in zip(normal_and_distance(m), (soup.n, soup.distance)):
        np.testing.assert_allclose(back, expected, rtol=1e-12, atol=1e-14)
    Z, g = at_anchor(m, anchor)
    np.testing.assert_allclose(Z, soup.depth_at(anchor), rtol=1e-12)
    np.testing.assert_allclose(about_anchor(Z, g, anchor), m, rtol=1e-12, atol=1e-14)


def test_planes_are_tilted_about_their_anchors_hardly_more_than_until_they_are_visible():
    anchor = np.tile(camera.rays(K_REF, [20.0, 30.0]), (9, 1))
    rays = anchor[:, None] + [[0.1, 0.1, 0], [-0.1, 0.1, 0], [0.1, -0.1, 0], [-0.1, -0.1, 0]]
    # eight so steep that a corner is behind the plane's horizon; a gentle one
    g = np.append(np.linspace(1.0, 3.0, 8)[:, None] * [15.0, 5.0], [[0.5, 0.2]], axis=0)
    Z = np.linspace(2.0, 3.0, 9)
    n, D = normal_and_distance(about_anchor(Z, g, anchor))
    soup = Soup(np.full(9, 0.5), n, 2 * D, np.tile(np.eye(3), (9, 1, 1)), anchor)
    done = tilt_to_camera(soup, anchor, rays, 1e-3)
    np.testing.assert_allclose(done.translation, 0.5 * anchor, rtol=1e-12)
    assert (-np.einsum("nc,nvc->nv", done.n, rays) > 1e-3 - 1e-6).all()
    np.testing.assert_array_equal(done.n[8], soup.n[8])
    depth, slope = at_anchor(inverse_depth(done.n, done.distance), anchor)
    np.testing.assert_allclose(depth, Z, rtol=1e-12)
    np.testing.assert_allclose(slope[:8, 0] / slope[:8, 1], 3.0)
    steeper, _ = normal_and_distance(about_anchor(depth, slope / 0.7, anchor))
    assert (-np.einsum("nc,nvc->nv", steeper, rays).max(axis=1) < 1e-3)[:8].all()


# --- soup --------------------------------------------------------------------------------------

GRID = camera.rays(K_REF, camera.pixel_grid(48, 64)[::9, ::9].reshape(-1, 2))


def test_depth_and_motion_by_hand():
    # plane z = 2 seen at 45 degrees: depth is z, not the distance along the ray
    normal, quarter = np.array([[0, 0, -1.0]]), np.array([[[0, -1.0, 0], [1, 0, 0], [0, 0, 1]]])
    soup = Soup(np.array([0.5]), normal, np.array([4.0]), quarter, np.array([[2.0, 0, 0]]))
    ray, X, Y = np.array([[[1.0, 0, 1]], [[2.0, 0, 2]], [[1.0, 2, 2]]])
    # also of several rays each
    for several in (np.s_[:], np.s_[:, None]):
        np.testing.assert_allclose(soup.depth_at(ray[several]), X[several][..., 2])
        np.testing.assert_allclose(soup.points(ray[several]), X[several])
        np.testing.assert_allclose(soup.moved(X[several]), Y[several])


@given(st.integers(0, 10_000), st.floats(1e-3, 1e3))
def test_normalised_knows_no_gauge_and_no_scale(seed, scale):
    soup = random_soup(seed, 5)
    rng = np.random.default_rng(seed)
    c = rng.uniform(0.1, 10.0, 5)
    twin = Soup(scale * c * soup.lam, soup.n, soup.d / c, soup.R, soup.t / c[:, None])
    share = rng.dirichlet(np.ones(5)) if seed % 2 else None
    a, b = soup.normalised(share), twin.normalised(share)
    np.testing.assert_allclose(a.lam.sum(), 1.0, rtol=1e-14)
    for name in ("lam", "d", "n", "R", "t"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=1e-11, atol=1e-12)
    # the same shape: depth ratios and motions relative to depth do not change
    ray = np.tile(GRID[3], (5, 1))
    ratio = a.depth_at(ray) / soup.depth_at(ray)
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-12)
    np.testing.assert_allclose(a.translation, ratio[0] * soup.translation, rtol=1e-11, atol=1e-14)
    if share is None:
        np.testing.assert_allclose(a.distance.mean(), 1.0, rtol=1e-12)
    else:
        np.testing.assert_allclose(a.lam, share * a.distance, rtol=1e-12)


# --- reconstruction ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("pose", "move"),
    [
        (placed(0, 0, 3.0), motion((0, 0, 0), (0.2, 0, 0))),
        (placed(0, 0, 2.0, yaw=30, pitch=-15), motion((1.0, -2.0, 0.5), (0.05, -0.02, 0.1))),
    ],
)
def test_reconstruction_of_a_rendered_plane_is_exact(pose, move):
    pair = plane_world(pose, move)
    truth = pair.truth
    height, width = pair.size
    labels = (np.arange(width) * 4 // width)[None].repeat(height, 0).astype(np.int32)
    rec = reconstruct(plane_soup(pose, move, 4), labels, pair.K_ref, pair.K_next)
    np.testing.assert_allclose(rec.depth_ref, truth.depth_ref, rtol=1e-12)
    np.testing.assert_allclose(rec.points_next - rec.points_ref, truth.scene_flow, atol=1e-12)
    np.testing.assert_allclose(rec.flow, truth.flow, atol=1e-9)
    seen = np.isfinite(rec.depth_next)
    assert 0.85 < seen.mean() <= 1
    # splatting rounds to whole pixels: depth is right up to the slope across two of them
    slope = max(np.abs(np.diff(truth.depth_next, axis=a)).max() for a in (0, 1))
    assert np.abs(rec.depth_next - truth.depth_next)[seen].max() <= 4 * slope + 1e-9
    assert "covered" in str(rec)


def test_pixels_that_a_plane_does_not_face_have_no_depth():
    n = np.array([[np.sin(1.4), 0.0, -np.cos(1.4)]])
    soup = Soup(np.ones(1), n, np.ones(1), np.eye(3)[None], np.zeros((1, 3)))
    K = camera.intrinsics(20.0, 20.0, 15.5, 11.5)
    labels = np.zeros((24, 32), np.int32)
    rec = reconstruct(soup, labels, K, K)
    facing = -camera.rays(K, camera.pixel_grid(24, 32)) @ n[0]
    np.testing.assert_array_equal(np.isnan(rec.depth_ref), facing <= 1e-6)
    assert 0 < np.isnan(rec.depth_ref).mean() < 1
    assert (rec.depth_ref[facing > 1e-6] > 0).all()


def splat_depth(target, z, size):
    source = nearest_on_top(target, z, size)
    return np.where(source >= 0, z.ravel()[source], np.nan)


def test_the_nearest_surface_wins_the_splat():
    target = np.array([[[2.0, 1.0], [2.2, 1.1], [2.0, 1.0], [0.0, 3.0]]])
    depth = splat_depth(target, np.array([[5.0, 3.0, 4.0, -1.0]]), (4, 5))
    assert depth[1, 2] == 3.0
    # a point behind the camera is not drawn, and no point lands far away
    assert np.isnan(depth[3, 0])
    assert np.isnan(depth[0]).all()
    # points outside or not finite are not drawn
    target = np.array([[[-5.0, 0.0], [np.nan, 1.0], [100.0, 1.0], [1.0, 1.0]]])
    depth = splat_depth(target, np.ones((1, 4)), (3, 3))
    assert np.isfinite(depth).sum() == 4
    assert depth[1, 1] == depth[2, 2] == 1.0


@given(st.integers(0, 1000))
def test_splat_has_no_cracks_below_twofold_stretch(seed):
    rng = np.random.default_rng(seed)
    scale = rng.uniform(1.0, 1.9)
    target = camera.pixel_grid(12, 12) * scale + rng.uniform(0, 1, 2)
    depth = splat_depth(target, np.full((12, 12), 2.0), (24, 24))
    last = int(11 * scale)
    assert np.isfinite(depth[1:last, 1:last]).all()


def test_both_sides_of_a_break_of_the_surface_are_at_a_jump():
    right, below = np.ones((3, 3), bool), np.ones((2, 4), bool)
    right[0, 1] = below[1, 3] = False
    expected = np.zeros((3, 4), bool)
    expected[0, 1:3] = expected[1:, 3] = True
    np.testing.assert_array_equal(at_jumps(right, below), expected)


def test_a_surface_breaks_where_depth_jumps():
    labels, group = np.array([[0, 0, 1, 1]]), np.zeros((1, 4), int)
    planes, detail = np.array([[0, 0, 0.5], [0, 0, 0.48]]), np.array([[0, 0.2, 0.2, 0.25]])
    # 22 % within a superpixel, 4 % between two planes, 5 % within
    right, below = joined(planes, labels, group, K_REF, detail)
    np.testing.assert_array_equal(right, [[False, True, True]])
    assert below.shape == (0, 4)
    right, _ = joined(planes, labels, np.array([[0, 0, 1, 1]]), K_REF, detail)
    np.testing.assert_array_equal(right, [[False, False, True]])
