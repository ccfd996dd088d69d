"""Elimination order of the presolve's unknowns by nested dissection of the image (George 1973).

A separator is a set of unknowns without which the matrix falls into two parts. Ordered after both
parts, it confines their fill to themselves. Minimum degree, which libraries use by default, knows
no positions: at N = 8,000 its factor takes half as many operations again.
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from soup_nlp.arrays import Float, Int

KIND = np.array([0, 1, 1, 0, 0, 0, 0, 0, 0])
"""Of a superpixel's nine unknowns: slopes, which next neighbours alone share, and all others."""
LEAF = 100
"""Unknowns that are not divided further; below, the fill hardly depends on the order."""
STRIP = 30.0, 0.3, 0.7
"""A separator lies in a strip in the middle, which has a share of the n unknowns: the first number
divided by sqrt(n), between the other two. A strip must be wider than the reach of a superpixel."""


def dissected(upper: sparse.csc_matrix, place: Float) -> Int:
    """(9 N,) the unknowns in an order of elimination with little fill.

    Args:
        upper: (9 N, 9 N) pattern, upper triangle.
        place: (N, 2) positions of the superpixels in the image.
    """
    unknowns = np.arange(upper.shape[0])
    node = unknowns // 9 * 2 + KIND[unknowns % 9]
    columns = np.repeat(unknowns, np.diff(upper.indptr))
    size = 2 * len(place)
    ends = node[upper.indices], node[columns]
    one = sparse.coo_matrix((np.ones(len(columns), np.int32), ends), (size, size)).tocsr()
    graph = (one + one.T).tocsr()
    weight = np.tile(np.bincount(KIND), len(place))
    order = _order(graph, weight, np.repeat(place, 2, axis=0))
    rank = np.empty(size, int)
    rank[order] = np.arange(size)
    return np.argsort(rank[node], kind="stable")


def _order(graph: sparse.csr_matrix, weight: Int, place: Float) -> Int:
    """Nodes of a graph in an order of elimination: two parts, then what separates them.

    Args:
        graph: (n, n) symmetric adjacency.
        weight: (n,) unknowns of a node.
        place: (n, 2) positions of the nodes.
    """
    whole = np.arange(len(weight))
    if weight.sum() <= LEAF:
        return whole
    side = _separated(graph, weight, _halves(weight, place))
    parts = [np.flatnonzero(side == s) for s in (-1, 1)]
    if not all(map(len, parts)):
        return whole
    ordered = [p[_order(graph[p][:, p], weight[p], place[p])] for p in parts]
    return np.concatenate([*ordered, np.flatnonzero(side == 0)])


def _halves(weight: Int, place: Float) -> Int:
    """(n,) sides -1 and 1 of a cut across the longer extent; 0 in the strip between them."""
    along = place[:, np.argmax(np.ptp(place, axis=0))]
    order, total = np.argsort(along, kind="stable"), weight.sum()
    share = np.cumsum(weight[order]) / total
    factor, least, most = STRIP
    half = 0.5 * np.clip(factor / np.sqrt(total), least, most)
    side = np.empty(len(weight), np.int64)
    side[order] = (share > 0.5 + half).astype(int) - (share < 0.5 - half)
    return side


def _separated(graph: sparse.csr_matrix, weight: Int, side: Int) -> Int:
    """(n,) sides -1 and 1, and 0 for the lightest set of the strip's nodes that separates them.

    It is a minimum cut of the strip's nodes, each of them an arc from its entry to its exit
    (Menger's theorem). Sides that touch each other directly remain so.

    Args:
        graph: (n, n) symmetric adjacency.
        weight: (n,) unknowns of a node.
        side: (n,) -1 and 1, 0 for the nodes of the strip.
    """
    strip = np.flatnonzero(side == 0)
    k, rows = len(strip), graph[strip]
    first, last = (np.flatnonzero(rows @ (side == s).astype(np.int32)) for s in (-1, 1))
    inner = rows[:, strip].tocoo()
    entry, source, sink = 2 * np.arange(k), 2 * k, 2 * k + 1
    start = [entry, 2 * inner.row + 1, np.full(len(first), source), entry[last] + 1]
    end = [entry + 1, 2 * inner.col, entry[first], np.full(len(last), sink)]
    unlimited = int(weight.sum())
    capacity = [weight[strip], *(np.full(len(e), unlimited) for e in end[1:])]
    arcs = (np.concatenate(capacity).astype(np.int32), tuple(map(np.concatenate, (start, end))))
    network = sparse.csr_matrix(arcs, (2 * k + 2, 2 * k + 2))
    left = network - maximum_flow(network, source, sink).flow
    left.eliminate_zeros()
    reached = np.zeros(2 * k + 2, bool)
    reached[breadth_first_order(left, source, return_predecessors=False)] = True
    out = side.copy()
    out[strip] = np.where(reached[entry + 1], -1, np.where(reached[entry], 0, 1))
    return out
