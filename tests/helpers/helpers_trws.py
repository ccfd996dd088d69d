"""The original TRW-S node by node, brute force and random problems."""

import itertools
from types import SimpleNamespace

import numpy as np
from hypothesis import strategies as st

from soup_nlp.mrf.levels import colours
from soup_nlp.mrf.trws import solve_trws

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


def colour_order(n, edges):
    """The nodes in the order of the forward pass."""
    return np.argsort(colours(n, np.asarray(edges).reshape(-1, 2)), kind="stable")


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


def rises(result: SimpleNamespace, slack: float = 1e-10) -> bool:
    scale = max(1.0, abs(result.energy))
    return bool((np.diff(result.bound_history) >= -slack * scale).all())
