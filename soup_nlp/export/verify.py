"""KKT residuals of a foreign solver's point, with the multipliers that balance it best."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from soup_nlp.model.nlp import NLP, to_scipy
from soup_nlp.solve.kkt import optimality

Float = NDArray[np.float64]

SLACK = 10.0
"""Solvers scale their residuals differently; ours are unscaled and may be this much larger."""
ENERGY_SLACK = 1e-3
"""A solution's exact energy may be this share above the proposal's because of the smoothing."""
ACTIVE = 1e-5
"""A row this close to a bound (relative to 1 + |bound|) counts as active."""
DAMPING = 1e-12
"""Of least-squares multipliers, relative to the mean square of a row's gradient."""


@dataclass(frozen=True)
class Limits:
    """Limits that are equal for every solver.

    Attributes:
        seconds: CPU time, set-up included.
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
    """Violation of "bounds" (nx,) and "rows" (ng,); infinite where it is not a number."""
    with np.errstate(all="ignore"):
        g = np.asarray(nlp.oracle(x, nlp.p)[1]).ravel()
        outside = {
            "bounds": np.maximum(nlp.lbx - x, x - nlp.ubx),
            "rows": np.maximum(nlp.lbg - g, g - nlp.ubg),
        }
    return {k: np.maximum(0.0, np.where(np.isnan(v), np.inf, v)) for k, v in outside.items()}


def examine(nlp: NLP, x: Float, lam_g: Float | None) -> Optimality:
    """Residuals of a point with the solver's multipliers or the least-squares ones.

    The multipliers that balance the gradient better are taken. Those of the bounds follow from the
    point. What is not a number counts as infinite.

    Args:
        nlp: The problem.
        x: (nx,) point.
        lam_g: (ng,) the solver's multipliers, or None.
    """
    primal = max(float(v.max(initial=0.0)) for v in violations(nlp, x).values())
    nothing = np.zeros(nlp.ng)
    values = (*nlp.grad_f(x, nlp.p), *nlp.jac_g(x, nlp.p))
    if not all(np.isfinite(np.array(v.nonzeros(), float)).all() for v in values):
        return Optimality(Residuals(primal, np.inf, np.inf, "none"), np.zeros(nlp.nx), nothing)
    candidates = {"least squares": least_squares_multipliers(nlp, x)}
    if lam_g is not None:
        candidates["solver"] = lam_g
    candidates = {k: v for k, v in candidates.items() if np.isfinite(v).all()}
    found = []
    for name, lam in (candidates or {"none": nothing}).items():
        with np.errstate(all="ignore"):
            lam_x = bound_multipliers(nlp, x, lam)
            off = optimality(nlp, x, lam_x, lam)
        dual, gap = (
            np.inf if np.isnan(off[key]) else off[key]
            for key in ("dual_infeasibility", "complementarity")
        )
        found.append(Optimality(Residuals(primal, dual, gap, name), lam_x, lam))
    return min(found, key=lambda o: max(o.residuals.dual, o.residuals.complementarity))


def bound_multipliers(nlp: NLP, x: Float, lam_g: Float) -> Float:
    """(nx,) multipliers of the bounds that belong to a point and its lam_g.

    What is left of the gradient, r = -(grad f + J' lam_g), is balanced by the bound on the side
    that it points to; split so that dual infeasibility and complementarity are equal,
    lam = r / (1 + gap).
    """
    r = -(_gradient(nlp, x) + _jacobian(nlp, x).T @ lam_g)
    with np.errstate(invalid="ignore"):
        gap = np.where(r > 0, nlp.ubx - x, x - nlp.lbx)
    # a point outside its bounds has no gap
    lam = r / (1 + np.maximum(gap, 0.0))
    fixed = nlp.lbx == nlp.ubx
    return np.where(fixed, r, np.where(np.isfinite(gap), lam, 0.0))


def least_squares_multipliers(nlp: NLP, x: Float) -> Float:
    """(ng,) multipliers that balance the gradient best; only active rows have one.

    min |grad f + J_A' lam_A| over the active rows A and the variables that are off their bounds;
    signs that an inequality cannot have are dropped and the rest solved once more.
    """
    J, grad = _jacobian(nlp, x), _gradient(nlp, x)
    g = np.asarray(nlp.oracle(x, nlp.p)[1]).ravel()
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
    """x that makes |A x - b| least, by the augmented system [I A; A' -delta]; A may lack rank."""
    k, n = A.shape
    delta = DAMPING * sparse.linalg.norm(A) ** 2 / n
    blocks = [[sparse.identity(k), A], [A.T, -delta * sparse.identity(n)]]
    solve = splu(sparse.csc_matrix(sparse.block_array(blocks))).solve
    x = np.zeros(n)
    # every repetition takes a factor off what the damping left
    for _ in range(3):
        x += solve(np.concatenate([b - A @ x, np.zeros(n)]))[k:]
    return x


def _gradient(nlp: NLP, x: Float) -> Float:
    return np.asarray(nlp.grad_f(x, nlp.p)[1]).ravel()


def _jacobian(nlp: NLP, x: Float) -> sparse.csr_matrix:
    return sparse.csr_matrix(to_scipy(nlp.jac_g(x, nlp.p)[1]))
