"""Opcodes of AMPL's .nl format for CasADi's operations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca


@dataclass(frozen=True)
class Op:
    """One operation of a .nl expression; `model.operations` has the same in numpy.

    Attributes:
        code: Opcode; "o54" (sum), "o11" and "o12" (min, max) are followed by their argument count.
        before: Constants before the arguments, e.g. 1 of 1 / x.
        after: Constants after the arguments, e.g. 2 of x^2.
    """

    code: str
    before: tuple[str, ...] = ()
    after: tuple[str, ...] = ()


PLUS, MINUS, TIMES, DIVIDE, POWER = "o0", "o1", "o2", "o3", "o5"
SUM = "o54"

OPS: Mapping[int, Op] = {
    ca.OP_ADD: Op(PLUS),
    ca.OP_SUB: Op(MINUS),
    ca.OP_MUL: Op(TIMES),
    ca.OP_DIV: Op(DIVIDE),
    ca.OP_NEG: Op("o16"),
    ca.OP_FABS: Op("o15"),
    ca.OP_SQRT: Op("o39"),
    ca.OP_EXP: Op("o44"),
    ca.OP_LOG: Op("o43"),
    ca.OP_POW: Op(POWER),
    ca.OP_CONSTPOW: Op(POWER),
    ca.OP_SQ: Op(POWER, after=("2",)),
    ca.OP_TWICE: Op(TIMES, before=("2",)),
    ca.OP_INV: Op(DIVIDE, before=("1",)),
    # used by plain NLPs only
    ca.OP_SIN: Op("o41"),
    ca.OP_COS: Op("o46"),
    ca.OP_TAN: Op("o38"),
    ca.OP_ASIN: Op("o51"),
    ca.OP_ACOS: Op("o53"),
    ca.OP_ATAN: Op("o49"),
    ca.OP_SINH: Op("o40"),
    ca.OP_COSH: Op("o45"),
    ca.OP_TANH: Op("o37"),
    ca.OP_ASINH: Op("o50"),
    ca.OP_ACOSH: Op("o52"),
    ca.OP_ATANH: Op("o47"),
    ca.OP_ATAN2: Op("o48"),
    ca.OP_FMIN: Op("o11\n2"),
    ca.OP_FMAX: Op("o12\n2"),
}
"""Operations that can be written; others raise an ExportError."""

COMMUTATIVE = frozenset({ca.OP_ADD, ca.OP_MUL, ca.OP_FMIN, ca.OP_FMAX})


def number(value: float) -> str:
    """Shortest text that reads back as the same double (at most 17 significant digits)."""
    text = repr(float(value))
    return text[:-2] if text.endswith(".0") else text
