"""The linear program of scales: its minimum, what decides a scale; the ground."""

import numpy as np
import pytest
from helpers_start import facing, flow_of, squares

from soup_nlp.geometry import camera
from soup_nlp.geometry.soup import Soup
from soup_nlp.start.regions import ORIGINS, TOO_FAST
from soup_nlp.start.scales import (
    FREE_DISPLACEMENT,
    LEAST_STEP_IN_FRONT,
    Rows,
    ground,
    held,
    minimum,
    on_ground,
    scaled,
)
from soup_nlp.start.views import FlowFit

K = camera.intrinsics(50.0, 50.0, 15.5, 7.5)
HANGS = [[0] * 5, [0, 0, 1, 0, 0], [0] * 5, [0] * 5]
STANDS = [[0] * 5, [0, 0, 1, 0, 0], [0, 0, 1, 0, 0], [0] * 5]
CUT_OFF = [[0] * 5, [0, 0, 1, 0, 0], [0, 0, 1, 0, 0], [0, 0, 1, 0, 0]]


def found(z, component, far=0.5, floor=0.0, order=None, **options):
    """Log scale and origin of component 1, whose planes are at depth 1 in its own unit.

    There it moves by `far` where the scene moves by 1.
    """
    label = np.ravel(component)
    flow = flow_of(squares(*np.shape(component)), K=K, **options)
    moved = np.where(label, far, 1.0)[:, None] * [1.0, 0.0, 0.0]
    soup = facing(np.where(label == 1, 1.0, np.ravel(z)), moved)
    says = np.zeros(len(flow.seg.pairs)) if order is None else order(label, flow.seg)
    scale, origin = scaled(flow, soup, label, says, floor=np.full(len(soup), floor))
    assert (scale[label == 0] == 1).all()
    assert (origin[label == 0] == ORIGINS.index("reference")).all()
    return float(np.log(scale[label == 1][0])), ORIGINS[origin[label == 1][0]]


def cost(x, r: Rows) -> float:
    off = x[r.a] - x[r.b] - r.value
    return float(np.sum(r.up * np.maximum(off, 0) + r.down * np.maximum(-off, 0)))


def test_the_minimum_is_one():
    rng = np.random.default_rng(0)
    a, b = rng.integers(0, 4, (2, 40))
    value, up, down = rng.normal(size=40), rng.random(40), rng.random(40)
    r = Rows(a, b, value, up, down, ORIGINS.index("outline"))
    x, origin = minimum(4, [r])
    assert x[0] == 0
    assert origin[0] == ORIGINS.index("reference")
    assert (origin[1:] == ORIGINS.index("outline")).all()
    for step in (1e-3, 0.1, 1.0):
        for _ in range(50):
            other = x + step * rng.normal(size=4) * [0, 1, 1, 1]
            assert cost(other, r) >= cost(x, r) - 1e-9


def test_what_is_too_fast_covers_all_that_it_touches():
    label = np.ravel(CUT_OFF)
    flow = flow_of(squares(4, 5), K=K)
    soup, origin = facing(np.where(label, 1.0, 8.0), np.ones(3)), np.where(label, TOO_FAST, 0)
    ends = label[flow.seg.pairs]
    none = np.zeros(len(ends))
    order = held(flow, soup, label, origin, none, none)
    np.testing.assert_array_equal(order, ends[:, 1] - ends[:, 0])
    assert held(flow, soup, label, 0 * origin, none, none) is None


def covers(label, seg):
    """Component 1 covers all that it touches."""
    ends = label[seg.pairs]
    return 0.9 * (ends[:, 1] - ends[:, 0])


def wall(*floor, rows=4):
    """Depth 8 everywhere but in the lowest rows, of these depths."""
    return np.repeat([8.0] * (rows - len(floor)) + [*floor], 5).reshape(rows, 5)


SLOW = {"far": 1e-3}
"""Moves hardly at all beside the scene."""


@pytest.mark.parametrize(
    ("z", "component", "options", "origin", "expected"),
    [
        pytest.param(wall(2.0), STANDS, {}, "contact below", np.log(2), id="stands on the ground"),
        pytest.param(
            np.full((3, 5), 4.0), HANGS[:3], {"upright": False},
            "outline", np.log(4), id="before a wall, not behind it",
        ),
        # by contact with the wall it would move eight times as far as the scene
        pytest.param(
            wall(), CUT_OFF, {"far": 1.0},
            "too fast", FREE_DISPLACEMENT, id="moves little farther than the scene",
        ),
        pytest.param(wall(), HANGS, SLOW, "contact below", np.log(8), id="slow, ground unknown"),
        pytest.param(
            wall(), HANGS, {**SLOW, "order": covers, "upright": False},
            "occlusion", np.log(8) - LEAST_STEP_IN_FRONT, id="before all that it covers",
        ),
        pytest.param(
            wall(4.0), STANDS, {**SLOW, "order": covers},
            "contact below", np.log(4), id="before all but what it stands on",
        ),
        # the ground is at depth 4 everywhere
        pytest.param(
            wall(), HANGS, {**SLOW, "floor": 0.25}, "ground", np.log(4), id="not below the ground",
        ),
    ],
)  # fmt: skip
def test_what_decides_a_scale(z, component, options, origin, expected):
    log_scale, found_origin = found(z, component, **options)
    assert found_origin == origin
    # displacements are limited up to 1e-6
    np.testing.assert_allclose(log_scale, expected, rtol=1e-6, atol=1e-6 * (origin == "too fast"))


# --- nothing lies below the ground ---------------------------------------------------------------

HIGH, FAR = 1.5, 30.0
"""Height of the camera, and distance of a wall."""
SIDE, ROWS, COLUMNS = 8, 20, 30
ROAD_K = np.array([[150.0, 0, SIDE * COLUMNS / 2], [0, 150.0, SIDE * ROWS / 2], [0, 0, 1]])
ROW, COLUMN = np.divmod(np.arange(ROWS * COLUMNS), COLUMNS)
BODY = (ROW >= 9) & (ROW <= 13) & (COLUMN >= 10) & (COLUMN <= 14)
"""Superpixels of a car."""
ALL, SCENE = BODY | ~BODY, 0 * ROW
"""Every superpixel, and all as one component."""


@pytest.fixture(scope="module")
def flow() -> FlowFit:
    """Square superpixels of a camera above a road."""
    return flow_of(squares(ROWS, COLUMNS, SIDE, neighbours=8), K=ROAD_K)


def street(flow: FlowFit, car: float = 1.0) -> np.ndarray:
    """Depth of a road that ends at a wall, with a car `car` times as far as it stands."""
    y = flow.views.anchor[:, 1]
    Z = np.where(y > HIGH / FAR, HIGH / np.maximum(y, 1e-6), FAR)
    foot = HIGH / camera.rays(ROAD_K, np.array([[0.0, 14 * SIDE]]))[0, 1]
    return np.where(BODY, car * foot, Z)


def moving(Z: np.ndarray) -> Soup:
    """Planes parallel to the image at these depths; the camera moves by 1."""
    return facing(Z, np.array([0.0, 0.0, -1.0]))


def lift(flow, Z, reliable, component):
    known = reliable & (component * ALL == SCENE)
    ray = flow.views.anchor
    floor = np.maximum(ray @ ground(ray, 1 / Z, np.where(known, 1.0, 0.0), 0), 0.0)
    soup, lifted = on_ground(flow, moving(Z), floor, known, component * ALL)
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
    assert (ground(ray, 1 / Z, ALL * 1.0, 0) == 0).all()


@pytest.mark.parametrize(
    ("where", "least", "most", "depth", "known", "lifted"),
    [
        # unknown depth comes up to the road
        (lambda x, y: (y > 0.2) & (x > 0.5), 0.02, 0.2, lambda Z: 40.0, False, True),
        # a ditch whose depth is known is kept
        (lambda x, y: (y > 0.3) & (np.abs(x) < 0.1), 0, 0.05, lambda Z: 1.5 * Z, True, False),
        # at ten times the depth it is wrong
        (lambda x, y: (y > 0.3) & (np.abs(x) < 0.1), 0, 0.05, lambda Z: 10 * Z, True, True),
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
