"""What TRW-S runs on: node orders, the batches they allow, and the pairwise tables.

An order turns every edge into an arrow from its earlier to its later node, which makes the graph
acyclic. The level of a node is the length of the longest arrow path that ends there: nodes of one
level never touch, and every arrow climbs. Level by level is therefore the same computation as
node by node, in both directions and for any order. A colour order has as many levels as colours,
so a few large batches.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import NoReturn

import numpy as np

from soup_nlp.errors import ModelError

TableFunction = Callable[[np.ndarray], np.ndarray]

CALL_BYTES = 1 << 25  # tables asked from a pairwise function at once
_CACHE_BYTES = 1 << 19  # tables handled together: half of a usual second-level cache


def fail(
    what: str, where: object, found: object, expected: object, hint: str | None = None
) -> NoReturn:
    """Raise a :class:`ModelError` with the given parts."""
    raise ModelError(what, where=where, found=found, expected=expected, hint=hint)


@dataclass(frozen=True)
class Side:
    """The edges from the nodes of one level to later nodes (``up``) or to earlier ones (``down``).

    Attributes:
        ids: (n,) edge numbers, sorted by the level's node.
        node: (n,) position in the level of each edge's node.
        other: (n,) node at the far end.
        parts: Positions into ``ids`` by the table axis of the level's node: ``(1, positions)``
            for a node that comes first in its edge, ``(2, positions)`` for one that comes second.
        who: (k,) positions in the level that have at least one of these edges.
        starts: (k,) where each of them starts in ``ids``.
    """

    ids: np.ndarray
    node: np.ndarray
    other: np.ndarray
    parts: tuple[tuple[int, np.ndarray], ...]
    who: np.ndarray
    starts: np.ndarray

    def add(self, out: np.ndarray, values: np.ndarray) -> None:
        """Add (n, L) values of the edges to the (m, L) rows of the level's nodes, in place."""
        if self.who.size:
            out[self.who] += np.add.reduceat(values, self.starts, axis=0)


@dataclass(frozen=True)
class Level:
    """Nodes that do not touch, in increasing number, with the edges on both sides.

    Attributes:
        nodes: (n,) node numbers.
        gamma: (n, 1) ``1 / max(edges up, edges down)``, the weight of a node in each of the
            monotonic chains through it (1 where the node has no edge; it is then not used).
        up: Edges to later nodes.
        down: Edges to earlier nodes.
    """

    nodes: np.ndarray
    gamma: np.ndarray
    up: Side
    down: Side


def check_edges(edges: object, n_nodes: int) -> np.ndarray:
    """Edges as an (E, 2) int64 array, checked.

    Args:
        edges: (E, 2) integers, each row two different nodes; empty allowed.
        n_nodes: Number of nodes N.

    Raises:
        ModelError: Wrong shape or type, a node out of range, or an edge from a node to itself.
    """
    out = np.asarray(edges)
    if out.size == 0:
        return np.zeros((0, 2), dtype=np.int64)
    if out.ndim != 2 or out.shape[1] != 2 or not np.issubdtype(out.dtype, np.integer):
        found = f"shape {out.shape}, {out.dtype}"
        fail("The edges are no pairs of nodes.", "edges", found, "shape (E, 2), integers")
    bad = ((out < 0) | (out >= n_nodes)).any(axis=1) | (out[:, 0] == out[:, 1])
    if bad.any():
        fail(
            "An edge does not join two different nodes of the MRF.",
            f"edges[{bad.argmax()}]",
            out[bad.argmax()].tolist(),
            f"two different numbers from 0 to {n_nodes - 1}",
            "the diagonal of the table of a loop belongs to the node's unary cost",
        )
    return out.astype(np.int64)


def check_labels(labels: object, counts: np.ndarray, name: str) -> np.ndarray:
    """(N,) int64 copy of labels, checked against the (N,) label counts (ModelError)."""
    out = np.asarray(labels)
    if out.shape != counts.shape or not np.issubdtype(out.dtype, np.integer):
        found = f"shape {out.shape}, {out.dtype}"
    elif (out < 0).any() or (out >= counts).any():
        found = f"label {out[(out < 0) | (out >= counts)][0]}"
    else:
        return out.astype(np.int64)
    expected = f"{counts.size} integers, each from 0 to its node's label count"
    fail("The labels do not fit the nodes.", name, found, expected)


def merge_parallel(edges: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Which edges join the same two nodes.

    Args:
        edges: (E, 2) checked edges.

    Returns:
        ``kept`` (U,) the first edge of every pair of nodes, increasing; ``row`` (E,) the position
        in ``kept`` of each edge's pair; ``flip`` (E,) whether the edge runs against the kept one.
    """
    if not len(edges):
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, bool)
    _, first, inverse = np.unique(
        np.sort(edges, axis=1), axis=0, return_index=True, return_inverse=True
    )
    inverse = inverse.reshape(-1)
    kept = np.sort(first)
    row = np.searchsorted(kept, first)[inverse]
    return kept, row, edges[:, 0] != edges[kept[row], 0]


def node_order(order: object, n_nodes: int, edges: np.ndarray) -> np.ndarray:
    """The nodes in the order of the forward pass.

    Args:
        order: ``"input"`` (0, 1, 2, ...), ``"colour"`` (:func:`colour_order`), or an (N,)
            permutation whose k-th entry is the node handled at step k.
        n_nodes: Number of nodes N.
        edges: (E, 2) checked edges.

    Raises:
        ModelError: An unknown name, or an array that is no permutation of the nodes.
    """
    if isinstance(order, str):
        if order == "input":
            return np.arange(n_nodes)
        if order == "colour":
            return colour_order(n_nodes, edges)
        found: object = repr(order)
    else:
        out = np.asarray(order)
        if out.shape == (n_nodes,) and np.issubdtype(out.dtype, np.integer):
            if np.array_equal(np.sort(out), np.arange(n_nodes)):
                return out.astype(np.int64)
            found = "integers that repeat, miss or exceed some nodes"
        else:
            found = f"shape {out.shape}, {out.dtype}"
    expected = f'"colour", "input" or a permutation of 0 to {n_nodes - 1}'
    fail("The node order cannot be used.", "order", found, expected)


def colour_order(n_nodes: int, edges: np.ndarray) -> np.ndarray:
    """Nodes sorted by a greedy colour, largest degree first (Welsh and Powell 1967).

    No two nodes of a colour touch, and the greedy rule gives every node a neighbour in each lower
    colour, so the levels of this order are exactly the colours: at most the largest degree + 1.

    Args:
        n_nodes: Number of nodes N.
        edges: (E, 2) checked edges.

    Returns:
        (N,) node numbers, by colour and then by number.
    """
    near: list[list[int]] = [[] for _ in range(n_nodes)]
    for a, b in edges.tolist():
        near[a].append(b)
        near[b].append(a)
    colour = [-1] * n_nodes
    for v in sorted(range(n_nodes), key=lambda v: -len(near[v])):
        used = {colour[u] for u in near[v]}
        colour[v] = next(c for c in range(len(used) + 1) if c not in used)
    return np.argsort(np.asarray(colour, dtype=np.int64), kind="stable")


def node_levels(sequence: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """(N,) length of the longest path of arrows that ends in each node.

    Args:
        sequence: (N,) nodes in the order of the forward pass.
        edges: (E, 2) checked edges.
    """
    rank = np.argsort(sequence)
    early, late = _arrows(rank, edges)
    level = [0] * len(sequence)
    by_source = np.argsort(rank[early], kind="stable")
    for a, b in zip(early[by_source].tolist(), late[by_source].tolist()):
        if level[b] <= level[a]:  # level[a] is final: all arrows into a came before
            level[b] = level[a] + 1
    return np.asarray(level, dtype=np.int64)


def plan_levels(sequence: np.ndarray, edges: np.ndarray) -> list[Level]:
    """The batches of an order, first to last in the forward pass.

    Args:
        sequence: (N,) nodes in the order of the forward pass.
        edges: (E, 2) checked edges without parallels.
    """
    n = len(sequence)
    level = node_levels(sequence, edges)
    count = int(level.max()) + 1
    early, late = _arrows(np.argsort(sequence), edges)
    chains = np.maximum(np.bincount(early, minlength=n), np.bincount(late, minlength=n))
    gamma = 1.0 / np.maximum(chains, 1)
    nodes = np.argsort(level, kind="stable")
    cuts = np.searchsorted(level[nodes], np.arange(count + 1))
    place = np.empty(n, dtype=np.int64)
    place[nodes] = np.arange(n) - cuts[level[nodes]]
    forwards = early == edges[:, 0]
    ups = _sides(early, late, forwards, level, place)
    downs = _sides(late, early, ~forwards, level, place)
    return [
        Level(nodes[a:b], gamma[nodes[a:b], None], up, down)
        for a, b, up, down in zip(cuts[:-1], cuts[1:], ups, downs)
    ]


def _arrows(rank: np.ndarray, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(E,) earlier and (E,) later node of every edge."""
    keep = rank[edges[:, 0]] < rank[edges[:, 1]]
    return np.where(keep, edges[:, 0], edges[:, 1]), np.where(keep, edges[:, 1], edges[:, 0])


def _sides(
    near: np.ndarray, far: np.ndarray, head: np.ndarray, level: np.ndarray, place: np.ndarray
) -> list[Side]:
    """One :class:`Side` a level, of the edges seen from their ``near`` node.

    Args:
        near: (E,) node on this side of every edge.
        far: (E,) node at the other end.
        head: (E,) whether ``near`` comes first in its edge.
        level: (N,) level of every node.
        place: (N,) position of every node in its level.
    """
    ids = np.lexsort((place[near], level[near]))
    cuts = np.searchsorted(level[near[ids]], np.arange(int(level.max()) + 2))
    out = []
    for a, b in itertools.pairwise(cuts):
        mine = ids[a:b]
        node = place[near[mine]]
        who, starts = np.unique(node, return_index=True)
        both = ((1, np.flatnonzero(head[mine])), (2, np.flatnonzero(~head[mine])))
        parts = tuple(part for part in both if part[1].size)
        out.append(Side(mine, node, far[mine], parts, who, starts))
    return out


class Tables:
    """The pairwise tables, one a pair of nodes, read block by block.

    An array is read in place, without a copy, unless edges join the same two nodes: their tables
    are added up in a copy. A function is called for every block of every pass, so that memory
    holds one block at a time; it cannot have parallel edges.

    Args:
        source: (E, L, L) array of the working type, or a function of (n,) edge numbers that
            returns (n, L, L); axis 1 belongs to ``edges[e, 0]``, axis 2 to ``edges[e, 1]``.
        edges: (E, 2) checked edges.
        size: Largest label count L.
        dtype: Working type.

    Raises:
        ModelError: A function with parallel edges; a block of the wrong shape.
    """

    def __init__(
        self, source: np.ndarray | TableFunction, edges: np.ndarray, size: int, dtype: np.dtype
    ) -> None:
        self.kept, row, flip = merge_parallel(edges)
        self.call = None if isinstance(source, np.ndarray) else source
        room = _CACHE_BYTES if self.call is None else CALL_BYTES
        self.step = max(1, room // (size * size * dtype.itemsize))
        self.buffer = np.empty((max(1, min(self.step, len(edges))), size, size), dtype)
        self.table = source if isinstance(source, np.ndarray) else self.buffer
        extra = np.setdiff1d(np.arange(len(edges)), self.kept)
        if self.call is not None and extra.size:
            fail(
                "Parallel edges cannot be merged when tables are not kept.",
                f"edges[{extra[0]}]",
                edges[extra[0]].tolist(),
                "every pair of nodes once",
                "add up their tables in the function, or keep the tables",
            )
        if extra.size:
            merged = self.table[self.kept]
            for e in extra:
                merged[row[e]] += self.table[e].T if flip[e] else self.table[e]
            self.table = merged

    def block(self, ids: np.ndarray) -> np.ndarray:
        """(n, L, L) tables of at most ``step`` edges, in a buffer that the caller may overwrite."""
        out = self.buffer[: len(ids)]
        if self.call is None:
            np.take(self.table, ids, axis=0, out=out, mode="clip")
        else:
            out[...] = call_tables(self.call, ids, out.shape[1])
        return out

    def lines(self, side: Side, labels: np.ndarray) -> np.ndarray:
        """(n, L) table entries over the labels of the level's node, the far end held fixed."""
        fixed = labels[side.other]
        out = np.empty((len(side.ids), self.buffer.shape[1]), self.buffer.dtype)
        for axis, part in side.parts:
            step = len(part) if self.call is None else self.step
            for k in range(0, len(part), step):
                at = part[k : k + step]
                rows, table = side.ids[at], self.table
                if self.call is not None:
                    rows, table = np.arange(len(at)), self.block(rows)
                out[at] = table[rows, :, fixed[at]] if axis == 1 else table[rows, fixed[at]]
        return out


def call_tables(function: TableFunction, ids: np.ndarray, size: int) -> np.ndarray:
    """(n, L, L) tables that a function returns for some edges, their shape checked."""
    out = np.asarray(function(ids))
    if out.shape != (len(ids), size, size):
        where, shape = f"pairwise(edges {ids[0]} to {ids[-1]})", (len(ids), size, size)
        fail("The pairwise function returned the wrong shape.", where, out.shape, shape)
    return out
