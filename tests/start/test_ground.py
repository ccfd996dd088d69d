"""Nothing lies below the ground, and nothing floats above it."""

import numpy as np
import pytest
from helpers_start import facing, flow_of, squares

from soup_nlp.geometry.camera import rays
from soup_nlp.geometry.soup import Soup
from soup_nlp.start.ground import ground, off_ground, on_ground
from soup_nlp.start.views import FlowFit

HIGH, FAR = 1.5, 30.0
"""Height of the camera, and distance of a wall."""
SIDE, ROWS, COLUMNS = 8, 20, 30
K = np.array([[150.0, 0, SIDE * COLUMNS / 2], [0, 150.0, SIDE * ROWS / 2], [0, 0, 1]])
ROW, COLUMN = np.divmod(np.arange(ROWS * COLUMNS), COLUMNS)
BODY = (ROW >= 9) & (ROW <= 13) & (COLUMN >= 10) & (COLUMN <= 14)
"""Superpixels of a car."""
ALL, SCENE = BODY | ~BODY, 0 * ROW
"""Every superpixel, and all as one component."""


@pytest.fixture(scope="module")
def flow() -> FlowFit:
    """Square superpixels of a camera above a road."""
    return flow_of(squares(ROWS, COLUMNS, SIDE, neighbours=8), K=K)


def street(flow: FlowFit, car: float = 1.0) -> np.ndarray:
    """Depth of a road that ends at a wall, with a car `car` times as far as it stands."""
    y = flow.views.anchor[:, 1]
    Z = np.where(y > HIGH / FAR, HIGH / np.maximum(y, 1e-6), FAR)
    foot = HIGH / rays(K, np.array([[0.0, 14 * SIDE]]))[0, 1]
    return np.where(BODY, car * foot, Z)


def moving(Z: np.ndarray) -> Soup:
    """Planes parallel to the image at these depths; the camera moves by 1."""
    return facing(Z, np.array([0.0, 0.0, -1.0]))


def lift(flow, Z, reliable, component):
    scene = component * ALL == SCENE
    floor = ground(flow, 1 / Z, reliable & scene)
    soup, lifted = on_ground(flow, moving(Z), floor, reliable, component * ALL)
    np.testing.assert_array_equal(lifted, ~np.isclose(soup.depth_at(flow.views.anchor), Z))
    return soup


def test_unknown_depth_comes_up_to_the_road(flow):
    ray, Z = flow.views.anchor, street(flow)
    lost = (ray[:, 1] > 0.2) & (ray[:, 0] > 0.5)
    assert 0.02 < lost.mean() < 0.2
    depth = np.where(lost, 40.0, Z)
    soup = lift(flow, depth, ~lost, SCENE)
    np.testing.assert_allclose(soup.depth_at(ray), Z, rtol=1e-9)
    # the scene keeps its motion
    np.testing.assert_allclose(soup.translation, moving(depth).translation, rtol=1e-12)


@pytest.mark.parametrize("why", ["below", "steep", "nothing level"])
def test_without_a_ground_nothing_moves(flow, why):
    ray, Z = flow.views.anchor, street(flow)
    if why == "below":
        # a table: a tenth of the reliable area is the floor beside it
        Z = np.where((ray[:, 1] > 0.1) & (ray[:, 0] > 0.4), 2 * Z, Z)
    elif why == "steep":
        Z = 5 / (1 + 0.8 * ray[:, 1])
    else:
        Z = np.random.default_rng(0).uniform(3, 30, len(Z))
    assert (ground(flow, 1 / Z, ALL) == 0).all()


def test_reliable_depth_stays_below(flow):
    """A ditch with reliable depth is kept."""
    ray, Z = flow.views.anchor, street(flow)
    ditch = (ray[:, 1] > 0.3) & (np.abs(ray[:, 0]) < 0.1)
    assert 0 < ditch.mean() < 0.05
    depth = np.where(ditch, 1.5 * Z, Z)
    soup = lift(flow, depth, ALL, SCENE)
    np.testing.assert_allclose(soup.depth_at(ray), depth, rtol=1e-12)


def test_wrong_flow_below_the_road_is_lifted(flow):
    """Its depth is reliable, but differs from one superpixel to the next."""
    ray, Z = flow.views.anchor, street(flow)
    wrong = (ray[:, 1] > 0.25) & (np.abs(ray[:, 0]) < 0.2)
    assert 0.05 < wrong.mean() < 0.2
    far = np.random.default_rng(0).uniform(1.5, 20, len(Z))
    soup = lift(flow, np.where(wrong, far * Z, Z), ALL, SCENE)
    np.testing.assert_allclose(soup.depth_at(ray), Z, rtol=1e-9)


@pytest.mark.parametrize("car", [0.8, 1.0, 2.0])
@pytest.mark.parametrize("number", [0, 1])
def test_the_distance_of_a_region_from_the_ground_is_told(flow, car, number):
    """Whether it is too near or too far, and whichever component the ground is."""
    component = np.where(BODY, 1 - number, number)
    soup = moving(street(flow, car))
    off = off_ground(flow, soup, component, ALL)
    np.testing.assert_allclose(off[BODY], -np.log(car), atol=0.02)
    # the wall is the scene, and the road no region
    np.testing.assert_allclose(off[~BODY], 0.0, atol=1e-12)
    assert (off_ground(flow, soup, component, BODY) == 0).all()


def test_a_quarter_of_the_image_may_be_a_resting_table(flow):
    table = (ROW >= 4) & (ROW <= 16) & (COLUMN >= 5) & (COLUMN <= 24)
    assert table.mean() > 0.25
    edge = flow.views.anchor[17 * COLUMNS, 1]
    soup = moving(np.where(table, 0.5 * HIGH / edge, street(flow)))
    assert (off_ground(flow, soup, SCENE, ALL) == 0).all()
    # what moves is no table
    off = off_ground(flow, soup, table.astype(int), ALL)
    np.testing.assert_allclose(off[table], np.log(2), atol=0.1)
