"""Properties of an instance for the index, and verification of the answers of solvers to it.

Properties are sizes, classes, rank of the Jacobian and LICQ.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from soup_nlp.arrays import Float
from soup_nlp.export.program import file_orders
from soup_nlp.export.sol import Sol, read_sol
from soup_nlp.export.verify import FEASIBLE, Residuals, active, examine, violations
from soup_nlp.family.frozen import load_frozen
from soup_nlp.family.instances import build_instance, case_of, parse_name
from soup_nlp.geometry.constraints import Kind, kind
from soup_nlp.model.nlp import NLP

CLASSES = ("constant", "linear", "quadratic", "general")
LETTERS = "CLQO"
"""CUTEst letter of each class of an objective; constant rows count as linear."""
RANK = 1e-8
"""Singular values below this share of the largest count as 0."""


def degree(value: ca.SX, x: ca.SX) -> int:
    """0 constant, 1 linear, 2 quadratic, 3 anything else, as an expression of x."""
    for order in range(3):
        if order:
            value = ca.vertcat(*ca.jacobian(value, x).nonzeros())
        if not any(ca.which_depends(value, x, 1, True)):
            return order
    return 3


def classes(nlp: NLP) -> dict[str, Any]:
    """Class of the objective, and class, kind and number of rows of every kind of constraint."""
    objective, rows = 0, {}
    for group in nlp.groups:
        kernel = group.kernel
        if kernel.objective is not None:
            objective = max(objective, degree(kernel.objective, kernel.x))
        if kernel.constraints is not None:
            places = np.unique(group.rows)
            equal = bool((nlp.lbg[places] == nlp.ubg[places]).all())
            rows[kernel.name if group.kernel.objective is None else f"epigraph_{kernel.name}"] = {
                "rows": len(places),
                "class": CLASSES[degree(kernel.constraints, kernel.x)],
                "kind": "equality" if equal else "inequality",
            }
    return {"objective_class": CLASSES[objective], "constraint_classes": rows}


def classification(nlp: NLP, kinds: dict[str, Any]) -> str:
    """CUTEst classification such as OQR2-MN-1808-1809.

    It has letters for the objective and the constraints, R for twice differentiable, 2 for second
    derivatives, M for a modelling exercise, Y if there are slack variables, n and m.
    """
    rows = max(CLASSES.index(c["class"]) for c in kinds["constraint_classes"].values())
    internal = nlp.x_names()[-1].startswith("s_")
    letters = LETTERS[CLASSES.index(kinds["objective_class"])] + LETTERS[max(rows, 1)]
    return f"{letters}R2-M{'Y' if internal else 'N'}-{nlp.nx}-{nlp.ng}"


def rank(matrix: sparse.csr_matrix) -> int:
    """Rank of a sparse matrix whose rows share few columns.

    A row with a column of its own is independent of all others and is removed. The rest is split
    into independent blocks, whose singular values are computed.
    """
    left = sparse.csr_matrix(matrix)
    left.eliminate_zeros()
    independent = 0
    while left.shape[0]:
        count = np.bincount(left.indices, minlength=left.shape[1])
        largest = np.abs(left).max() if left.nnz else 0.0
        single = (count == 1)[left.indices] & (np.abs(left.data) > RANK * largest)
        owner = np.repeat(np.arange(left.shape[0]), np.diff(left.indptr))
        removed = np.zeros(left.shape[0], bool)
        removed[owner[single]] = True
        if not removed.any():
            break
        independent += int(removed.sum())
        left = left[~removed]
    if not left.nnz:
        return independent
    _, block = connected_components(left @ left.T, directed=False)
    order = np.argsort(block, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(block[order])) + 1):
        part = left[rows]
        used = np.unique(part.indices)
        if len(used):
            independent += int(np.linalg.matrix_rank(part[:, used].toarray(), rtol=RANK))
    return independent


def qualification(nlp: NLP, x: Float) -> dict[str, Any]:
    """Rank of the Jacobian and of its active rows, and LICQ, at a feasible point x (nx,)."""
    J, (at_lower, at_upper, off) = nlp.jacobian(x), active(nlp, x)
    rows = at_lower | at_upper
    # variables on their bounds cannot move
    active_rank = rank(J[rows][:, off])
    return {
        "jacobian_rank": rank(J),
        "active_rows": int(rows.sum()),
        "active_rank": active_rank,
        "variables_on_bounds": int(len(x) - off.sum()),
        "licq": active_rank == int(rows.sum()),
    }


# --- answers of solvers --------------------------------------------------------------------------


@dataclass(frozen=True)
class Verdict:
    """Recomputed values of a solver's point for an instance.

    Attributes:
        sol: Contents of the .sol file.
        objective: Objective at the point.
        best: Best known objective.
        residuals: Unscaled KKT residuals.
        kinds: Violations of bounds and rows.
    """

    sol: Sol
    objective: float
    best: float
    residuals: Residuals
    kinds: list[Kind]

    def __str__(self) -> str:
        r, gap = self.residuals, (self.objective - self.best) / abs(self.best)
        word = "verified" if r.optimal else "not verified"
        return "\n".join(
            [
                f"{self.sol}: {word}",
                f"objective   {self.objective:.9g}, best known {self.best:.9g}, gap {gap:+.2e}",
                f"residuals   primal {r.primal:.1e}  dual {r.dual:.1e}  complementarity"
                f" {r.complementarity:.1e}  (unscaled; multipliers: {r.multipliers})",
            ]
        )


def check_sol(path: Path) -> Verdict:
    """Read `<name>.sol`, the answer to the instance of that name, and recompute its values.

    The instance is built again; the .nl file is not used.

    Raises:
        ConfigError: the name is not one of the family.
        ExportError: the file cannot be read.
    """
    instance = parse_name(path.stem)
    record = load_frozen(instance.scene, instance.size)
    case = case_of(record)
    nlp = build_instance(case, record, instance.formulation, instance.start)[0]
    best = build_instance(case, record, instance.formulation, "best")[0].x0
    sol = read_sol(path, *file_orders(nlp))
    with np.errstate(all="ignore"):
        return Verdict(
            sol,
            nlp.value(sol.x),
            nlp.value(best),
            examine(nlp, sol.x, sol.lam_g),
            [kind(k, v, FEASIBLE, False) for k, v in violations(nlp, sol.x).items()],
        )
