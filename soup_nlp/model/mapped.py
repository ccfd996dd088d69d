"""Kernels in CasADi's virtual machine, summed over their table.

They replace `vectors` where a kernel has an operation that `vectors` does not know.
"""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float
from soup_nlp.model.kernel import Table


class Mapped:
    """One function of a kernel, summed over the kernel's table.

    Numbers pass through CasADi's buffers: reading a Hessian with a million nonzeros through
    `casadi.DM` takes five times as long as computing it.
    """

    def __init__(self, function: ca.Function, table: Table, place: NDArray[np.integer]) -> None:
        """Map the function over the table.

        Args:
            function: (x, row, theta) or (x, row, theta, lam_f, lam_c) -> (k,).
            table: The kernel's table, E elements.
            place: (E, k) where each entry is added.
        """
        # the buffer refers to the function, which must live as long
        self._function = function.map(len(table))
        self._buffer, self._evaluate = self._function.buffer()
        self._entries = np.zeros(self._function.nnz_out(0))
        self._buffer.set_res(0, memoryview(self._entries.data))
        self._table, self._place = table, place.astype(np.int64).ravel()

    def add(self, out: Float, x: Float, theta: Float, lam_f: float, lam_g: Float | None) -> None:
        """Add the elements' entries to `out`; arguments as of `lanes.Summed.add`."""
        table, size = self._table, len(self._table)
        given = [x[table.index], table.data, np.tile(theta, size)]
        if lam_g is not None:
            given += [np.full(size, lam_f), lam_g[table.rows]]
        held = [np.ascontiguousarray(a, dtype=float).ravel() for a in given]
        for i, a in enumerate(held):
            self._buffer.set_arg(i, memoryview(a.data))
        self._evaluate()
        np.add.at(out, self._place, self._entries)
