"""A claim checked: KKT residuals and exact energy, recomputed from the point."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from soup_nlp.export.duals import bound_multipliers, least_squares_multipliers
from soup_nlp.model.nlp import NLP
from soup_nlp.solve.kkt import optimality

Float = NDArray[np.float64]

SLACK = 10.0
"""Solvers scale their residuals, each in its way; ours are unscaled and may be this much larger."""
ENERGY_SLACK = 1e-3
"""A solution's exact energy may be this share above the proposal's: the smoothing moves it."""


@dataclass(frozen=True)
class Limits:
    """Equal for every solver.

    Attributes:
        seconds: Wall time, set-up included.
        iterations: Of the solver's outer loop.
        tol: Dual infeasibility and complementarity; constraints get 1e-2 of it.
        memory: Bytes beyond what the problem itself takes.
    """

    seconds: float = 60.0
    iterations: int = 300
    tol: float = 1e-4
    memory: int = 4 << 30

    @property
    def feasibility(self) -> float:
        """Tolerance of the constraints."""
        return 1e-2 * self.tol


@dataclass(frozen=True)
class Residuals:
    """KKT residuals of a point, unscaled.

    Attributes:
        primal: Largest violation of a bound or a row.
        dual: |grad f + J' lam_g + lam_x|, largest entry.
        complementarity: Largest product of a gap and its multiplier.
        multipliers: "solver" or "least squares": whose lam_g balances better; "none" where the
            point has no derivatives.
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


@dataclass(frozen=True)
class Optimality:
    """Residuals of a point with the multipliers that they belong to.

    Attributes:
        residuals: Of point and multipliers.
        lam_x: (nx,) multipliers of the bounds.
        lam_g: (ng,) multipliers of the rows.
    """

    residuals: Residuals
    lam_x: Float
    lam_g: Float


def violations(nlp: NLP, x: Float) -> dict[str, Float]:
    """How far "bounds" (nx,) and "rows" (ng,) are outside; infinite where it is not a number."""
    with np.errstate(all="ignore"):
        g = np.asarray(nlp.oracle(x, nlp.p)[1]).ravel()
        outside = {
            "bounds": np.maximum(nlp.lbx - x, x - nlp.ubx),
            "rows": np.maximum(nlp.lbg - g, g - nlp.ubg),
        }
    return {k: np.maximum(0.0, np.where(np.isnan(v), np.inf, v)) for k, v in outside.items()}


def kkt(nlp: NLP, x: Float, lam_g: Float | None) -> Residuals:
    """Residuals of a point with the solver's multipliers or the least-squares ones.

    Multipliers of the bounds follow from the point: nothing of the solver's is needed.

    Args:
        nlp: The problem.
        x: (nx,) point.
        lam_g: (ng,) the solver's multipliers, or None.
    """
    return examine(nlp, x, lam_g).residuals


def examine(nlp: NLP, x: Float, lam_g: Float | None) -> Optimality:
    """As `kkt`, with the multipliers that balance better; what is not a number is infinite."""
    primal = max(float(v.max(initial=0.0)) for v in violations(nlp, x).values())
    nothing = np.zeros(nlp.ng)
    if not _has_derivatives(nlp, x):
        lost = Residuals(primal, np.inf, np.inf, "none")
        return Optimality(lost, np.zeros(nlp.nx), nothing)
    candidates = {"least squares": least_squares_multipliers(nlp, x)}
    if lam_g is not None:
        candidates["solver"] = lam_g
    candidates = {k: v for k, v in candidates.items() if np.isfinite(v).all()}
    best: Optimality | None = None
    # no multipliers at all are worse than any, and better than none to report
    for name, lam in (candidates or {"none": nothing}).items():
        with np.errstate(all="ignore"):
            lam_x = bound_multipliers(nlp, x, lam)
            found = optimality(nlp, x, lam_x, lam)
        dual, gap = (
            np.inf if np.isnan(found[key]) else found[key]
            for key in ("dual_infeasibility", "complementarity")
        )
        if best is None or max(dual, gap) < max(
            best.residuals.dual, best.residuals.complementarity
        ):
            best = Optimality(Residuals(primal, dual, gap, name), lam_x, lam)
    assert best is not None
    return best


def _has_derivatives(nlp: NLP, x: Float) -> bool:
    """Objective, rows and their first derivatives are numbers here."""
    values = (*nlp.grad_f(x, nlp.p), *nlp.jac_g(x, nlp.p))
    return all(np.isfinite(np.array(v.nonzeros(), float)).all() for v in values)
