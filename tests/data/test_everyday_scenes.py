"""Rendered everyday scenes: exact truth, and the parallax and moving bodies of each kind."""

from functools import cache
from itertools import combinations

import numpy as np
import pytest

from soup_nlp.data.pair import Pair
from soup_nlp.data.scenes.catalogue import render_scene
from soup_nlp.data.scenes.everyday import LAYOUTS
from soup_nlp.data.scenes.shapes import Ellipsoid
from soup_nlp.data.scenes.things import SceneBuilder
from soup_nlp.geometry import camera

WIDTH, HEIGHT = 160, 120
ALL = list(LAYOUTS)
PARALLAX = {"swing": (1, 7), "jam": (0.05, 2), "facade": (1.5, 7), "corridor": (4, 14)}
"""Bounds of the background's median parallax, px at 640 columns."""
MOVES = {"handheld": (0.03, 0.2), "swing": (0.1, 0.32), "jam": (0.3, 0.65), "standing": (0.05, 0.3)}
"""Bounds of the moving share of the image; of the other kinds, only `pan` at odd seeds has one."""


@cache
def pair(name: str, seed: int = 0) -> Pair:
    return render_scene(name, seed, WIDTH, HEIGHT)


def background_parallax(p: Pair) -> np.ndarray:
    """Flow (N,) of the static background beyond the camera's rotation, px at 640 columns."""
    uv, R = camera.pixel_grid(*p.size), p.truth.motions[0, :3, :3]
    turned = camera.project(p.K_next, camera.rays(p.K_ref, uv) @ R.T) - uv
    left = np.linalg.norm(p.truth.flow - turned, axis=-1)
    return left[p.truth.components == 0] * 640 / WIDTH


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("name", ALL)
def test_each_kind_has_its_parallax_and_moving_bodies(name, seed):
    p = pair(name, seed)
    far = background_parallax(p)
    if name in ("pan", "standing"):
        assert far.max() < 1e-6
    elif name == "handheld":
        size = np.linalg.norm(p.truth.motions[0, :3, 3]) / np.median(p.truth.depth_ref)
        assert 0.008 < size < 0.035
    else:
        least, most = PARALLAX[name]
        assert least < np.median(far) < most
    moves = (p.truth.components > 0).mean()
    least, most = (0.01, 0.15) if name == "pan" and seed % 2 else MOVES.get(name, (0, 0))
    assert least <= moves <= most
    assert np.bincount(p.truth.components.ravel()).min() > 0.002 * p.truth.components.size
    if name == "standing":
        np.testing.assert_allclose(p.truth.motions[0], np.eye(4), rtol=0, atol=1e-12)
    if name == "pan":
        turn = np.degrees(np.arccos((np.trace(p.truth.motions[0, :3, :3]) - 1) / 2))
        assert 1.9 < turn < 6.5


@pytest.mark.parametrize("name", ALL)
def test_seeds_differ_in_depth_and_camera_motion(name):
    for a, b in combinations([pair(name, seed).truth for seed in range(6)], 2):
        assert abs(np.log(a.depth_ref / b.depth_ref)).mean() > 0.02
        assert name == "standing" or abs(a.motions[0] - b.motions[0]).max() > 1e-3


def test_limbs_of_a_person_move_differently():
    body = SceneBuilder(np.random.default_rng(0)).person(0, 3, 1.7, 40)
    assert body.bends
    shifts = [p.motion @ p.scene_from_part @ [0, 0, 0, 1] for p in body.parts]
    shifts = np.array(shifts) - [p.scene_from_part @ [0, 0, 0, 1] for p in body.parts]
    assert np.ptp(shifts[:, :3], axis=0).max() > 0.03


def test_an_ellipsoid_by_hand():
    shape, eye = Ellipsoid((1.0, 2.0, 3.0)), np.array([0.0, 0.0, -5.0])
    ahead = np.array([[0.0, 0.0, 1.0], [0.5, 0.0, 1.0]])
    np.testing.assert_allclose(shape.intersect(eye, ahead), [2, np.inf])
    at = np.array([[0.0, 0.0, -3.0], [1.0, 0.0, 0.0], [0.0, np.sqrt(2), 1.5 * np.sqrt(2)]])
    normal = [[0, 0, -1], [1, 0, 0], np.array([0, 3, 2]) / np.sqrt(13)]
    np.testing.assert_allclose(shape.normals(at), normal, atol=1e-12)
