"""Checks of the input of the .nl writers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import casadi as ca
import numpy as np

from soup_nlp.arrays import Float
from soup_nlp.errors import ExportError


def plain_problem(problem: Mapping[str, object], where: object) -> tuple[ca.SX, ca.SX, ca.SX]:
    """x (nx,), scalar f and g (ng,) of a problem in the form of nlpsol.

    Args:
        problem: `x`, `f` and, if there are constraints, `g`; `p` must be empty.
        where: File, for messages.

    Raises:
        ExportError: an entry is unknown, missing, not SX or of a wrong shape, or a symbol is not a
            variable.
    """
    if not isinstance(problem, Mapping):
        raise ExportError(
            "NLP is not a dictionary",
            where=where,
            found=type(problem).__name__,
            expected="x, f and, if there are constraints, g",
        )
    if set(problem) - {"x", "f", "g", "p"} or problem.get("x") is None:
        raise ExportError(
            "NLP is not of the form x, f, g",
            where=where,
            found=", ".join(map(str, problem)),
            expected="x, f and, if there are constraints, g",
        )
    x, f, g, p = (_expression(k, problem.get(k), where) for k in ("x", "f", "g", "p"))
    if not x.numel() or not x.is_valid_input():
        raise ExportError("x is not a vector of symbols", where=where, found=str(x)[:60])
    if problem.get("f") is None:
        f = ca.SX(0)
    if f.numel() != 1:
        raise ExportError("objective is not a scalar", where=where, found=f.shape)
    x, g = ca.vec(x), ca.vec(g)
    free = [s for s in ca.symvar(ca.vertcat(f, g)) if not ca.depends_on(x, s)]
    if p.numel() or free:
        raise ExportError(
            "NLP has symbols that are not variables",
            where=where,
            found=free if free else p,
            hint="substitute numbers for the parameters first",
        )
    return x, f, g


def _expression(name: str, value: object, where: object) -> ca.SX:
    """An entry as SX; None becomes an empty vector."""
    try:
        return ca.SX(0, 1) if value is None else ca.SX(value)
    except (NotImplementedError, TypeError, RuntimeError):
        raise ExportError(
            f"{name} of the NLP is not SX",
            where=where,
            found=type(value).__name__,
            hint="Function.expand() makes SX of most MX expressions",
        ) from None


def vector(name: str, values: object, size: int, default: float, where: object) -> Float:
    """(size,) numbers; a scalar stands for all entries, None for the default.

    Raises:
        ExportError: they are not numbers, or have another length.
    """
    try:
        found = np.asarray(default if values is None else values, float)
    except (TypeError, ValueError, OverflowError, RuntimeError, NotImplementedError):
        raise ExportError(
            f"{name} is not a vector of numbers", where=where, found=type(values).__name__
        ) from None
    if found.size == 1:
        return np.full(size, found.item())
    if found.size != size or found.size != max(found.shape, default=1):
        raise ExportError(
            f"{name} has a wrong length", where=where, found=found.shape, expected=f"({size},)"
        )
    return found.ravel()


def require_finite(name: str, values: Float, where: object) -> None:
    """Raise ExportError if an entry is NaN or infinite."""
    if not np.isfinite(values).all():
        k = int(np.argmin(np.isfinite(values)))
        raise ExportError(f"{name} is not finite", where=where, found=f"{values[k]} at entry {k}")


def require_bounds(name: str, lower: Float, upper: Float, where: object) -> None:
    """Raise ExportError for bounds (n,) that are NaN, cross, or admit no finite number."""
    # false for NaN too
    good = (lower <= upper) & (lower < np.inf) & (upper > -np.inf)
    if not good.all():
        k = int(np.argmin(good))
        raise ExportError(
            f"bounds of {name} hold for no number",
            where=where,
            found=f"[{lower[k]}, {upper[k]}] at entry {k}",
        )


def require_names(name: str, names: Sequence[str] | None, size: int, where: object) -> None:
    """Raise ExportError unless there are `size` nonempty names without line breaks."""
    if names is None:
        return
    if len(names) != size:
        raise ExportError(
            f"{name} has a wrong length", where=where, found=len(names), expected=size
        )
    for word in names:
        if not isinstance(word, str) or len(word.splitlines()) != 1 or not word.strip():
            raise ExportError(f"one of {name} is no name", where=where, found=repr(word)[:60])
