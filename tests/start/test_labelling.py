"""The labelling: regions get one motion, what does not pay goes, what is not seen continues."""

from dataclasses import replace

import numpy as np
import pytest
from helpers_start import WEDGE, corner, fitted, flow_of, squares
from helpers_truth import majority

from soup_nlp.data.pair import Flow
from soup_nlp.geometry import rotation
from soup_nlp.geometry.graph import connected
from soup_nlp.mrf.trws import mrf_energy
from soup_nlp.start import labelling
from soup_nlp.start.epipolar import SIDEWAYS, Motion
from soup_nlp.start.labelling import CHANGE_COST, MOST_COST, labelled, price_of_motion, smooth
from soup_nlp.start.propose import propose
from soup_nlp.start.regions import belonging, continued, harmonic, likeness


@pytest.fixture(scope="module")
def world():
    """A wedge that moves in a room: pair, flow of superpixels, true component and motions."""
    pair, seg, _ = corner(wedge=WEDGE, count=100)
    M = pair.truth.motions
    motions = [Motion(m[:3, :3], m[:3, 3] / np.linalg.norm(m[:3, 3])) for m in M]
    return pair, fitted(pair, seg), majority(pair.truth, seg)[0], motions


def turned(m: Motion, degrees: float, axis: int) -> Motion:
    """Another motion that small patches hardly tell from `m`."""
    R = rotation.exp(np.radians(degrees) * np.eye(3)[axis])
    t = m.t + 0.2 * np.eye(3)[axis]
    return Motion(R @ m.R, t / np.linalg.norm(t))


@pytest.mark.parametrize(
    "given",
    [
        "three of the wedge",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("none", "room")),
    ],
)
def test_every_region_gets_one_motion(world, given):
    _, flow, component, (room, wedge) = world
    several = [turned(wedge, 0.4, 0), turned(wedge, -0.4, 1), turned(wedge, 0.4, 2)]
    motions = {"none": [SIDEWAYS], "room": [room], "three of the wedge": [room, *several]}[given]
    found = labelled(flow, motions, connected(flow.seg.pairs[flow.jump < 1], len(flow.seg)))
    assert len(found.motions) == 2
    first = int(np.bincount(component[found.label == 0]).argmax())
    assert (found.label == (component != first)).mean() > 0.95
    for motion, true in zip(found.motions, (room, wedge) if first == 0 else (wedge, room)):
        turn = np.degrees(np.linalg.norm(rotation.log(motion.R @ true.R.T)))
        assert turn < 0.3
    assert np.median(found.excess) < 0.02
    assert found.unexplained[flow.views.usable].mean() < 0.05


def test_an_error_that_the_flow_shares_is_no_motion():
    """Every cost up to the shared error is 0, however many superpixels have it."""
    shared = 0.2
    price = labelling._cost(np.array([0.0, 0.1, 0.2, 0.3, 99.0]), shared)
    np.testing.assert_allclose(price, [0, 0, 0, 0.5, MOST_COST], atol=1e-12)


@pytest.mark.parametrize(("pays", "saved"), [(True, 1.1), (False, 0.9)])
def test_a_motion_stays_if_it_saves_its_price(pays, saved):
    seg = squares(10, 10)
    own = np.isin(np.arange(100) // 10, (0, 1)) & (np.arange(100) % 10 < 4)
    cost = np.zeros((100, 3))
    cost[own, 0] = saved * price_of_motion(100) / own.sum()
    cost[~own, 1] = MOST_COST
    cost[:, 2] = 0.5 * MOST_COST
    used, label = labelling._paying(flow_of(seg, jump=9.0), cost)
    assert used == ([0, 1] if pays else [0])
    np.testing.assert_array_equal(label, own if pays else 0)


def test_neighbours_agree_unless_the_flow_jumps(world):
    _, flow, component, _ = world
    seg, n = flow.seg, len(flow.seg)
    rng = np.random.default_rng(1)
    # each component prefers its own label by half the price, a fifth of them the wrong one
    wrong = rng.random(n) < 0.2
    mine = np.where(wrong, 1 - component, component)[:, None]
    cost = np.where(np.arange(2) == mine, 0.0, 0.5 * CHANGE_COST)
    near = np.exp(-2 * flow.jump)
    label = smooth(flow, cost)
    assert (label == component).mean() > 0.95
    # no single change is better
    i, k = seg.pairs.T
    length = seg.boundary_length.astype(float)
    rim = np.bincount(i, length, n) + np.bincount(k, length, n)
    weight = CHANGE_COST * near * length * (1 / rim[i] + 1 / rim[k])
    tables = weight[:, None, None] * (1 - np.eye(2))
    best = mrf_energy(label, cost, seg.pairs, tables)
    for s in range(n):
        other = label.copy()
        other[s] = 1 - other[s]
        assert mrf_energy(other, cost, seg.pairs, tables) >= best - 1e-9


def test_a_surface_continues_harmonically_and_not_into_another():
    seg = squares(1, 9)
    mu = np.linspace(1.0, 3.0, 9)
    known = np.isin(np.arange(9), (0, 8))
    np.testing.assert_allclose(continued(seg, mu * known, np.zeros(9, int), known), mu, atol=1e-6)
    # what touches one known superpixel alone has its value
    label = np.repeat([0, 1], [4, 5])
    expected = np.where(label == 0, 1.0, 3.0)
    np.testing.assert_allclose(continued(seg, mu * known, label, known), expected, atol=1e-3)
    # nothing known, or everything
    np.testing.assert_array_equal(continued(seg, mu, label, np.zeros(9, bool)), mu)
    np.testing.assert_array_equal(continued(seg, mu, label, np.ones(9, bool)), mu)


def test_a_random_walk_finds_the_surface_along_edges_of_like_colour():
    seg = squares(1, 8)
    label, seen = np.array([5, 0, 0, 0, 0, 0, 0, 2]), np.isin(np.arange(8), (0, 7))
    np.testing.assert_array_equal(belonging(seg, label, seen), [5, 5, 5, 5, 2, 2, 2, 2])
    # an edge of the image between the second and the third is the end of the surface
    weight = np.where(np.arange(7) == 1, 0.1, 1.0) * seg.pair_weight
    edge = replace(seg, pair_weight=weight)
    np.testing.assert_array_equal(belonging(edge, label, seen), [5, 5, 2, 2, 2, 2, 2, 2])
    share = harmonic(likeness(edge), edge, np.eye(8)[:, [0, 7]], seen)
    np.testing.assert_allclose(share.sum(axis=1), 1, atol=1e-9)
    assert (np.diff(share[:, 0]) < 0).all()


@pytest.mark.slow
def test_what_is_not_seen_has_no_motion_of_its_own(world):
    """Superpixels of the wedge without flow have its motion, and continue its surface."""
    pair, flow, component, (room, wedge) = world
    seg = flow.seg
    inner = component == 1
    ends = seg.pairs[seg.across(component)]
    inner[ends.ravel()] = False
    hidden = np.flatnonzero(inner)[:3]
    assert len(hidden) == 3
    uv = pair.flow.uv + np.where(np.isin(seg.labels, hidden)[..., None], 7.0, 0.0)
    confidence = np.where(np.isin(seg.labels, hidden), 0.0, 1.0)
    blind = fitted(pair.with_flow(Flow(uv.astype(np.float32), confidence, "test")), seg)
    found = labelled(
        blind, [room, wedge], connected(blind.seg.pairs[blind.jump < 1], len(blind.seg))
    )
    assert len(found.motions) == 2
    assert len(np.unique(found.label[inner])) == 1
    start = propose(blind)
    assert start.interpolated[hidden].all()
    assert not start.wrong[hidden].any()
    z, true = start.soup.depth_at(blind.views.anchor), propose(flow).soup
    ratio = z[hidden] / true.depth_at(blind.views.anchor)[hidden]
    assert np.abs(np.log(ratio)).max() < 0.1
