"""Writer of AMPL's .nl text format for NLPs of kernels and tables.

The expression of every kernel is traced once and filled in for every element (`template`, `body`).
The format requires an order of the variables (nonlinear in both, in constraints, in the objective,
linear) and of the rows (nonlinear before linear); `NLFile` has the permutations. References: D. M.
Gay, "Writing .nl files" (2005), and the AMPL/MP reader.
"""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse

from soup_nlp.arrays import Float, Int
from soup_nlp.errors import ExportError
from soup_nlp.export.body import NlBody
from soup_nlp.export.program import Program, lifted, make_program, orders
from soup_nlp.export.template import number
from soup_nlp.model.nlp import NLP
from soup_nlp.storage.files import as_path, write_bytes, write_text


@dataclass(frozen=True)
class NLFile:
    """A .nl file that was written.

    Attributes:
        path: The file; `.col` and `.row` are beside it if names were given.
        sha256, size: Of its bytes.
        variables: (nx,) variable of the NLP for each variable of the file.
        rows: (ng,) constraint of the NLP for each row of the file.
        counts: Nonzeros and nonlinear parts, for the manifest and the index of the family.
        lifted: Variables, and rows, of the file alone, which stand before the others.
    """

    path: Path
    sha256: str
    size: int
    variables: Int = field(repr=False)
    rows: Int = field(repr=False)
    counts: dict[str, Any]
    lifted: int


def write_nl(path: str | Path, nlp: NLP, lam_g: Float | None = None, lift: bool = False) -> NLFile:
    """Write an NLP of kernels and tables; names go to `.col` and `.row` beside the file.

    Args:
        path: The .nl file.
        nlp: The NLP; its Hessian does not matter.
        lam_g: (ng,) multipliers of the start in CasADi's sign, for the segment of initial duals.
        lift: Write shared expressions as variables with rows, not as defined variables, see `body`.

    Raises:
        ExportError: an operation has no opcode, or a number is not finite.
        DataError: the folder cannot be written.
    """
    path = as_path(path, "file", error=ExportError)
    names = nlp.x_names(), nlp.g_names()
    program = make_program(nlp.groups, nlp.nx, nlp.ng, nlp.thetas())
    program = lifted(program) if lift else program
    variables, rows = orders(program)
    body = NlBody(program, np.argsort(variables), np.argsort(rows), lift)

    def after(front: object, values: Any, order: Int) -> Any:
        """Values in the order of the file, after those of what is lifted."""
        return np.append(np.full(body.lifted, front), values[order])

    # the objective stays the last row
    last = np.append(rows, nlp.ng)
    entries = body.with_lifted(program.linear[last][:, variables])
    x0 = after(0.0, nlp.x0, variables)
    x0[: body.lifted] = body.lifted_values(nlp.x0[variables])
    lbg, ubg = (after(0.0, v, rows) for v in (nlp.lbg, nlp.ubg))
    w = [f"w[{k}]" for k in range(body.lifted)]
    x_names, g_names = (
        w + [axis[k] for k in order] for axis, order in zip(names, (variables, rows))
    )
    program = replace(
        program,
        linear=entries,
        in_rows=after(True, program.in_rows, variables),
        in_objective=after(True, program.in_objective, variables),
        curved=after(True, program.curved, last),
    )
    lines = chain(
        header(program, (lbg, ubg), (g_names, x_names), body.classes),
        body.segments(),
        # AMPL's multipliers have the other sign
        [] if lam_g is None else start(-after(0.0, lam_g, rows), "d"),
        start(x0),
        bounds("r", lbg, ubg),
        bounds("b", after(-np.inf, nlp.lbx, variables), after(np.inf, nlp.ubx, variables)),
        linear(entries),
    )
    data = ("\n".join(lines) + "\n").encode("ascii")
    write_bytes(path, data)
    write_text(path.with_suffix(".col"), "".join(f"{name}\n" for name in x_names))
    # the objective's name follows those of the rows
    write_text(path.with_suffix(".row"), "".join(f"{name}\n" for name in [*g_names, "E"]))
    nonlinear = {"rows": program.in_rows, "objective": program.in_objective}
    nonlinear["both"] = program.in_rows & program.in_objective
    return NLFile(
        path=path,
        sha256=hashlib.sha256(data).hexdigest(),
        size=len(data),
        variables=variables,
        rows=rows,
        counts={
            "gradient_nonzeros": int(entries[-1].nnz),
            "nonlinear_rows": int(program.curved[:-1].sum()),
            "nonlinear_variables": {key: int(mask.sum()) for key, mask in nonlinear.items()},
            "defined_variables": sum(body.classes),
            "lifted_variables": body.lifted,
        },
        lifted=body.lifted,
    )


def header(
    program: Program,
    bounds: tuple[Float, Float],
    names: Sequence[Sequence[str]],
    defined: Sequence[int],
) -> list[str]:
    """The ten lines of counts; `bounds` (ng,) are those of the rows, `names` those of rows and of
    variables, and `defined` are `NlBody.classes`."""
    longest = [max(map(len, every), default=0) for every in names]
    lower, upper = bounds
    equations = lower == upper
    ranges = np.isfinite(lower) & np.isfinite(upper) & ~equations
    in_rows, both = program.in_rows.sum(), (program.in_rows & program.in_objective).sum()
    only = program.in_objective.sum() - both
    # if the objective has variables of its own, its count includes those of the constraints
    in_objective = in_rows + only if only else both
    n, m = len(program.in_rows), len(lower)
    gradient = program.linear[-1].nnz
    return [
        "g3 1 1 0",
        f" {n} {m} 1 {ranges.sum()} {equations.sum()}"
        "\t# vars, constraints, objectives, ranges, eqns",
        f" {program.curved[:-1].sum()} {int(program.curved[-1])}"
        "\t# nonlinear constraints, objectives",
        " 0 0\t# network constraints: nonlinear, linear",
        f" {in_rows} {in_objective} {both}\t# nonlinear vars in constraints, objectives, both",
        " 0 0 0 1\t# linear network variables; functions; arith, flags",
        " 0 0 0 0 0\t# discrete variables: binary, integer, nonlinear (b,c,o)",
        f" {program.linear.nnz - gradient} {gradient}\t# nonzeros in Jacobian, gradients",
        f" {longest[0]} {longest[1]}\t# max name lengths: constraints, variables",
        f" {' '.join(map(str, defined))}\t# common exprs: b,c,o,c1,o1",
    ]


def start(values: Float, segment: str = "x") -> Iterator[str]:
    """`x` segment of the start, or `d` segment of its multipliers."""
    yield f"{segment}{len(values)}"
    yield from (f"{k} {number(v)}" for k, v in enumerate(values.tolist()))


def bounds(segment: str, lower: Float, upper: Float) -> Iterator[str]:
    """`b` or `r` segment."""
    if segment == "r" and not len(lower):
        return
    yield segment
    for lo, up in zip(lower.tolist(), upper.tolist()):
        if lo == up:
            yield f"4 {number(lo)}"
        elif lo > -np.inf and up < np.inf:
            yield f"0 {number(lo)} {number(up)}"
        elif lo > -np.inf:
            yield f"2 {number(lo)}"
        elif up < np.inf:
            yield f"1 {number(up)}"
        else:
            yield "3"


def linear(entries: sparse.csr_matrix) -> Iterator[str]:
    """`k` (column counts), `J` and, of the last row, `G` segments; nonlinear entries may be 0."""
    (count, width), at = entries.shape, entries.indptr.tolist()
    if count > 1:
        columns = np.bincount(entries.indices[: at[-2]], minlength=width)
        yield f"k{width - 1}"
        yield from map(str, np.cumsum(columns)[:-1].tolist())
    for k, (begin, end) in enumerate(pairwise(at)):
        if begin == end:
            continue
        yield f"{f'J{k}' if k < count - 1 else 'G0'} {end - begin}"
        places, values = entries.indices[begin:end].tolist(), entries.data[begin:end].tolist()
        yield from (f"{c} {number(v)}" for c, v in zip(places, values))
