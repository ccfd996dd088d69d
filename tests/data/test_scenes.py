"""Rendered scenes: exact truth, images that agree with it, and what each kind moves."""

from functools import cache

import numpy as np
import pytest
from scipy import ndimage

from benchmarks.everyday import LAYOUTS
from soup_nlp.data.inputs import SceneInput
from soup_nlp.data.pair import Pair
from soup_nlp.data.scenes import catalogue
from soup_nlp.data.scenes.catalogue import placed, render_scene
from soup_nlp.data.scenes.raycast import Body, Part, Scene, render
from soup_nlp.data.scenes.surfaces import Box, Ellipsoid, Plane, Sheet, Texture
from soup_nlp.errors import ConfigError, DataError
from soup_nlp.geometry import camera

SCENES = catalogue.LAYOUTS
FIRST = [name for name in SCENES if name not in LAYOUTS]
"""Scenes of the catalogue itself; `LAYOUTS` are the everyday ones."""
RIGID = {"sheet": (0.01, 0.5), "banner": (0.5, 0.9), "handheld": (0.8, 1), "standing": (0.7, 1)}
"""Bounds of the share of rigid pixels in scenes with bending bodies."""
WIDTH, HEIGHT = 160, 68
SMALL = (128, 96)
QUICK = "street", "banner"
EVERY = [*QUICK, *(pytest.param(n, marks=pytest.mark.slow) for n in SCENES if n not in QUICK)]
SIZES = dict.fromkeys(SCENES, (WIDTH, HEIGHT)) | dict.fromkeys(LAYOUTS, SMALL)
GREY = Texture(((0.5, 0.5, 0.5), (0.4, 0.4, 0.4)), cell=0.3)


@cache
def pair(name: str, seed: int = 0, size: tuple[int, int] | None = None) -> Pair:
    return render_scene(name, seed, *(size or SIZES[name]))


def points(p: Pair) -> np.ndarray:
    uv = camera.pixel_grid(*p.size)
    return p.truth.depth_ref[..., None] * camera.rays(p.K_ref, uv)


# --- exactness of the truth -------------------------------------------------------------------


@pytest.mark.parametrize("name", EVERY)
def test_depth_motion_and_flow_agree_exactly(name):
    p = pair(name)
    T, uv = p.truth, camera.pixel_grid(*p.size)
    moved = points(p) + T.scene_flow
    np.testing.assert_allclose(camera.project(p.K_next, moved), uv + T.flow, rtol=0, atol=1e-6)
    # motions are rigid, and NaN for bending bodies only
    rigid = np.isfinite(T.motions).all(axis=(1, 2))
    assert rigid.tolist() == [True] + [name not in RIGID] * (len(rigid) - 1)
    R = T.motions[rigid, :3, :3]
    identity = np.broadcast_to(np.eye(3), R.shape)
    np.testing.assert_allclose(R @ R.transpose(0, 2, 1), identity, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(R), 1)
    M = T.motions[T.components]
    rigidly = np.einsum("hwij,hwj->hwi", M[..., :3, :3], points(p)) + M[..., :3, 3]
    rigid = np.isfinite(rigidly).all(axis=-1)
    least, most = RIGID.get(name, (1, 1))
    assert least <= rigid.mean() <= most
    np.testing.assert_allclose(rigidly[rigid], moved[rigid], rtol=0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("name", FIRST)
def test_no_moved_point_lies_before_what_the_next_frame_shows(name):
    # with fewer pixels too many straddle an edge
    p = pair(name, 0, (240, 102))
    T = p.truth
    target = camera.pixel_grid(*p.size) + T.flow
    size = np.array(p.size[::-1])
    inside = ((target >= -1e-6) & (target <= size - 1 + 1e-6)).all(axis=-1)
    at, z = target[inside], (points(p) + T.scene_flow)[inside][:, 2]
    # inverse depth is linear on a plane
    got = 1 / ndimage.map_coordinates(1 / T.depth_next, at.T[::-1], order=1, mode="nearest")
    # the other pixels are hidden, or straddle an edge, where interpolation mixes two surfaces
    assert np.mean(abs(got - z) < 2e-3 * z) > 0.9
    near = ndimage.minimum_filter(T.depth_next, 3)  # nearest surface around the target
    u, v = np.round(at).astype(int).T
    assert np.mean(z < near[v, u] * (1 - 1e-4)) < 3e-3


def test_orbit_has_one_motion_and_street_three():
    M = pair("orbit").truth.motions
    assert len(M) > 3
    np.testing.assert_allclose(M, np.tile(M[0], (len(M), 1, 1)), atol=1e-12)
    assert np.linalg.norm(M[0, :3, 3]) > 0.05
    M = pair("street").truth.motions
    gaps = [np.linalg.norm(M[i] - M[j]) for i, j in ((0, 1), (0, 2), (1, 2))]
    assert min(gaps) > 0.05


def test_still_background_does_not_move():
    p = pair("still")
    T = p.truth
    np.testing.assert_allclose(T.motions[0], np.eye(4), atol=1e-12)
    assert abs(T.flow[T.components == 0]).max() < 1e-9
    assert np.linalg.norm(T.flow[T.components == 1], axis=-1).mean() > 1
    same = (T.components == 0) & (T.depth_ref == T.depth_next)
    change = np.abs(p.image_ref.astype(int) - p.image_next).max(axis=-1)
    assert np.mean(change[same] == 0) > 0.95  # the others are edge pixels of the moving body


# --- shapes -----------------------------------------------------------------------------------


@pytest.mark.parametrize("angle", [0.3, -0.1])
@pytest.mark.parametrize("curvature", [0.0, 1e-9, 1e-4, -0.8, 1.1])
def test_sheet_is_isometric_and_hit_where_it_is(curvature, angle):
    sheet = Sheet((0.6, 0.4), curvature, angle)
    rng = np.random.default_rng(0)
    a = np.zeros((500, 3))
    a[:, :2] = rng.uniform(-0.99, 0.99, (500, 2)) * sheet.half
    b = a + 1e-5 * np.c_[rng.standard_normal((500, 2)), np.zeros(500)]
    on = sheet.place(a)
    step = sheet.place(b) - on
    length = np.linalg.norm(step, axis=1)
    np.testing.assert_allclose(length, np.linalg.norm(a - b, axis=1), rtol=1e-6)
    np.testing.assert_allclose(sheet.material(on), a, atol=1e-12)
    across = np.einsum("ni,ni->n", step / length[:, None], sheet.normals(on))
    assert abs(across).max() < 1e-4
    eye = np.array([0.1, -0.1, -3.0])
    np.testing.assert_allclose(sheet.intersect(eye, on - eye), 1, atol=1e-9)
    beyond = sheet.place(a / np.abs(a / [0.6, 0.4, 1]).max(1)[:, None] * 1.01)
    assert np.isinf(sheet.intersect(eye, beyond - eye)).mean() > 0.95


def test_hits_by_hand():
    ahead = np.array([[0.0, 0.0, 1.0], [0.5, 0.0, 1.0]])
    eye, ball = np.array([0.0, 0.0, -5.0]), Ellipsoid((2.0, 2.0, 2.0))
    np.testing.assert_allclose(Plane().intersect(eye, ahead), [5, 5])
    np.testing.assert_allclose(Box((1.0, 1.0, 2.0)).intersect(eye, ahead), [3, np.inf])
    np.testing.assert_allclose(ball.intersect(eye, ahead), [3, np.inf])
    np.testing.assert_allclose(Box((1.0, 1.0, 2.0)).intersect(0 * eye, ahead), [2, 2])
    assert np.isinf(ball.intersect(-eye, ahead)).all()
    shape = Ellipsoid((1.0, 2.0, 3.0))
    np.testing.assert_allclose(shape.intersect(eye, ahead), [2, np.inf])
    at = np.array([[0.0, 0.0, -3.0], [1.0, 0.0, 0.0], [0.0, np.sqrt(2), 1.5 * np.sqrt(2)]])
    normal = [[0, 0, -1], [1, 0, 0], np.array([0, 3, 2]) / np.sqrt(13)]
    np.testing.assert_allclose(shape.normals(at), normal, atol=1e-12)


def test_points_that_pass_the_camera_have_no_flow():
    wall = Body((Part(Plane(), placed(0, 0, 9), GREY),))
    near = Body((Part(Box((0.2, 0.2, 0.1)), placed(0, 0, 1), GREY),), placed(0, 0, -2))
    K = camera.intrinsics(64, 64, 31.5, 23.5)
    T = render(Scene((wall, near), np.eye(4), np.eye(4)), K, 48, 64).truth
    assert np.isnan(T.flow[T.components == 1]).all()
    assert np.isfinite(T.flow[T.components == 0]).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_same_seed_same_bytes_other_seed_other_scene(name):
    a, c = pair(name, 1), pair(name, 0)
    # not from the cache of conftest.py
    b = render_scene.__wrapped__(name, 1, *SIZES[name])
    for what in ("image_ref", "image_next", "K_ref"):
        assert getattr(a, what).tobytes() == getattr(b, what).tobytes()
    assert a.truth.flow.tobytes() == b.truth.flow.tobytes()
    assert a.truth.depth_ref.tobytes() == b.truth.depth_ref.tobytes()
    assert a.image_ref.tobytes() != c.image_ref.tobytes()
    assert a.truth.flow.tobytes() != c.truth.flow.tobytes()


def test_the_camera_scales_with_the_width_or_height():
    for width, height, focal in ((160, 50, 160), (48, 65, 65 * 4 / 3)):
        p = pair("room", 0, (width, height))
        np.testing.assert_allclose(p.K_ref[0, 0], 0.8 * focal)
        np.testing.assert_allclose(p.K_ref[:2, 2], [(width - 1) / 2, (height - 1) / 2])
        assert p.size == p.truth.depth_ref.shape == (height, width)
        assert np.isfinite(p.truth.flow).all()


@pytest.mark.parametrize(
    ("key", "value"),
    [("scene", "stret"), ("width", 63), ("height", 47), ("height", 99.5), ("seed", -1)],
)
def test_a_scene_that_cannot_be_rendered_is_refused(key, value):
    with pytest.raises(ConfigError, match=key):
        SceneInput(**{"kind": "scene", "scene": "room", key: value})


def test_a_scene_goes_on_where_its_first_pair_ends():
    first, second = (render_scene("street", 0, 64, 48, frame=k) for k in (0, 1))
    np.testing.assert_allclose(first.truth.depth_next, second.truth.depth_ref, rtol=1e-9)
    # the same motion again
    np.testing.assert_allclose(first.truth.motions[0], second.truth.motions[0], atol=1e-12)
    # a body is shaded as in the first frame of its pair
    gap = np.abs(first.image_next.astype(float) - second.image_ref)
    assert gap.mean() < 1
    for name in ("sheet", "banner"):
        with pytest.raises(DataError, match="bends"):
            render_scene(name, 0, 96, 64, frame=1)
