"""A phase of the presolve: smoothing, Hessian, barrier and the conditions that end it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from soup_nlp.solve.line_search import Point
from soup_nlp.solve.tangent_problem import HessianKind

Float = NDArray[np.float64]

FASTER = 0.3
"""Steps beyond the tolerance go on while dual infeasibility or gap fall to this share."""
FAR_BELOW = 0.03
"""Share of the tolerance at which the dual infeasibility need not fall further."""


@dataclass(frozen=True)
class Phase:
    """One setting of smoothing, Hessian and barrier, and the conditions that end it.

    Attributes:
        name: For progress.
        hessian: "gauss-newton" (the reweighted majorant) or "exact".
        eps: Smoothing width, pixels.
        barrier: b of `f - b sum log c`.
        iterations: Limit.
        stagnation: Ends when the merit falls by less than this share of f, twice in a row.
        tol: Ends when dual infeasibility is below; "Solve_Succeeded".
        beyond: Whether steps go on after that while each makes the dual infeasibility or the gap
            FASTER times as large.
        highest: Barrier far from the solution, where superpixels need room to slide along a curved
            boundary. It follows 1e-6 of the dual infeasibility down to `barrier`.
    """

    name: str
    hessian: HessianKind
    eps: float
    barrier: float
    iterations: int
    stagnation: float
    tol: float
    beyond: bool = False
    highest: float = 0.0


class Reached(NamedTuple):
    """A point within the tolerance.

    Attributes:
        at: The point.
        z: (N, R) multipliers there.
        row: Of the history: f, dual infeasibility, gap, ...
    """

    at: Point
    z: Float
    row: tuple[float, ...]

    def done(self, phase: Phase) -> bool:
        """Whether another step gains nothing: the gap is the barrier's own."""
        _, dual, gap, *_ = self.row
        return dual <= FAR_BELOW * phase.tol and gap <= 1.01 * phase.barrier

    def less(self, dual: float, gap: float) -> bool:
        """Whether the next point is worth a step beyond it."""
        return dual < FASTER * self.row[1] or gap < FASTER * self.row[2]
