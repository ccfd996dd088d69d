"""Search along epipolar lines: path costs against their recursion, flow against the truth."""

import numpy as np
import pytest

from soup_nlp.data.flow.epipolar_search import (
    LARGE,
    OUTSIDE,
    SMALL,
    aggregated,
    descriptor,
    epipolar_flow,
    matching_cost,
    searched,
)
from soup_nlp.data.pair import Flow, Pair
from soup_nlp.data.scenes.catalogue import render_scene
from soup_nlp.geometry import rotation
from soup_nlp.geometry.camera import pixel_grid, rays
from soup_nlp.pipeline.case import search_again

WIDTH, HEIGHT = 320, 136
LOST, BELIEVED = np.s_[40:100, 60:120], np.s_[40:100, 180:240]


@pytest.fixture(scope="module")
def orbit() -> Pair:
    """A rigid scene with its true flow, which is wrong in a region that is not sure, and in one
    that is."""
    pair = render_scene("orbit", 0, WIDTH, HEIGHT)
    flow = np.nan_to_num(pair.truth.flow).astype(np.float32)
    sure = np.isfinite(pair.truth.flow).all(axis=2).astype(np.float32)
    flow[LOST], sure[LOST] = (40.0, 5.0), 0.2
    flow[BELIEVED], sure[BELIEVED] = (40.0, 5.0), 1.0
    return pair.with_flow(Flow(flow, sure, "dis"))


def motion(pair: Pair) -> tuple[np.ndarray, np.ndarray]:
    R, t = pair.truth.motions[0][:3, :3], pair.truth.motions[0][:3, 3]
    return R, t / np.linalg.norm(t)


def grey(image: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(image[..., 1])


def error(pair: Pair, uv: np.ndarray) -> np.ndarray:
    """Distance from the true flow, NaN where that is unknown or leads out of the image."""
    at = pixel_grid(*pair.size) + np.nan_to_num(pair.truth.flow, nan=1e6)
    inside = ((at > 4) & (at < np.array(pair.size[::-1]) - 5)).all(axis=2)
    return np.where(inside, np.linalg.norm(uv - pair.truth.flow, axis=2), np.nan)


def test_costs_along_paths_follow_their_recursion():
    cost = np.random.default_rng(0).integers(0, 17, (5, 6, 7)).astype(np.uint8)
    total = np.zeros(cost.shape)
    for dv, du in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        path = np.zeros(cost.shape)
        for v in range(5)[:: dv or 1]:
            for u in range(6)[:: du or 1]:
                path[v, u] = cost[v, u]
                if 0 <= v - dv < 5 and 0 <= u - du < 6:
                    q = path[v - dv, u - du]
                    for d in range(7):
                        beside = [q[k] + SMALL for k in (d - 1, d + 1) if 0 <= k < 7]
                        path[v, u, d] += min(q[d], *beside, q.min() + LARGE) - q.min()
        total += path
    np.testing.assert_array_equal(aggregated(cost), total)
    # the largest costs do not overflow
    most = np.full((9, 9, 4), 16, np.uint8)
    assert aggregated(most).min() == 4 * 16


def test_descriptors_do_not_depend_on_exposure():
    image = np.random.default_rng(1).integers(0, 100, (40, 50)).astype(np.uint8)
    assert np.mean(descriptor(image) == descriptor(image + 40)) > 0.99
    assert np.mean(descriptor(image) == descriptor(255 - image)) < 0.01
    zero = np.zeros((40, 50, 2), np.float32)
    assert matching_cost(image, image, zero).max() == 0
    assert matching_cost(image, image, zero + 1000).min() == OUTSIDE


@pytest.mark.parametrize("scene", ["orbit", "street"])
def test_flow_of_a_known_motion_is_found(scene):
    """The camera goes around, and ahead."""
    pair = render_scene(scene, 0, WIDTH, HEIGHT)
    R, t = motion(pair)
    images = grey(pair.image_ref), grey(pair.image_next)
    off = error(pair, epipolar_flow(*images, R, t, pair.K_ref, pair.K_next))
    off = off[(pair.truth.components == 0) & np.isfinite(off)]
    assert np.median(off) < 0.2
    assert np.mean(off < 1) > 0.85


def test_what_is_not_sure_is_searched_and_what_is_sure_stays(orbit: Pair):
    found = searched(orbit, *motion(orbit))
    off = error(orbit, found.uv)[LOST]
    off = off[np.isfinite(off)]
    assert np.mean(off < 1) > 0.9
    assert np.median(found.confidence[LOST]) > 0.9
    sure = orbit.flow.confidence > 0.5
    np.testing.assert_array_equal(found.uv[sure], orbit.flow.uv[sure])
    np.testing.assert_array_equal(found.confidence[sure], orbit.flow.confidence[sure])
    assert (found.uv[BELIEVED] == orbit.flow.uv[BELIEVED]).all()


def test_pieces_without_a_sure_window_stay(orbit: Pair):
    """Lines of three pixels are no window."""
    uv, sure = orbit.truth.flow.astype(np.float32), np.ones(orbit.size, np.float32)
    uv[~np.isfinite(uv)] = 0.0
    for v in range(10, HEIGHT - 10, 20):
        uv[v : v + 3], sure[v : v + 3] = (40.0, 5.0), 0.2
    pair = orbit.with_flow(Flow(uv, sure, "dis"))
    np.testing.assert_array_equal(searched(pair, *motion(pair)).uv, uv)


def test_the_camera_motion_is_that_of_the_flow(orbit: Pair):
    off = error(orbit, search_again(orbit).uv)[LOST]
    assert np.mean(off[np.isfinite(off)] < 1) > 0.85


@pytest.mark.parametrize("turn", [0.0, 0.02])
def test_a_camera_that_rests_or_turns_has_no_lines(orbit: Pair, turn):
    rng, grid = np.random.default_rng(0), pixel_grid(*orbit.size)
    ahead = rays(orbit.K_ref, grid) @ rotation.exp(np.array([0.0, turn, 0.0])).T
    uv = (ahead / ahead[..., 2:]) @ orbit.K_next[:2].T - grid
    uv = (uv + rng.normal(0, 0.1, uv.shape)).astype(np.float32)
    sure = np.ones(orbit.size, np.float32)
    uv[LOST], sure[LOST] = (40.0, 5.0), 0.2
    pair = orbit.with_flow(Flow(uv, sure, "dis"))
    assert search_again(pair) is pair.flow
    blind = orbit.with_flow(Flow(uv, 0 * sure, "dis"))
    assert search_again(blind) is blind.flow
