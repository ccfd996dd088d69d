"""KKT residuals of the point of another solver."""

from dataclasses import dataclass, field

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from soup_nlp.arrays import Float
from soup_nlp.model.nlp import NLP
from soup_nlp.solve.kkt import optimality

SLACK = 10.0
"""Allowed factor of unscaled residuals over the tolerance, since solvers scale theirs."""
ENERGY_SLACK = 1e-3
"""Allowed relative increase of the exact energy over the proposal, due to the smoothing."""
ACTIVE = 1e-5
"""Distance of a row to a bound, relative to 1 + |bound|, up to which it is active."""
FEASIBLE = 1e-6
"""Largest violation of a constraint in a verified answer."""
DAMPING = 1e-12
"""Damping of least-squares multipliers relative to the mean square gradient of a row."""


@dataclass(frozen=True)
class Limits:
    """Limits that are the same for every solver.

    Attributes:
        seconds: CPU time, set-up included.
        iterations: Outer iterations.
        tol: Dual infeasibility and complementarity; that of the constraints is 1e-2 tol.
        memory: Bytes beyond those of the problem.
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
    """KKT residuals of a point, unscaled, with its multipliers.

    Attributes:
        primal: Largest violation of a bound or a row.
        dual: Largest entry of |grad f + J' lam_g + lam_x|.
        complementarity: Largest product of a gap and its multiplier.
        multipliers: Origin of lam_g, "solver" or "least squares", whichever gives the smaller
            residuals; "none" if derivatives at the point are not finite.
        lam_x: (nx,) multipliers of the bounds.
        lam_g: (ng,) multipliers of the rows.
    """

    primal: float
    dual: float
    complementarity: float
    multipliers: str
    lam_x: Float = field(repr=False)
    lam_g: Float = field(repr=False)

    @property
    def optimal(self) -> bool:
        """Whether the point of a .sol file is verified: within the limits that `compare` has."""
        return self.primal <= FEASIBLE and self.within(Limits())

    def within(self, limits: Limits) -> bool:
        """Whether the residuals are small enough for a verified answer."""
        return (
            self.primal <= SLACK * limits.feasibility
            and self.dual <= SLACK * limits.tol
            and self.complementarity <= SLACK * limits.tol
        )


def violations(nlp: NLP, x: Float) -> dict[str, Float]:
    """Violations of "bounds" (nx,) and "rows" (ng,); infinite for NaN."""
    with np.errstate(all="ignore"):
        g = nlp.constraints(x)
        outside = {
            "bounds": np.maximum(nlp.lbx - x, x - nlp.ubx),
            "rows": np.maximum(nlp.lbg - g, g - nlp.ubg),
        }
    return {k: np.maximum(0.0, np.where(np.isnan(v), np.inf, v)) for k, v in outside.items()}


def examine(nlp: NLP, x: Float, lam_g: Float | None) -> Residuals:
    """Residuals of a point x (nx,) with the multipliers lam_g (ng,) or with least-squares ones,
    whichever are smaller; those of the bounds follow from the point. NaN counts as infinite."""
    primal = max(float(v.max(initial=0.0)) for v in violations(nlp, x).values())
    nothing = np.zeros(nlp.ng)
    values = nlp.value(x), nlp.gradient(x), nlp.constraints(x), nlp.jacobian_nonzeros(x)
    if not all(np.isfinite(v).all() for v in values):
        return Residuals(primal, np.inf, np.inf, "none", np.zeros(nlp.nx), nothing)
    candidates = {"least squares": least_squares_multipliers(nlp, x)}
    if lam_g is not None:
        candidates["solver"] = lam_g
    candidates = {k: v for k, v in candidates.items() if np.isfinite(v).all()}
    examined = []
    for name, lam in (candidates or {"none": nothing}).items():
        with np.errstate(all="ignore"):
            lam_x = bound_multipliers(nlp, x, lam)
            off = optimality(nlp, x, lam_x, lam)
        dual, gap = (
            np.inf if np.isnan(off[key]) else off[key]
            for key in ("dual_infeasibility", "complementarity")
        )
        examined.append(Residuals(primal, dual, gap, name, lam_x, lam))
    return min(examined, key=lambda r: max(r.dual, r.complementarity))


def bound_multipliers(nlp: NLP, x: Float, lam_g: Float) -> Float:
    """(nx,) multipliers of the bounds that belong to a point and its lam_g.

    The rest of the gradient, r = -(grad f + J' lam_g), acts on the bound in its direction. The
    multiplier lam = r / (1 + gap) makes dual infeasibility and complementarity equal.
    """
    r = -(nlp.gradient(x) + nlp.jacobian(x).T @ lam_g)
    with np.errstate(invalid="ignore"):
        gap = np.where(r > 0, nlp.ubx - x, x - nlp.lbx)
    # a point outside its bounds has no gap
    lam = r / (1 + np.maximum(gap, 0.0))
    fixed = nlp.lbx == nlp.ubx
    return np.where(fixed, r, np.where(np.isfinite(gap), lam, 0.0))


def least_squares_multipliers(nlp: NLP, x: Float) -> Float:
    """(ng,) multipliers of least dual infeasibility; 0 for inactive rows.

    Minimises |grad f + J_A' lam_A| over the active rows A, in the variables that are not on their
    bounds. Multipliers with a wrong sign are set to 0 and the others are solved again.
    """
    g, J, grad = nlp.constraints(x), nlp.jacobian(x), nlp.gradient(x)
    at_lower = np.isfinite(nlp.lbg) & (g - nlp.lbg <= ACTIVE * (1 + np.abs(nlp.lbg)))
    at_upper = np.isfinite(nlp.ubg) & (nlp.ubg - g <= ACTIVE * (1 + np.abs(nlp.ubg)))
    inside = (x - nlp.lbx > ACTIVE) & (nlp.ubx - x > ACTIVE)
    lam = np.zeros(nlp.ng)
    rows = np.flatnonzero(at_lower | at_upper)
    for _ in range(2):
        if not len(rows):
            break
        A = sparse.csr_matrix(J[rows][:, inside].T)
        lam[:] = 0.0
        lam[rows] = _least_squares(A, -grad[inside])
        wrong = (lam < 0) & ~at_lower | (lam > 0) & ~at_upper
        lam[wrong] = 0.0
        rows = rows[~wrong[rows]]
    return lam


def _least_squares(A: sparse.csr_matrix, b: Float) -> Float:
    """Minimum of |A x - b| by the augmented system [I A; A' -delta]; A may be rank deficient."""
    k, n = A.shape
    delta = DAMPING * sparse.linalg.norm(A) ** 2 / n
    blocks = [[sparse.identity(k), A], [A.T, -delta * sparse.identity(n)]]
    solve = splu(sparse.csc_matrix(sparse.block_array(blocks))).solve
    x = np.zeros(n)
    # each repetition reduces the error caused by the damping
    for _ in range(3):
        x += solve(np.concatenate([b - A @ x, np.zeros(n)]))[k:]
    return x
