"""The exact energy: invariances, values by hand, pixel samples, degenerate problems."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from helpers_model import (
    K_NEXT,
    K_REF,
    PAPER,
    UNITS,
    Tiny,
    form,
    random_soup,
    tiny,
    weights_for,
    world,
)
from helpers_start import facing
from hypothesis import given, settings
from hypothesis import strategies as st

from soup_nlp.data.pair import Flow
from soup_nlp.geometry import camera
from soup_nlp.geometry.graph import build_segmentation
from soup_nlp.geometry.soup import Soup
from soup_nlp.model import oracle
from soup_nlp.model.elements import present
from soup_nlp.model.energy_data import HINGE, EnergyData, build_energy_data, sample_pixels
from soup_nlp.model.energy_options import BENDING, GAP, EnergyOptions, Weights
from soup_nlp.model.programs import build_matrix_nlp
from soup_nlp.model.reweighting import HELD, Known, weighted
from soup_nlp.pipeline.case import build_energy
from soup_nlp.start.labelling import limited_noise

# --- invariances ---------------------------------------------------------------------------------


def energies(soup: Soup, data: EnergyData, weights: Weights) -> np.ndarray:
    e = oracle.energy(soup, data, weights)
    return np.array([e[k] for k in present(data)])


@pytest.mark.parametrize("units", UNITS)
@settings(max_examples=6)
@given(seed=st.integers(0, 10_000), scale=st.floats(1e-3, 1e3))
def test_energy_knows_no_global_scale_and_no_gauge(units, seed, scale):
    problem, weights = tiny(units), weights_for(units)
    soup = random_soup(seed, 12)
    c = np.random.default_rng(seed).uniform(0.1, 10, 12)
    expected = energies(soup, problem.data, weights)
    for twin in (
        replace(soup, lam=scale * soup.lam),
        replace(soup, d=scale * soup.d, t=scale * soup.t),
        Soup(c * soup.lam, soup.n, soup.d / c, soup.R, soup.t / c[:, None]),
        soup.normalised(),
    ):
        np.testing.assert_allclose(energies(twin, problem.data, weights), expected, rtol=1e-9)


# --- energy by hand ------------------------------------------------------------------------------


def test_two_superpixels_by_hand():
    """Two fronto-parallel planes at depths 1 and 3, both moved sideways, by 0.1 and 0.3."""
    labels = np.zeros((4, 8), np.int32)
    labels[:, 4:] = 1
    K = camera.intrinsics(10.0, 10.0, 3.5, 1.5)
    image = np.zeros((4, 8, 3), np.uint8)
    seg = build_segmentation(labels, image, neighbours=1, boundary_samples=None)
    flow = Flow(np.zeros((4, 8, 2), np.float32), np.ones((4, 8), np.float32), "zero")
    data = build_energy_data(seg, flow, K, K, None)
    D, T = np.array([1.0, 3.0]), np.array([[0.1, 0, 0], [0.3, 0, 0]])
    soup = facing(D, T)
    w = PAPER.replace(arap=1, proj=1, cont=1, orient=1, sigma_cont=0.2, sigma_orient=0.5)
    e = oracle.energy(soup, data, w)
    mean = 2.0  # of the plane distances: the length unit
    anchor = np.array([[-0.2, 0, 1], [0.2, 0, 1]])  # centroids 1.5 and 5.5 of columns about 3.5
    X = D[:, None] * anchor
    stretch = abs(np.linalg.norm(X[0] - X[1]) - np.linalg.norm(X[0] + T[0] - X[1] - T[1]))
    w1 = 2 * np.exp(-0.02 * 4)
    assert e["arap"] == pytest.approx(w1 * (0.2 + stretch) / mean)
    assert e["proj"] == pytest.approx(2 * 1.0)  # both move by one pixel
    rays = np.array([[0.0, (v - 1.5) / 10, 1] for v in range(4)])
    gap = np.linalg.norm(2 * rays) / mean  # four boundary points, stacked
    after = np.linalg.norm(2 * rays + [0.2, 0, 0]) / mean
    w4 = 2 * 4  # one colour: four neighbours, both directions
    assert e["cont"] == pytest.approx(w4 * (gap + min(after, 0.2)))
    assert e["orient"] == 0
    assert "order" not in e
    # the second covers the first, by 20 %: its inverse depth lacks 1.2 - 1/3; then the other way
    near = ((1 + 3.0**-4) / 2) ** 0.25
    for sign, lack in ((1.0, 1.2 - 1 / 3), (-1.0, 1.2 / 3 - 1.0)):
        ordered = replace(data, order_weight=np.array([0.5 * sign]), order_step=np.array([0.2]))
        x = lack / near
        hinge = (x + np.hypot(x, HINGE)) / 2
        assert (hinge > 0.1) == (sign > 0)
        priced = oracle.energy(soup, ordered, w.replace(order=3))["order"]
        assert priced == pytest.approx(3 * 0.5 * hinge)


@pytest.mark.parametrize(
    ("name", "parallax"),
    [("at rest", 0.5), ("fronto-parallel, sideways", 45 * np.hypot(0.1, 0.03))],
)
def test_pixel_units_by_hand(name, parallax):
    """At depth Z under a baseline T: a turn costs focal x angle, a motion gap g costs focal g / Z,
    a depth gap g costs the parallax focal (g / Z) (T / Z), of at least half a pixel."""
    data = world(name, "pixels", False)[1]
    np.testing.assert_allclose(data.pair_unit, 1 / parallax)
    np.testing.assert_allclose(data.edge_unit, 1 / 90)
    np.testing.assert_allclose(data.rotation_scale, 90)
    assert data.local_units


def test_sampled_boundaries_stand_for_the_whole():
    """With constant gaps the sampled Frobenius norm, times its factor, is that of all points."""
    soup = random_soup(0, 12, spread=0.0)
    lam = soup.lam * np.random.default_rng(0).uniform(0.8, 1.2, 12)
    soup = replace(soup, lam=lam)
    few = oracle.values("cont", soup, Tiny(boundary_samples=3).data, PAPER)
    every = oracle.values("cont", soup, Tiny(boundary_samples=None).data, PAPER)
    np.testing.assert_allclose(few, every, rtol=0.02)


# --- samples -------------------------------------------------------------------------------------


def test_sampled_pixels_are_distinct_confident_and_from_their_superpixel():
    problem = tiny()
    index, there = sample_pixels(problem.seg.labels, problem.flow, 9, 0)
    confidence = problem.flow.confidence.ravel()
    for i in range(12):
        mine = index[i][there[i]]
        assert len(set(mine.tolist())) == len(mine) == 9
        assert (problem.seg.labels.ravel()[mine] == i).all()
        assert (confidence[mine] > 0).all()
    again, _ = sample_pixels(problem.seg.labels, problem.flow, 9, 0)
    np.testing.assert_array_equal(index, again)
    other, _ = sample_pixels(problem.seg.labels, problem.flow, 9, 1)
    assert (index != other).any()
    # without a number all are taken
    index, there = sample_pixels(problem.seg.labels, problem.flow, None, 0)
    np.testing.assert_array_equal(np.sort(index[there]), np.flatnonzero(confidence > 0))


@pytest.mark.parametrize("blind", [[5], range(12)])
def test_superpixels_without_flow_take_no_pixels_and_have_no_projection(blind):
    problem = tiny()
    confidence, none = problem.flow.confidence.copy(), np.isin(range(12), blind)
    confidence[none[problem.seg.labels]] = 0
    flow = Flow(problem.flow.uv, confidence, "test")
    data = build_energy_data(problem.seg, flow, K_REF, K_NEXT, 6)
    assert (data.pixel_weight[none] == 0).all()
    assert (data.pixel_weight[~none] > 0).all()
    error = oracle.values("proj", problem.soup, data, PAPER)
    assert (error[none] == 0).all()
    nlp, _ = build_matrix_nlp(problem.soup, data, PAPER, form())
    assert np.isfinite(nlp.value(nlp.x0))


def test_prior_is_the_relative_slope_of_inverse_depth():
    problem = tiny("pixels")
    soup, data = problem.soup, replace(problem.data, prior_relief=0 * problem.data.edge_unit)
    expected = 0.0
    ray, Z = data.anchor_ray, soup.depth_at(data.anchor_ray)
    for i, near in enumerate(problem.seg.knn):
        for k in near:
            larger = ((Z[i] ** -4 + Z[k] ** -4) / 2) ** 0.25
            change = abs(1 / Z[i] - 1 / Z[k]) / larger
            expected += change / np.linalg.norm(ray[i] - ray[k]) / len(near)
    e = oracle.energy(soup, data, PAPER.replace(prior=0.7))
    assert e["prior"] == pytest.approx(0.7 * expected)
    flat = replace(soup, n=np.tile([0.0, 0.0, -1.0], (len(soup), 1)))
    flat = replace(flat, lam=1 / flat.d)
    assert oracle.energy(flat, data, PAPER)["prior"] == 0


@pytest.mark.parametrize(("error", "noise"), [(0.0, 0.05), (0.3, 0.3), (9.0, 0.6)])
def test_prior_is_measured_in_the_noise_of_the_flow(error, noise, small_room):
    assert limited_noise(np.full(12, error)) == noise
    wrong = np.arange(len(small_room)) == 5
    start = replace(small_room.start, noise=noise * small_room.start.noise, wrong=wrong)
    seg, whole = small_room.segmentation, small_room.data
    data, _ = build_energy(small_room.problem, small_room.pair, seg, start)
    weight, expected = (d.prior_weight[: len(seg.edges)] for d in (data, whole))
    np.testing.assert_allclose(weight, noise * expected)
    # what the start says of the flow counts as well
    assert not data.pixel_weight[wrong].any()
    assert data.pixel_weight[~wrong].any(axis=1).mean() > 0.9


def of_scene(count: int, **changes: Any) -> Known:
    """A scene of one component with depth of its own, with changes."""
    none = np.zeros(count, bool)
    plain = Known(none.astype(int), none, np.ones(count), 1.0, None, none)
    return replace(plain, **changes)


def test_weights_are_shares_across_components_and_factors_where_surfaces_bend():
    data, count = tiny("pixels").data, len(tiny().soup)
    part, bends = np.arange(count) % 2, np.arange(count) < 8
    (a, b), (i, k) = data.edges.T, data.pairs.T
    z = tiny().soup.depth_across(data.pairs, data.boundary_ray.mean(axis=1))
    gap = np.abs(z[0] - z[1]) > GAP * z.max(axis=0)
    assert 0 < gap[part[i] != part[k]].sum() < (part[i] != part[k]).sum()
    joined = np.where(part[a] == part[b], 1.0, 0.2)
    meets = np.where((part[i] != part[k]) & gap, 0.2, 1.0)
    options = EnergyOptions(across=0.2)
    # wherever bending begins, it does so at superpixels that both bend
    factor = {
        name: [np.where(bends[p] & bends[q], value, 1.0) for p, q in ((a, b), (i, k))]
        for name, value in BENDING.items()
    }
    found = weighted(
        data, tiny().soup, of_scene(count, component=part, bends=bends, noise=0.5), options
    )
    np.testing.assert_allclose(found.edge_weight, joined * data.edge_weight)
    expected = 0.5 * factor["prior"][0] * joined * data.prior_weight
    np.testing.assert_allclose(found.prior_weight, expected)
    np.testing.assert_allclose(found.pair_weight, factor["cont"][1] * meets * data.pair_weight)
    steep = np.where(factor["orient"][1] > 1, count / 1000 * BENDING["orient"], 1.0)
    np.testing.assert_allclose(found.orient_weight, steep * data.orient_weight)


def test_what_a_prior_decides_keeps_its_slopes_and_has_its_depths():
    data, soup = tiny("pixels").data, tiny().soup
    part = np.arange(len(soup)) % 2
    ambiguity = np.where(np.arange(len(soup)) < 7, 1.0, 0.0)
    log_depth = np.log(soup.depth_at(data.anchor_ray))
    prior = log_depth, ambiguity, np.full(len(soup), 0.12)
    known = of_scene(len(soup), component=part, prior=prior)
    plain = replace(data, orient_turn=0 * data.orient_turn)
    found = weighted(plain, soup, known, EnergyOptions(across=1.0))
    i, k = data.edges.T
    # between components the flow says nothing
    by_prior = np.where(part[i] == part[k], np.maximum(ambiguity[i], ambiguity[k]), 1.0)
    np.testing.assert_allclose(found.depth_weight, by_prior * data.prior_weight / 0.12)
    np.testing.assert_allclose(found.depth_change, log_depth[i] - log_depth[k])
    np.testing.assert_allclose(found.prior_weight, (1 - by_prior) * data.prior_weight)
    held = ambiguity[data.pairs].all(axis=1)
    assert 0 < held.sum() < len(held)
    cost = oracle.values("orient", soup, found, Weights())
    np.testing.assert_allclose(cost[held], 0.0, atol=1e-12)
    assert not found.orient_turn[~held].any()
    # orientation is held where the prior decides; where the flow does nothing changes
    steep = np.where(held, BENDING["orient"] * len(soup) / 1000, 1.0)
    np.testing.assert_allclose(found.orient_weight, steep * data.orient_weight)
    for some in (ambiguity, 0 * ambiguity):
        known = of_scene(len(soup), prior=(log_depth, some, np.full(len(soup), 0.12)))
        assert weighted(data, soup, known, EnergyOptions()).depth_weight.any() == some.any()


def test_what_is_not_seen_keeps_the_relief_of_the_start():
    data, soup = tiny("pixels").data, tiny().soup
    unseen = np.arange(len(soup)) < 7
    variance = np.where(unseen, np.inf, 1.0)
    found = weighted(data, soup, of_scene(len(soup), variance=variance), EnergyOptions())
    held = unseen[data.edges].any(axis=1)
    assert 0 < held.sum() < len(held)
    np.testing.assert_allclose(found.prior_weight, np.where(held, HELD, 1.0) * data.prior_weight)
    cost = oracle.values("prior", soup, found, Weights())
    np.testing.assert_allclose(cost[held], 0.0, atol=1e-12)
    assert not found.prior_relief[~held].any()


def test_order_weighs_by_the_noise_and_asks_for_steps_where_it_places():
    data, soup = tiny("pixels").data, tiny().soup
    count, first = len(soup), np.arange(len(data.pairs)) % 3 - 1.0
    placed = np.arange(count) < 4
    options = EnergyOptions()
    found = weighted(data, soup, of_scene(count, order=first, placed=placed, noise=0.5), options)
    np.testing.assert_allclose(found.order_weight, 0.5 * first)
    beside = placed[data.pairs].any(axis=1)
    assert (found.order_step[beside] > 0).any()
    assert (found.order_step >= 0).all()
    assert not found.order_step[~beside].any()
    off = options.replace(weights=options.weights.replace(order=0.0))
    assert not weighted(data, soup, of_scene(count, order=first), off).order_weight.any()


def test_local_units_make_every_edge_blind_to_its_own_scale():
    """Both superpixels of an edge twice as far: its energy stays, while others' does not."""
    problem, weights = tiny("pixels", True), weights_for("pixels", truncated=False)
    i, k = problem.seg.edges[0]
    lam = problem.soup.lam.copy()
    lam[[i, k]] *= 2
    twice = replace(problem.soup, lam=lam)
    a = oracle.values("arap", problem.soup, problem.data, weights)
    b = oracle.values("arap", twice, problem.data, weights)
    assert b[0] == pytest.approx(a[0], rel=1e-12)
    touched = np.isin(problem.seg.edges, [i, k]).any(axis=1)
    np.testing.assert_allclose(b[~touched], a[~touched], rtol=1e-12)
    assert (b[touched][1:] != a[touched][1:]).all()
