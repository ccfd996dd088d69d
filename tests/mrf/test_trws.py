"""TRW-S against plain loops of the original, brute force, linear programs and invariances."""

from __future__ import annotations

import numpy as np
import pytest
from helpers_trws import (
    FOREVER,
    brute,
    colour_order,
    dense,
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
from hypothesis import strategies as st

from soup_nlp.mrf.levels import colours, plan_levels
from soup_nlp.mrf.trws import mrf_energy, solve_trws

# --- the original, node by node ---------------------------------------------------------------


@pytest.mark.parametrize("seed", range(24))
def test_equals_plain_loops(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 15))
    unary, edges, tables = ragged(rng, n, int(rng.integers(0, 3 * n + 1)))
    bounds, energies, labellings = textbook(unary, edges, tables, colour_order(n, edges), 8)
    for k in (1, 8):
        result = solve_trws(*padded(unary, edges, tables), max_iter=k, **FOREVER)
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
    result = solve_trws(unary, edges, tables, max_iter=5, **FOREVER)
    np.testing.assert_allclose(result.bound_history, bounds, rtol=1e-12)
    np.testing.assert_allclose(result.energy_history, energies, rtol=1e-12)
    assert rises(result)


# --- exactness and bounds ---------------------------------------------------------------------


def test_chain_is_exact():
    rng = np.random.default_rng(0)
    n, size = 40, 6
    unary, tables = rng.normal(size=(n, size)), rng.normal(size=(n - 1, size, size))
    edges = np.stack([np.arange(n - 1), np.arange(1, n)], 1)
    value = unary[0]
    for k in range(1, n):
        value = unary[k] + (value[:, None] + tables[k - 1]).min(0)
    result = solve_trws(unary, edges, tables, max_iter=2000, gap=1e-10, patience=200)
    assert result.status == "gap"
    assert result.energy == pytest.approx(value.min(), abs=1e-9)
    assert result.lower_bound == pytest.approx(value.min(), abs=1e-7)
    assert rises(result)


@given(seeds)
@settings(max_examples=30, deadline=None)
def test_trees_are_exact(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 8))
    edges = random_tree(rng, n)
    counts = rng.integers(1, 4, n)
    unary = [rng.normal(size=k) for k in counts]
    tables = [rng.normal(size=(counts[a], counts[b])) for a, b in edges]
    result = solve_trws(
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
    result = solve_trws(*arrays, max_iter=60)
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
    result = solve_trws(np.zeros((3, 2)), edges, table, max_iter=50)
    assert local_polytope(np.zeros((3, 2)), edges, table) == pytest.approx(0.0)
    assert result.lower_bound == pytest.approx(0.0)
    assert result.energy == pytest.approx(1.0)
    assert result.status == "stagnation"
    assert result.ties >= 1


def test_larger_problem_float32_follows_float64():
    rng = np.random.default_rng(5)
    unary, edges, tables = dense(rng, 120, 700, 12)
    full = solve_trws(unary, edges, tables, max_iter=20, **FOREVER)
    half = solve_trws(unary, edges, tables, max_iter=20, dtype=np.float32, **FOREVER)
    scale = abs(full.energy)
    np.testing.assert_allclose(half.bound_history, full.bound_history, atol=1e-4 * scale)
    assert half.energy == pytest.approx(mrf_energy(half.labels, unary, edges, tables), rel=1e-12)
    assert half.energy == pytest.approx(half.best_history[-1], rel=1e-5)
    assert rises(full)
    assert rises(half, 1e-5)


# --- invariances ------------------------------------------------------------------------------


@given(seeds)
@settings(max_examples=25, deadline=None)
def test_names_of_labels_and_edge_directions_do_not_matter(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 9))
    unary, edges, tables = dense(rng, n, int(rng.integers(1, 20)), 4)
    plain = solve_trws(unary, edges, tables, max_iter=6, **FOREVER)
    shift = np.array([rng.permutation(4) for _ in range(n)])  # label x of node v is shift[v, x]
    other_unary, other_tables = np.empty_like(unary), np.empty_like(tables)
    for v in range(n):
        other_unary[v, shift[v]] = unary[v]
    for e, (a, b) in enumerate(edges):
        other_tables[e][np.ix_(shift[a], shift[b])] = tables[e]
    turn = rng.random(len(edges)) < 0.5
    other_edges = np.where(turn[:, None], edges[:, ::-1], edges)
    other_tables[turn] = other_tables[turn].transpose(0, 2, 1)
    other = solve_trws(other_unary, other_edges, other_tables, max_iter=6, **FOREVER)
    np.testing.assert_allclose(other.bound_history, plain.bound_history, rtol=1e-10, atol=1e-10)
    # once the messages stand still labels may tie, and rounding decides how they are decoded
    np.testing.assert_allclose(other.energy_history[0], plain.energy_history[0], 1e-10, 1e-10)
    if not plain.ties:
        np.testing.assert_array_equal(other.labels, shift[np.arange(n), plain.labels])


@given(seeds, st.booleans())
@settings(max_examples=25, deadline=None)
def test_reparametrisation(seed, late):
    """Cost moved between tables and nodes: the energy, and all passes if moved to later nodes."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 7))
    unary, edges, tables = dense(rng, n, int(rng.integers(1, 16)), 3)
    rank = np.argsort(colour_order(n, edges))
    other_unary, other_tables = unary.copy(), tables.copy()
    for e, (a, b) in enumerate(edges):
        for axis, v, far in ((0, a, b), (1, b, a)):
            if late and rank[v] < rank[far]:
                continue  # the first forward pass reads the messages into earlier nodes
            move = rng.normal(size=3)
            other_unary[v] += move
            other_tables[e] -= move[:, None] if axis == 0 else move
    plain = solve_trws(unary, edges, tables, max_iter=8, **FOREVER)
    other = solve_trws(other_unary, edges, other_tables, max_iter=8, **FOREVER)
    assert mrf_energy(plain.labels, other_unary, edges, other_tables) == pytest.approx(
        plain.energy, abs=1e-9
    )
    least = brute(unary, edges, tables)
    assert other.lower_bound <= least + 1e-9 <= other.energy + 2e-9
    assert rises(other)
    if late:
        np.testing.assert_allclose(other.bound_history, plain.bound_history, atol=1e-9)
        # later ones may tie
        np.testing.assert_allclose(other.energy_history[0], plain.energy_history[0], atol=1e-9)
        if not plain.ties:
            np.testing.assert_array_equal(other.labels, plain.labels)


@given(seeds, st.floats(-5, 5), st.floats(0.1, 10))
@settings(max_examples=15, deadline=None)
def test_constants_and_scale(seed, constant, scale):
    rng = np.random.default_rng(seed)
    unary, edges, tables = dense(rng, 6, 9, 3)
    plain = solve_trws(unary, edges, tables, max_iter=5, **FOREVER)
    other = solve_trws(
        scale * (unary + constant), edges, scale * (tables - constant), max_iter=5, **FOREVER
    )
    shift = constant * (len(unary) - len(edges))
    np.testing.assert_allclose(other.bound_history, scale * (plain.bound_history + shift), 1e-9)
    first = scale * (plain.energy_history[0] + shift)
    assert other.energy_history[0] == pytest.approx(first, abs=1e-9)


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
