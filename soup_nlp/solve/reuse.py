"""Newton steps by conjugate gradients, with the factorisation of an earlier matrix.

From one iteration to the next the matrix changes little, so that its last factor is a good
preconditioner. A factorisation grows as N^1.7, a solve as N^1.2: at N = 8,000 a factorisation costs
as much as 25 iterations of conjugate gradients.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from soup_nlp.solve.factor import Back

Float = NDArray[np.float64]
Times = Callable[[Float], Float]

LIMIT = 15
"""Largest number of iterations; beyond it a new factorisation is cheaper."""
AHEAD = 0.4
"""Share of the way, in logarithms, by which half of them must have reduced the residual."""
WORN = 8
"""Number of iterations of a solve after which the next matrix is factorised."""


class Solved(NamedTuple):
    """Result of conjugate gradients.

    Attributes:
        h: The step.
        product: Matrix times step.
        iterations: Made.
        solved: Whether the tolerance was reached.
        indefinite: Whether a direction has no curvature: the matrix is not positive definite.
    """

    h: Float
    product: Float
    iterations: int
    solved: bool = False
    indefinite: bool = False

    @property
    def worn(self) -> bool:
        """Whether the factor has become a poor preconditioner."""
        return self.iterations > WORN


def held(back: Back, a: Float) -> Times:
    """Newton step for a gradient, within the plane `a . h = 0`."""
    v = back(a)

    def newton(gradient: Float) -> Float:
        u = back(gradient)
        return np.asarray(-u + v * (a @ u) / (a @ v))

    return newton


def preconditioned(times: Times, newton: Times, gradient: Float, tol: float) -> Solved:
    """Minimise `gradient . h + h . H h / 2` in the plane of `newton` (Gould, Hribar, Nocedal 2001).

    Args:
        times: H times a vector.
        newton: Newton step of another matrix, from `held`.
        gradient: (n,) at h = 0.
        tol: Ends when the preconditioned residual is below this share of its first value.
    """
    out = Solved(np.zeros_like(gradient), np.zeros_like(gradient), 0)
    p = newton(gradient)
    first = old = least = -float(gradient @ p)
    while first > 0 and out.iterations < LIMIT:
        if out.iterations == LIMIT // 2 and least > tol ** (2 * AHEAD) * first:
            break
        Hp = times(p)
        curved = float(p @ Hp)
        if not curved > 0:
            return out._replace(indefinite=True)
        ahead = old / curved
        out = Solved(out.h + ahead * p, out.product + ahead * Hp, out.iterations + 1)
        residual = gradient + out.product
        step = newton(residual)
        new = -float(residual @ step)
        if new <= tol**2 * first:
            return out._replace(solved=True)
        p, old, least = step + new / old * p, new, min(least, new)
    return out
