"""KKT points: residuals recomputed in plain numpy, and the multipliers of the presolve's answer."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from soup_nlp.arrays import Float
from soup_nlp.geometry.soup import Soup
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.model.nlp import NLP
from soup_nlp.solve.ipopt import Stage

LIMITS = {
    "so3": 1e-8,
    "normal": 1e-8,
    "simplex": 1e-10,
    "positive": 0.0,
    "det": 1e-8,
    # Ipopt keeps inequalities to its own tolerance
    "visible": 1e-6,
}
"""Largest violation that a delivered soup may have, by kind of constraint."""
UNMET = "Constraints_Violated"
"""Status of a solve whose answer violates its constraints, whatever status the solver reports."""


def feasible(soup: Soup, rim_ray: Float, min_facing: float) -> bool:
    """Whether a soup satisfies its constraints within LIMITS; arguments as below."""
    violations = constraint_residuals(soup, rim_ray, min_facing)
    # false for NaN too
    return all(violations[name] <= limit for name, limit in LIMITS.items())


def constraint_residuals(soup: Soup, rim_ray: Float, min_facing: float) -> dict[str, float]:
    """Largest violation of every kind of constraint, from the arrays alone.

    Args:
        soup: State.
        rim_ray: (N, V, 3) rays where visibility is imposed.
        min_facing: c of `-n . r >= c`.

    Returns:
        so3 (largest entry of |R^T R - I|), normal (| |n|^2 - 1 |), simplex (|sum lam - 1|),
        positive (how far a scale or offset is below 0), visible (how far -n . r is below c),
        det (how far det R is from +1).
    """
    gram = np.swapaxes(soup.R, 1, 2) @ soup.R - np.eye(3)
    facing = -np.einsum("nc,nvc->nv", soup.n, rim_ray)
    return {
        "so3": float(np.abs(gram).max()),
        "normal": float(np.abs(np.sum(soup.n**2, axis=1) - 1).max()),
        "simplex": float(abs(soup.lam.sum() - 1)),
        "positive": float(max(0.0, -soup.lam.min(), -soup.d.min())),
        "visible": float(max(0.0, (min_facing - facing).max())),
        "det": float(np.abs(np.linalg.det(soup.R) - 1).max()),
    }


def optimality(nlp: NLP, x: Float, lam_x: Float, lam_g: Float) -> dict[str, float]:
    """Dual infeasibility and complementarity of a point and its multipliers.

    Args:
        nlp: The problem.
        x: (nx,) point.
        lam_x: (nx,) multipliers of the bounds (positive at upper bounds).
        lam_g: (ng,) multipliers of the constraints (positive at upper bounds).
    """
    g = nlp.constraints(x)
    dual = nlp.gradient(x) + nlp.jacobian(x).T @ lam_g + lam_x
    products = [0.0]
    for value, lower, upper, lam in ((x, nlp.lbx, nlp.ubx, lam_x), (g, nlp.lbg, nlp.ubg, lam_g)):
        open_ = lower < upper
        for gap, mult in ((value - lower, -lam), (upper - value, lam)):
            use = open_ & np.isfinite(gap) & (mult > 0)
            products.append(float(np.abs(gap[use] * mult[use]).max(initial=0.0)))
            # the multiplier of an infinite bound does not count
            absent = mult[~np.isfinite(gap) & (mult > 0)]
            products.append(float(absent.max(initial=0.0)))
    return {"dual_infeasibility": float(np.abs(dual).max()), "complementarity": max(products)}


def residuals(
    nlp: NLP, soup: Soup, stage: Stage, data: EnergyData, min_facing: float
) -> dict[str, float]:
    """Constraint residuals of the delivered soup; violation and optimality of Ipopt's answer."""
    g = nlp.constraints(stage.x)
    outside = np.maximum(nlp.lbg - g, g - nlp.ubg).max(initial=0.0)
    return {
        **constraint_residuals(soup, data.rim_ray, min_facing),
        "nlp_infeasibility": float(max(outside, 0.0)),
        **optimality(nlp, stage.x, stage.lam_x, stage.lam_g),
    }


WARM: Mapping[str, Any] = {
    "warm_start_init_point": "yes",
    "mu_init": 1e-10,
    "warm_start_bound_push": 1e-10,
    "warm_start_bound_frac": 1e-10,
    "warm_start_slack_bound_push": 1e-10,
    "warm_start_slack_bound_frac": 1e-10,
    "warm_start_mult_bound_push": 1e-10,
}
"""Ipopt options that leave a given start where it is."""


def warm_start(nlp: NLP, data: EnergyData, soup: Soup, rim: Float) -> dict[str, Float]:
    """Start multipliers of the constrained NLP at the presolve's solution.

    Args:
        nlp: The constrained NLP, started at `soup`.
        data: Numbers of the energy.
        soup: The presolve's answer.
        rim: (N, V) multipliers of visibility of the rim pixels, rows divided by the anchor's facing
            (`Presolve.rim`).

    Returns:
        lam_x0, lam_g0. The equalities' multipliers are the least squares of stationarity.
    """
    lam_g = np.zeros(nlp.ng)
    facing = -np.einsum("nc,nc->n", soup.n, data.anchor_ray)
    visible = next(g for g in nlp.groups if g.kernel.name == "visible").rows
    lam_g[visible[:, 1:]] = -rim / facing[:, None]
    gradient = nlp.gradient(nlp.x0)
    slack, row = nlp.slacks()
    # an epigraph's slack is in no other row
    lam_g[row] = -gradient[slack] / (2 * nlp.x0[slack])
    J = nlp.jacobian(nlp.x0)
    force = gradient + J.T @ lam_g
    equal = np.flatnonzero(nlp.lbg == nlp.ubg)
    A = J[equal]
    gram = (A @ A.T).tocsc()
    solve = splu(gram + 1e-12 * sparse.identity(len(equal), format="csc")).solve
    # normal equations lose half the digits: refined until stationarity has full accuracy
    for _ in range(3):
        lam_g[equal] -= solve(A @ (force + A.T @ lam_g[equal]))
    return {"lam_x0": np.zeros(nlp.nx), "lam_g0": lam_g}
