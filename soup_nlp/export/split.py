"""Split of a kernel into linear parts (J and G segments) and nonlinear expressions."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.export.template import trace
from soup_nlp.model.kernel import Group, Kernel


@dataclass(frozen=True)
class Split:
    """Linear and nonlinear part of the outputs of a kernel: objective, if any, then rows.

    Attributes:
        nonlinear: (m,) expressions without their linear variables.
        row, column: (k,) output and local variable of every Jacobian nonzero.
        is_linear: (k,) whether the nonzero is independent of the variables.
        coefficient: (E, k) its value for every element if it is linear, else 0.
        objective: Whether output 0 is an objective.
    """

    nonlinear: ca.SX
    row: Int
    column: Int
    is_linear: Mask
    coefficient: Float
    objective: bool


def outputs(kernel: Kernel) -> ca.SX:
    """(m,) objective, if any, and constraints."""
    parts = [p for p in (kernel.objective, kernel.constraints) if p is not None]
    return ca.densify(ca.vertcat(*parts)) if parts else ca.SX(0, 1)


def split(group: Group, theta: Float) -> Split:
    """Split the outputs of a kernel.

    A variable is linear in an output if that entry of the Jacobian depends on no variable.

    Raises:
        ExportError: an operation has no opcode.
    """
    kernel, table = group.kernel, group.table
    out = outputs(kernel)
    # before the split, since a piecewise constant part such as sign(a) has a zero derivative and
    # would look linear
    trace(kernel.name, out, group, theta)
    jacobian = ca.jacobian(out, kernel.x)
    r, c = jacobian.sparsity().get_triplet()
    row, column = np.asarray(r, np.int64), np.asarray(c, np.int64)
    entries = ca.vertcat(*jacobian.nonzeros()) if len(row) else ca.SX(0, 1)
    linear = np.zeros(len(row), bool)
    if len(row):
        linear = ~np.asarray(ca.which_depends(entries, kernel.x, 1, True), bool)
    coefficient = np.zeros((group.size, len(row)))
    if linear.any():
        kept = ca.vertcat(*[entries[int(k)] for k in np.flatnonzero(linear)])
        function = ca.Function("c", [kernel.x, kernel.row, kernel.theta], [kept])
        nowhere = np.zeros((kernel.nx, group.size))
        shared = np.repeat(np.asarray(theta, float)[:, None], group.size, axis=1)
        value = function.map(group.size)(nowhere, table.data.T, shared)
        coefficient[:, linear] = np.asarray(value).reshape(-1, group.size).T
    parts = []
    for k in range(out.numel()):
        part, gone = out[k], column[linear & (row == k)]
        if len(gone):
            held = ca.vertcat(*[kernel.x[int(j)] for j in gone])
            part = ca.substitute(part, held, ca.SX.zeros(len(gone)))
        parts.append(part)
    nonlinear = ca.densify(ca.cse(ca.vertcat(*parts))) if parts else ca.SX(0, 1)
    return Split(nonlinear, row, column, linear, coefficient, kernel.objective is not None)
