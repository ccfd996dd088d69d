"""Numbers of the refinement that its rounds would forgive: each is compared with what it means."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers_model import Tiny, weights_for
from test_refine import FEW, Planar

from soup_nlp.geometry import rotation
from soup_nlp.geometry.plane import tilt_to_camera
from soup_nlp.geometry.soup import Soup
from soup_nlp.model import oracle
from soup_nlp.mrf.trws import mrf_energy
from soup_nlp.refine import mppbp
from soup_nlp.refine.anchored import Local, Particles, fit_motion, neighbours
from soup_nlp.refine.costs import PairCosts
from soup_nlp.refine.mppbp import refine_soup
from soup_nlp.refine.particles import Proposer
from soup_nlp.refine.population import KINDS, SHARES, relearn, spread_of
from soup_nlp.refine.records import RefineOptions


def test_the_mrf_follows_a_change_of_length_unit():
    """In the paper's units every depth changes the unit of all: its price is in the unary costs."""
    tiny = Tiny(samples=6)
    weights = weights_for("paper", truncated=False)
    best = tiny.soup.normalised(tiny.data.share).retracted()
    pair_costs = PairCosts(tiny.data, weights)
    now = Particles.of(best)
    h = 1e-4
    # particle 1: plane and translation grow together, and with them the unit
    p = now.joined(Particles(now.n, (1 + h) * now.D, now.R, (1 + h) * now.T))
    rays, near = tiny.data.visibility_ray(5.0), neighbours(tiny.data.edges, tiny.data.anchor_ray)
    own = tiny.data, weights, None, RefineOptions(), rays, 1e-3, pair_costs, near
    unary, pairwise = mppbp._Costs(*own).of(best, p)
    slope = mppbp.length_slope(best, tiny.data, weights)
    for chosen in ([0], [3, 7], range(6), range(len(best))):
        labels = np.zeros(len(best), np.int64)
        labels[list(chosen)] = 1
        mrf = [
            mrf_energy(x, unary, pair_costs.edges, np.asarray(pairwise, float))
            for x in (0 * labels, labels)
        ]
        exact = [
            oracle.energy(p.soup(x, tiny.data.share).retracted(), tiny.data, weights)["total"]
            for x in (0 * labels, labels)
        ]
        share = float(np.sum((tiny.data.share * best.distance)[list(chosen)]))
        unit = share / float(np.sum(tiny.data.share * best.distance))
        # to first order; what the unit adds is much more than what is neglected
        assert abs(np.diff(mrf)[0] - np.diff(exact)[0]) < 0.02 * abs(slope * h * unit)


def test_accepted_kinds_are_proposed_more_often():
    shares, proposed = dict(SHARES), dict.fromkeys(KINDS, 100)
    accepted = {k: 50 if k == "walk_scale" else 1 for k in KINDS}
    for _ in range(20):
        relearn(shares, proposed, accepted)
    assert shares["walk_scale"] > 1.2 * SHARES["walk_scale"]
    for k in set(SHARES) - {"walk_scale"}:
        assert 0.4 * SHARES[k] < shares[k] < 0.9 * SHARES[k], k
    # where nothing at all is accepted nothing is learnt
    before = dict(shares)
    relearn(shares, proposed, dict.fromkeys(KINDS, 0))
    assert shares == before


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


def test_a_refit_under_the_true_motion_finds_the_true_slope():
    scene = Planar()
    truth, data = scene.truth, scene.data
    n = len(truth)
    now = Local.of(truth, data.anchor_ray)
    # planes parallel to the image at the true depth, true motion
    flat = Local(now.Z, 0 * now.g, now.R, now.T).particles(data.anchor_ray)
    soup = Soup(np.ones(n), flat.n[:, 0], flat.D[:, 0], flat.R[:, 0], flat.T[:, 0])
    proposer = Proposer(data, neighbours(data.edges, data.anchor_ray), 0)
    p = proposer.propose(soup, {"own_refit": 1}).particles
    was, found = (
        np.degrees(np.arccos(np.clip(np.sum(v * truth.n, axis=1), -1, 1)))
        for v in (soup.n, p.n[:, 0])
    )
    assert np.median(was) > 12
    assert np.median(found) < 0.4 * np.median(was)


@pytest.mark.parametrize(
    ("seed", "turn", "outliers", "rounds", "gaps"),
    [
        *[(seed, [0.2, -0.1, 0.8], 0, 5, (1e-6, 1e-6)) for seed in range(3)],
        (0, [0, 0, 0], 5, 15, (1e-3, 5e-3)),
    ],
)
def test_a_motion_is_fitted_to_its_points(seed, turn, outliers, rounds, gaps):
    rng = np.random.default_rng(seed)
    X = rng.uniform([-1, -1, 2], [1, 1, 4], (60, 3))
    begin = rotation.exp(np.array(turn, float))
    R, T = rotation.exp([0.03, -0.02, 0.05]) @ begin, np.array([0.1, -0.05, 0.2])
    Y = X @ R.T + T
    target = Y / Y[:, 2:]
    target[:outliers, :2] += 0.3
    R1, T1 = fit_motion(begin, np.zeros(3), X, target, np.ones(60), 500.0, rounds)
    assert np.abs(R1 - R).max() < gaps[0]
    assert np.abs(T1 - T).max() < gaps[1]


def test_a_plane_is_tilted_no_further_than_it_must_be():
    """It keeps nearly all of the slope that visibility allows, and the depth at its anchor."""
    tiny = Tiny("pixels")
    data = tiny.data
    rays = data.visibility_ray(5.0)
    now = Local.of(tiny.soup, data.anchor_ray)
    steep = np.tile([4.0, -3.0], (len(tiny.soup), 1, 1)) / data.radius[:, None, None]
    p = Local(now.Z, steep, now.R, now.T).particles(data.anchor_ray)
    made = Soup(np.ones(len(tiny.soup)), p.n[:, 0], p.D[:, 0], tiny.soup.R, tiny.soup.translation)

    def facing(soup: Soup) -> np.ndarray:
        return -np.einsum("nc,nvc->nv", soup.n, rays).max(axis=1)

    assert (facing(made) < 0).all()
    done = tilt_to_camera(made, data.anchor_ray, rays, 1e-3)
    assert (facing(done) >= 1e-3 - 1e-6).all()
    after = Local.of(done, data.anchor_ray)
    np.testing.assert_allclose(after.Z, now.Z, rtol=1e-12)
    kept = after.g[:, 0] / steep[:, 0]
    np.testing.assert_allclose(kept[:, 0], kept[:, 1], rtol=1e-9)
    assert (kept > 0.01).all()
    more = Local(after.Z, after.g / 0.7, now.R, now.T).particles(data.anchor_ray)
    assert (facing(replace(made, n=more.n[:, 0])) < 1e-3).all()


def test_the_spread_of_particles_weighs_depths_by_their_min_marginals():
    """Depths 1, e and one that is forbidden, the second half as likely as the first."""
    normal = np.tile([0.0, 0.0, -1.0], (1, 3, 1))
    D = np.array([[1.0, np.e, -5.0]])
    p = Particles(normal, D, np.tile(np.eye(3), (1, 3, 1, 1)), np.zeros((1, 3, 3)))
    cost = np.array([[0.0, np.log(2.0), np.inf]])
    found = spread_of(p, cost, np.array([[0.0, 0.0, 1.0]]))
    # mean 1/3, variance 2/3 (1/3)^2 + 1/3 (2/3)^2
    assert found == pytest.approx([np.sqrt(2 / 9)])
