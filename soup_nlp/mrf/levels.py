"""The batches of nodes that TRW-S works through.

A greedy colouring of the graph orders the nodes: colour by colour, and inside a colour by number.
Nodes of one colour have no edge between them, so that processing them as one batch, a level, is the
same computation as processing them one after the other. An edge leads from the level of its lower
colour up to that of its higher colour.
"""

import itertools
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Side:
    """The edges from the nodes of one level to higher levels (``up``) or to lower ones (``down``).

    Attributes:
        ids: (n,) edge numbers, sorted by the level's node.
        node: (n,) position in the level of each edge's node.
        far: (n,) node at the far end.
        parts: Positions into ``ids`` by the table axis of the level's node: ``(1, positions)``
            for a node that comes first in its edge, ``(2, positions)`` for one that comes second.
        linked: (k,) positions in the level that have at least one of these edges.
        starts: (k,) position in ``ids`` of the first edge of each of these nodes.
    """

    ids: np.ndarray
    node: np.ndarray
    far: np.ndarray
    parts: tuple[tuple[int, np.ndarray], ...]
    linked: np.ndarray
    starts: np.ndarray

    def add(self, out: np.ndarray, values: np.ndarray) -> None:
        """Add values (n, L) of the edges to the rows (m, L) of the level's nodes, in place."""
        if self.linked.size:
            out[self.linked] += np.add.reduceat(values, self.starts, axis=0)


@dataclass(frozen=True)
class Level:
    """Nodes without an edge between them, in increasing number, with the edges on both sides.

    Attributes:
        nodes: (n,) node numbers.
        gamma: (n, 1) ``1 / max(edges up, edges down)``, the weight of a node in each of the
            monotonic chains through it (1 where the node has no edge; it is then not used).
        up: Edges to higher levels.
        down: Edges to lower levels.
    """

    nodes: np.ndarray
    gamma: np.ndarray
    up: Side
    down: Side


def colours(n_nodes: int, edges: np.ndarray) -> np.ndarray:
    """(N,) colour, from 0, of every node of a graph with these edges (E, 2): greedy, largest degree
    first (Welsh and Powell 1967).

    No two nodes of a colour have an edge between them, and every node has a neighbour in each
    lower colour: there are at most as many colours as the largest degree + 1.
    """
    near: list[list[int]] = [[] for _ in range(n_nodes)]
    for a, b in edges.tolist():
        near[a].append(b)
        near[b].append(a)
    colour = [-1] * n_nodes
    for v in sorted(range(n_nodes), key=lambda v: -len(near[v])):
        used = {colour[u] for u in near[v]}
        colour[v] = next(c for c in range(len(used) + 1) if c not in used)
    return np.asarray(colour, dtype=np.int64)


def plan_levels(colour: np.ndarray, edges: np.ndarray) -> list[Level]:
    """The levels of a colouring (N,) of edges (E, 2), first to last in the forward pass."""
    n, count = len(colour), int(colour.max()) + 1
    forwards = colour[edges[:, 0]] < colour[edges[:, 1]]
    early = np.where(forwards, edges[:, 0], edges[:, 1])
    late = np.where(forwards, edges[:, 1], edges[:, 0])
    chains = np.maximum(np.bincount(early, minlength=n), np.bincount(late, minlength=n))
    gamma = 1.0 / np.maximum(chains, 1)
    nodes = np.argsort(colour, kind="stable")
    cuts = np.searchsorted(colour[nodes], np.arange(count + 1))
    position = np.empty(n, dtype=np.int64)
    position[nodes] = np.arange(n) - cuts[colour[nodes]]
    ups = _sides(early, late, forwards, colour, position)
    downs = _sides(late, early, ~forwards, colour, position)
    return [
        Level(nodes[a:b], gamma[nodes[a:b], None], up, down)
        for a, b, up, down in zip(cuts[:-1], cuts[1:], ups, downs)
    ]


def _sides(
    near: np.ndarray, far: np.ndarray, head: np.ndarray, level: np.ndarray, position: np.ndarray
) -> list[Side]:
    """One :class:`Side` per level, of the edges seen from their ``near`` node (E,); ``head`` (E,)
    says whether it comes first in its edge, ``position`` (N,) is that of a node in its level."""
    ids = np.lexsort((position[near], level[near]))
    cuts = np.searchsorted(level[near[ids]], np.arange(int(level.max()) + 2))
    out = []
    for a, b in itertools.pairwise(cuts):
        members = ids[a:b]
        node = position[near[members]]
        linked, starts = np.unique(node, return_index=True)
        by_axis = ((1, np.flatnonzero(head[members])), (2, np.flatnonzero(~head[members])))
        parts = tuple(part for part in by_axis if part[1].size)
        out.append(Side(members, node, far[members], parts, linked, starts))
    return out
