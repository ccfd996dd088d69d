"""KKT points: optimality, and the multipliers of the presolve's answer."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from soup_nlp.arrays import Float
from soup_nlp.geometry.constraints import constraints
from soup_nlp.geometry.soup import Soup
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.model.nlp import NLP
from soup_nlp.solve.ipopt import Stage, warm

UNMET = "Constraints_Violated"
"""Status of a solve whose answer violates its constraints, whatever status the solver reports."""


def optimality(nlp: NLP, x: Float, lam_x: Float, lam_g: Float) -> dict[str, float]:
    """Dual infeasibility and complementarity of a point (nx,) and its multipliers.

    Those of the bounds (nx,) and of the constraints (ng,) are positive at upper bounds.
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
        **constraints(soup, data.rim_ray, min_facing).largest,
        "nlp_infeasibility": float(outside),
        **optimality(nlp, stage.x, stage.lam_x, stage.lam_g),
    }


WARM: Mapping[str, Any] = {"mu_init": 1e-10, **warm(1e-10)}
"""Ipopt options that leave a given start where it is."""


def warm_start(nlp: NLP, data: EnergyData, soup: Soup, rim: Float) -> dict[str, Float]:
    """Start multipliers lam_x0, lam_g0 of the constrained NLP at the presolve's soup.

    `rim` (N, V) is that of the presolve. The equalities' are the least squares of stationarity.
    """
    lam_g = np.zeros(nlp.ng)
    facing = -np.einsum("nc,nc->n", soup.n, data.anchor_ray)
    visible = next(g for g in nlp.groups if g.kernel.name == "visible").rows
    lam_g[visible[:, 1:]] = -rim / facing[:, None]
    gradient = nlp.gradient(nlp.x0)
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
