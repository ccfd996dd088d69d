"""Operations that kernels may have, in numpy and in .nl files; kernels summed over their table.

A kernel's instructions run one after the other on blocks of elements, so that an instruction costs
one call of numpy a block. In CasADi's virtual machine, instruction by instruction and element by
element, a kernel takes four times as long.
"""

from collections.abc import Callable, Mapping
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float
from soup_nlp.errors import ModelError
from soup_nlp.model.kernel import Group, in_blocks


class Operation(NamedTuple):
    """One operation of a kernel.

    Attributes:
        numpy: Function of arrays and, last, of the array that takes the result (or None).
        nl: Its prefix text in AMPL's format, with {0} and {1} for the operands; "" where an
            expression with the operation cannot be written. "o11" and "o12" (min, max) are
            followed by their argument count.
    """

    numpy: Callable[..., Any]
    nl: str = ""


_ONE = np.array(1.0)
OPERATIONS: Mapping[int, Operation] = {
    ca.OP_ADD: Operation(np.add, "o0 {0} {1}"),
    ca.OP_SUB: Operation(np.subtract, "o1 {0} {1}"),
    ca.OP_MUL: Operation(np.multiply, "o2 {0} {1}"),
    ca.OP_DIV: Operation(np.divide, "o3 {0} {1}"),
    ca.OP_NEG: Operation(np.negative, "o16 {0}"),
    ca.OP_SQ: Operation(np.square, "o5 {0} n2"),
    ca.OP_TWICE: Operation(lambda a, out=None: np.add(a, a, out), "o2 n2 {0}"),
    ca.OP_INV: Operation(lambda a, out=None: np.divide(_ONE, a, out), "o3 n1 {0}"),
    ca.OP_FABS: Operation(np.abs, "o15 {0}"),
    # an output as third argument is deprecated in these two
    ca.OP_FMAX: Operation(lambda a, b, out=None: np.maximum(a, b, out=out), "o12 2 {0} {1}"),
    ca.OP_FMIN: Operation(lambda a, b, out=None: np.minimum(a, b, out=out), "o11 2 {0} {1}"),
    ca.OP_LT: Operation(np.less),
    ca.OP_LE: Operation(np.less_equal),
    ca.OP_NOT: Operation(lambda a, out=None: np.equal(a, 0.0, out)),
    # not a product: what is left out may be infinite
    ca.OP_IF_ELSE_ZERO: Operation(lambda a, b, out: np.copyto(out, np.where(a, b, 0.0))),
    ca.OP_SQRT: Operation(np.sqrt, "o39 {0}"),
    ca.OP_POW: Operation(np.power, "o5 {0} {1}"),
    ca.OP_CONSTPOW: Operation(np.power, "o5 {0} {1}"),
    ca.OP_ATAN2: Operation(np.arctan2, "o48 {0} {1}"),
    ca.OP_EXP: Operation(np.exp, "o44 {0}"),
    ca.OP_LOG: Operation(np.log, "o43 {0}"),
    ca.OP_SIN: Operation(np.sin, "o41 {0}"),
    ca.OP_COS: Operation(np.cos, "o46 {0}"),
    ca.OP_TAN: Operation(np.tan, "o38 {0}"),
    ca.OP_ASIN: Operation(np.arcsin, "o51 {0}"),
    ca.OP_ACOS: Operation(np.arccos, "o53 {0}"),
    ca.OP_ATAN: Operation(np.arctan, "o49 {0}"),
    ca.OP_SINH: Operation(np.sinh, "o40 {0}"),
    ca.OP_COSH: Operation(np.cosh, "o45 {0}"),
    ca.OP_TANH: Operation(np.tanh, "o37 {0}"),
    ca.OP_ASINH: Operation(np.arcsinh, "o50 {0}"),
    ca.OP_ACOSH: Operation(np.arccosh, "o52 {0}"),
    ca.OP_ATANH: Operation(np.arctanh, "o47 {0}"),
}
"""Operations by CasADi's number."""
NAMES: Mapping[int, str] = {
    getattr(ca, n): n.removeprefix("OP_").lower() for n in dir(ca) if n.startswith("OP_")
}
"""Names of all operations for error messages."""


Instruction = tuple[int, list[int], list[int], float]
"""CasADi's number of an operation; the register that takes the result, or output and nonzero of the
function (OP_OUTPUT); registers of the operands, or input and nonzero (OP_INPUT); the value of
OP_CONST, else 0."""
LARGE = 20_000
"""Instructions from which a function's list takes megabytes: only those of one solve are kept."""


def _instructions(f: ca.Function) -> tuple[Instruction, ...]:
    numbers = [f.instruction_id(k) for k in range(f.n_instructions())]
    return tuple(
        (
            number,
            f.instruction_output(k),
            f.instruction_input(k),
            f.instruction_constant(k) if number == ca.OP_CONST else 0.0,
        )
        for k, number in enumerate(numbers)
    )


_of_small = lru_cache(maxsize=200)(_instructions)
_of_large = lru_cache(maxsize=16)(_instructions)


def instructions(function: ca.Function) -> tuple[Instruction, ...]:
    """What an SX function computes, step by step."""
    return (_of_small if function.n_instructions() < LARGE else _of_large)(function)


# --- kernels summed over their table --------------------------------------------------------------


class Vectors:
    """One function of a kernel, for every element of the kernel's table.

    Attributes:
        entries: Number of its results, those of elements that fill the last block included.
    """

    def __init__(self, function: ca.Function, group: Group) -> None:
        """Translate a function (x, row, theta) or (x, row, theta, lam_f, lam_c) -> (k,)."""
        size = group.block_size
        # what a function does not take has no rows
        count = [function.nnz_in(i) if i < function.n_in() else 0 for i in range(5)]
        self._x, self._data = np.empty((count[0], size)), np.empty((count[1], size))
        self._theta, self._lam_f = np.empty(count[2]), np.empty(1)
        self._lam_c, self._out = np.empty((count[4], size)), np.empty((function.nnz_out(0), size))
        self._function, self._blocks = function, group.blocks
        self.entries = len(self._blocks) * self._out.size

    def ordered(self, target: NDArray[np.integer], behind: int) -> NDArray[np.integer]:
        """Numbers (E, k) of the elements' entries in the order of `evaluate`; `behind` for what
        fills the last block."""
        last = np.full((1, target.shape[1]), behind)
        return in_blocks(target, self._out.shape[1], last).ravel()

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
            elif op not in OPERATIONS:
                raise ModelError("unknown operation", where="a kernel", found=NAMES[op])
            else:
                given = [registers[i] for i in source]
                registers[to[0]] = work[to[0]]
                calls.append((OPERATIONS[op].numpy, (*given, work[to[0]])))
        return calls

    def evaluate(
        self, out: Float, x: Float, theta: Float, lam_f: float, lam_g: Float | None
    ) -> None:
        """Write the entries at x (nx,) into `out` (entries,); multipliers are those of Hessians."""
        self._theta[:], self._lam_f[0] = theta[: len(self._theta)], lam_f
        with np.errstate(all="ignore"):
            for part, (index, data, rows) in zip(out.reshape(-1, *self._out.shape), self._blocks):
                np.take(x, index, out=self._x)
                self._data[:] = data
                if lam_g is not None:
                    np.take(lam_g, rows, out=self._lam_c)
                for call, given in self._calls:
                    call(*given)
                part[:] = self._out
