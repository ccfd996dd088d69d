"""Calling CasADi functions on numpy arrays without copies into CasADi's own matrices."""

from __future__ import annotations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


class Buffered:
    """A CasADi function whose outputs are numpy arrays of nonzeros.

    Reading a Hessian with a million nonzeros through `casadi.DM` takes five times as long as
    computing it. The arrays that a call returns are written over by the next call.

    Attributes:
        function: The function.
    """

    def __init__(self, function: ca.Function) -> None:
        # the buffer refers to the function, which must live as long
        self.function = function
        self._buffer, self._evaluate = function.buffer()
        self._out = [np.zeros(function.nnz_out(i)) for i in range(function.n_out())]
        for i, out in enumerate(self._out):
            self._buffer.set_res(i, memoryview(out.data))

    def __call__(self, *arguments: Float | float) -> list[Float]:
        """Nonzeros of every output.

        Args:
            arguments: Nonzeros of every input.

        Raises:
            ValueError: An argument has another number of nonzeros than the input.
        """
        held = [np.ascontiguousarray(a, dtype=float).ravel() for a in arguments]
        for i, a in enumerate(held):
            if len(a) != self.function.nnz_in(i):
                raise ValueError(
                    f"{self.function.name()}: input {i} has {len(a)} nonzeros,"
                    f" expected {self.function.nnz_in(i)}"
                )
            self._buffer.set_arg(i, memoryview(a.data))
        self._evaluate()
        return self._out
