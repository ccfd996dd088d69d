"""Scales of components by contact; weights of the energy across components and occlusions."""

from dataclasses import replace

import numpy as np
import pytest
from helpers_start import facing, flow_of, squares

from soup_nlp.config.problem import make_problem
from soup_nlp.data.pair import Flow
from soup_nlp.geometry import camera
from soup_nlp.model import oracle
from soup_nlp.model.energy_data import build_energy_data
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.reweighting import in_pixels
from soup_nlp.pipeline.run import run
from soup_nlp.start.components import TOO_FAST, contact_scales
from soup_nlp.start.pace import nearer_where_fast, order_in_front

K = camera.intrinsics(50.0, 50.0, 15.5, 7.5)


@pytest.fixture(scope="module")
def world():
    """Eight fronto-parallel planes in two rows, the right half with another translation."""
    seg = squares(2, 4)
    flow = Flow(np.zeros((16, 32, 2), np.float32), np.ones((16, 32), np.float32), "zero")
    component = (seg.anchors[:, 0] > 16).astype(np.int64)
    T = np.where(component[:, None] == 1, [[0.3, 0, 0]], [[0.1, 0, 0]])
    return seg, facing(np.full(8, 2.0), T), component, build_energy_data(seg, flow, K, K, 4)


@pytest.mark.parametrize("factor", [10.0, 1e4])
def test_a_component_gains_little_by_receding(world, factor):
    """Its motion kept, the right component goes far away: 2^(1/4) is the most that E_arap falls."""
    seg, soup, component, data = world
    data = in_pixels(data, soup, seg)
    weights = Weights(sigma_arap=np.inf)
    across = np.abs(np.diff(component[seg.edges], axis=1)[:, 0]) == 1
    far = np.where(component == 1, factor, 1.0)
    away = replace(soup, d=soup.d * far)
    np.testing.assert_allclose(away.translation, soup.translation, rtol=1e-14)
    gap = data.edge_weight[across] * 50.0 * 0.2 / 2.0  # focal x |T_i - T_k| / depth
    near = oracle.values("arap", soup, data, weights)[across]
    # the anchors' distance changes by at most |T_i - T_k|: the sum is once or twice the gap
    assert (near >= gap * (1 - 1e-12)).all()
    assert (near <= 2 * gap * (1 + 1e-12)).all()
    receded = oracle.values("arap", away, data, weights)[across]
    assert (receded >= 2**-0.25 * gap * (1 - 1e-12)).all()


def placed(z, component, far=0.01, **options):
    """Flow, soup and ties of fronto-parallel squares at depths z (r, c), and their scales found.

    In its own unit of length the component moves by `far` where the scene moves by 1; everything
    else is at its true depth.
    """
    flow = flow_of(squares(*np.shape(z)), K=K, **options)
    label = np.ravel(component).astype(np.int64)
    moved = np.where(np.ravel(component), far, 1.0)[:, None] * [1.0, 0.0, 0.0]
    soup = facing(np.ravel(z), moved)
    scale, tie = contact_scales(flow, soup, label, np.zeros(len(soup), bool))
    found, tie = nearer_where_fast(flow, replace(soup, lam=soup.lam * scale), label, tie)
    return flow, found, tie, (found.lam / soup.lam).reshape(np.shape(z))


def scales(*args, **options):
    """Scales (r, c) that are found, see `placed`."""
    return placed(*args, **options)[-1]


def thrice(cells):
    """Every entry as 3 x 3 superpixels, so that every boundary has inner neighbours."""
    return np.repeat(np.repeat(cells, 3, axis=0), 3, axis=1)


TOWER = [[8.0, 8, 8], [8, 1, 8], [8, 1, 8], [8, 1, 8], [2, 2, 2]]
TOWER_OF = [[0, 0, 0], [0, 2, 0], [0, 2, 0], [0, 1, 0], [0, 0, 0]]
CORNER = [[0, 0, 0], [0, 1, 0], [0, 0, 0]]
CONTACTS = {
    # a component cut off by the lower image border, without a visible support, does not wait
    "cut off": (
        [[8.0] * 5, [8, 1, 1, 8, 8], [8, 8, 1, 2, 2], *[[2, 2, 1, 2, 2]] * 2],
        [[0, 0, 0, 0, 0], [0, 2, 2, 0, 0], *[[0, 0, 1, 0, 0]] * 3],
        2.0,
    ),
    # the component below the arch touches nothing else: neither of them can wait
    "arch": (
        [[4.0] * 5, [4, 1, 1, 1, 4], [4, 1, 1, 1, 4]],
        [[0, 0, 0, 0, 0], [0, 2, 2, 2, 0], [0, 2, 1, 2, 0]],
        4.0,
    ),
    # before a wall, on the ground, half behind a near object
    "ground": ([[1.0, 4, 4], [1, 1, 4], [1, 2.0, 2.0]], CORNER, 2.0),
    # the lower edge of the image cuts it off: a low quantile of the depth ratios around it
    "outline": ([[4.0, 6, 4], [3, 1, 3.5]], [[0, 0, 0], [0, 1, 0]], 3.5),
}


@pytest.mark.parametrize(("z", "component", "scale"), CONTACTS.values(), ids=CONTACTS)
def test_a_component_has_the_depth_of_what_it_touches(z, component, scale):
    component = thrice(component)
    scale_found = scales(thrice(z), component)
    np.testing.assert_allclose(scale_found, np.where(component > 0, scale, 1.0), rtol=1e-12)


def test_without_a_vertical_the_longest_contact_comes_first():
    # the vertical is not known: the tall component touches the wall first
    component = thrice(TOWER_OF)
    scale_found = scales(thrice(TOWER), component, upright=False)
    np.testing.assert_allclose(scale_found[component == 2], 8.0, rtol=1e-12)


@pytest.mark.parametrize(
    ("pace", "share"),
    # the share of the log pace by which a component comes nearer that stands on the ground: none
    # while contact is more probably right, nearly half when it is surely wrong, none at rest
    [(-2.0, 0.0), (1.4, 0.0), (1.6, 0.115), (2.0, 0.411), (3.0, 0.499), (5.0, 0.0)],
)
def test_components_come_nearer_where_contact_makes_them_too_fast(pace, share):
    component = thrice([[0, 0, 0], [0, 1, 0], [0, 0, 0]])
    z = np.where(component == 1, 1.0, thrice([[8.0] * 3, [8.0] * 3, [2.0] * 3]))
    flow, soup, tie, found = placed(z, component, np.exp(pace) / 2)
    nearer = np.where(component == 1, share * pace, 0.0)
    np.testing.assert_allclose(np.log(found), np.where(component, np.log(2), 0) - nearer, atol=0.02)
    np.testing.assert_array_equal(tie == TOO_FAST, np.ravel(nearer > 0))
    # what is placed in front covers everything that it touches; nothing else has an order
    order = order_in_front(flow, soup, np.ravel(component), tie)
    if not share:
        assert order is None
        return
    ends = np.ravel(component)[flow.seg.pairs]
    np.testing.assert_array_equal(order, ends[:, 1] - ends[:, 0])
    # it comes nearer once
    again = nearer_where_fast(flow, soup, np.ravel(component), tie)
    np.testing.assert_array_equal(again[0].lam, soup.lam)


@pytest.mark.slow
def test_the_nlp_keeps_a_swinging_box_off_the_wall():
    what = {"kind": "scene", "scene": "swing", "seed": 2, "width": 256, "height": 192}
    raw = {"input": what, "flow": {"source": "truth"}, "segmentation": {"superpixels": 60}}

    def result(order):
        options = f"energy.weights.order={order}", "refine.enabled=false"
        return run(make_problem(raw, options))

    held, free = result(10.0), result(0.0)
    assert (held.start.tie == TOO_FAST).any()
    assert held.metrics["solution"].mre < 0.6 * free.metrics["solution"].mre
    # where it is exactly remains a guess
    assert held.confidence.sigma[held.start.tie[held.segmentation.labels] == TOO_FAST].min() > 0.25


def test_depths_across_pairs_are_those_of_both_planes(world):
    seg, soup, _, _ = world
    ray = camera.rays(K, seg.boundary.mean(axis=1))
    for side, z in enumerate(soup.depth_across(seg.pairs, ray)):
        superpixel = seg.pairs[:, side]
        expected = [soup.depth_at(np.tile(r, (len(soup), 1)))[i] for r, i in zip(ray, superpixel)]
        np.testing.assert_allclose(z, expected, rtol=1e-14)
    edge_on = replace(soup, n=np.tile([0, 1.0, 0], (len(soup), 1)))
    z = edge_on.depth_across(seg.pairs, np.tile([0, 1.0, 1], (len(seg.pairs), 1)))
    np.testing.assert_allclose(z, edge_on.distance[seg.pairs.T] / 1e-3, rtol=1e-14)
