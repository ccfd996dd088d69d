"""TRW-S: labels and a lower bound for a discrete energy on a graph, in numpy alone.

The energy is ``E(x) = sum_i u_i(x_i) + sum_ij p_ij(x_i, x_j)``. The method is sequential
tree-reweighted message passing (V. Kolmogorov, "Convergent tree-reweighted message passing for
energy minimization", IEEE TPAMI 28(10), 2006) on monotonic chains, step by step as in its
author's TRW_S-v1.3 with general tables, so that the bound of every iteration is the same:

* forward pass, for every node s in order: ``D_s = u_s + sum of the messages into s``, and for
  every later neighbour t ``M_st(x_t) = min over x_s of (gamma_s D_s - M_ts)(x_s) + p(x_s, x_t)``,
  less its minimum over x_t, with ``gamma_s = 1 / max(later neighbours, earlier neighbours)``;
* backward pass, the same in reverse towards earlier neighbours once ``D_s`` lost its minimum;
  the lower bound is the sum of the minima taken out of nodes and messages in this pass;
* decoding in order: ``x_i = argmin u_i + sum_(j<i) p_ji(x_j, .) + sum_(j>i) M_ji``, the first
  label in a tie.

An edge stores one message, the one that the last pass over it wrote. Nodes that the order does
not separate run as one batch (:mod:`soup_nlp.mrf.order`), which changes nothing but the
order of floating-point sums.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from soup_nlp.mrf.order import (
    CALL_BYTES,
    Level,
    Side,
    TableFunction,
    Tables,
    call_tables,
    check_edges,
    check_labels,
    fail,
    node_order,
    plan_levels,
)

Unary = np.ndarray | Sequence[np.ndarray]
Pairwise = np.ndarray | Sequence[np.ndarray] | TableFunction
Callback = Callable[[int, float, float, float], bool | None]


@dataclass(frozen=True)
class TRWSResult:
    """Outcome of :func:`solve_trws`.

    Attributes:
        labels: (N,) int64, the best labelling met.
        energy: Its energy by :func:`mrf_energy`, in float64.
        lower_bound: Largest bound met, at most ``energy``; -inf before the first iteration ended.
        bound_history: (K,) bound after each iteration, as computed (rounding included).
        energy_history: (K,) energy decoded after each iteration, in the working type.
        best_history: (K,) least energy up to each iteration, ``init_labels`` included.
        iterations: K, each one forward and one backward pass.
        status: ``"gap"``, ``"stagnation"``, ``"iterations"`` or ``"interrupted"``.
        ties: Nodes whose label was a tie, to rounding, when ``labels`` were decoded; 0 if they
            are ``init_labels``.
        seconds: Wall time.
    """

    labels: np.ndarray
    energy: float
    lower_bound: float
    bound_history: np.ndarray
    energy_history: np.ndarray
    best_history: np.ndarray
    iterations: int
    status: str
    ties: int
    seconds: float


def solve_trws(
    unary: Unary,
    edges: np.ndarray,
    pairwise: Pairwise,
    *,
    order: str | np.ndarray = "colour",
    max_iter: int = 100,
    gap: float = 1e-6,
    stagnation: float = 1e-7,
    patience: int = 10,
    dtype: type | np.dtype = np.float64,
    init_labels: np.ndarray | None = None,
    keep_tables: bool = True,
    polish: bool = False,
    callback: Callback | None = None,
) -> TRWSResult:
    """Minimise a pairwise energy by TRW-S; see the module for the equations.

    Args:
        unary: (N, L) costs, or N arrays (L_i,) where nodes have different label counts. A cost
            of +inf forbids a label; every node needs a finite one.
        edges: (E, 2) node numbers. Edges that join the same two nodes are merged into one whose
            table is the sum (transposed where they run in opposite directions).
        pairwise: (E, L, L) tables, axis 1 for ``edges[e, 0]``; or E arrays (L_a, L_b), padded
            inside to the largest L; or a function of (n,) edge numbers that returns (n, L, L).
            Finite; entries beyond a node's labels are not used. A C-contiguous array of the
            working type is read in place: it must not change during the call.
        order: ``"colour"`` (few large batches), ``"input"``, or an (N,) permutation.
        max_iter: Most iterations.
        gap: Stop once best energy - bound <= ``gap * max(1, |best energy|)``; negative: never.
        stagnation: Stop once, over ``patience`` iterations, the best energy did not fall and the
            bound rose by at most ``stagnation * max(1, |bound|)``; negative: never.
        patience: See ``stagnation``.
        dtype: float64, or float32 for half the memory; the bound is then exact to that rounding.
        init_labels: (N,) labels that the result is never worse than; they do not steer the method.
        keep_tables: Whether to keep the tables of a pairwise function. If not, it is called in
            blocks of at most 32 MiB, for every edge three times an iteration, and parallel edges
            are refused.
        polish: Whether to end with iterated conditional modes, which can only lower the energy.
        callback: Called after every iteration as ``callback(iteration, bound, energy, best
            energy)``; a true answer or a KeyboardInterrupt, there or anywhere in the iterations,
            ends them with status ``"interrupted"``.

    Raises:
        ModelError: Inputs of the wrong shape, type or range, or not finite.
    """
    start = time.perf_counter()
    work = _working_type(dtype)
    for name, value in (("max_iter", max_iter), ("patience", patience)):
        if value < 1:
            fail("An option of TRW-S is too small.", name, value, "at least 1")
    costs, counts = _read_unary(unary)
    pairs = check_edges(edges, len(counts))
    begin = None if init_labels is None else check_labels(init_labels, counts, "init_labels")
    with np.errstate(over="ignore"):  # what a float32 cannot hold is caught as infinite
        source = _read_pairwise(pairwise, pairs, counts, work, keep_tables)
    tables = Tables(source, pairs, costs.shape[1], work)
    pairs = pairs[tables.kept]
    plan = plan_levels(node_order(order, len(counts), pairs), pairs)
    solver = _Passes(costs, plan, tables)
    first = math.inf if begin is None else mrf_energy(begin, unary, edges, pairwise)
    best = (first, costs.argmin(axis=1) if begin is None else begin, 0)
    rows: list[tuple[float, float, float]] = []
    status = "iterations"
    try:
        for k in range(max_iter):
            bound = solver.sweep()
            energy, labels, ties = solver.decode()
            if energy < best[0]:
                best = (energy, labels, ties)
            rows.append((bound, energy, best[0]))
            if callback is not None and callback(k + 1, bound, energy, best[0]):
                status = "interrupted"
            elif best[0] - bound <= gap * max(1.0, abs(best[0])):
                status = "gap"
            elif k >= patience and best[0] >= rows[k - patience][2]:
                rise = bound - rows[k - patience][0]
                status = "stagnation" if rise <= stagnation * max(1.0, abs(bound)) else status
            if status != "iterations":
                break
        if polish and status != "interrupted":
            best = (best[0], solver.icm(best[1]), best[2])
    except KeyboardInterrupt:
        status = "interrupted"
    _, labels, ties = best
    energy = mrf_energy(labels, unary, edges, pairwise)
    if begin is not None and first < energy:
        energy, labels, ties = first, begin, 0  # float32 took a worse labelling for a better one
    bounds, energies, bests = np.array(rows).reshape(-1, 3).T.copy()
    bound = min(float(bounds.max(initial=-math.inf)), energy)
    took = time.perf_counter() - start
    return TRWSResult(labels, energy, bound, bounds, energies, bests, len(rows), status, ties, took)


def mrf_energy(labels: np.ndarray, unary: Unary, edges: np.ndarray, pairwise: Pairwise) -> float:
    """Energy of a labelling in float64, by plain look-up of the inputs of :func:`solve_trws`.

    Args:
        labels: (N,) integers.
        unary: As there, like the two below; parallel edges count one by one.
        edges: (E, 2) node numbers.
        pairwise: Tables or function.

    Raises:
        ModelError: Inputs of the wrong shape, type or range.
    """
    costs, counts = _read_unary(unary)
    pairs = check_edges(edges, len(counts))
    x = check_labels(labels, counts, "labels")
    at, to = x[pairs[:, 0]], x[pairs[:, 1]]
    total = float(costs[np.arange(len(x)), x].sum())
    if not callable(pairwise):
        _check_tables(pairwise, pairs, counts)
        return total + math.fsum(float(pairwise[e][a, b]) for e, (a, b) in enumerate(zip(at, to)))
    step = max(1, CALL_BYTES // (8 * costs.shape[1] ** 2))
    for k in range(0, len(pairs), step):
        ids = np.arange(k, min(len(pairs), k + step))
        block = call_tables(pairwise, ids, costs.shape[1])
        total += float(block[ids - k, at[ids], to[ids]].sum(dtype=np.float64))
    return total


def _working_type(dtype: type | np.dtype) -> np.dtype:
    found: object = repr(dtype)
    try:
        found = out = np.dtype(dtype)
        if out in (np.dtype(np.float32), np.dtype(np.float64)):
            return out
    except TypeError:
        pass  # it names no type at all
    fail("TRW-S cannot work in this type.", "dtype", found, "float64 or float32")


class _Passes:
    """Messages and passes of one problem.

    Args:
        costs: (N, L) unary costs, +inf where a label does not exist.
        plan: Levels of the order, first to last.
        tables: Tables of the edges, in the working type.
    """

    def __init__(self, costs: np.ndarray, plan: list[Level], tables: Tables) -> None:
        dtype, absent = tables.buffer.dtype, np.isinf(costs)
        with np.errstate(over="ignore"):
            self.costs = costs.astype(dtype)
        if not np.array_equal(np.isinf(self.costs), absent):
            fail("A unary cost is too large.", "unary", costs[~absent].max(), f"within {dtype}")
        self.absent, self.plan, self.tables = absent, plan, tables
        self.messages = np.zeros((len(tables.kept), costs.shape[1]), dtype)

    def sweep(self) -> float:
        """One forward and one backward pass; the lower bound."""
        bound = 0.0
        with np.errstate(invalid="ignore", over="ignore"):
            for level in self.plan:
                self._send(level.up, level, self._beliefs(level))
            for level in reversed(self.plan):
                belief = self._beliefs(level)
                least = belief.min(axis=1, keepdims=True)
                belief -= least
                bound += float(least.sum(dtype=np.float64)) + self._send(level.down, level, belief)
        if not math.isfinite(bound):
            hint = "the tables must be finite; scale the costs down, or work in float64"
            fail("The messages of TRW-S overflow.", "pairwise", bound, "a finite bound", hint)
        return bound

    def _beliefs(self, level: Level) -> np.ndarray:
        """(n, L) unary costs plus all messages into the nodes of a level."""
        out = self.costs[level.nodes]
        level.up.add(out, self.messages[level.up.ids])
        level.down.add(out, self.messages[level.down.ids])
        return out

    def _send(self, side: Side, level: Level, belief: np.ndarray) -> float:
        """Replace the messages of one side of a level; the sum of the minima taken out."""
        belief = belief * level.gamma.astype(belief.dtype)
        sent = belief[side.node] - self.messages[side.ids]
        out = np.empty_like(sent)
        for axis, part in side.parts:
            for k in range(0, len(part), self.tables.step):
                at = part[k : k + self.tables.step]
                block = self.tables.block(side.ids[at])
                block += sent[at, :, None] if axis == 1 else sent[at, None]
                out[at] = block.min(axis=axis)
        gone = self.absent[side.other]
        np.copyto(out, np.inf, where=gone)
        least = out.min(axis=1, keepdims=True)
        out -= least
        np.copyto(out, 0.0, where=gone)
        self.messages[side.ids] = out
        return float(least.sum(dtype=np.float64))

    def decode(self) -> tuple[float, np.ndarray, int]:
        """Energy, (N,) labels and the number of ties of the decoding in order."""
        labels = np.zeros(len(self.costs), np.int64)
        energy, ties = 0.0, 0
        rounding = 1e3 * float(np.finfo(self.costs.dtype).eps)
        for level in self.plan:
            exact = self.costs[level.nodes]
            level.down.add(exact, self.tables.lines(level.down, labels))
            total = exact.copy()
            level.up.add(total, self.messages[level.up.ids])
            best = total.argmin(axis=1)
            labels[level.nodes] = best
            energy += float(exact[np.arange(len(best)), best].sum(dtype=np.float64))
            near = total.min(axis=1, keepdims=True)
            near = near + rounding * np.maximum(1, np.abs(near))
            ties += int(((total <= near).sum(axis=1) > 1).sum())
        return energy, labels, ties

    def icm(self, labels: np.ndarray) -> np.ndarray:
        """(N,) labels after sweeps of single-node moves, each of which lowers the energy."""
        labels = labels.copy()
        for _ in range(100):
            moved = False
            for level in self.plan:
                total = self.costs[level.nodes]
                level.up.add(total, self.tables.lines(level.up, labels))
                level.down.add(total, self.tables.lines(level.down, labels))
                row, now = np.arange(len(total)), labels[level.nodes]
                new = total.argmin(axis=1)
                new = np.where(total[row, new] < total[row, now], new, now)
                moved = moved or not np.array_equal(new, now)
                labels[level.nodes] = new
            if not moved:
                break
        return labels


def _read_unary(unary: Unary) -> tuple[np.ndarray, np.ndarray]:
    """(N, L) float64 costs padded with +inf, and (N,) label counts, checked."""
    rows = [np.asarray(row, np.float64) for row in unary]
    bad = [i for i, row in enumerate(rows) if row.ndim != 1 or not row.size]
    if not rows or bad:
        where = f"unary[{bad[0]}]" if bad else "unary"
        found = f"shape {rows[bad[0]].shape}" if bad else "no node"
        fail("The unary costs are not one row of labels a node.", where, found, "shape (N, L)")
    counts = np.array([row.size for row in rows])
    out = np.full((len(rows), int(counts.max())), np.inf)
    for i, row in enumerate(rows):
        out[i, : row.size] = row
    wrong = np.flatnonzero(~(out > -np.inf).all(axis=1) | np.isinf(out).all(axis=1))
    if wrong.size:
        where, expected = f"unary[{wrong[0]}]", "numbers or +inf, at least one finite"
        fail("A node has costs that cannot be used.", where, rows[wrong[0]], expected)
    return out, counts


def _check_tables(
    pairwise: np.ndarray | Sequence[np.ndarray], edges: np.ndarray, counts: np.ndarray
) -> None:
    """Fail where tables do not have the shapes that the edges and label counts ask for."""
    n, size = len(edges), int(counts.max())
    if isinstance(pairwise, np.ndarray):
        if pairwise.shape != (n, size, size) and (n or pairwise.size):
            fail("The tables have the wrong shape.", "pairwise", pairwise.shape, (n, size, size))
        return
    if len(pairwise) != n:
        fail("The tables are not one an edge.", "pairwise", len(pairwise), n)
    for e, (a, b) in enumerate(edges):
        found, shape = np.shape(pairwise[e]), (int(counts[a]), int(counts[b]))
        if found != shape:
            fail("A table does not fit its edge's nodes.", f"pairwise[{e}]", found, shape)


def _read_pairwise(
    pairwise: Pairwise, edges: np.ndarray, counts: np.ndarray, dtype: np.dtype, keep: bool
) -> np.ndarray | TableFunction:
    """(E, L, L) tables padded with zeros and checked, or the function itself if not kept."""
    n, size = len(edges), int(counts.max())
    step = max(1, CALL_BYTES // (size * size * dtype.itemsize))
    chunks = [np.arange(k, min(n, k + step)) for k in range(0, n, step)]
    if callable(pairwise):
        if not keep:
            return pairwise
        table = np.empty((n, size, size), dtype)
        for ids in chunks:
            table[ids[0] : ids[-1] + 1] = call_tables(pairwise, ids, size)
    elif isinstance(pairwise, np.ndarray):
        _check_tables(pairwise, edges, counts)
        table = np.ascontiguousarray(pairwise.reshape(n, size, size), dtype)
    else:
        _check_tables(pairwise, edges, counts)
        table = np.zeros((n, size, size), dtype)
        for e, (a, b) in enumerate(edges):
            table[e, : counts[a], : counts[b]] = pairwise[e]
    for ids in chunks:
        bad = ~np.isfinite(table[ids[0] : ids[-1] + 1]).all(axis=(1, 2))
        if bad.any():
            where = f"pairwise[{ids[bad.argmax()]}]"
            hint = "forbid a pair by a large cost, a label by an infinite unary cost"
            fail("A table is not finite.", where, "nan or infinity", f"finite in {dtype}", hint)
    return table
