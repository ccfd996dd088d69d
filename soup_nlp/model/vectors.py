"""Kernels in numpy, summed over their table.

The kernel's instructions run one after the other on blocks of elements, so that an instruction
costs one call of numpy a block. In CasADi's virtual machine, instruction by instruction and element
by element, a kernel takes four times as long.
"""

from collections.abc import Callable
from functools import cached_property
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float
from soup_nlp.model.kernel import Group
from soup_nlp.model.operations import instructions, operation

BLOCK = 2048
"""Elements of a block: more cost fewer calls, fewer fit into the cache."""


class Vectors:
    """One function of a kernel, summed over the kernel's table."""

    def __init__(
        self, function: ca.Function, group: Group, target: NDArray[np.integer], sums: int
    ) -> None:
        """Translate the function.

        Args:
            function: (x, row, theta) or (x, row, theta, lam_f, lam_c) -> (k,).
            group: Kernel and table of E elements.
            target: (E, k) where each entry is added.
            sums: Size of the vector; what pads the last block is added behind it.
        """
        size = max(1, min(BLOCK, len(group)))
        # what a function does not take has no rows
        count = [function.nnz_in(i) if i < function.n_in() else 0 for i in range(5)]
        self._x, self._data = np.empty((count[0], size)), np.empty((count[1], size))
        self._theta, self._lam_f = np.empty(count[2]), np.empty(1)
        self._lam_c, self._out = np.empty((count[4], size)), np.empty((function.nnz_out(0), size))
        self._function = function
        tables = (_in_blocks(t, size, t[-1:]) for t in (group.index, group.data, group.rows))
        behind = np.full((1, target.shape[1]), sums)
        self._blocks = list(zip(*tables, _in_blocks(target, size, behind)))

    @cached_property
    def _calls(self) -> list[tuple[Callable[..., Any], Any]]:
        """Calls of numpy with their arguments: rows of the block's buffers and registers.

        Translated at the first evaluation, because many Hessians are never evaluated.
        """
        f = self._function
        inputs = self._x, self._data, self._theta[:, None], self._lam_f[:, None], self._lam_c
        rows, out = [list(values) for values in inputs], list(self._out)
        work = list(np.empty((f.sz_w(), self._out.shape[1])))
        registers: dict[int, Float] = {}
        calls: list[tuple[Callable[..., Any], Any]] = []
        for op, to, source, constant in instructions(f):
            if op == ca.OP_INPUT:
                registers[to[0]] = rows[source[0]][source[1]]
            elif op == ca.OP_CONST:
                registers[to[0]] = np.array([constant])
            elif op == ca.OP_OUTPUT:
                calls.append((np.copyto, (out[to[1]], registers[source[0]])))
            else:
                known = operation(op)
                given = [registers[i] for i in source[: known.operands]]
                registers[to[0]] = work[to[0]]
                calls.append((known.numpy, (*given, work[to[0]])))
        return calls

    def add(self, out: Float, x: Float, theta: Float, lam_f: float, lam_g: Float | None) -> None:
        """Add the elements' entries at x (nx,) to `out`; multipliers are those of Hessians."""
        self._theta[:], self._lam_f[0] = theta[: len(self._theta)], lam_f
        with np.errstate(all="ignore"):
            for index, data, rows, target in self._blocks:
                np.take(x, index, out=self._x)
                self._data[:] = data
                if lam_g is not None:
                    np.take(lam_g, rows, out=self._lam_c)
                for call, given in self._calls:
                    call(*given)
                out += np.bincount(target.ravel(), self._out.ravel(), len(out))


def _in_blocks(table: NDArray[Any], width: int, last: NDArray[Any]) -> NDArray[Any]:
    """(E, k) table as (B, k, width), filled up with a last row (1, k)."""
    full = np.concatenate([table, np.repeat(last, -len(table) % width, axis=0)])
    full = full.astype(np.float64 if full.dtype.kind == "f" else np.int64)
    blocks = full.reshape(len(full) // width, width, table.shape[1])
    return np.ascontiguousarray(blocks.transpose(0, 2, 1))
