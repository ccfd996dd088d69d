"""The linear program of scales: its minimum, and what decides a scale."""

import numpy as np
from helpers_start import facing, flow_of, squares

from soup_nlp.geometry import camera
from soup_nlp.start.regions import ORIGINS
from soup_nlp.start.scales import (
    LEAST_STEP_IN_FRONT,
    Rows,
    minimum,
    scaled,
)

K = camera.intrinsics(50.0, 50.0, 15.5, 7.5)
HANGS = [[0] * 5, [0, 0, 1, 0, 0], [0] * 5, [0] * 5]
STANDS = [[0] * 5, [0, 0, 1, 0, 0], [0, 0, 1, 0, 0], [0] * 5]


def found(z, component, order=None, **options):
    """Log scale and origin of component 1, whose planes are at depth 1 in its own unit."""
    label = np.ravel(component)
    flow = flow_of(squares(*np.shape(component)), K=K, **options)
    soup = facing(np.where(label == 1, 1.0, np.ravel(z)), np.array([1.0, 0.0, 0.0]))
    says = np.zeros(len(flow.seg.pairs)) if order is None else order(label, flow.seg)
    scale, origin = scaled(flow, soup, label, says)
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


def test_what_stands_on_the_ground_has_its_depth():
    z = np.array([[8.0] * 5, [8.0] * 5, [8.0] * 5, [2.0] * 5])
    log_scale, origin = found(z, STANDS)
    assert origin == "contact below"
    np.testing.assert_allclose(log_scale, np.log(2), rtol=1e-6)


def test_what_is_before_a_wall_is_not_behind_it():
    z = np.array([[4.0] * 5, [4.0] * 5, [4.0] * 5])
    log_scale, origin = found(z, HANGS[:3], upright=False)
    assert origin == "outline"
    np.testing.assert_allclose(log_scale, np.log(4), rtol=1e-6)


def covers(label, seg):
    """Component 1 covers all that it touches."""
    ends = label[seg.pairs]
    return 0.9 * (ends[:, 1] - ends[:, 0])


def test_what_covers_is_in_front_of_all_but_what_it_stands_on():
    wall = np.full((4, 5), 8.0)
    log_scale, origin = found(wall, HANGS, order=covers, upright=False)
    assert origin == "occlusion"
    np.testing.assert_allclose(log_scale, np.log(8) - LEAST_STEP_IN_FRONT, rtol=1e-6)
    wall[-1] = 4.0
    log_scale, origin = found(wall, STANDS, order=covers)
    assert origin == "contact below"
    np.testing.assert_allclose(log_scale, np.log(4), rtol=1e-6)
