"""The batches of nodes that TRW-S works through.

A greedy colouring of the graph orders the nodes: colour by colour, and inside a colour by number.
Nodes of one colour have no edge between them, so that processing them as one batch, a level, is the
same computation as processing them one after the other. An edge leads from the level of its lower
colour up to that of its higher colour.
"""

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
    own = colour[edges]
    other, levels = own[:, ::-1], []
    for c in range(int(colour.max()) + 1):
        nodes = np.flatnonzero(colour == c)
        up, down = (_side(nodes, edges, (own == c) & far) for far in (other > c, other < c))
        chains = np.maximum(*(np.bincount(s.node, minlength=len(nodes)) for s in (up, down)))
        levels.append(Level(nodes, 1.0 / np.maximum(chains, 1)[:, None], up, down))
    return levels


def _side(nodes: np.ndarray, edges: np.ndarray, near: np.ndarray) -> Side:
    """The edges of which one end (E, 2) is ``near``: among the nodes of a level."""
    ids, end = np.nonzero(near)
    node = np.searchsorted(nodes, edges[ids, end])
    order = np.argsort(node, kind="stable")
    ids, end, node = ids[order], end[order], node[order]
    linked, starts = np.unique(node, return_index=True)
    by_axis = ((axis + 1, np.flatnonzero(end == axis)) for axis in (0, 1))
    parts = tuple(part for part in by_axis if part[1].size)
    return Side(ids, node, edges[ids, 1 - end], parts, linked, starts)
