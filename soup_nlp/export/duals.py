"""Multipliers where a solver gives none, or only some: the best that the point itself allows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import lsmr

from soup_nlp.model.nlp import NLP, to_scipy

Float = NDArray[np.float64]

ACTIVE = 1e-5
"""A row this close to a bound (relative to 1 + |bound|) may push."""


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
    """(ng,) multipliers that balance the gradient best; only rows at a bound may push.

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
        lam[rows] = lsmr(A, -grad[inside], atol=1e-12, btol=1e-12, maxiter=20 * len(rows))[0]
        wrong = (lam < 0) & ~at_lower | (lam > 0) & ~at_upper
        lam[wrong] = 0.0
        rows = rows[~wrong[rows]]
    return lam


def _gradient(nlp: NLP, x: Float) -> Float:
    return np.asarray(nlp.grad_f(x, nlp.p)[1]).ravel()


def _jacobian(nlp: NLP, x: Float) -> sparse.csr_matrix:
    return sparse.csr_matrix(to_scipy(nlp.jac_g(x, nlp.p)[1]))
