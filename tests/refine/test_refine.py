"""Particles are feasible and mean what they say; rounds never raise E, and they find repairs."""

from __future__ import annotations

import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from helpers_model import K_NEXT, K_REF, Tiny, random_soup, weights_for, with_graph

from soup_nlp.data.pair import Flow
from soup_nlp.geometry import camera, rotation
from soup_nlp.geometry.graph import build_segmentation
from soup_nlp.geometry.soup import Soup
from soup_nlp.geometry.superpixels import segment
from soup_nlp.model import oracle
from soup_nlp.model.energy_data import EnergyData, build_energy_data
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.reweighting import in_pixels
from soup_nlp.refine import mppbp
from soup_nlp.refine.anchored import Local, Particles, anchor_depth, neighbours
from soup_nlp.refine.mppbp import refine_soup
from soup_nlp.refine.particles import Proposer
from soup_nlp.refine.population import BORROWED, COMMON, KINDS, WALKS
from soup_nlp.refine.records import RefineOptions
from soup_nlp.solve.kkt import constraint_residuals
from soup_nlp.storage.progress import Watch

FEW = RefineOptions(rounds=3, particles=16)
NEW = (*WALKS, *COMMON, *BORROWED)


def proposer(tiny: Tiny, seed: int = 0) -> Proposer:
    near = neighbours(tiny.data.edges, tiny.data.anchor_ray)
    return Proposer(tiny.data, near, seed)


def anchor_targets(p: Particles, data: EnergyData) -> np.ndarray:
    """(N, L, 2) where anchors go, pixels."""
    X = anchor_depth(p, data.anchor_ray)[..., None] * data.anchor_ray[:, None]
    return camera.project(data.K_next, np.einsum("nlij,nlj->nli", p.R, X) + p.T)


class Planar:
    """Two planes under two motions in 30 grid superpixels, exact flow: the truth has known E."""

    def __init__(self, broken: int = 0, seed: int = 0) -> None:
        rng = np.random.default_rng(seed)
        image = np.zeros((60, 80, 3), np.uint8)
        labels = segment(image, 30, "grid")
        seg = build_segmentation(labels, image, 6, boundary_samples=2)
        n = len(seg)
        self.left = left = seg.anchors[:, 0] < 40
        normal = np.where(left[:, None], [0.2, 0.1, -1.0], [-0.3, 0.0, -1.0])
        normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        D = np.where(left, 1.0, 1.3)
        R = rotation.exp(np.where(left[:, None], [0.0, 0.02, 0.0], [0.03, -0.02, 0.01]))
        T = np.where(left[:, None], [0.08, 0.0, 0.02], [-0.05, 0.04, 0.0])
        self.truth = Soup(np.ones(n), normal, D, R, T)
        H = self.truth.homographies(K_REF, K_NEXT)[labels]
        uv = camera.pixel_grid(60, 80)
        y = np.einsum("hwij,hwj->hwi", H, np.concatenate([uv, np.ones((60, 80, 1))], axis=-1))
        flow = Flow(
            (y[..., :2] / y[..., 2:] - uv).astype(np.float32), np.ones((60, 80), np.float32), "test"
        )
        data = build_energy_data(seg, flow, K_REF, K_NEXT, 8, seed)
        self.data = in_pixels(data, self.truth, seg)
        self.bad = rng.choice(n, broken, replace=False)
        m = {k: getattr(self.truth, k).copy() for k in ("lam", "n", "d", "R", "t")}
        other = random_soup(seed + 7, n)
        for i in self.bad:
            m["n"][i], m["R"][i] = other.n[i], other.R[i]
            m["d"][i] *= np.exp(rng.normal(0, 0.3))
            m["t"][i] = other.t[i] * other.lam[i]
        self.soup = Soup(**m)


def test_local_coordinates_lose_nothing():
    tiny = Tiny()
    p = Local.of(tiny.soup, tiny.data.anchor_ray).particles(tiny.data.anchor_ray)
    for a, b in zip((p.n, p.D, p.R, p.T), vars(Particles.of(tiny.soup)).values()):
        assert np.allclose(a, b, atol=1e-14)


@pytest.mark.parametrize("kind", NEW)
def test_every_proposal_is_feasible_by_construction(kind):
    tiny = Tiny("pixels", samples=8)
    made = proposer(tiny).propose(tiny.soup, {kind: 4})
    p = made.particles
    n, count = p.shape
    assert n == len(tiny.soup)
    assert 1 <= count <= 4
    assert set(made.kind) == {KINDS.index(kind)}
    assert made.step.shape == (n, count)
    gram = np.swapaxes(p.R, 2, 3) @ p.R
    assert np.abs(gram - np.eye(3)).max() < 1e-13
    assert (np.linalg.det(p.R) > 0).all()
    assert np.abs(np.linalg.norm(p.n, axis=2) - 1).max() < 1e-14
    assert (p.D > 0).sum() >= 0.9 * p.D.size
    assert all(np.isfinite(v).all() for v in vars(p).values())
    # something is proposed: at most a re-fit may find the state that is there
    now = Particles.of(tiny.soup)
    moved = np.abs(p.R - now.R).max(axis=(2, 3)) + np.abs(p.T - now.T).max(axis=2)
    moved = moved + np.abs(p.n - now.n).max(axis=2) + np.abs(p.D - now.D)
    assert (moved > 1e-9).any(axis=1).all()


def test_scale_steps_and_turns_keep_the_anchors_target():
    tiny = Tiny("pixels")
    before = anchor_targets(Particles.of(tiny.soup), tiny.data)
    for kind in ("walk_scale", "walk_pivot"):
        p = proposer(tiny).propose(tiny.soup, {kind: 5}).particles
        assert np.abs(anchor_targets(p, tiny.data) - before).max() < 1e-9, kind
    p = proposer(tiny).propose(tiny.soup, {"walk_motion": 5}).particles
    assert np.abs(anchor_targets(p, tiny.data) - before).max() > 0.05


def test_a_step_is_about_so_many_pixels():
    tiny = Tiny("pixels")
    before = anchor_targets(Particles.of(tiny.soup), tiny.data)
    for kind in ("walk_plane", "walk_motion"):
        maker = proposer(tiny)
        maker.spread.width = 0.0
        maker.spread.centre[kind] = np.log(0.1)
        p = maker.propose(tiny.soup, {kind: 200}).particles
        moved = np.linalg.norm(anchor_targets(p, tiny.data) - before, axis=2)
        # several coordinates add up: from a third of the step to four times it
        assert 0.03 < np.median(moved) < 0.4, kind


def test_steps_follow_what_was_accepted():
    spread = proposer(Tiny()).spread
    spread.learn("walk_all", np.array([0.01, 0.01, 0.01, np.nan]))
    assert spread.centre["walk_all"] < np.log(0.1)
    before = spread.centre["walk_plane"]
    spread.learn("walk_plane", np.array([np.nan, 1.0]))
    assert spread.centre["walk_plane"] == pytest.approx(before + np.log(spread.shrink))


def test_neighbours_on_one_plane_propose_that_plane():
    scene = Planar()
    near = neighbours(scene.data.edges, scene.data.anchor_ray)
    made = Proposer(scene.data, near, 0).propose(scene.truth, {"neighbour_both": 3})
    p = made.particles
    same = np.abs(p.n - scene.truth.n[:, None]).max(axis=2) < 1e-9
    same &= np.abs(p.D - scene.truth.distance[:, None]) < 1e-9
    same &= np.abs(p.T - scene.truth.translation[:, None]).max(axis=2) < 1e-12
    # all but those beside the other component find themselves
    assert same.any(axis=1).mean() > 0.8
    assert same.mean() > 0.5


def test_a_refit_under_the_true_motion_finds_the_true_plane():
    scene = Planar(broken=6)
    truth, bad = scene.truth, scene.bad
    n = scene.soup.n.copy()
    D = scene.soup.distance.copy()
    planes_only = Soup(np.ones(len(n)), n, D, truth.R, truth.translation)
    near = neighbours(scene.data.edges, scene.data.anchor_ray)
    p = Proposer(scene.data, near, 0).propose(planes_only, {"own_refit": 1}).particles
    Z = anchor_depth(p, scene.data.anchor_ray)[:, 0]
    true = truth.depth_at(scene.data.anchor_ray)
    was = np.abs(planes_only.depth_at(scene.data.anchor_ray) / true - 1)[bad]
    assert was.mean() > 0.1
    assert np.abs(Z / true - 1)[bad].max() < 0.02


def test_neighbours_come_nearest_first():
    tiny = Tiny()
    near = neighbours(tiny.data.edges, tiny.data.anchor_ray)
    gap = np.linalg.norm(tiny.data.anchor_ray[near] - tiny.data.anchor_ray[:, None], axis=2)
    assert (np.diff(gap, axis=1) >= 0).all()
    edges = {tuple(e) for e in tiny.data.edges}
    assert all((min(i, k), max(i, k)) in edges for i in range(len(near)) for k in near[i])
    assert neighbours(np.zeros((0, 2), int), tiny.data.anchor_ray).shape == (12, 0)


@pytest.mark.parametrize("units", ["paper", "pixels"])
def test_no_round_raises_the_energy_or_violates_constraints(units):
    tiny = Tiny(units, samples=6)
    weights = weights_for(units)
    done = refine_soup(tiny.soup, tiny.data, weights, FEW, seed=1)
    totals = [done.energy_begin["total"], *(r.energy["total"] for r in done.rounds)]
    assert (np.diff(totals) <= 0).all()
    assert totals[-1] < 0.9 * totals[0]
    assert done.energy == oracle.energy(done.soup, tiny.data, weights)
    assert done.status == "rounds"
    assert len(done.rounds) == FEW.rounds
    residuals = constraint_residuals(done.soup, tiny.data.rim_ray, 1e-3)
    assert max(residuals.values()) < 1e-12
    for r in done.rounds:
        assert r.bound <= r.mrf_energy + 1e-9
        assert r.gap >= -1e-9
        assert sum(r.accepted.values()) == len(tiny.soup)
        assert r.spread.shape == (len(tiny.soup),)
        assert (r.spread >= 0).all()
        assert r.spread.max() > 0
        assert sum(r.proposed.values()) <= FEW.particles * len(tiny.soup)
        if units == "pixels" and r.taken:
            assert r.mrf_energy == pytest.approx(r.energy["total"], rel=1e-5)
    assert set(done.rounds[0].accepted) == set(KINDS)


def test_the_same_seed_gives_the_same_soup_and_another_another():
    tiny = Tiny("pixels", samples=6)
    weights = weights_for("pixels")
    a, b, c = (
        refine_soup(tiny.soup, tiny.data, weights, FEW, seed=s).soup.distance for s in (1, 1, 2)
    )
    assert np.array_equal(a, b)
    assert not np.allclose(a, c)


def test_broken_superpixels_are_repaired_by_their_neighbours():
    scene = Planar(broken=6)
    weights = Weights()
    truth = oracle.energy(scene.truth, scene.data, weights)["total"]
    begin = oracle.energy(scene.soup, scene.data, weights)["total"]
    assert begin > 1.5 * truth
    done = refine_soup(scene.soup, scene.data, weights, FEW.replace(particles=30), seed=0)
    assert done.energy["total"] < truth + 0.05 * (begin - truth)
    ratio = done.soup.depth_at(scene.data.anchor_ray) / scene.truth.depth_at(scene.data.anchor_ray)
    # what remains is the scale between the two components, which two views do not determine
    for component in (scene.left, ~scene.left):
        assert np.abs(ratio[component] / np.median(ratio[component]) - 1).max() < 1e-3


def test_a_soup_at_its_optimum_is_left_alone():
    scene = Planar()
    # one plane under one motion with exact flow: E is 0
    one = np.zeros(len(scene.truth), int)
    same = Soup(*(v[one] for v in vars(scene.truth).values()))
    y = same.moved(same.points(scene.data.pixel_ray.reshape(len(same), -1, 3)))
    data = replace(scene.data, pixel_target=camera.project(K_NEXT, y))
    # a slanted plane has relief, which E_prior charges
    done = refine_soup(same, data, Weights(prior=0.0), FEW, seed=0)
    assert done.energy["total"] < 1e-9
    ratio = done.soup.depth_at(data.anchor_ray) / same.depth_at(data.anchor_ray)
    assert np.abs(ratio / ratio[0] - 1).max() < 1e-6
    gap = done.soup.R - same.R
    assert np.abs(gap).max() < 1e-6


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
    stop.clear()
    lines: list[str] = []

    def say(line: str) -> None:
        lines.append(line)
        stop.set()

    done = refine_soup(tiny.soup, tiny.data, weights, FEW, watch=Watch(stop=stop, say=say))
    assert done.status == "interrupted"
    assert len(done.rounds) == len(lines) == 1
    assert done.energy["total"] < done.energy_begin["total"]
    late = refine_soup(tiny.soup, tiny.data, weights, FEW.replace(max_seconds=1e-9))
    assert late.status == "time limit"
    assert not late.rounds


@pytest.mark.parametrize(
    ("what", "status"),
    [("stop", "interrupted"), ("interrupt", "interrupted"), ("wait", "time limit")],
)
def test_a_listener_can_end_a_round(what, status, monkeypatch):
    """By the stop event or a KeyboardInterrupt, which TRW-S keeps to itself; or it takes long."""
    # TRW-S does not stop at a gap
    monkeypatch.setattr(mppbp, "TRWS_GAP", -1.0)
    tiny, stop, heard = Tiny("pixels", samples=6), threading.Event(), []

    def listener(progress: object) -> None:
        heard.append(str(progress))
        if what == "wait":
            time.sleep(0.55)
        elif len(heard) == 2 and what == "interrupt":
            raise KeyboardInterrupt
        elif len(heard) == 2:
            stop.set()

    o = FEW.replace(max_seconds=0.5 if what == "wait" else 300.0)
    watch = Watch(listener, stop)
    done = refine_soup(tiny.soup, tiny.data, weights_for("pixels"), o, seed=1, watch=watch)
    assert done.status == status
    assert stop.is_set() == (what == "stop")
    assert [r.status for r in done.rounds] == ["interrupted"]
    assert done.rounds[0].iterations == len(heard) == (1 if what == "wait" else 2)
    assert heard[0].startswith("refine 1")
    assert done.energy["total"] <= done.energy_begin["total"]


def test_stagnation_ends_the_rounds():
    tiny = Tiny("pixels", samples=6)
    o = FEW.replace(rounds=30, stagnation=0.5)
    done = refine_soup(tiny.soup, tiny.data, weights_for("pixels"), o)
    assert done.status == "stagnated"
    assert len(done.rounds) < 30


@pytest.mark.parametrize("particles", [2, 3, 9])
def test_few_particles_and_isolated_superpixels_work(particles):
    tiny = Tiny("pixels", samples=6)
    o = FEW.replace(particles=particles)
    done = refine_soup(tiny.soup, tiny.data, weights_for("pixels"), o)
    assert done.energy["total"] <= done.energy_begin["total"]
    alone = with_graph(tiny.data, [], [])
    done = refine_soup(tiny.soup, alone, weights_for("pixels"), o)
    assert done.energy["total"] <= done.energy_begin["total"]
