"""Multipliers of the constrained NLP from those of the presolve: a start at its KKT point.

Ipopt's own least-squares estimate gives active visibility rows no multiplier; the Hessian of the
Lagrangian is then indefinite, and the first dozen iterations leave the point and return to it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from soup_nlp.arrays import Float
from soup_nlp.geometry.soup import Soup
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.model.nlp import NLP

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
    visible = next(g for g in nlp.groups if g.kernel.name == "visible").table.rows
    lam_g[visible[:, 1:]] = -rim / facing[:, None]
    gradient = nlp.gradient(nlp.x0)
    # an epigraph's slack s is in no other row than s^2 >= |v|^2 + eps^2
    for group in nlp.groups:
        slacks = [i for i in range(group.kernel.nx) if group.kernel.x[i].name().startswith("s_")]
        for slack, row in zip(slacks, group.table.rows.T):
            s = group.table.index[:, slack]
            lam_g[row] = -gradient[s] / (2 * nlp.x0[s])
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
