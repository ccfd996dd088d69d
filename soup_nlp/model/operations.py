"""Operations that kernels may have: in numpy, and in .nl files."""

from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from soup_nlp.errors import ModelError


class Operation(NamedTuple):
    """One operation of a kernel.

    Attributes:
        numpy: Function of arrays and, last, of the array that takes the result (or None).
        nl: Its prefix text in AMPL's format, with {0} and {1} for the operands; "" where an
            expression with the operation cannot be written. "o11" and "o12" (min, max) are
            followed by their argument count.
        operands: One or two.
    """

    numpy: Callable[..., Any]
    nl: str = ""
    operands: int = 1


def _if_else_zero(a: Any, b: Any, out: Any = None) -> Any:
    # not a product: what is left out may be infinite
    return np.copyto(out, np.where(a != 0, b, 0.0))


_ONE = np.array(1.0)
OPERATIONS: Mapping[int, Operation] = {
    ca.OP_ADD: Operation(np.add, "o0 {0} {1}", 2),
    ca.OP_SUB: Operation(np.subtract, "o1 {0} {1}", 2),
    ca.OP_MUL: Operation(np.multiply, "o2 {0} {1}", 2),
    ca.OP_DIV: Operation(np.divide, "o3 {0} {1}", 2),
    ca.OP_NEG: Operation(np.negative, "o16 {0}"),
    ca.OP_SQ: Operation(np.square, "o5 {0} n2"),
    ca.OP_TWICE: Operation(lambda a, out=None: np.add(a, a, out), "o2 n2 {0}"),
    ca.OP_INV: Operation(lambda a, out=None: np.divide(_ONE, a, out), "o3 n1 {0}"),
    ca.OP_FABS: Operation(np.abs, "o15 {0}"),
    # an output as third argument is deprecated in these two
    ca.OP_FMAX: Operation(lambda a, b, out=None: np.maximum(a, b, out=out), "o12 2 {0} {1}", 2),
    ca.OP_FMIN: Operation(lambda a, b, out=None: np.minimum(a, b, out=out), "o11 2 {0} {1}", 2),
    ca.OP_LT: Operation(np.less, operands=2),
    ca.OP_LE: Operation(np.less_equal, operands=2),
    ca.OP_NOT: Operation(lambda a, out=None: np.equal(a, 0.0, out)),
    ca.OP_IF_ELSE_ZERO: Operation(_if_else_zero, operands=2),
    ca.OP_SQRT: Operation(np.sqrt, "o39 {0}"),
    ca.OP_POW: Operation(np.power, "o5 {0} {1}", 2),
    ca.OP_CONSTPOW: Operation(np.power, "o5 {0} {1}", 2),
    ca.OP_ATAN2: Operation(np.arctan2, "o48 {0} {1}", 2),
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
"""Operations by CasADi's number; `operation` finds them."""
NAMES: Mapping[int, str] = {
    getattr(ca, n): n.removeprefix("OP_").lower() for n in dir(ca) if n.startswith("OP_")
}
"""Names of all operations for error messages."""


def operation(number: int) -> Operation:
    """The operation of CasADi's number.

    Raises:
        ModelError: a kernel with it cannot be evaluated.
    """
    if number not in OPERATIONS:
        raise ModelError("unknown operation", where="a kernel", found=NAMES[number])
    return OPERATIONS[number]


Instruction = tuple[int, list[int], list[int], float]
"""CasADi's number of an operation; the register that takes the result, or output and nonzero of the
function (OP_OUTPUT); registers of the operands, or input and nonzero (OP_INPUT); the value of
OP_CONST, else 0."""


def instructions(function: ca.Function) -> tuple[Instruction, ...]:
    """What an SX function computes, step by step."""
    return (_of_small if function.n_instructions() < LARGE else _of_large)(function)


LARGE = 20_000
"""Instructions from which a function's list takes megabytes: only those of one solve are kept."""


def _instructions(f: ca.Function) -> tuple[Instruction, ...]:
    numbers = [f.instruction_id(k) for k in range(f.n_instructions())]
    values = [f.instruction_constant(k) if n == ca.OP_CONST else 0.0 for k, n in enumerate(numbers)]
    places = [(f.instruction_output(k), f.instruction_input(k)) for k in range(len(numbers))]
    return tuple((n, *place, value) for n, place, value in zip(numbers, places, values))


_of_small = lru_cache(maxsize=200)(_instructions)
_of_large = lru_cache(maxsize=16)(_instructions)
