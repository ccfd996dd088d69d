"""TRW-S against plain loops of the original, brute force, linear programs and invariances."""

from __future__ import annotations

import numpy as np
import pytest
from helpers_trws import (
    FOREVER,
    brute,
    colour_order,
    dense,
    followed,
    local_polytope,
    padded,
    ragged,
    random_edges,
    random_tree,
    rises,
    seeds,
    textbook,
)
from hypothesis import given, settings

from soup_nlp.mrf.levels import colours, plan_levels
from soup_nlp.mrf.trws import mrf_energy

# --- the original, node by node ---------------------------------------------------------------


@pytest.mark.parametrize("seed", range(24))
def test_equals_plain_loops(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 15))
    unary, edges, tables = ragged(rng, n, int(rng.integers(0, 3 * n + 1)))
    bounds, energies, labellings = textbook(unary, edges, tables, colour_order(n, edges), 8)
    for k in (1, 8):
        result = followed(*padded(unary, edges, tables), max_iter=k, **FOREVER)
        np.testing.assert_allclose(result.bound_history, bounds[:k], rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(result.energy_history, energies[:k], rtol=1e-12, atol=1e-12)
        best = int(np.argmin(energies[:k]))
        np.testing.assert_array_equal(result.labels, labellings[best])
        np.testing.assert_allclose(result.best_history, np.minimum.accumulate(energies[:k]))


def test_equals_plain_loops_on_a_grid(monkeypatch):
    monkeypatch.setattr("soup_nlp.mrf.levels._CACHE_BYTES", 3 * 7 * 7 * 8)
    rng = np.random.default_rng(3)
    index = np.arange(48).reshape(6, 8)
    edges = np.concatenate(
        [
            np.stack([index[:, :-1].ravel(), index[:, 1:].ravel()], 1),
            np.stack([index[1:].ravel(), index[:-1].ravel()], 1),
        ]
    )
    unary, tables = rng.random((48, 7)), rng.random((len(edges), 7, 7))
    bounds, energies, _ = textbook(unary, edges, tables, colour_order(48, edges), 5)
    result = followed(unary, edges, tables, max_iter=5, **FOREVER)
    np.testing.assert_allclose(result.bound_history, bounds, rtol=1e-12)
    np.testing.assert_allclose(result.energy_history, energies, rtol=1e-12)
    assert rises(result)


# --- exactness and bounds ---------------------------------------------------------------------


@given(seeds)
@settings(max_examples=30, deadline=None)
def test_trees_are_exact(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 8))
    edges = random_tree(rng, n)
    counts = rng.integers(1, 4, n)
    unary = [rng.normal(size=k) for k in counts]
    tables = [rng.normal(size=(counts[a], counts[b])) for a, b in edges]
    result = followed(
        *padded(unary, edges, tables), max_iter=3000, gap=1e-9, stagnation=1e-13, patience=50
    )
    least = brute(unary, edges, tables)
    assert result.energy == pytest.approx(least, abs=1e-8)
    assert result.lower_bound == pytest.approx(least, abs=1e-6)
    assert rises(result)


@given(seeds)
@settings(max_examples=40, deadline=None)
def test_bound_linear_program_brute_force_in_this_order(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 7))
    unary, edges, tables = ragged(rng, n, int(rng.integers(1, 16)), most=4)
    arrays = padded(unary, edges, tables)
    result = followed(*arrays, max_iter=60)
    relaxed, least = local_polytope(unary, edges, tables), brute(unary, edges, tables)
    slack = 1e-7 * max(1.0, abs(least))
    assert result.lower_bound <= relaxed + slack
    assert relaxed <= least + slack
    assert least <= result.energy + 1e-9
    assert result.lower_bound <= result.energy  # the solver cuts its bound off at the energy
    assert (result.energy_history >= result.energy - 1e-9).all()
    assert result.energy == pytest.approx(result.best_history[-1], rel=1e-12, abs=1e-12)
    assert (np.diff(result.best_history) <= 0).all()
    assert result.energy == pytest.approx(mrf_energy(result.labels, *arrays), rel=1e-12)
    assert rises(result)


def test_binary_bound_reaches_the_relaxation_of_a_frustrated_cycle():
    edges = np.array([[0, 1], [1, 2], [0, 2]])
    table = np.eye(2)[None].repeat(3, axis=0)  # equal neighbours cost 1: one pair must be equal
    result = followed(np.zeros((3, 2)), edges, table, max_iter=50)
    assert local_polytope(np.zeros((3, 2)), edges, table) == pytest.approx(0.0)
    assert result.lower_bound == pytest.approx(0.0)
    assert result.energy == pytest.approx(1.0)
    assert result.status == "stagnation"
    assert result.ties >= 1


def test_larger_problem_float32_follows_float64():
    rng = np.random.default_rng(5)
    unary, edges, tables = dense(rng, 120, 700, 12)
    full = followed(unary, edges, tables, max_iter=20, **FOREVER)
    half = followed(unary, edges, tables, max_iter=20, dtype=np.float32, **FOREVER)
    scale = abs(full.energy)
    np.testing.assert_allclose(half.bound_history, full.bound_history, atol=1e-4 * scale)
    assert half.energy == pytest.approx(mrf_energy(half.labels, unary, edges, tables), rel=1e-12)
    assert half.energy == pytest.approx(half.best_history[-1], rel=1e-5)
    assert rises(full)
    assert rises(half, 1e-5)


# --- invariances ------------------------------------------------------------------------------


# --- levels -----------------------------------------------------------------------------------


@given(seeds)
@settings(max_examples=25, deadline=None)
def test_levels_are_colours_and_hold_every_edge_twice(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 30))
    edges = random_edges(rng, n, int(rng.integers(0, 4 * n)))
    colour = colours(n, edges)
    assert (colour[edges[:, 0]] != colour[edges[:, 1]]).all()
    degree = np.bincount(edges.ravel(), minlength=n).max() if len(edges) else 0
    assert colour.max() <= degree
    plan = plan_levels(colour, edges)
    assert sorted(np.concatenate([p.nodes for p in plan]).tolist()) == list(range(n))
    assert all((colour[p.nodes] == k).all() for k, p in enumerate(plan))
    for part in ("up", "down"):
        ids = np.concatenate([getattr(p, part).ids for p in plan])
        assert sorted(ids.tolist()) == list(range(len(edges)))


def test_a_bipartite_graph_takes_two_levels():
    edges = np.array([(a, b) for a in range(5) for b in range(5, 11)])
    assert colours(11, edges).max() == 1
