"""Costs of particles are the exact energy; proposals are feasible; rounds never raise E."""

import threading
from dataclasses import replace

import numpy as np
import pytest
from helpers_model import Tiny, random_soup, weights_for, world

from soup_nlp.geometry import camera
from soup_nlp.geometry.constraints import constraints
from soup_nlp.geometry.soup import Soup
from soup_nlp.model import oracle
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.model.energy_options import Weights
from soup_nlp.mrf.trws import mrf_energy
from soup_nlp.refine import mppbp, particles
from soup_nlp.refine.mppbp import length_slope, refine_soup
from soup_nlp.refine.particles import (
    NEIGHBOURS,
    WALKS,
    PairCosts,
    Particles,
    Proposer,
    counts,
    feasible,
    neighbours,
    unary_costs,
)
from soup_nlp.refine.records import RefineOptions
from soup_nlp.storage.progress import Watch

# --- costs ----------------------------------------------------------------------------------------


def cloud(tiny: Tiny, labels: int, seed: int = 3, spread: float = 1.0) -> Particles:
    """Particles of `labels` soups: the tiny soup first, then random ones."""
    n = len(tiny.soup)
    random = [Particles.of(random_soup(seed + k, n, spread)) for k in range(labels - 1)]
    return Particles.of(tiny.soup).joined(*random)


def chosen(p: Particles, labels: np.ndarray) -> Soup:
    """The soup of labels, in the length unit of its particles."""
    rows = np.arange(len(labels))
    n, D, R, T = (a[rows, labels] for a in (p.n, p.D, p.R, p.T))
    return Soup(np.ones(len(labels)), n, D, R, T)


@pytest.mark.parametrize("units", ["paper", "pixels"])
@pytest.mark.parametrize("at_anchors", [False, True])
@pytest.mark.parametrize("truncated", [False, True])
def test_costs_of_chosen_labels_are_the_exact_energy(units, at_anchors, truncated):
    tiny = Tiny(units, at_anchors=at_anchors, samples=None)
    own = _, weights = tiny.data, weights_for(units, truncated)
    costs = PairCosts(*own)
    p = cloud(tiny, 6)
    exactly = costs.tables(p, 1.3)
    single = costs.tables(p, 1.3, np.float32)
    assert single.dtype == np.float32
    np.testing.assert_allclose(single, exactly, rtol=1e-6, atol=1e-6 * exactly.max())
    rng = np.random.default_rng(5)
    for _ in range(4):
        labels = rng.integers(0, 6, len(tiny.soup))
        soup = chosen(p, labels)
        unit = float(np.sum(tiny.data.share * soup.distance))
        exact = oracle.energy(soup, tiny.data, weights)["total"]
        found = mrf_energy(labels, unary_costs(p, *own)[0], costs.edges, costs.tables(p, unit))
        assert found == pytest.approx(exact, rel=1e-12)
        # the delivered soup has the same energy, because E does not depend on the scale
        delivered = oracle.energy(p.soup(labels, tiny.data.share), tiny.data, weights)["total"]
        assert delivered == pytest.approx(exact, rel=1e-12)


def test_blocks_change_no_digit_that_matters(monkeypatch):
    tiny, weights = Tiny("pixels"), weights_for("pixels")
    costs = PairCosts(tiny.data, weights)
    p = cloud(tiny, 5)
    whole, (unary, ahead) = costs.tables(p), unary_costs(p, tiny.data, weights)
    monkeypatch.setattr("soup_nlp.refine.particles.BLOCK_BYTES", 1)
    monkeypatch.setattr("soup_nlp.refine.particles.UNARY_BYTES", 1)
    np.testing.assert_allclose(costs.tables(p), whole, rtol=1e-12, atol=1e-13 * whole.max())
    in_blocks = unary_costs(p, tiny.data, weights)
    np.testing.assert_allclose(in_blocks[0], unary, rtol=1e-12)
    np.testing.assert_array_equal(in_blocks[1], ahead)


def test_a_particle_whose_pixels_fall_behind_the_camera_is_told():
    tiny = Tiny("pixels")
    p = cloud(tiny, 2)
    p.T[3, 1] = [0.0, 0.0, -50.0]
    _, ahead = unary_costs(p, tiny.data, weights_for("pixels"))
    assert not ahead[3, 1]
    assert ahead.sum() == ahead.size - 1


def test_visibility_is_that_of_the_nlp():
    tiny = Tiny()
    p = cloud(tiny, 2)
    rays = tiny.data.visibility_ray(5.0)
    assert feasible(p, rays, 1e-3).all()
    p.n[2, 1] = [0.0, 0.0, 1.0]
    visible = feasible(p, rays, 1e-3)
    assert not visible[2, 1]
    assert visible.sum() == visible.size - 1


def test_the_length_slope_is_the_derivative_of_the_energy():
    tiny = Tiny("paper")
    weights = weights_for("paper", truncated=False)
    h = 1e-5
    # the unit is sum(share D)
    scaled = [replace(tiny.data, share=tiny.data.share * (1 + s * h)) for s in (1, -1)]
    up, down = (oracle.energy(tiny.soup, d, weights)["total"] for d in scaled)
    assert length_slope(tiny.soup, tiny.data, weights) == pytest.approx(
        (down - up) / (2 * h), rel=1e-5
    )


# --- proposals and rounds -------------------------------------------------------------------------

FEW = RefineOptions(rounds=3, particles=16)


def proposer(data: EnergyData, seed: int = 0) -> Proposer:
    return Proposer(data, neighbours(data.edges, data.anchor_ray), seed)


def anchor_targets(p: Particles, data: EnergyData) -> np.ndarray:
    """(N, L, 2) positions of moved anchors in the next image, pixels."""
    depth = -p.D / np.einsum("nlc,nc->nl", p.n, data.anchor_ray)
    X = depth[..., None] * data.anchor_ray[:, None]
    return camera.project(data.K_next, np.einsum("nlij,nlj->nli", p.R, X) + p.T)


@pytest.mark.parametrize("kind", [*WALKS, *NEIGHBOURS])
def test_every_proposal_is_feasible_by_construction(kind):
    tiny = Tiny("pixels", samples=8)
    p = proposer(tiny.data).propose(tiny.soup, kind, 4)
    assert p.shape == (len(tiny.soup), 4)
    gram = np.swapaxes(p.R, 2, 3) @ p.R
    assert np.abs(gram - np.eye(3)).max() < 1e-13
    assert (np.linalg.det(p.R) > 0).all()
    assert np.abs(np.linalg.norm(p.n, axis=2) - 1).max() < 1e-14
    assert (p.D > 0).sum() >= 0.9 * p.D.size
    assert all(np.isfinite(v).all() for v in vars(p).values())
    now = Particles.of(tiny.soup)
    moved = np.abs(p.R - now.R).max(axis=(2, 3)) + np.abs(p.T - now.T).max(axis=2)
    moved = moved + np.abs(p.n - now.n).max(axis=2) + np.abs(p.D - now.D)
    assert (moved > 1e-9).any(axis=1).all()


@pytest.mark.parametrize("kind", ["walk_plane", "walk_motion"])
def test_a_step_is_about_so_many_pixels(kind, monkeypatch):
    tiny = Tiny("pixels")
    monkeypatch.setattr(particles, "WIDTH", 0.0)
    monkeypatch.setattr(particles, "STEP", 0.1)
    before = anchor_targets(Particles.of(tiny.soup), tiny.data)
    p = proposer(tiny.data).propose(tiny.soup, kind, 200)
    moved = np.linalg.norm(anchor_targets(p, tiny.data) - before, axis=2)
    # several coordinates add up: from a third of the step to four times it
    assert 0.03 < np.median(moved) < 0.4


@pytest.mark.parametrize("kind", NEIGHBOURS)
def test_neighbours_on_one_plane_propose_that_plane(kind):
    truth, data = world("slanted", "pixels", False)
    p = proposer(data).propose(truth, kind, 3)
    for name, expected in vars(Particles.of(truth)).items():
        every = np.broadcast_to(expected, getattr(p, name).shape)
        np.testing.assert_allclose(getattr(p, name), every, atol=1e-9, err_msg=name)


def test_planes_of_neighbours_keep_motion_or_anchor():
    tiny = Tiny("pixels")
    p = proposer(tiny.data).propose(tiny.soup, "neighbour_plane", 4)
    targets = [anchor_targets(q, tiny.data) for q in (Particles.of(tiny.soup), p)]
    np.testing.assert_allclose(
        targets[1][:, ::2], np.repeat(targets[0], 2, axis=1), rtol=1e-9, atol=1e-9
    )
    T = tiny.soup.translation[:, None]
    np.testing.assert_allclose(p.T[:, 1::2], np.repeat(T, 2, axis=1), rtol=1e-12)


@pytest.mark.parametrize(
    ("total", "near"), [(0, 20), (1, 20), (7, 20), (49, 20), (49, 0), (49, 3), (49, 7)]
)
def test_proposals_are_split_by_shares_and_limited_by_neighbours(total, near):
    """Random steps replace the proposals of too few neighbours."""
    shares = {**WALKS, **NEIGHBOURS}
    split = counts(shares, total, near)
    assert sum(split.values()) == total
    if near < 20:
        assert {split[kind] for kind in NEIGHBOURS} == {near}
        return
    for kind, count in split.items():
        assert abs(count - total * shares[kind] / sum(shares.values())) <= 1


@pytest.mark.parametrize("units", ["paper", "pixels"])
def test_no_round_raises_the_energy_or_violates_constraints(units):
    tiny = Tiny(units, samples=6)
    weights = weights_for(units)
    o = FEW.replace(stagnation=0.0)
    done = refine_soup(tiny.soup, tiny.data, weights, o, seed=1)
    totals = [done.energy_begin["total"], *(r.energy["total"] for r in done.rounds)]
    assert (np.diff(totals) <= 0).all()
    assert totals[-1] < 0.9 * totals[0]
    assert done.energy == oracle.energy(done.soup, tiny.data, weights)
    assert done.status == "rounds"
    assert len(done.rounds) == FEW.rounds
    residuals = constraints(done.soup, tiny.data.rim_ray, 1e-3).largest
    assert max(residuals.values()) < 1e-12
    for r in done.rounds:
        assert r.bound <= r.mrf_energy + 1e-9
        assert r.gap >= -1e-9
        assert 0 <= r.moved <= len(tiny.soup)
        if units == "pixels" and r.taken:
            assert r.mrf_energy == pytest.approx(r.energy["total"], rel=1e-5)


def test_the_same_seed_gives_the_same_soup_and_another_another():
    one = FEW.replace(rounds=1)
    tiny = Tiny("pixels", samples=6)
    weights = weights_for("pixels")
    a, b, c = (refine_soup(tiny.soup, tiny.data, weights, one, seed=s).soup.t for s in (1, 1, 2))
    assert np.array_equal(a, b)
    assert not np.allclose(a, c)


def test_broken_superpixels_are_repaired_by_their_neighbours():
    """Of a plane, whose truth has no energy."""
    truth, data = world("slanted", "pixels", False)
    good, random = Particles.of(truth), Particles.of(random_soup(7, 12, 0.5).normalised())
    broken = np.isin(np.arange(12), (1, 6, 7))
    begin = good.joined(random).soup(broken.astype(int), data.share)
    own = Weights(prior=0.0), FEW.replace(particles=30)
    done = refine_soup(begin, data, *own, seed=0)
    assert done.energy["total"] < 1e-9 * done.energy_begin["total"]
    ratio = done.soup.depth_at(data.anchor_ray) / truth.depth_at(data.anchor_ray)
    assert np.abs(ratio / np.median(ratio) - 1).max() < 1e-9


def test_interruption_and_time_limit_keep_the_best():
    tiny = Tiny("pixels", samples=6)
    weights = weights_for("pixels")
    stop = threading.Event()
    stop.set()
    done = refine_soup(tiny.soup, tiny.data, weights, FEW, watch=Watch(stop=stop))
    assert done.status == "interrupted"
    assert not done.rounds
    assert done.energy["total"] == pytest.approx(
        oracle.energy(tiny.soup, tiny.data, weights)["total"], rel=1e-12
    )
    late = refine_soup(tiny.soup, tiny.data, weights, FEW.replace(max_seconds=1e-9))
    assert late.status == "time limit"
    assert not late.rounds


@pytest.mark.parametrize("particles", [2, 3, 9])
def test_few_particles_and_a_lone_superpixel_work(particles):
    for tiny in (Tiny("pixels", samples=6), Tiny("pixels", samples=6, superpixels=1)):
        own = weights_for("pixels"), FEW.replace(particles=particles)
        done = refine_soup(tiny.soup, tiny.data, *own)
        assert done.energy["total"] <= done.energy_begin["total"]


@pytest.mark.parametrize("chosen", [[0], [3, 7], range(6), range(12)])
def test_the_mrf_follows_a_change_of_length_unit(chosen):
    """In the paper's units every depth changes the length unit: unary costs contain that change."""
    tiny = Tiny(samples=6)
    data, weights = tiny.data, weights_for("paper", truncated=False)
    best = tiny.soup.normalised(data.share).retracted()
    now, h = Particles.of(best), 1e-4
    # particle 1: plane and translation grow together, and with them the unit
    p = now.joined(Particles(now.n, (1 + h) * now.D, now.R, (1 + h) * now.T))
    visibility = data.visibility_ray(5.0), 1e-3
    rounds = mppbp.Rounds(best, {}, data, weights, RefineOptions(), None, visibility, 0)
    unary, pairwise = rounds.costs(p)
    labels = np.zeros((2, len(best)), np.int64)
    labels[1, list(chosen)] = 1
    edges, table = rounds.pairs.edges, np.asarray(pairwise, float)
    mrf = [mrf_energy(x, unary, edges, table) for x in labels]
    soups = [p.soup(x, data.share).retracted() for x in labels]
    exact = [oracle.energy(x, data, weights)["total"] for x in soups]
    share = data.share * best.distance
    unit = share[list(chosen)].sum() / share.sum()
    # to first order: the neglected terms are much smaller than the effect of the unit
    slope = mppbp.length_slope(best, data, weights)
    assert abs(np.diff(mrf)[0] - np.diff(exact)[0]) < 0.02 * abs(slope * h * unit)


def test_a_slow_round_ends_the_refinement(monkeypatch):
    """Two fast rounds, then a slow one."""
    tiny = Tiny("pixels", samples=6)
    totals = iter([100.0, 90.0, 50.0, 49.99, 10.0, 5.0])
    monkeypatch.setattr(
        mppbp.oracle, "energy", lambda *a: {"total": next(totals), "proj": 0.0, "arap": 0.0}
    )
    o = FEW.replace(rounds=6, stagnation=1e-2, particles=4)
    done = refine_soup(tiny.soup, tiny.data, weights_for("pixels"), o)
    assert done.status == "stagnated"
    assert [r.energy["total"] for r in done.rounds] == [90.0, 50.0, 49.99]
