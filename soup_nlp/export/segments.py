"""Header of a .nl file, and its segments with start, bounds, sparsity and linear parts."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from scipy import sparse

from soup_nlp.arrays import Float
from soup_nlp.export.opcodes import number
from soup_nlp.export.program import Program


def header(
    program: Program, bounds: tuple[Float, Float], longest: Sequence[int], defined: Sequence[int]
) -> list[str]:
    """The ten lines of counts.

    Args:
        program: Parts of the NLP.
        bounds: (ng,) lower and upper bounds of the rows.
        longest: Length of the longest name of a row and of a variable.
        defined: Defined variables by use, see `nl.NLFile`.
    """
    lower, upper = bounds
    equations = lower == upper
    ranges = np.isfinite(lower) & np.isfinite(upper) & ~equations
    in_rows, both = program.in_rows.sum(), (program.in_rows & program.in_objective).sum()
    only = program.in_objective.sum() - both
    # if the objective has variables of its own, its count includes those of the constraints
    in_objective = in_rows + only if only else both
    n, m = len(program.in_rows), len(lower)
    return [
        "g3 1 1 0",
        f" {n} {m} 1 {ranges.sum()} {equations.sum()}"
        "\t# vars, constraints, objectives, ranges, eqns",
        f" {program.curved_rows.sum()} {int(program.curved_objective)}"
        "\t# nonlinear constraints, objectives",
        " 0 0\t# network constraints: nonlinear, linear",
        f" {in_rows} {in_objective} {both}\t# nonlinear vars in constraints, objectives, both",
        " 0 0 0 1\t# linear network variables; functions; arith, flags",
        " 0 0 0 0 0\t# discrete variables: binary, integer, nonlinear (b,c,o)",
        f" {program.jacobian.nnz} {program.gradient.nnz}\t# nonzeros in Jacobian, gradients",
        f" {longest[0]} {longest[1]}\t# max name lengths: constraints, variables",
        f" {' '.join(map(str, defined))}\t# common exprs: b,c,o,c1,o1",
    ]


def start(x0: Float) -> Iterator[str]:
    """`x` segment."""
    yield f"x{len(x0)}"
    yield from (f"{k} {number(v)}" for k, v in enumerate(x0.tolist()))


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


def linear(J: sparse.csr_matrix, G: sparse.csr_matrix) -> Iterator[str]:
    """`k` (column counts), `J` and `G` segments; entries of nonlinear variables may be 0."""
    if J.shape[0]:
        count = np.bincount(J.indices, minlength=J.shape[1])
        yield f"k{J.shape[1] - 1}"
        yield from map(str, np.cumsum(count)[:-1].tolist())
    for letter, matrix in (("J", J), ("G", G)):
        at = matrix.indptr.tolist()
        for k in range(matrix.shape[0]):
            begin, end = at[k], at[k + 1]
            if begin == end:
                continue
            yield f"{letter}{k} {end - begin}"
            columns, values = matrix.indices[begin:end].tolist(), matrix.data[begin:end].tolist()
            yield from (f"{c} {number(v)}" for c, v in zip(columns, values))
