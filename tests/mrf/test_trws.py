"""TRW-S against plain loops of the original and brute force; its inputs, options and ends."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from soup_nlp.errors import ModelError
from soup_nlp.mrf.levels import colours
from soup_nlp.mrf.trws import mrf_energy, solve_trws

NO_EDGES, NO_TABLES = np.zeros((0, 2), int), np.zeros((0, 3, 3))
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

    def sent(v, e, total):
        """The message that a node sends along an arc."""
        table = arcs[e][2] if arcs[e][0] == v else arcs[e][2].T
        return np.min((gamma(v) * total - message[e])[:, None] + table, axis=0)

    bounds, energies, labellings = [], [], []
    for _ in range(iterations):
        for v in sequence:
            total = belief(v)
            for e in ahead[v]:
                out = sent(v, e, total)
                message[e] = out - out.min()
        bound = 0.0
        for v in reversed(sequence):
            total = belief(v)
            bound += total.min()
            total -= total.min()
            for e in behind[v]:
                out = sent(v, e, total)
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


def ragged(rng, n, edges, most=5):
    """Random costs of different label counts: unary list, the edges, table list."""
    counts = rng.integers(1, most + 1, n)
    unary = [rng.normal(size=k) for k in counts]
    return unary, edges, [rng.normal(size=(counts[a], counts[b])) for a, b in edges]


def padded(unary, edges, tables):
    """A ragged problem as arrays: labels that a node does not have cost +inf."""
    size = max(len(u) for u in unary)
    costs, table = np.full((len(unary), size), np.inf), np.full((len(edges), size, size), -1e3)
    for i, u in enumerate(unary):
        costs[i, : len(u)] = u
    for e, t in enumerate(tables):
        table[e, : t.shape[0], : t.shape[1]] = t
    return costs, edges, table


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


def random_tree(rng, n):
    """Edges of a random tree, nodes shuffled."""
    name = rng.permutation(n)
    return np.array([(name[rng.integers(k)], name[k]) for k in range(1, n)])


def followed(*problem, **options) -> SimpleNamespace:
    """The result of TRW-S, with bound, energy and least energy of every iteration."""
    rows = []
    result = solve_trws(*problem, callback=lambda _, *row: rows.append(row), **options)
    names = ("bound_history", "energy_history", "best_history")
    return SimpleNamespace(**vars(result), **dict(zip(names, np.array(rows).reshape(-1, 3).T)))


# --- the original, node by node ---------------------------------------------------------------


@pytest.mark.parametrize("seed", range(12))
def test_equals_plain_loops(seed, monkeypatch):
    if seed % 2:
        # edges are passed in small blocks
        monkeypatch.setattr("soup_nlp.mrf.trws._CACHE_BYTES", 3 * 5 * 5 * 8)
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 15))
    unary, edges, tables = ragged(rng, n, random_edges(rng, n, int(rng.integers(0, 3 * n + 1))))
    order = np.argsort(colours(n, edges), kind="stable")
    bounds, energies, labellings = textbook(unary, edges, tables, order, 8)
    for k in (1, 8):
        result = followed(*padded(unary, edges, tables), max_iter=k, gap=-1.0)
        np.testing.assert_allclose(result.bound_history, bounds[:k], rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(result.energy_history, energies[:k], rtol=1e-12, atol=1e-12)
        best = int(np.argmin(energies[:k]))
        np.testing.assert_array_equal(result.labels, labellings[best])
        np.testing.assert_allclose(result.best_history, np.minimum.accumulate(energies[:k]))


# --- exactness and bounds ---------------------------------------------------------------------


@pytest.mark.parametrize("shape", ["tree", "graph", "parallel edges"])
@given(seed=seeds)
@settings(max_examples=8)
def test_bound_brute_force_and_energy_in_this_order(shape, seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 7))
    graph = random_edges(rng, n, int(rng.integers(1, 16)))
    edges = {
        "tree": random_tree(rng, n),
        "graph": graph,
        "parallel edges": np.concatenate([graph, graph[:2, ::-1], graph[:1]]),
    }[shape]
    unary, edges, tables = ragged(rng, n, edges, most=4)
    arrays = padded(unary, edges, tables)
    result = followed(*arrays, max_iter=60)
    least = brute(unary, edges, tables)
    assert result.lower_bound - 1e-9 <= least <= result.energy + 1e-9
    assert result.lower_bound <= result.energy  # the solver cuts its bound off at the energy
    assert (result.energy_history >= result.energy - 1e-9).all()
    assert result.energy == pytest.approx(result.best_history[-1], rel=1e-12, abs=1e-12)
    assert (np.diff(result.best_history) <= 0).all()
    assert result.energy == pytest.approx(mrf_energy(result.labels, *arrays), rel=1e-12)
    slack = 1e-10 * max(1.0, abs(result.energy))
    assert (np.diff(result.bound_history) >= -slack).all()
    if shape == "tree":
        # exact, however long it takes
        result = followed(*arrays, max_iter=300, gap=1e-9)
        assert result.energy == pytest.approx(least, abs=1e-8)
        assert result.lower_bound == pytest.approx(least, abs=1e-6)


# --- levels -----------------------------------------------------------------------------------


@given(seeds)
def test_every_node_has_a_neighbour_in_each_lower_colour(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 30))
    edges = random_edges(rng, n, int(rng.integers(0, 4 * n)))
    colour = colours(n, edges)
    assert (colour[edges[:, 0]] != colour[edges[:, 1]]).all()
    degree = np.bincount(edges.ravel(), minlength=n).max() if len(edges) else 0
    assert colour.max() <= degree
    for v in range(n):
        beside = edges[(edges == v).any(axis=1)].ravel()
        assert {*range(colour[v])} <= {*colour[beside].tolist()}


# --- forms of input ---------------------------------------------------------------------------


def test_an_infinite_unary_cost_forbids_a_label():
    rng = np.random.default_rng(9)
    unary, edges, tables = dense(rng, 7, 12, 4)
    allowed = rng.random((7, 4)) < 0.6
    allowed[np.arange(7), rng.integers(0, 4, 7)] = True
    short = [u[keep] for u, keep in zip(unary, allowed)]
    cut = [t[np.ix_(allowed[a], allowed[b])] for (a, b), t in zip(edges, tables)]
    plain = followed(*padded(short, edges, cut), max_iter=6, gap=-1.0)
    forbidding = followed(np.where(allowed, unary, np.inf), edges, tables, max_iter=6, gap=-1.0)
    np.testing.assert_allclose(forbidding.bound_history, plain.bound_history, rtol=1e-12)
    assert forbidding.energy == pytest.approx(plain.energy)
    assert allowed[np.arange(7), forbidding.labels].all()


def test_no_edges_lone_nodes_and_single_labels():
    unary = [np.array([2.0, 1.0]), np.array([3.0]), np.array([0.5, 0.5, 4.0])]
    alone = solve_trws(*padded(unary, NO_EDGES, []))
    assert (alone.energy, alone.lower_bound, alone.status) == (4.5, 4.5, "gap")
    assert alone.labels.tolist() == [1, 0, 0]
    assert alone.iterations == 1
    joined = solve_trws(*padded(unary, np.array([[1, 0]]), [np.array([[5.0, 7.0]])]))
    assert joined.energy == pytest.approx(10.5)
    assert joined.lower_bound == pytest.approx(10.5)
    assert solve_trws(np.eye(3), NO_EDGES, NO_TABLES).energy == 0.0
    assert solve_trws(np.zeros((2, 1)), np.array([[0, 1]]), np.ones((1, 1, 1))).energy == 1.0


# --- options ----------------------------------------------------------------------------------


def test_never_worse_than_the_initial_labels():
    rng = np.random.default_rng(12)
    unary, edges, tables = dense(rng, 6, 15, 3)
    grid = itertools.product(range(3), repeat=6)
    best = min(grid, key=lambda x: mrf_energy(np.array(x), unary, edges, tables))
    for dtype in (np.float64, np.float32):
        single = tables.astype(dtype)
        result = followed(unary, edges, single, init_labels=np.array(best), max_iter=1, gap=-1.0)
        assert result.energy == mrf_energy(np.array(best), unary, edges, single)
        assert result.labels.tolist() == list(best)
        assert result.best_history[0] <= result.energy_history[0]


def test_initial_labels_return_where_rounding_misled():
    """In float32 the three costs are equal, and below the exact cost of the initial label."""
    unary = np.array([[3.5, 3.0, 3.9]]) + 1e8
    none = NO_TABLES.astype(np.float32)
    result = solve_trws(unary, NO_EDGES, none, init_labels=np.array([1]))
    assert result.energy == 1e8 + 3.0
    assert result.labels.tolist() == [1]
    # where float32 distinguishes the costs, the best label is chosen
    result = solve_trws(unary - 1e8, NO_EDGES, none, init_labels=np.array([2]))
    assert (result.energy, result.labels.tolist()) == (3.0, [1])


def test_stops():
    rng = np.random.default_rng(14)
    unary, edges, tables = dense(rng, 12, 50, 4)
    few = followed(unary, edges, tables, max_iter=3, gap=-1.0)
    assert (few.status, few.iterations) == ("iterations", 3)
    assert len(few.bound_history) == len(few.energy_history) == len(few.best_history) == 3
    loose = followed(unary, edges, tables, gap=10.0)
    assert (loose.status, loose.iterations) == ("gap", 1)


@pytest.mark.parametrize("how", ["interrupt", "answer"])
def test_interruption_keeps_the_best(how):
    rng = np.random.default_rng(15)
    unary, edges, tables = dense(rng, 12, 50, 4)
    rows = []

    def callback(iteration, bound, energy, best):
        rows.append((bound, energy, best))
        if iteration == 3:
            if how == "interrupt":
                raise KeyboardInterrupt
            return True
        return None

    result = solve_trws(unary, edges, tables, callback=callback, gap=-1.0)
    assert (result.status, result.iterations) == ("interrupted", 3)
    bounds, energies, least = np.array(rows).T
    assert result.lower_bound == max(bounds)
    np.testing.assert_array_equal(least, np.minimum.accumulate(energies))
    assert result.energy == pytest.approx(least[-1])


# --- costs that are not finite ----------------------------------------------------------------

GOOD = {
    "unary": np.zeros((3, 2)),
    "edges": np.array([[0, 1], [1, 2]]),
    "pairwise": np.zeros((2, 2, 2)),
}


@pytest.mark.parametrize(
    "change",
    [
        {"unary": np.array([[0, 1], [np.nan, 0], [0, 0]])},
        {"unary": np.array([[0, 1], [0, 0], [-np.inf, 0]])},
        {"unary": np.array([[0, 1], [0, 0], [np.inf, np.inf]])},
        {"unary": np.full((3, 2), 1e300), "pairwise": np.zeros((2, 2, 2), np.float32)},
        {"pairwise": np.full((2, 2, 2), np.inf)},
        {"pairwise": np.where(np.arange(2) == 1, np.nan, 0.0) * np.ones((2, 2, 2))},
    ],
)
def test_costs_that_are_not_finite_are_refused(change):
    with pytest.raises(ModelError, match="overflow") as caught:
        solve_trws(**{**GOOD, **change})
    assert caught.value.found is not None
    assert caught.value.expected is not None


def test_interruption_in_the_first_pass(monkeypatch):
    def interrupted(self):
        raise KeyboardInterrupt

    monkeypatch.setattr("soup_nlp.mrf.trws._Passes.sweep", interrupted)
    unary, edges, tables = dense(np.random.default_rng(16), 5, 6, 3)
    result = solve_trws(unary, edges, tables)
    assert (result.status, result.iterations) == ("interrupted", 0)
    assert result.lower_bound == -np.inf
    assert result.labels.tolist() == unary.argmin(1).tolist()


def test_binary_bound_reaches_the_relaxation_of_a_frustrated_cycle():
    edges = np.array([[0, 1], [1, 2], [0, 2]])
    table = np.eye(2)[None].repeat(3, axis=0)  # equal neighbours cost 1: one pair must be equal
    result = followed(np.zeros((3, 2)), edges, table, max_iter=50)
    # all labels with half a weight each: the linear program costs nothing
    assert result.lower_bound == pytest.approx(0.0)
    assert result.energy == pytest.approx(1.0)
    assert (result.status, result.iterations) == ("iterations", 50)
