"""Writers of AMPL's .nl text format, for NLPs of kernels and tables and for plain SX NLPs.

The expression of every kernel is traced once and filled in for every element (`template`, `body`).
The format requires an order of the variables (nonlinear in both, in constraints, in the objective,
linear) and of the rows (nonlinear before linear); `NLFile` has the permutations. References: D. M.
Gay, "Writing .nl files" (2005), and the AMPL/MP reader.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from soup_nlp.arrays import Float, Int
from soup_nlp.errors import ExportError
from soup_nlp.export.body import Body
from soup_nlp.export.program import make_program, orders
from soup_nlp.export.segments import bounds, header, linear, start
from soup_nlp.export.validate import (
    plain_problem,
    require_bounds,
    require_finite,
    require_names,
    vector,
)
from soup_nlp.model.kernel import Group, Kernel, Table
from soup_nlp.model.nlp import NLP
from soup_nlp.storage.atomic import write_bytes, write_text
from soup_nlp.storage.files import as_path


@dataclass(frozen=True)
class NLFile:
    """A .nl file that was written.

    Attributes:
        path: The file; `.col` and `.row` are beside it if names were given.
        sha256: SHA-256 of its bytes.
        size: Number of bytes.
        variables: (nx,) variable of the NLP for each variable of the file.
        rows: (ng,) constraint of the NLP for each row of the file.
        nonlinear: Number of variables nonlinear in (constraints, objective, both).
        nonlinear_rows: Number of leading rows with an expression.
        jacobian_nonzeros: Entries of the J segments.
        gradient_nonzeros: Entries of the G segment.
        defined: Defined variables by use: both, constraints, objective (several), one constraint,
            the objective alone.
    """

    path: Path
    sha256: str
    size: int
    variables: Int = field(repr=False)
    rows: Int = field(repr=False)
    nonlinear: tuple[int, int, int]
    nonlinear_rows: int
    jacobian_nonzeros: int
    gradient_nonzeros: int
    defined: tuple[int, int, int, int, int]

    def counts(self) -> dict[str, Any]:
        """Counts of nonzeros and nonlinear parts, for the manifest and the index of the family."""
        return {
            "gradient_nonzeros": self.gradient_nonzeros,
            "nonlinear_rows": self.nonlinear_rows,
            "nonlinear_variables": dict(zip(("rows", "objective", "both"), self.nonlinear)),
            "defined_variables": sum(self.defined),
        }


Names = Sequence[str]
AllNames = tuple[Names | None, Names | None, str]
"""Names of variables, rows and the objective; None writes no file."""


def write_nl(path: str | Path, nlp: NLP, names: tuple[Names, Names] | None = None) -> NLFile:
    """Write an NLP of kernels and tables; names go to `.col` and `.row` beside the file.

    Args:
        path: The .nl file; written whole or not at all.
        nlp: The NLP; its Hessian does not matter.
        names: Names of variables and constraints; default those of the NLP.

    Raises:
        ExportError: an operation has no opcode, a number is not finite, bounds cross, or the
            number of names is wrong.
        DataError: the folder cannot be written.
    """
    x_names, g_names = names or (nlp.x_names(), nlp.g_names())
    theta = nlp.p[: len(nlp.theta)]
    x, g = (nlp.x0, nlp.lbx, nlp.ubx), (nlp.lbg, nlp.ubg)
    path = as_path(path, "file", error=ExportError)
    return _write(path, nlp.groups, theta, x, g, (x_names, g_names, "E"))


def write_sx_nl(
    path: str | Path,
    problem: Mapping[str, ca.SX],
    *,
    x0: Float | float | None = None,
    lbx: Float | float | None = None,
    ubx: Float | float | None = None,
    lbg: Float | float | None = None,
    ubg: Float | float | None = None,
    x_names: Names | None = None,
    g_names: Names | None = None,
    lam_g0: Float | float | None = None,
) -> NLFile:
    """Write any plain NLP in the form of CasADi's nlpsol.

    Args:
        path: The .nl file.
        problem: `x`, `f` and, if there are constraints, `g`, all SX; no parameters.
        x0: (nx,) start, default 0; here and below a number stands for all entries.
        lbx: (nx,) lower bounds, default none.
        ubx: (nx,) upper bounds, default none.
        lbg: (ng,) lower bounds of g, default none.
        ubg: (ng,) upper bounds of g, default none.
        x_names: Names for the .col file; None writes none.
        g_names: Names for the .row file; None writes none.
        lam_g0: (ng,) initial multipliers in CasADi's sign (positive at upper bounds), which is
            the opposite of AMPL's sign in the file; None writes none.

    Raises:
        ExportError: see `write_nl`; or the problem is not SX, has a free symbol or no scalar
            objective, or a vector has a wrong length.

    Example:
        >>> x = ca.SX.sym("x", 2)
        >>> rosenbrock = {"x": x, "f": (1 - x[0]) ** 2 + 100 * (x[1] - x[0] ** 2) ** 2}
        >>> write_sx_nl("rosenbrock.nl", rosenbrock, x0=[-1.2, 1])  # doctest: +SKIP
    """
    path = as_path(path, "file", error=ExportError)
    x, f, g = plain_problem(problem, path)
    nx, ng = x.numel(), g.numel()
    none = ca.SX(0, 1)
    kernel = Kernel("nlp", x, none, none, objective=f, constraints=g if ng else None)
    table = Table(np.arange(nx)[None], np.zeros((1, 0)), np.arange(ng)[None])
    return _write(
        path,
        (Group(kernel, table),),
        np.zeros(0),
        (
            vector("x0", x0, nx, 0.0, path),
            vector("lbx", lbx, nx, -np.inf, path),
            vector("ubx", ubx, nx, np.inf, path),
        ),
        (vector("lbg", lbg, ng, -np.inf, path), vector("ubg", ubg, ng, np.inf, path)),
        (x_names, g_names, "f"),
        None if lam_g0 is None else vector("lam_g0", lam_g0, ng, 0.0, path),
    )


def _write(
    path: Path,
    groups: Sequence[Group],
    theta: Float,
    x: tuple[Float, Float, Float],
    g: tuple[Float, Float],
    names: AllNames,
    lam_g0: Float | None = None,
) -> NLFile:
    """Check and write an NLP."""
    _check(path, x, g, names, lam_g0)
    program = make_program(groups, len(x[0]), len(g[0]), theta)
    variables, rows = orders(program)
    body = Body(program, np.argsort(variables), np.argsort(rows))
    J = program.jacobian[rows][:, variables].tocsr()
    J.sort_indices()
    G = program.gradient[:, variables].tocsr()
    G.sort_indices()
    x0, lbx, ubx = (v[variables] for v in x)
    lbg, ubg = (v[rows] for v in g)
    longest = [max(map(len, n or ()), default=0) for n in (names[1], names[0])]
    lines = chain(
        header(program, (lbg, ubg), longest, body.classes),
        body.segments(),
        start(x0, None if lam_g0 is None else lam_g0[rows]),
        bounds("r", lbg, ubg),
        bounds("b", lbx, ubx),
        linear(J, G),
    )
    data = ("\n".join(lines) + "\n").encode("ascii")
    write_bytes(path, data)
    _write_names(path, names, variables, rows)
    both = program.in_rows & program.in_objective
    return NLFile(
        path=path,
        sha256=hashlib.sha256(data).hexdigest(),
        size=len(data),
        variables=variables,
        rows=rows,
        nonlinear=(int(program.in_rows.sum()), int(program.in_objective.sum()), int(both.sum())),
        nonlinear_rows=int(program.curved_rows.sum()),
        jacobian_nonzeros=int(J.nnz),
        gradient_nonzeros=int(G.nnz),
        defined=body.classes,
    )


def _check(
    path: Path,
    x: tuple[Float, Float, Float],
    g: tuple[Float, Float],
    names: AllNames,
    lam_g0: Float | None,
) -> None:
    """Raise ExportError if a .nl file cannot hold the problem."""
    if lam_g0 is not None:
        require_finite("lam_g0", lam_g0, path)
    require_finite("x0", x[0], path)
    require_bounds("x", x[1], x[2], path)
    require_bounds("g", g[0], g[1], path)
    require_names("x_names", names[0], len(x[0]), path)
    require_names("g_names", names[1], len(g[0]), path)


def _write_names(path: Path, names: AllNames, variables: Int, rows: Int) -> None:
    """Write the .col and .row files in the order of the .nl file."""
    if names[0] is not None:
        write_text(path.with_suffix(".col"), "".join(f"{names[0][k]}\n" for k in variables))
    if names[1] is not None:
        # the objective's name follows those of the rows
        text = "".join(f"{names[1][k]}\n" for k in rows) + f"{names[2]}\n"
        write_text(path.with_suffix(".row"), text)
