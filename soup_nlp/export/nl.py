"""AMPL's .nl text format: exact, fast, from kernels and tables or from any plain SX NLP.

Every kernel's expression is read once and stamped once per element (`template`, `stamp`).
Variables and constraints are in the order that the format demands (nonlinear in both, in
constraints, in the objective, linear; nonlinear rows before linear ones): `NLFile` says where each
went. After D. M. Gay, "Writing .nl files" (2005), and the AMPL/MP reader.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from soup_nlp.export.program import Body, orders, take_apart
from soup_nlp.export.segments import bounds, linear, start
from soup_nlp.export.validate import (
    plain_problem,
    require_bounds,
    require_finite,
    require_names,
    vector,
)
from soup_nlp.model.kernel import Group, Kernel, Table
from soup_nlp.model.nlp import NLP
from soup_nlp.storage.atomic import atomic_path

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class NLFile:
    """A .nl file that was written.

    Attributes:
        path: The file; `.col` and `.row` lie beside it when names were given.
        sha256: Of its bytes.
        size: Bytes.
        variables: (nx,) variable of the NLP that each variable of the file is.
        rows: (ng,) constraint of the NLP that each row of the file is.
        nonlinear: Variables nonlinear in (constraints, objective, both).
        nonlinear_rows: Leading rows of the file that have an expression.
        jacobian_nonzeros: Entries of the J segments.
        gradient_nonzeros: Entries of the G segment.
        defined: Defined variables by use: both, constraints, objective (several), one constraint,
            the objective alone.
        seconds: Wall time to write.
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
    seconds: float


def write_nl(
    path: str | Path,
    nlp: NLP,
    *,
    p: Float | None = None,
    x0: Float | None = None,
    lam_g0: Float | None = None,
    names: tuple[Sequence[str], Sequence[str]] | None = None,
) -> NLFile:
    """Write an NLP of kernels and tables; names go to `.col` and `.row` beside the file.

    Args:
        path: The .nl file; written whole or not at all.
        nlp: The NLP; the Hessian that it carries does not matter.
        p: Parameters whose leading entries (theta) count, default nlp.p.
        x0: Start, default nlp.x0.
        lam_g0: (ng,) initial multipliers in CasADi's sign (positive at upper bounds); the file
            has AMPL's, which is the opposite. None writes none.
        names: Of variables and constraints; default the NLP's own, see `names.readable_names`.

    Raises:
        ExportError: an operation has no opcode, a number is not finite, bounds cross, or a vector
            or names are of a wrong length.
        DataError: the folder cannot be written.
    """
    x_names, g_names = names or (nlp.x_names(), nlp.g_names())
    return write_groups(
        path,
        nlp.groups,
        x0=nlp.x0 if x0 is None else x0,
        lbx=nlp.lbx,
        ubx=nlp.ubx,
        lbg=nlp.lbg,
        ubg=nlp.ubg,
        theta=(nlp.p if p is None else p)[: len(nlp.theta)],
        x_names=x_names,
        g_names=g_names,
        lam_g0=lam_g0,
        objective_name="E",
    )


def write_sx_nl(
    path: str | Path,
    problem: Mapping[str, ca.SX],
    *,
    x0: Float | float | None = None,
    lbx: Float | float | None = None,
    ubx: Float | float | None = None,
    lbg: Float | float | None = None,
    ubg: Float | float | None = None,
    x_names: Sequence[str] | None = None,
    g_names: Sequence[str] | None = None,
    lam_g0: Float | float | None = None,
) -> NLFile:
    """Write any plain NLP of CasADi's nlpsol form.

    Args:
        path: The .nl file.
        problem: `x`, `f` and, if there are constraints, `g`, all SX; no parameters.
        x0: (nx,) start, default 0; here and below a number stands for all entries.
        lbx: (nx,) lower bounds, default none.
        ubx: (nx,) upper bounds, default none.
        lbg: (ng,) lower bounds of g, default none.
        ubg: (ng,) upper bounds of g, default none.
        x_names: For the .col file; None writes none.
        g_names: For the .row file; None writes none.
        lam_g0: (ng,) initial multipliers, see `write_nl`.

    Raises:
        ExportError: as `write_nl`; or the problem is not SX, has a free symbol, or its objective
            is not a scalar.

    Example:
        >>> x = ca.SX.sym("x", 2)
        >>> rosenbrock = {"x": x, "f": (1 - x[0]) ** 2 + 100 * (x[1] - x[0] ** 2) ** 2}
        >>> write_sx_nl("rosenbrock.nl", rosenbrock, x0=[-1.2, 1])  # doctest: +SKIP
    """
    x, f, g = plain_problem(problem, path)
    nx, ng = x.numel(), g.numel()
    none = ca.SX(0, 1)
    kernel = Kernel("nlp", x, none, none, objective=f, constraints=g if ng else None)
    table = Table(np.arange(nx)[None], np.zeros((1, 0)), np.arange(ng)[None])

    return write_groups(
        path,
        (Group(kernel, table),),
        x0=vector("x0", x0, nx, 0.0, path),
        lbx=vector("lbx", lbx, nx, -np.inf, path),
        ubx=vector("ubx", ubx, nx, np.inf, path),
        lbg=vector("lbg", lbg, ng, -np.inf, path),
        ubg=vector("ubg", ubg, ng, np.inf, path),
        theta=np.zeros(0),
        x_names=x_names,
        g_names=g_names,
        lam_g0=lam_g0,
    )


def write_groups(
    path: str | Path,
    groups: Sequence[Group],
    *,
    x0: Float,
    lbx: Float,
    ubx: Float,
    lbg: Float,
    ubg: Float,
    theta: Float,
    x_names: Sequence[str] | None = None,
    g_names: Sequence[str] | None = None,
    lam_g0: Float | float | None = None,
    objective_name: str = "f",
) -> NLFile:
    """Write sums of kernels over tables; see `write_nl`.

    Raises:
        ExportError: as `write_nl`; nothing is written then.
    """
    begin = time.perf_counter()
    path = Path(path)
    x0 = vector("x0", x0, len(lbx), 0.0, path)
    multipliers = None if lam_g0 is None else vector("lam_g0", lam_g0, len(lbg), 0.0, path)
    if multipliers is not None:
        require_finite("lam_g0", multipliers, path)
    require_finite("x0", x0, path)
    require_bounds("x", lbx, ubx, path)
    require_bounds("g", lbg, ubg, path)
    require_names("x_names", x_names, len(lbx), path)
    require_names("g_names", g_names, len(lbg), path)
    program = take_apart(groups, len(x0), len(lbg), np.asarray(theta, float))
    variables, rows = orders(program)
    place = np.empty(len(variables), np.int64)
    place[variables] = np.arange(len(variables))
    row_place = np.empty(len(rows), np.int64)
    row_place[rows] = np.arange(len(rows))

    body = Body(program, place, row_place)
    nlc = int(program.curved_rows.sum())
    both = int((program.in_rows & program.in_objective).sum())
    nlvc = int(program.in_rows.sum())
    only = int((program.in_objective & ~program.in_rows).sum())
    # the count for objectives spans the constraints' variables where it has some of its own
    nlvo = nlvc + only if only else both
    J = program.jacobian[rows][:, variables].tocsr()
    J.sort_indices()
    G = program.gradient[:, variables].tocsr()
    G.sort_indices()
    lbx, ubx, x0 = lbx[variables], ubx[variables], x0[variables]
    lbg, ubg = lbg[rows], ubg[rows]
    duals = None if multipliers is None else multipliers[rows]
    ranges = np.isfinite(lbg) & np.isfinite(ubg) & (lbg != ubg)
    widest = [max(map(len, names or ()), default=0) for names in (g_names, x_names)]
    header = [
        "g3 1 1 0",
        f" {len(x0)} {len(lbg)} 1 {int(ranges.sum())} {int((lbg == ubg).sum())}"
        "\t# vars, constraints, objectives, ranges, eqns",
        f" {nlc} {int(program.curved_objective)}\t# nonlinear constraints, objectives",
        " 0 0\t# network constraints: nonlinear, linear",
        f" {nlvc} {nlvo} {both}\t# nonlinear vars in constraints, objectives, both",
        " 0 0 0 1\t# linear network variables; functions; arith, flags",
        " 0 0 0 0 0\t# discrete variables: binary, integer, nonlinear (b,c,o)",
        f" {J.nnz} {G.nnz}\t# nonzeros in Jacobian, gradients",
        f" {widest[0]} {widest[1]}\t# max name lengths: constraints, variables",
        " " + " ".join(map(str, body.classes)) + "\t# common exprs: b,c,o,c1,o1",
    ]
    digest = hashlib.sha256()
    size = 0
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        for lines in (
            header,
            body.segments(),
            start(x0, duals),
            bounds("r", lbg, ubg),
            bounds("b", lbx, ubx),
            linear(J, G),
        ):
            for chunk in _chunks(lines):
                digest.update(chunk)
                size += len(chunk)
                file.write(chunk)
    for suffix, names, order in ((".col", x_names, variables), (".row", g_names, rows)):
        if names is not None:
            # the objective's name follows those of the rows
            last = [objective_name] if suffix == ".row" else []
            with atomic_path(path.with_suffix(suffix)) as temporary:
                lines_ = [*(names[k] for k in order), *last]
                temporary.write_text("\n".join(lines_) + "\n", encoding="utf-8")
    return NLFile(
        path=path,
        sha256=digest.hexdigest(),
        size=size,
        variables=variables,
        rows=rows,
        nonlinear=(nlvc, both + only, both),
        nonlinear_rows=nlc,
        jacobian_nonzeros=int(J.nnz),
        gradient_nonzeros=int(G.nnz),
        defined=body.classes,
        seconds=time.perf_counter() - begin,
    )


def _chunks(lines: Iterator[str] | Sequence[str], count: int = 20000) -> Iterator[bytes]:
    buffer: list[str] = []
    for line in lines:
        buffer.append(line)
        if len(buffer) >= count:
            yield ("\n".join(buffer) + "\n").encode("ascii")
            buffer = []
    if buffer:
        yield ("\n".join(buffer) + "\n").encode("ascii")
