"""TRW-S: labels and a lower bound for a discrete energy on a graph, in numpy alone.

The energy is ``E(x) = sum_i u_i(x_i) + sum_ij p_ij(x_i, x_j)``. The method is sequential
tree-reweighted message passing (V. Kolmogorov, "Convergent tree-reweighted message passing for
energy minimization", IEEE TPAMI 28(10), 2006) on monotonic chains, step by step as in its
author's TRW_S-v1.3 with general tables: the bound of every iteration equals that of the original,
if it visits the nodes in the same order, colour by colour (bounds depend on the order):

* forward pass, for every node s in order: ``D_s = u_s + sum of the messages into s``, and for
  every later neighbour t ``M_st(x_t) = min over x_s of (gamma_s D_s - M_ts)(x_s) + p(x_s, x_t)``,
  less its minimum over x_t, with ``gamma_s = 1 / max(later neighbours, earlier neighbours)``;
* backward pass, the same in reverse towards earlier neighbours, ``D_s`` less its minimum;
  the lower bound is the sum of the minima subtracted from nodes and messages in this pass;
* decoding in order: ``x_i = argmin u_i + sum_(j<i) p_ji(x_j, .) + sum_(j>i) M_ji``, the first
  label in a tie.

An edge stores one message, that of the last pass over it. Nodes of one colour are processed as one
batch (:mod:`soup_nlp.mrf.levels`), which changes only the order of floating-point sums.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from soup_nlp.errors import ModelError
from soup_nlp.mrf.levels import Level, Side, colours, plan_levels

_CACHE_BYTES = 1 << 19  # tables handled together: half of a usual second-level cache

Callback = Callable[[int, float, float, float], bool | None]


@dataclass(frozen=True)
class TRWSResult:
    """Outcome of :func:`solve_trws`.

    Attributes:
        labels: (N,) int64, the labelling of lowest energy found.
        energy: Its energy by :func:`mrf_energy`, in float64.
        lower_bound: Largest bound so far, at most ``energy``; -inf if no iteration ended.
        iterations: Number of iterations, each one forward and one backward pass.
        status: ``"gap"``, ``"iterations"`` or ``"interrupted"``.
    """

    labels: np.ndarray
    energy: float
    lower_bound: float
    iterations: int
    status: str


def solve_trws(
    unary: np.ndarray,
    edges: np.ndarray,
    pairwise: np.ndarray,
    *,
    max_iter: int = 100,
    gap: float = 1e-6,
    init_labels: np.ndarray | None = None,
    callback: Callback | None = None,
) -> TRWSResult:
    """Minimise a pairwise energy by TRW-S; see the module for the equations.

    Args:
        unary: (N, L) costs. A cost of +inf forbids a label; every node needs a finite one.
        edges: (E, 2) node numbers.
        pairwise: (E, L, L) finite tables, axis 1 for ``edges[e, 0]``. Their type is the working
            type: float64, or float32 for half the memory; the bound is then exact to that rounding.
            Floats are read in place and must not change during the call.
        max_iter: Most iterations.
        gap: Stop once best energy - bound <= ``gap * max(1, |best energy|)``; negative: never.
        init_labels: (N,) labels whose energy the result does not exceed; they guide no message.
        callback: Called after every iteration as ``callback(iteration, bound, energy, best
            energy)``, numbers of the working type; a true return value, or a KeyboardInterrupt at
            any time, ends the iterations with status ``"interrupted"``.

    Raises:
        ModelError: A cost is not finite in the working type.
    """
    costs, begin = np.asarray(unary, np.float64), init_labels
    # integers become float64; tables of floats are read in place
    table = np.asarray(pairwise, np.result_type(pairwise, np.float32))
    solver = _Passes(costs, plan_levels(colours(len(costs), edges), edges), table)
    first = math.inf if begin is None else mrf_energy(begin, unary, edges, pairwise)
    best = (first, costs.argmin(axis=1) if begin is None else begin)
    iterations, highest, status = 0, -math.inf, "iterations"
    try:
        while iterations < max_iter and status == "iterations":
            bound = solver.sweep()
            energy, labels = solver.decode()
            if energy < best[0]:
                best = (energy, labels)
            iterations, highest = iterations + 1, max(highest, bound)
            if callback is not None and callback(iterations, bound, energy, best[0]):
                status = "interrupted"
            elif best[0] - bound <= gap * max(1.0, abs(best[0])):
                status = "gap"
    except KeyboardInterrupt:
        status = "interrupted"
    labels = best[1]
    energy = mrf_energy(labels, unary, edges, pairwise)
    if begin is not None and first < energy:
        energy, labels = first, begin  # float32 ranked a worse labelling as better
    return TRWSResult(labels, energy, min(highest, energy), iterations, status)


def mrf_energy(
    labels: np.ndarray, unary: np.ndarray, edges: np.ndarray, pairwise: np.ndarray
) -> float:
    """Energy of a labelling (N,) in float64, by plain look-up of inputs of :func:`solve_trws`."""
    edge_costs = pairwise[np.arange(len(edges)), labels[edges[:, 0]], labels[edges[:, 1]]]
    node_costs = np.asarray(unary, np.float64)[np.arange(len(labels)), labels]
    return float(node_costs.sum()) + math.fsum(edge_costs.tolist())


class _Passes:
    """Messages and passes of one problem, whose tables are read block by block."""

    def __init__(self, costs: np.ndarray, plan: list[Level], table: np.ndarray) -> None:
        with np.errstate(over="ignore", invalid="ignore"):
            self.costs = costs.astype(table.dtype)
        self.absent, self.plan, self.table = np.isinf(costs), plan, table
        self.messages = np.zeros(table.shape[:2], table.dtype)
        step = max(1, _CACHE_BYTES // (table.itemsize * table.shape[1] ** 2))
        self.block = np.empty((min(step, len(table)), *table.shape[1:]), table.dtype)

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
            raise ModelError(
                "The messages of TRW-S overflow.",
                where="unary or pairwise",
                found=bound,
                expected="a finite bound",
                hint="smaller weights, so that all costs but those that forbid a label are finite",
            )
        return bound

    def _beliefs(self, level: Level) -> np.ndarray:
        """(n, L) unary costs plus all messages into the nodes of a level."""
        out = self.costs[level.nodes]
        level.up.add(out, self.messages[level.up.ids])
        level.down.add(out, self.messages[level.down.ids])
        return out

    def _send(self, side: Side, level: Level, belief: np.ndarray) -> float:
        """Replace the messages of one side of a level; returns the sum of the subtracted minima."""
        belief = belief * level.gamma.astype(belief.dtype)
        sent = belief[side.node] - self.messages[side.ids]
        out = np.empty_like(sent)
        for axis, part in side.parts:
            for k in range(0, len(part), len(self.block)):
                at = part[k : k + len(self.block)]
                block = self.block[: len(at)]
                np.take(self.table, side.ids[at], axis=0, out=block, mode="clip")
                block += sent[at, :, None] if axis == 1 else sent[at, None]
                out[at] = block.min(axis=axis)
        absent = self.absent[side.far]
        np.copyto(out, np.inf, where=absent)
        least = out.min(axis=1, keepdims=True)
        out -= least
        np.copyto(out, 0.0, where=absent)
        self.messages[side.ids] = out
        return float(least.sum(dtype=np.float64))

    def _lines(self, side: Side, labels: np.ndarray) -> np.ndarray:
        """(n, L) table entries over the labels of the level's node, the far end held fixed."""
        fixed = labels[side.far]
        out = np.empty((len(side.ids), self.table.shape[1]), self.table.dtype)
        for axis, at in side.parts:
            rows = side.ids[at]
            out[at] = self.table[rows, :, fixed[at]] if axis == 1 else self.table[rows, fixed[at]]
        return out

    def decode(self) -> tuple[float, np.ndarray]:
        """Energy and (N,) labels of the decoding in order."""
        labels, energy = np.zeros(len(self.costs), np.int64), 0.0
        for level in self.plan:
            exact = self.costs[level.nodes]
            level.down.add(exact, self._lines(level.down, labels))
            total = exact.copy()
            level.up.add(total, self.messages[level.up.ids])
            best = total.argmin(axis=1)
            labels[level.nodes] = best
            energy += float(exact[np.arange(len(best)), best].sum(dtype=np.float64))
        return energy, labels
