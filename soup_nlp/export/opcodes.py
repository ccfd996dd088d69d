"""Opcodes of AMPL's .nl format for CasADi's operations, and the same operations in NumPy."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

Fold = Callable[..., Any]


@dataclass(frozen=True)
class Op:
    """One operation of a .nl expression.

    Attributes:
        code: Opcode; "o54" (sum), "o11" and "o12" (min, max) are followed by their argument count.
        fold: The operation in NumPy.
        before: Constants before the arguments, e.g. 1 of 1 / x.
        after: Constants after the arguments, e.g. 2 of x^2.
    """

    code: str
    fold: Fold
    before: tuple[str, ...] = ()
    after: tuple[str, ...] = ()


PLUS, MINUS, TIMES, DIVIDE, POWER = "o0", "o1", "o2", "o3", "o5"
SUM = "o54"

OPS: Mapping[int, Op] = {
    ca.OP_ADD: Op(PLUS, np.add),
    ca.OP_SUB: Op(MINUS, np.subtract),
    ca.OP_MUL: Op(TIMES, np.multiply),
    ca.OP_DIV: Op(DIVIDE, np.divide),
    ca.OP_NEG: Op("o16", np.negative),
    ca.OP_FABS: Op("o15", np.abs),
    ca.OP_SQRT: Op("o39", np.sqrt),
    ca.OP_EXP: Op("o44", np.exp),
    ca.OP_LOG: Op("o43", np.log),
    ca.OP_POW: Op(POWER, np.power),
    ca.OP_CONSTPOW: Op(POWER, np.power),
    ca.OP_SQ: Op(POWER, np.square, after=("2",)),
    ca.OP_TWICE: Op(TIMES, lambda a: 2 * a, before=("2",)),
    ca.OP_INV: Op(DIVIDE, lambda a: 1 / a, before=("1",)),
    # used by plain NLPs only
    ca.OP_SIN: Op("o41", np.sin),
    ca.OP_COS: Op("o46", np.cos),
    ca.OP_TAN: Op("o38", np.tan),
    ca.OP_ASIN: Op("o51", np.arcsin),
    ca.OP_ACOS: Op("o53", np.arccos),
    ca.OP_ATAN: Op("o49", np.arctan),
    ca.OP_SINH: Op("o40", np.sinh),
    ca.OP_COSH: Op("o45", np.cosh),
    ca.OP_TANH: Op("o37", np.tanh),
    ca.OP_ASINH: Op("o50", np.arcsinh),
    ca.OP_ACOSH: Op("o52", np.arccosh),
    ca.OP_ATANH: Op("o47", np.arctanh),
    ca.OP_ATAN2: Op("o48", np.arctan2),
    ca.OP_FMIN: Op("o11\n2", np.fmin),
    ca.OP_FMAX: Op("o12\n2", np.fmax),
}
"""Operations that can be written; others raise an ExportError."""

COMMUTATIVE = frozenset({ca.OP_ADD, ca.OP_MUL, ca.OP_FMIN, ca.OP_FMAX})

NAMES: Mapping[int, str] = {
    getattr(ca, n): n.removeprefix("OP_").lower() for n in dir(ca) if n.startswith("OP_")
}
"""Names of all operations for error messages."""


def number(value: float) -> str:
    """Shortest text that reads back as the same double (at most 17 significant digits)."""
    text = repr(float(value))
    return text[:-2] if text.endswith(".0") else text
