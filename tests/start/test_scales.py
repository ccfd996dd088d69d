"""The linear program of scales: its minimum, and what decides a scale."""

import numpy as np
import pytest
from helpers_start import facing, flow_of, squares

from soup_nlp.geometry import camera
from soup_nlp.start.regions import ORIGINS, TOO_FAST
from soup_nlp.start.scales import (
    FREE_DISPLACEMENT,
    LEAST_STEP_IN_FRONT,
    Rows,
    held,
    minimum,
    scaled,
)

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
    x, origin = minimum(4, [r], np.array([0]))
    assert x[0] == 0
    assert origin[0] == ORIGINS.index("reference")
    assert (origin[1:] == ORIGINS.index("outline")).all()
    for step in (1e-3, 0.1, 1.0):
        for _ in range(50):
            other = x + step * rng.normal(size=4) * [0, 1, 1, 1]
            assert cost(other, r) >= cost(x, r) - 1e-9


def test_a_row_is_a_weighted_quantile():
    value = np.array([1.0, 2.0, 3.0, 4.0, 5.0])
    one, origin = np.ones(5, int), ORIGINS.index("outline")
    for share, expected in ((0.1, 1.0), (0.5, 3.0), (0.7, 4.0)):
        x, _ = minimum(2, [Rows(one, 0, value, 1 - share, share, origin)], np.array([0]))
        np.testing.assert_allclose(x[1], expected, atol=1e-9)


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
