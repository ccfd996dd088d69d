"""A phase of the presolve: smoothing, Hessian, barrier and the conditions that end it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from soup_nlp.arrays import Float
from soup_nlp.solve.line_search import Point
from soup_nlp.solve.solver_options import SolverOptions
from soup_nlp.solve.tangent_problem import HessianKind

POLISH = "presolve polish"
"""Name of the phase with the exact Hessian."""
FASTER = 0.3
"""Steps beyond the tolerance continue while dual infeasibility or gap fall to this share."""
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
        stagnation: Ends when the merit falls by less than this share of f, twice in a row; where it
            is 0, when the merit and the least dual infeasibility do not fall twice in a row.
        tol: Ends when the dual infeasibility is below; the status is "Solve_Succeeded".
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


def reweighted(o: SolverOptions, kind: str = "") -> list[Phase]:
    """The reweighted phases: barriers from 1e-3 down to 1e-5 while the smoothing shrinks."""
    last = len(o.presolve_eps) - 1
    barriers = np.geomspace(1e-3, 1e-5, last + 1) if last else np.array([1e-5])
    return [
        Phase(
            name=f"presolve {kind}{eps:g}",
            hessian="gauss-newton",
            eps=eps,
            barrier=float(barrier),
            iterations=o.presolve_iterations,
            stagnation=o.stagnation * (0.01 if k == last else 1.0),
            tol=o.presolve_tol,
        )
        for k, (eps, barrier) in enumerate(zip(o.presolve_eps, barriers))
    ]


def polish(o: SolverOptions) -> Phase:
    """The last phase, with the exact Hessian."""
    return Phase(
        name=POLISH,
        hessian="exact",
        eps=o.eps,
        barrier=1e-10,
        iterations=o.polish_iterations,
        stagnation=0.0,
        tol=o.presolve_tol,
        beyond=True,
        highest=1e-5,
    )


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
        """Whether another step gains nothing: the gap is that of the barrier problem's solution."""
        _, dual, gap, *_ = self.row
        return dual <= FAR_BELOW * phase.tol and gap <= 1.01 * phase.barrier

    def less(self, dual: float, gap: float) -> bool:
        """Whether the next point is worth a step beyond it."""
        return dual < FASTER * self.row[1] or gap < FASTER * self.row[2]


class Convergence:
    """Whether a phase has converged, and the best point within its tolerance.

    Attributes:
        reached: That point; None before there is one.
    """

    def __init__(self, phase: Phase) -> None:
        self.reached: Reached | None = None
        self._phase = phase

    def met(self, at: Point, z: Float, row: tuple[float, ...]) -> bool:
        """Whether the phase ends here: it has converged, and further steps gain nothing.

        Args:
            at: The iterate.
            z: (N, R) multipliers there.
            row: Of the history: f, dual infeasibility, gap, ...
        """
        phase, before, (_, dual, gap, *_) = self._phase, self.reached, row
        good = dual <= phase.tol and gap <= max(phase.tol, 2 * phase.barrier)
        enough = before is not None and not (good and before.less(dual, gap))
        if good and (before is None or not enough or dual < before.row[1]):
            self.reached = Reached(at, z, row)
        if enough or (good and not phase.beyond):
            return True
        return self.reached is not None and self.reached.done(phase)
