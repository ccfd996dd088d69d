"""Which side of an outline covers the other, and what is placed in that order."""

from functools import cache

import numpy as np
import pytest
from helpers_start import fitted, rendered, squares

from soup_nlp.data.pair import Flow, Pair
from soup_nlp.geometry import camera
from soup_nlp.geometry.graph import Segmentation
from soup_nlp.geometry.soup import reconstruct
from soup_nlp.start.propose import Start, propose
from soup_nlp.start.regions import LEAST_ORDER, ORIGINS, covering, vote
from soup_nlp.start.scales import LEAST_STEP_IN_FRONT

HEIGHT, WIDTH, CELL = 96, 128, 16
K = camera.intrinsics(120.0, 120.0, 63.5, 47.5)
SHIFT = 5
"""By which parts of an image move, pixels."""


def textured(seed: int) -> np.ndarray:
    """(H, W, 3) noise, grey levels; two seeds differ in their mean."""
    rng = np.random.default_rng(seed)
    return (60 + 90 * (seed % 2) + rng.integers(0, 60, (HEIGHT, WIDTH, 3))).astype(np.uint8)


@cache
def sliding(covers: bool) -> tuple[Pair, Segmentation]:
    """Two parts of 3 x 2 cells that approach each other before a wall, or behind holes in it."""
    wall, inside = textured(0), textured(1)
    before, after, uv = wall.copy(), wall.copy(), np.zeros((HEIGHT, WIDTH, 2), np.float32)
    for left, shift in ((CELL, SHIFT), (5 * CELL, -SHIFT)):
        part = np.zeros((HEIGHT, WIDTH), bool)
        part[CELL : 4 * CELL, left : left + 2 * CELL] = True
        before[part], uv[part] = inside[part], (shift, 0)
        seen = np.roll(part, shift, axis=1) if covers else part
        after[seen] = np.roll(inside, shift, axis=1)[seen]
    pair = Pair(before, after, K, K).with_flow(Flow(uv))
    return pair, squares(HEIGHT // CELL, WIDTH // CELL, CELL, neighbours=15)


def ordered(seg: Segmentation, pair: Pair) -> Start:
    flow = fitted(pair, seg)
    return propose(flow, covering(pair, flow))


@pytest.mark.parametrize("covers", [True, False])
def test_the_side_that_loses_or_gains_pixels_is_behind(covers):
    pair, seg = sliding(covers)
    contrast = covering(pair, fitted(pair, seg))
    moves = pair.flow.uv[..., 0].ravel()[np.unique(seg.labels, return_index=True)[1]] != 0
    i, k = seg.pairs.T
    # upper and lower edges slide along each other: neither closes nor opens
    upright = (moves[i] != moves[k]) & (np.ptp(seg.boundary[..., 0], axis=1) < 1)
    assert upright.sum() == 12
    assert not contrast[~upright].any()
    front = np.where(covers, moves, ~moves)
    assert (np.sign(contrast[upright]) == np.where(front[k], 1, -1)[upright]).all()
    assert np.abs(contrast[upright]).min() > 8
    order = vote(contrast, moves.astype(int), seg)
    np.testing.assert_allclose(np.abs(order[upright]), 13 / 14)


def test_a_vote_needs_several_strips_and_agreement():
    _, seg = sliding(True)
    region = (seg.anchors[:, 0] > WIDTH / 2).astype(int)
    across = np.flatnonzero(seg.across(region))
    assert len(across) == 6
    says = np.zeros(len(seg.pairs))
    says[across[:3]] = 20.0
    assert not vote(says, region, seg).any()
    says[across[:5]] = 20.0
    np.testing.assert_allclose(vote(says, region, seg)[across[:5]], 6 / 7)
    says[across[5]] = -20.0
    assert LEAST_ORDER > 6 / 8
    assert not vote(says, region, seg).any()
    # inside a region, parallax orders depth
    assert not vote(np.full(len(seg.pairs), 20.0), 0 * region, seg).any()


@pytest.mark.slow
@pytest.mark.parametrize("covers", [True, False])
def test_a_mover_before_a_resting_camera_is_placed_in_order(covers):
    pair, seg = sliding(covers)
    before = propose(fitted(pair, seg))
    start = ordered(seg, pair)
    assert before.at_rest
    z = np.log(start.soup.depth_at(camera.rays(K, seg.anchors)))
    z -= np.log(before.soup.depth_at(camera.rays(K, seg.anchors)))
    moves = start.origin == ORIGINS.index("occlusion")
    assert moves.sum() == 12
    # relative to the plane on which all of the image is drawn
    step = np.median(z[~moves]) - np.median(z[moves])
    assert step == pytest.approx(LEAST_STEP_IN_FRONT if covers else -LEAST_STEP_IN_FRONT, rel=1e-6)
    # the flow is explained as before, and the mover is a component
    np.testing.assert_allclose(start.error, before.error)
    flows = [reconstruct(soup, seg.labels, K, K).flow for soup in (start.soup, before.soup)]
    np.testing.assert_allclose(*flows, atol=1e-9)
    assert len(np.unique(start.component)) == 3
    np.testing.assert_array_equal(start.part, start.component)
    # the order is held along the whole outline, upper and lower edges included
    np.testing.assert_array_equal(start.order != 0, moves[seg.pairs].sum(axis=1) == 1)


@pytest.fixture(scope="module")
def swing() -> tuple[Pair, Segmentation]:
    return rendered("swing", 1, 320, 240, 150)


@pytest.mark.slow
def test_a_swinging_object_comes_before_the_wall(swing):
    pair, seg = swing
    before = propose(fitted(pair, seg))
    start = ordered(seg, pair)
    u, v = np.rint(seg.anchors).astype(int).T
    truth = np.log(pair.truth.depth_ref[v, u])
    ordered_pairs = start.order != 0
    i, k = np.where(start.order > 0, seg.pairs.T, seg.pairs.T[::-1])[:, ordered_pairs]
    assert ordered_pairs.sum() > 10
    assert np.mean(truth[i] > truth[k]) > 0.9

    def right(s) -> float:
        z = s.soup.depth_at(camera.rays(pair.K_ref, seg.anchors))
        return float(np.mean(z[i] > z[k]))

    # of what is wrong before, little is left
    assert 1 - right(start) < min(0.05, 0.3 * (1 - right(before)))
    # depths determined by parallax keep their shape
    main = start.component == np.argmax(np.bincount(start.component))
    ratio = start.soup.distance[main] / before.soup.distance[main]
    np.testing.assert_allclose(ratio, ratio[0])
    assert not (start.origin[main] == ORIGINS.index("occlusion")).any()


@pytest.mark.slow
def test_what_moves_before_a_resting_camera_is_a_part_without_an_order_too():
    pair, seg = sliding(True)
    moves = (pair.flow.uv[..., 0] != 0).ravel()[np.unique(seg.labels, return_index=True)[1]]
    start = propose(fitted(pair, seg))
    assert start.at_rest
    assert not start.component.any()
    np.testing.assert_array_equal(start.part > 0, moves)
    assert len(np.unique(start.part)) == 3
    # a piece of flow that is hardly usable need not move
    left = np.arange(WIDTH) < WIDTH / 2
    doubtful = np.where((pair.flow.uv[..., 0] != 0) & left, 0.3, 1.0)
    pair = pair.with_flow(Flow(pair.flow.uv, doubtful))
    start = propose(fitted(pair, seg))
    assert start.at_rest
    np.testing.assert_array_equal(start.part > 0, moves & (seg.anchors[:, 0] > WIDTH / 2))


@pytest.mark.slow
def test_an_image_without_discontinuities_keeps_its_start(swing):
    pair, seg = swing
    still = pair.with_flow(Flow(0 * pair.flow.uv, pair.flow.confidence, "zero"))
    start, same = propose(fitted(still, seg)), ordered(seg, still)
    np.testing.assert_array_equal(same.soup.distance, start.soup.distance)
    assert same.order is None
