"""Nothing lies below the ground, and nothing floats above it."""

import numpy as np
import pytest
from helpers_start import facing, flow_of, squares

from soup_nlp.geometry.camera import rays
from soup_nlp.geometry.soup import Soup
from soup_nlp.start.scales import ground, on_ground
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


@pytest.mark.parametrize(
    ("where", "least", "most", "depth", "known", "lifted"),
    [
        # unknown depth comes up to the road
        (lambda x, y: (y > 0.2) & (x > 0.5), 0.02, 0.2, lambda Z: 40.0, False, True),
        # a ditch with reliable depth is kept
        (lambda x, y: (y > 0.3) & (np.abs(x) < 0.1), 0, 0.05, lambda Z: 1.5 * Z, True, False),
        # reliable depth that differs from one superpixel to the next is wrong
        (
            lambda x, y: (y > 0.25) & (np.abs(x) < 0.2), 0.05, 0.2,
            lambda Z: np.random.default_rng(0).uniform(1.5, 20, len(Z)) * Z, True, True,
        ),
    ],
    ids=["unknown", "ditch", "wrong flow"],
)  # fmt: skip
def test_what_is_below_the_road_is_lifted(flow, where, least, most, depth, known, lifted):
    ray, Z = flow.views.anchor, street(flow)
    part = where(ray[:, 0], ray[:, 1])
    assert least < part.mean() < most
    below = np.where(part, depth(Z), Z)
    soup = lift(flow, below, ALL if known else ~part, SCENE)
    np.testing.assert_allclose(soup.depth_at(ray), *((Z, 1e-9) if lifted else (below, 1e-12)))
    # the scene keeps its motion
    np.testing.assert_allclose(soup.translation, moving(below).translation, rtol=1e-12)
