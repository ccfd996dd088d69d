"""Conversion of an NLP of kernels and tables to the parts of a .nl file."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from scipy import sparse

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.errors import ExportError
from soup_nlp.export.template import Template, make_template, trace
from soup_nlp.model.kernel import Group
from soup_nlp.model.nlp import NLP


@dataclass(frozen=True)
class Program:
    """Parts of the NLP, with variables and rows in its order; the objective is row ng.

    Attributes:
        stamped: (template, (E, nx) variables, (E, m) row of every output).
        linear: (ng + 1, nx) linear coefficients; 0 is stored for nonlinear entries.
        in_rows: (nx,) variable is nonlinear in some constraint.
        in_objective: (nx,) variable is nonlinear in the objective.
        curved: (ng + 1,) row has an expression with variables; a constraint, or a constant.
        constant: (ng + 1,) numbers that are added to the expressions.
    """

    stamped: tuple[tuple[Template, Int, Int], ...]
    linear: sparse.csr_matrix
    in_rows: Mask
    in_objective: Mask
    curved: Mask
    constant: Float


def make_program(groups: Sequence[Group], nx: int, ng: int, theta: Float) -> Program:
    """Split and trace every kernel; ExportError for an operation without an opcode, or a number
    that is not finite."""
    in_rows, in_objective = np.zeros(nx, bool), np.zeros(nx, bool)
    curved, constant = np.zeros(ng + 1, bool), np.zeros(ng + 1)
    stamped = []
    linear: list[tuple[Float, Int, Int]] = []
    for group in groups:
        nonlinear, row, column, is_linear, coefficient = split(group, theta)
        template = make_template(nonlinear, group, theta)
        graph, zero = template.graph, np.zeros(())
        for values in (*graph.number.values(), coefficient):
            if not np.isfinite(values).all():
                raise ExportError(
                    "number of an expression is not finite",
                    where=group.kernel.name,
                    hint="a kernel divides by a column that is 0 somewhere",
                )
        objective = group.kernel.objective is not None
        goal = np.full((len(group), int(objective)), ng)
        if group.kernel.nc:
            goal = np.concatenate([goal, group.rows], axis=1)
        stamped.append((template, group.index, goal))
        places = goal[:, row].ravel(), group.index[:, column].ravel()
        linear.append((coefficient.ravel(), *places))
        for k in range(nonlinear.numel()):
            variables = group.index[:, column[(row == k) & ~is_linear]]
            curved[goal[:, k]] |= template.roots[k] is not None
            values = np.broadcast_to(graph.number.get(graph.roots[k], zero), len(group))
            if objective and k == 0:
                in_objective[variables] = True
                constant[ng] += values.sum()
            else:
                in_rows[variables] = True
                np.add.at(constant, goal[:, k], values)
    curved[:ng] |= constant[:ng] != 0
    # sums of triplets keep zeros, so that nonlinear entries stay in the structure
    value, row, column = (np.concatenate(column) for column in zip(*linear))
    matrix = sparse.csr_matrix((value, (row, column)), (ng + 1, nx))
    return Program(tuple(stamped), matrix, in_rows, in_objective, curved, constant)


def lifted(program: Program) -> Program:
    """The same where defined variables are variables with rows, in which every other may be."""
    both = program.in_rows | program.in_objective
    return replace(program, in_rows=both, in_objective=both)


def orders(program: Program) -> tuple[Int, Int]:
    """Variables and rows in the order of the format.

    Variables: nonlinear in rows and objective, in rows only, in the objective only, linear. Rows:
    nonlinear, linear. The order of the NLP is kept within a class.
    """
    variables = np.lexsort((~program.in_objective, ~program.in_rows))
    return variables, np.argsort(~program.curved[:-1], kind="stable")


def file_orders(nlp: NLP, lift: bool = False) -> tuple[Int, Int]:
    """Variables (nx,) and rows (ng,) of an NLP in the order of its .nl file, see `write_nl`."""
    program = make_program(nlp.groups, nlp.nx, nlp.ng, nlp.thetas())
    return orders(lifted(program) if lift else program)


def split(group: Group, theta: Float) -> tuple[ca.SX, Int, Int, Mask, Float]:
    """Linear and nonlinear part of the outputs of a kernel: objective, if any, then rows.

    A variable is linear in an output if that entry of the Jacobian depends on no variable.

    Returns:
        (m,) expressions without their linear variables; of every Jacobian nonzero (k,) output,
        local variable and whether it is linear; (E, k) its value for every element, 0 if not.
    """
    kernel = group.kernel
    given = [part for part in (kernel.objective, kernel.constraints) if part is not None]
    out = ca.densify(ca.vertcat(*given))
    # before the split, since a piecewise constant part such as sign(a) has a zero derivative and
    # would look linear
    trace(out, group, theta)
    jacobian = ca.jacobian(out, kernel.x)
    r, c = jacobian.sparsity().get_triplet()
    row, column = np.asarray(r, np.int64), np.asarray(c, np.int64)
    entries = ca.vertcat(*jacobian.nonzeros()) if len(row) else ca.SX(0, 1)
    linear = ~np.asarray(ca.which_depends(entries, kernel.x, 1, True), bool)
    function = ca.Function("c", [kernel.x, kernel.row, kernel.theta], [entries])
    shared = np.repeat(np.asarray(theta, float)[:, None], len(group), axis=1)
    value = function.map(len(group))(np.zeros((kernel.nx, len(group))), group.data.T, shared)
    # nonlinear entries are not constant, and may be NaN at 0
    coefficient = np.where(linear, np.asarray(value).T, 0.0)
    parts = []
    for k in range(out.numel()):
        gone = column[linear & (row == k)].tolist()
        zero = ca.SX.zeros(len(gone))
        parts.append(ca.substitute(out[k], kernel.x[gone], zero) if gone else out[k])
    return ca.densify(ca.cse(ca.vertcat(*parts))), row, column, linear, coefficient
