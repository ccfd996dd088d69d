"""TRW-S against plain loops of the original, brute force, linear programs and invariances."""

from __future__ import annotations

import itertools
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog
from scipy.sparse import coo_array

from soup_nlp.errors import ModelError
from soup_nlp.refine.trws import TRWSResult, mrf_energy, solve_trws
from soup_nlp.refine.trws_order import colour_order, node_levels, plan_levels

FOREVER = {"gap": -1.0, "stagnation": -1.0}
seeds = st.integers(0, 2**32 - 1)


def textbook(unary, edges, tables, sequence, iterations):
    """TRW_S-v1.3, general type, node by node: bounds, energies and labels of every iteration."""
    rank = {int(v): k for k, v in enumerate(sequence)}
    arcs = []  # tail, head, table with the tail first: the original swaps ends the same way
    for (a, b), table in zip(edges, tables):
        arcs.append((a, b, table) if rank[a] < rank[b] else (b, a, table.T))
    ahead = {v: [e for e, arc in enumerate(arcs) if arc[0] == v] for v in rank}
    behind = {v: [e for e, arc in enumerate(arcs) if arc[1] == v] for v in rank}
    message = [np.zeros(arc[2].shape[0]) for arc in arcs]  # towards the tail, to begin with

    def belief(v):
        total = unary[v].copy()
        for e in ahead[v] + behind[v]:
            total += message[e]
        return total

    def gamma(v):
        return 1.0 / max(len(ahead[v]), len(behind[v]))

    bounds, energies, labellings = [], [], []
    for _ in range(iterations):
        for v in sequence:
            total = belief(v)
            for e in ahead[v]:
                table = arcs[e][2]
                out = np.empty(table.shape[1])
                for x in range(table.shape[1]):
                    out[x] = min(
                        gamma(v) * total[y] - message[e][y] + table[y, x] for y in range(len(total))
                    )
                message[e] = out - out.min()
        bound = 0.0
        for v in reversed(sequence):
            total = belief(v)
            bound += total.min()
            total -= total.min()
            for e in behind[v]:
                table = arcs[e][2]
                out = np.empty(table.shape[0])
                for y in range(table.shape[0]):
                    out[y] = min(
                        gamma(v) * total[x] - message[e][x] + table[y, x] for x in range(len(total))
                    )
                bound += out.min()
                message[e] = out - out.min()
        labels = np.zeros(len(unary), int)
        energy = 0.0
        for v in sequence:
            exact = unary[v].copy()
            for e in behind[v]:
                exact += arcs[e][2][labels[arcs[e][0]]]
            total = exact.copy()
            for e in ahead[v]:
                total += message[e]
            labels[v] = total.argmin()
            energy += exact[labels[v]]
        bounds.append(bound)
        energies.append(energy)
        labellings.append(labels)
    return np.array(bounds), np.array(energies), labellings


def random_edges(rng, n, count):
    """Distinct node pairs in random directions."""
    pairs = np.array(list(itertools.combinations(range(n), 2)), dtype=int).reshape(-1, 2)
    pairs = rng.permutation(pairs)[:count]
    return np.where(rng.random((len(pairs), 1)) < 0.5, pairs, pairs[:, ::-1])


def ragged(rng, n, count, most=5, scale=1.0):
    """Random problem with different label counts: unary list, edges, table list."""
    counts = rng.integers(1, most + 1, n)
    edges = random_edges(rng, n, count)
    unary = [scale * rng.normal(size=k) for k in counts]
    return unary, edges, [scale * rng.normal(size=(counts[a], counts[b])) for a, b in edges]


def dense(rng, n, count, size):
    """Random problem with equal label counts: unary array, edges, table array."""
    edges = random_edges(rng, n, count)
    return rng.normal(size=(n, size)), edges, rng.normal(size=(len(edges), size, size))


def brute(unary, edges, tables):
    """Least energy over all labellings."""
    return min(
        sum(u[x] for u, x in zip(unary, labels))
        + sum(t[labels[a], labels[b]] for (a, b), t in zip(edges, tables))
        for labels in itertools.product(*(range(len(u)) for u in unary))
    )


def local_polytope(unary, edges, tables):
    """Optimum of the linear program over the local polytope, by HiGHS."""
    starts = np.concatenate([[0], np.cumsum([len(u) for u in unary])])
    at = int(starts[-1])
    cost = [np.asarray(u, float) for u in unary]
    row, column, value, right = [], [], [], []
    for i, u in enumerate(unary):
        row += [len(right)] * len(u)
        column += list(range(starts[i], starts[i] + len(u)))
        value += [1.0] * len(u)
        right.append(1.0)
    for (a, b), table in zip(edges, tables):
        index = at + np.arange(table.size).reshape(table.shape)
        at += table.size
        cost.append(table.ravel())
        for node, lines in ((a, index), (b, index.T)):
            for x, line in enumerate(lines):
                row += [len(right)] * (len(line) + 1)
                column += [*line.tolist(), int(starts[node]) + x]
                value += [1.0] * len(line) + [-1.0]
                right.append(0.0)
    matrix = coo_array((value, (row, column)), shape=(len(right), at)).tocsr()
    solved = linprog(np.concatenate(cost), A_eq=matrix, b_eq=right, bounds=(0, None))
    assert solved.status == 0
    return solved.fun


def random_tree(rng, n):
    """Edges of a random tree, nodes shuffled."""
    name = rng.permutation(n)
    return np.array([(name[rng.integers(k)], name[k]) for k in range(1, n)])


def rises(result: TRWSResult, slack: float = 1e-10) -> bool:
    scale = max(1.0, abs(result.energy))
    return bool((np.diff(result.bound_history) >= -slack * scale).all())


# --- the original, node by node ---------------------------------------------------------------


@pytest.mark.parametrize("seed", range(12))
@pytest.mark.parametrize("order", ["input", "colour", "random"])
def test_equals_plain_loops(seed, order):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 15))
    unary, edges, tables = ragged(rng, n, int(rng.integers(0, 3 * n + 1)))
    if order == "random":
        sequence = order = rng.permutation(n)
    else:
        sequence = np.arange(n) if order == "input" else colour_order(n, edges)
    bounds, energies, labellings = textbook(unary, edges, tables, sequence, 8)
    for k in (1, 8):
        result = solve_trws(unary, edges, tables, order=order, max_iter=k, **FOREVER)
        np.testing.assert_allclose(result.bound_history, bounds[:k], rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(result.energy_history, energies[:k], rtol=1e-12, atol=1e-12)
        best = int(np.argmin(energies[:k]))
        np.testing.assert_array_equal(result.labels, labellings[best])
        np.testing.assert_allclose(result.best_history, np.minimum.accumulate(energies[:k]))


def test_equals_plain_loops_on_a_grid_with_many_tables_a_block(monkeypatch):
    monkeypatch.setattr("soup_nlp.refine.trws_order._CACHE_BYTES", 3 * 7 * 7 * 8)
    rng = np.random.default_rng(3)
    index = np.arange(48).reshape(6, 8)
    edges = np.concatenate(
        [
            np.stack([index[:, :-1].ravel(), index[:, 1:].ravel()], 1),
            np.stack([index[1:].ravel(), index[:-1].ravel()], 1),
        ]
    )
    unary, tables = rng.random((48, 7)), rng.random((len(edges), 7, 7))
    bounds, energies, _ = textbook(unary, edges, tables, np.arange(48), 5)
    result = solve_trws(unary, edges, tables, order="input", max_iter=5, **FOREVER)
    np.testing.assert_allclose(result.bound_history, bounds, rtol=1e-12)
    np.testing.assert_allclose(result.energy_history, energies, rtol=1e-12)
    assert rises(result)


# --- exactness and bounds ---------------------------------------------------------------------


@pytest.mark.parametrize("order", ["input", "colour"])
def test_chain_is_exact(order):
    rng = np.random.default_rng(0)
    n, size = 40, 6
    unary, tables = rng.normal(size=(n, size)), rng.normal(size=(n - 1, size, size))
    edges = np.stack([np.arange(n - 1), np.arange(1, n)], 1)
    value = unary[0]
    for k in range(1, n):
        value = unary[k] + (value[:, None] + tables[k - 1]).min(0)
    result = solve_trws(unary, edges, tables, order=order, max_iter=2000, gap=1e-10, patience=200)
    assert result.status == "gap"
    assert result.energy == pytest.approx(value.min(), abs=1e-9)
    assert result.lower_bound == pytest.approx(value.min(), abs=1e-7)
    assert order == "colour" or result.iterations == 1
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
    order = rng.permutation(n)
    result = solve_trws(
        unary, edges, tables, order=order, max_iter=3000, gap=1e-9, stagnation=1e-13, patience=50
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
    order = ["input", "colour", rng.permutation(n)][seed % 3]
    result = solve_trws(unary, edges, tables, order=order, max_iter=60)
    relaxed, least = local_polytope(unary, edges, tables), brute(unary, edges, tables)
    slack = 1e-7 * max(1.0, abs(least))
    assert result.lower_bound <= relaxed + slack
    assert relaxed <= least + slack
    assert least <= result.energy + 1e-9
    assert result.lower_bound <= result.energy
    assert (result.energy_history >= result.energy - 1e-9).all()
    assert result.energy == pytest.approx(result.best_history[-1], rel=1e-12, abs=1e-12)
    assert (np.diff(result.best_history) <= 0).all()
    assert result.energy == mrf_energy(result.labels, unary, edges, tables)
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
    assert half.energy == mrf_energy(half.labels, unary, edges, tables)
    assert half.energy == pytest.approx(half.best_history[-1], rel=1e-5)
    assert rises(full)
    assert rises(half, 1e-5)


# --- invariances ------------------------------------------------------------------------------


@given(seeds)
@settings(max_examples=25, deadline=None)
def test_names_of_nodes_labels_and_edge_directions_do_not_matter(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 9))
    unary, edges, tables = ragged(rng, n, int(rng.integers(1, 20)))
    order = rng.permutation(n)
    plain = solve_trws(unary, edges, tables, order=order, max_iter=6, **FOREVER)

    name = rng.permutation(n)  # node v is now name[v]; its label x is now shift[v][x]
    shift = [rng.permutation(len(u)) for u in unary]
    other_unary = [np.empty(0)] * n
    for v in range(n):
        moved = np.empty(len(unary[v]))
        moved[shift[v]] = unary[v]
        other_unary[name[v]] = moved
    other_edges, other_tables = [], []
    for e in rng.permutation(len(edges)):
        a, b = edges[e]
        table = np.empty_like(tables[e])
        table[np.ix_(shift[a], shift[b])] = tables[e]
        turn = rng.random() < 0.5
        other_edges.append((name[b], name[a]) if turn else (name[a], name[b]))
        other_tables.append(table.T if turn else table)
    other = solve_trws(
        other_unary, np.array(other_edges), other_tables, order=name[order], max_iter=6, **FOREVER
    )
    np.testing.assert_allclose(other.bound_history, plain.bound_history, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(other.energy_history, plain.energy_history, rtol=1e-10, atol=1e-10)
    mapped = [shift[v][plain.labels[v]] for v in range(n)]
    np.testing.assert_array_equal(other.labels[name], mapped)


@given(seeds, st.booleans())
@settings(max_examples=25, deadline=None)
def test_reparametrisation(seed, late):
    """Cost moved between tables and nodes: the energy, and all passes if moved to later nodes."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 7))
    unary, edges, tables = ragged(rng, n, int(rng.integers(1, 16)), most=3)
    order = rng.permutation(n)
    rank = np.argsort(order)
    other_unary, other_tables = [u.copy() for u in unary], [t.copy() for t in tables]
    for e, (a, b) in enumerate(edges):
        for axis, v, far in ((0, a, b), (1, b, a)):
            if late and rank[v] < rank[far]:
                continue  # the first forward pass reads the messages into earlier nodes
            move = rng.normal(size=len(unary[v]))
            other_unary[v] += move
            other_tables[e] -= move[:, None] if axis == 0 else move
    plain = solve_trws(unary, edges, tables, order=order, max_iter=8, **FOREVER)
    other = solve_trws(other_unary, edges, other_tables, order=order, max_iter=8, **FOREVER)
    assert mrf_energy(plain.labels, other_unary, edges, other_tables) == pytest.approx(
        plain.energy, abs=1e-9
    )
    least = brute(unary, edges, tables)
    assert other.lower_bound <= least + 1e-9 <= other.energy + 2e-9
    assert rises(other)
    if late:
        np.testing.assert_allclose(other.bound_history, plain.bound_history, atol=1e-9)
        np.testing.assert_allclose(other.energy_history, plain.energy_history, atol=1e-9)
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
    assert other.energy == pytest.approx(scale * (plain.energy + shift), abs=1e-9)


# --- orders and batches -----------------------------------------------------------------------


@given(seeds)
@settings(max_examples=25, deadline=None)
def test_levels_climb_and_colours_are_levels(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 30))
    edges = random_edges(rng, n, int(rng.integers(0, 4 * n)))
    for sequence in (np.arange(n), rng.permutation(n), colour_order(n, edges)):
        assert sorted(sequence.tolist()) == list(range(n))
        level, rank = node_levels(sequence, edges), np.argsort(sequence)
        assert ((level[edges[:, 0]] < level[edges[:, 1]]) == (rank[edges] @ [-1, 1] > 0)).all()
        assert (level[edges[:, 0]] != level[edges[:, 1]]).all()
        plan = plan_levels(sequence, edges)
        assert sorted(np.concatenate([p.nodes for p in plan]).tolist()) == list(range(n))
        for part in ("up", "down"):
            ids = np.concatenate([getattr(p, part).ids for p in plan])
            assert sorted(ids.tolist()) == list(range(len(edges)))
    coloured = colour_order(n, edges)
    assert (np.diff(node_levels(coloured, edges)[coloured]) >= 0).all()
    degree = np.bincount(edges.ravel(), minlength=n).max() if len(edges) else 0
    assert node_levels(coloured, edges).max() <= degree


def test_a_bipartite_graph_takes_two_levels():
    edges = np.array([(a, b) for a in range(5) for b in range(5, 11)])
    assert node_levels(colour_order(11, edges), edges).max() == 1


# --- forms of input ---------------------------------------------------------------------------


def test_functions_lists_and_arrays_agree(monkeypatch):
    monkeypatch.setattr("soup_nlp.refine.trws.CALL_BYTES", 5 * 4 * 4 * 8)
    monkeypatch.setattr("soup_nlp.refine.trws_order.CALL_BYTES", 5 * 4 * 4 * 8)
    rng = np.random.default_rng(7)
    unary, edges, tables = dense(rng, 12, 30, 4)
    asked: list[int] = []

    def pairwise(ids):
        asked.append(len(ids))
        return tables[ids]

    plain = solve_trws(unary, edges, tables, max_iter=4, polish=True, **FOREVER)
    before = tables.copy()
    for form, keep in ((list(tables), True), (pairwise, True), (pairwise, False)):
        other = solve_trws(unary, edges, form, max_iter=4, polish=True, keep_tables=keep, **FOREVER)
        np.testing.assert_array_equal(other.bound_history, plain.bound_history)
        np.testing.assert_array_equal(other.energy_history, plain.energy_history)
        np.testing.assert_array_equal(other.labels, plain.labels)
        assert other.energy == pytest.approx(plain.energy, abs=1e-12)
    assert max(asked) == 5
    np.testing.assert_array_equal(tables, before)


def test_padded_function_with_different_label_counts():
    rng = np.random.default_rng(8)
    unary, edges, tables = ragged(rng, 8, 15)
    size = max(len(u) for u in unary)

    def pairwise(ids):
        out = np.full((len(ids), size, size), -1e3)  # nonsense where there is no label
        for k, e in enumerate(ids):
            out[k, : tables[e].shape[0], : tables[e].shape[1]] = tables[e]
        return out

    plain = solve_trws(unary, edges, tables, max_iter=5, **FOREVER)
    for keep in (True, False):
        other = solve_trws(unary, edges, pairwise, max_iter=5, keep_tables=keep, **FOREVER)
        np.testing.assert_array_equal(other.bound_history, plain.bound_history)
        np.testing.assert_array_equal(other.labels, plain.labels)


def test_an_infinite_unary_cost_forbids_a_label():
    rng = np.random.default_rng(9)
    unary, edges, tables = dense(rng, 7, 12, 4)
    allowed = rng.random((7, 4)) < 0.6
    allowed[np.arange(7), rng.integers(0, 4, 7)] = True
    short = [u[keep] for u, keep in zip(unary, allowed)]
    cut = [t[np.ix_(allowed[a], allowed[b])] for (a, b), t in zip(edges, tables)]
    plain = solve_trws(short, edges, cut, max_iter=6, **FOREVER)
    other = solve_trws(np.where(allowed, unary, np.inf), edges, tables, max_iter=6, **FOREVER)
    np.testing.assert_allclose(other.bound_history, plain.bound_history, rtol=1e-12)
    assert other.energy == pytest.approx(plain.energy)
    assert allowed[np.arange(7), other.labels].all()


def test_parallel_edges_are_added_up():
    rng = np.random.default_rng(10)
    unary, edges, tables = dense(rng, 6, 8, 3)
    twice = np.concatenate([edges, edges[[2, 5]], edges[[2, 7], ::-1]])
    extra = rng.normal(size=(4, 3, 3))
    both = np.concatenate([tables, extra])
    summed = tables.copy()
    summed[[2, 5]] += extra[:2]
    summed[[2, 7]] += extra[2:].transpose(0, 2, 1)
    plain = solve_trws(unary, edges, summed, max_iter=5, **FOREVER)
    other = solve_trws(unary, twice, both, max_iter=5, **FOREVER)
    np.testing.assert_allclose(other.bound_history, plain.bound_history, rtol=1e-12)
    assert other.energy == mrf_energy(other.labels, unary, twice, both)
    assert other.energy == pytest.approx(plain.energy)
    with pytest.raises(ModelError, match="Parallel"):
        solve_trws(unary, twice, lambda ids: both[ids], keep_tables=False)


def test_no_edges_lone_nodes_and_single_labels():
    unary = [np.array([2.0, 1.0]), np.array([3.0]), np.array([0.5, 0.5, 4.0])]
    alone = solve_trws(unary, np.zeros((0, 2), int), [])
    assert (alone.energy, alone.lower_bound, alone.status) == (4.5, 4.5, "gap")
    assert alone.labels.tolist() == [1, 0, 0]
    assert (alone.iterations, alone.ties) == (1, 1)
    joined = solve_trws(unary, np.array([[1, 0]]), [np.array([[5.0, 7.0]])])
    assert joined.energy == joined.lower_bound == pytest.approx(10.5)
    for empty in (np.zeros((0, 3, 3)), lambda ids: np.zeros((len(ids), 3, 3))):
        assert solve_trws(np.eye(3), [], empty).energy == 0.0


def test_tables_of_the_working_type_are_not_copied():
    rng = np.random.default_rng(11)
    unary, edges, tables = dense(rng, 60, 400, 40)
    tracemalloc.start()
    solve_trws(unary, edges, tables, max_iter=2, **FOREVER)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < tables.nbytes


# --- options ----------------------------------------------------------------------------------


def test_never_worse_than_the_initial_labels():
    rng = np.random.default_rng(12)
    unary, edges, tables = dense(rng, 6, 15, 3)
    grid = itertools.product(range(3), repeat=6)
    best = min(grid, key=lambda x: mrf_energy(np.array(x), unary, edges, tables))
    least = mrf_energy(np.array(best), unary, edges, tables)
    for dtype in (np.float64, np.float32):
        result = solve_trws(
            unary, edges, tables, init_labels=np.array(best), max_iter=1, dtype=dtype, **FOREVER
        )
        assert result.energy == least
        assert result.labels.tolist() == list(best)
        assert result.best_history[0] <= result.energy_history[0]


def test_polish_ends_where_no_single_node_helps():
    rng = np.random.default_rng(13)
    unary, edges, tables = dense(rng, 10, 40, 4)
    rough = solve_trws(unary, edges, tables, max_iter=1, **FOREVER)
    result = solve_trws(unary, edges, tables, max_iter=1, polish=True, **FOREVER)
    assert result.energy <= rough.energy
    for v, x in itertools.product(range(10), range(4)):
        moved = result.labels.copy()
        moved[v] = x
        assert mrf_energy(moved, unary, edges, tables) >= result.energy - 1e-9


def test_stops():
    rng = np.random.default_rng(14)
    unary, edges, tables = dense(rng, 12, 50, 4)
    few = solve_trws(unary, edges, tables, max_iter=3, **FOREVER)
    assert (few.status, few.iterations) == ("iterations", 3)
    assert len(few.bound_history) == len(few.energy_history) == len(few.best_history) == 3
    loose = solve_trws(unary, edges, tables, gap=10.0)
    assert (loose.status, loose.iterations) == ("gap", 1)
    stuck = solve_trws(unary, edges, tables, gap=-1.0, max_iter=5000, patience=4)
    assert stuck.status == "stagnation"
    rise = stuck.bound_history[-1] - stuck.bound_history[-5]
    assert rise <= 1e-7 * max(1.0, abs(stuck.bound_history[-1]))
    assert stuck.best_history[-1] == stuck.best_history[-5]


@pytest.mark.parametrize("how", ["interrupt", "answer"])
def test_interruption_keeps_the_best(how):
    rng = np.random.default_rng(15)
    unary, edges, tables = dense(rng, 12, 50, 4)
    seen = []

    def callback(iteration, bound, energy, best):
        seen.append((bound, energy, best))
        if iteration == 3:
            if how == "interrupt":
                raise KeyboardInterrupt
            return True
        return None

    result = solve_trws(unary, edges, tables, callback=callback, **FOREVER)
    assert (result.status, result.iterations) == ("interrupted", 3)
    columns = [result.bound_history, result.energy_history, result.best_history]
    np.testing.assert_array_equal(np.array(seen).T, columns)
    assert result.energy == pytest.approx(result.best_history[-1])


def test_interruption_in_the_first_pass():
    rng = np.random.default_rng(16)
    unary, edges, tables = dense(rng, 5, 6, 3)
    calls = []

    def pairwise(ids):
        calls.append(1)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return tables[ids]

    result = solve_trws(unary, edges, pairwise, keep_tables=False)
    assert (result.status, result.iterations) == ("interrupted", 0)
    assert result.lower_bound == -np.inf
    assert result.labels.tolist() == unary.argmin(1).tolist()


def test_result_is_frozen():
    result = solve_trws(np.eye(2), [], np.zeros((0, 2, 2)))
    with pytest.raises(AttributeError):
        result.energy = 0.0


# --- energy -----------------------------------------------------------------------------------


@given(seeds)
@settings(max_examples=15, deadline=None)
def test_energy_is_a_plain_sum(seed):
    rng = np.random.default_rng(seed)
    unary, edges, tables = dense(rng, 7, 12, 3)
    labels = rng.integers(0, 3, 7)
    total = sum(unary[i, x] for i, x in enumerate(labels))
    total += sum(t[labels[a], labels[b]] for (a, b), t in zip(edges, tables))
    for form in (tables, list(tables), lambda ids: tables[ids]):
        assert mrf_energy(labels, unary, edges, form) == pytest.approx(total, abs=1e-12)


# --- wrong inputs -----------------------------------------------------------------------------

GOOD = {
    "unary": np.zeros((3, 2)),
    "edges": np.array([[0, 1], [1, 2]]),
    "tables": np.zeros((2, 2, 2)),
}


@pytest.mark.parametrize(
    ("change", "where"),
    [
        ({"unary": np.zeros((0, 2))}, "unary"),
        ({"unary": np.zeros(3)}, "unary[0]"),
        ({"unary": np.array([[0, 1], [np.nan, 0], [0, 0]])}, "unary[1]"),
        ({"unary": np.array([[0, 1], [0, 0], [-np.inf, 0]])}, "unary[2]"),
        ({"unary": np.array([[0, 1], [0, 0], [np.inf, np.inf]])}, "unary[2]"),
        ({"unary": np.full((3, 2), 1e300), "dtype": np.float32}, "unary"),
        ({"edges": np.array([[0, 1], [1, 3]])}, "edges[1]"),
        ({"edges": np.array([[-1, 1], [1, 2]])}, "edges[0]"),
        ({"edges": np.array([[0, 1], [2, 2]])}, "edges[1]"),
        ({"edges": np.array([[0.0, 1.0], [1.0, 2.0]])}, "edges"),
        ({"edges": np.array([0, 1, 2])}, "edges"),
        ({"tables": np.zeros((2, 2, 3))}, "pairwise"),
        ({"tables": np.zeros((1, 2, 2))}, "pairwise"),
        ({"tables": np.full((2, 2, 2), np.inf)}, "pairwise[0]"),
        ({"tables": np.full((2, 2, 2), 1e300), "dtype": np.float32}, "pairwise[0]"),
        ({"tables": np.where(np.arange(2) == 1, np.nan, 0.0) * np.ones((2, 2, 2))}, "pairwise[0]"),
        ({"tables": [np.zeros((2, 2))]}, "pairwise"),
        ({"tables": [np.zeros((2, 2)), np.zeros((2, 3))]}, "pairwise[1]"),
        ({"tables": lambda ids: np.zeros((1, 2, 2))}, "pairwise(edges 0 to 1)"),
        ({"tables": lambda ids: np.full((len(ids), 2, 2), np.nan)}, "pairwise[0]"),
        ({"order": "colors"}, "order"),
        ({"order": np.array([0, 1, 1])}, "order"),
        ({"order": np.array([0, 1])}, "order"),
        ({"dtype": np.int32}, "dtype"),
        ({"max_iter": 0}, "max_iter"),
        ({"patience": 0}, "patience"),
        ({"init_labels": np.array([0, 1, 2])}, "init_labels"),
        ({"init_labels": np.array([0.0, 1.0, 1.0])}, "init_labels"),
    ],
)
def test_wrong_inputs_are_named(change, where):
    case = {**GOOD, **change}
    with pytest.raises(ModelError) as caught:
        solve_trws(case.pop("unary"), case.pop("edges"), case.pop("tables"), **case)
    assert caught.value.where == where
    assert caught.value.found is not None
    assert caught.value.expected is not None


def test_a_function_that_is_not_finite_is_caught_when_not_kept():
    with pytest.raises(ModelError, match="overflow"):
        solve_trws(
            GOOD["unary"],
            GOOD["edges"],
            lambda ids: np.full((len(ids), 2, 2), np.nan),
            keep_tables=False,
        )
    with pytest.raises(ModelError, match="wrong shape"):
        solve_trws(GOOD["unary"], GOOD["edges"], lambda ids: np.zeros((3, 2, 2)), keep_tables=False)
    with pytest.raises(ModelError, match="labels"):
        mrf_energy(np.zeros(2, int), GOOD["unary"], GOOD["edges"], GOOD["tables"])
