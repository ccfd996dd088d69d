"""A claim checked: KKT residuals and exact energy, recomputed from the point."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from soup_nlp.compare.task import Limits
from soup_nlp.export.duals import bound_multipliers, least_squares_multipliers
from soup_nlp.model.nlp import NLP
from soup_nlp.solve.kkt import optimality

Float = NDArray[np.float64]

SLACK = 10.0
"""Solvers scale their residuals, each in its way; ours are unscaled and may be this much larger."""


@dataclass(frozen=True)
class Residuals:
    """KKT residuals of a point, unscaled.

    Attributes:
        primal: Largest violation of a bound or a row.
        dual: |grad f + J' lam_g + lam_x|, largest entry.
        complementarity: Largest product of a gap and its multiplier.
        multipliers: "solver" or "least squares": whose lam_g balances better.
    """

    primal: float
    dual: float
    complementarity: float
    multipliers: str

    def within(self, limits: Limits) -> bool:
        """Small enough for success."""
        return (
            self.primal <= SLACK * limits.feasibility
            and self.dual <= SLACK * limits.tol
            and self.complementarity <= SLACK * limits.tol
        )

    def as_dict(self) -> dict[str, float | str]:
        """For a row."""
        return asdict(self)


def kkt(nlp: NLP, x: Float, lam_g: Float | None) -> Residuals:
    """Residuals of a point with the solver's multipliers or the least-squares ones.

    Multipliers of the bounds follow from the point: nothing of the solver's is needed.

    Args:
        nlp: The problem.
        x: (nx,) point.
        lam_g: (ng,) the solver's multipliers, or None.
    """
    g = np.asarray(nlp.oracle(x, nlp.p)[1]).ravel()
    outside = [np.maximum(nlp.lbx - x, x - nlp.ubx), np.maximum(nlp.lbg - g, g - nlp.ubg)]
    primal = max(0.0, *(float(v.max(initial=0.0)) for v in outside))
    candidates = {"least squares": least_squares_multipliers(nlp, x)}
    if lam_g is not None and np.isfinite(lam_g).all():
        candidates["solver"] = lam_g
    best: Residuals | None = None
    for name, lam in candidates.items():
        found = optimality(nlp, x, bound_multipliers(nlp, x, lam), lam)
        dual, gap = found["dual_infeasibility"], found["complementarity"]
        if best is None or max(dual, gap) < max(best.dual, best.complementarity):
            best = Residuals(primal, dual, gap, name)
    assert best is not None
    return best
