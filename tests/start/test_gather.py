"""Components get one motion each: pieces are gathered, lost halves return, others do not change."""

import numpy as np
import pytest
from helpers_start import WEDGE, corner, fitted
from helpers_truth import majority

from soup_nlp.geometry import camera, rotation
from soup_nlp.mrf.trws import mrf_energy
from soup_nlp.start.choice import Choice, flow_affinity, smooth_choice
from soup_nlp.start.components import borrow
from soup_nlp.start.epipolar import Motion
from soup_nlp.start.merge import gather
from soup_nlp.start.propose import propose


@pytest.fixture(scope="module")
def world():
    """A wedge that moves in a room: flow of superpixels, true component and motions."""
    pair, seg, _ = corner(wedge=WEDGE, count=100)
    return fitted(pair, seg), majority(pair.truth, seg)[0], unit(pair.truth.motions)


def unit(M: np.ndarray) -> list[Motion]:
    return [Motion(m[:3, :3], m[:3, 3] / np.linalg.norm(m[:3, 3])) for m in M]


def turned(m: Motion, degrees: float, axis: int) -> Motion:
    """Another motion that small patches hardly tell from `m`."""
    R = rotation.exp(np.radians(degrees) * np.eye(3)[axis])
    t = m.t + 0.2 * np.eye(3)[axis]
    return Motion(R @ m.R, t / np.linalg.norm(t))


def agreement(choice: Choice, component: np.ndarray) -> tuple[float, float]:
    """Shares of the wedge and of the room with the most frequent motion there."""
    shares = []
    for b in (1, 0):
        own = choice.label[component == b]
        shares.append(np.unique(own, return_counts=True)[1].max() / len(own))
    return shares[0], shares[1]


def off(choice: Choice, component: np.ndarray, m: Motion) -> float:
    """Median angle in degrees between the wedge's rotation and the true one."""
    R = np.stack([own.R for own in choice.motions])[choice.label[component == 1]]
    turn = rotation.log(np.swapaxes(R, 1, 2) @ m.R)
    return float(np.median(np.degrees(np.linalg.norm(turn, axis=1))))


def test_a_component_with_three_motions_is_gathered(world):
    flow, component, (room, wedge) = world
    several = [room, turned(wedge, 0.4, 0), turned(wedge, -0.4, 1), turned(wedge, 0.4, 2)]
    part = 1 + np.arange(len(flow.seg)) % 3
    before = Choice.of(flow.views, several, np.where(component == 1, part, 0), 0.05)
    assert agreement(before, component)[0] < 0.5
    after = gather(flow, before)
    assert min(agreement(after, component)) > 0.85
    assert off(after, component, wedge) < 0.3
    assert off(after, component, wedge) < off(before, component, wedge)
    assert np.median(after.error[component == 1]) < np.median(before.error[component == 1])


def test_superpixels_with_motions_of_their_own_are_gathered(world):
    flow, component, (room, wedge) = world
    rng = np.random.default_rng(0)
    motions, label = [room], np.zeros(len(component), int)
    for i in np.flatnonzero(component == 1):
        motions.append(turned(wedge, rng.uniform(-0.5, 0.5), int(rng.integers(3))))
        label[i] = len(motions) - 1
    before = Choice.of(flow.views, motions, label, 0.05)
    after = gather(flow, before)
    assert min(agreement(after, component)) > 0.85
    assert off(after, component, wedge) < 0.3
    count = np.bincount(after.label)
    assert len(after.motions) == len(count) < 5
    assert (np.diff(count) <= 0).all()
    np.testing.assert_allclose(flow.views.fit(after.motions, after.label).cost, after.fit.cost)


def test_half_a_component_with_the_rooms_motion_comes_back(world):
    flow, component, (room, wedge) = world
    x = flow.seg.anchors[:, 0]
    left = x < np.median(x[component == 1])
    before = Choice.of(flow.views, [room, wedge], np.where((component == 1) & left, 1, 0), 0.05)
    assert agreement(before, component)[0] < 0.7
    after = gather(flow, before)
    assert min(agreement(after, component)) > 0.85


def test_one_rigid_world_stays_as_it_is(world):
    flow, component, (room, _) = world
    before = Choice.of(flow.views, [room], np.zeros(len(component), int), 0.05)
    after = gather(flow, before)
    assert after.motions == before.motions
    assert (after.label == 0).all()


def test_neighbours_agree_unless_the_flow_jumps(world):
    flow, component, _ = world
    seg = flow.seg
    rng = np.random.default_rng(1)
    n = len(seg)
    # each component prefers its own label by 0.3 pixels, a fifth of the superpixels the wrong one
    wrong = rng.random(n) < 0.2
    cost = np.where(np.arange(2) == np.where(wrong, 1 - component, component)[:, None], 0.0, 0.3)
    near = flow_affinity(flow)
    assert near.max() <= 1
    assert near[flow.jump > 3 * flow.options.discontinuity_px].max() < 0.01
    label = smooth_choice(flow, cost, 0.5)
    assert (label == component).mean() > 0.95
    # without a price each takes its own; a high price leaves one
    np.testing.assert_array_equal(smooth_choice(flow, cost, 0.0), np.argmin(cost, axis=1))
    assert len(np.unique(smooth_choice(flow._replace(jump=0 * near), cost, 1e3))) == 1
    # no single change is better
    i, k = seg.pairs.T
    length = seg.boundary_length.astype(float)
    rim = np.bincount(i, length, n) + np.bincount(k, length, n)
    weight = 0.5 * near * length * (1 / rim[i] + 1 / rim[k])
    tables = weight[:, None, None] * (1 - np.eye(2))
    best = mrf_energy(label, cost, seg.pairs, tables)
    for s in range(n):
        other = label.copy()
        other[s] = 1 - other[s]
        assert mrf_energy(other, cost, seg.pairs, tables) >= best - 1e-9


def test_a_motion_without_known_depth_borrows_from_another(world):
    seg = world[0].seg
    label = np.arange(len(seg)) % 2
    mu, weak = np.where(label == 1, 0.5, 0.001), label == 0
    new, flat = borrow(mu, np.ones((len(mu), 2)), label, weak, seg)
    np.testing.assert_array_equal(new, 0.5)
    np.testing.assert_array_equal(flat, np.where(weak, 0.0, 1.0)[:, None] * [1, 1])


def test_a_camera_at_rest_starts_near_its_flow():
    """The room has no parallax; the depths that it borrows must not throw it across the image."""
    pair, seg, _ = corner(np.eye(4), WEDGE, count=100)
    start = propose(fitted(pair, seg))
    anchor = camera.rays(pair.K_ref, seg.anchors)
    uv = camera.project(pair.K_next, start.soup.moved(start.soup.points(anchor)))
    shift = np.linalg.norm(uv - seg.anchors, axis=1)[start.borrowed]
    assert len(shift) > 20
    assert np.median(shift) < 0.1
