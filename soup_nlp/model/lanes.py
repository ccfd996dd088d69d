"""Kernels as machine code that works on eight elements at a time, summed over their table in C.

CasADi's own C code is scalar, and mapping it over a table copies the table's data at every call.
The kernel's instructions on the compiler's vectors (GCC, clang), with gathers and sums in one loop,
take a fifth of the time.
"""

import ctypes
import logging
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float
from soup_nlp.model.compile import shared_library
from soup_nlp.model.kernel import Blocks, in_blocks
from soup_nlp.model.operations import OPERATIONS, input_sizes, instructions, operation

log = logging.getLogger(__name__)
LANES = 8

_HEAD = f"""
#include <math.h>
#include <string.h>
#define L {LANES}
typedef double real __attribute__((vector_size(8 * L)));
typedef long long mask __attribute__((vector_size(8 * L)));
static const real zero = {{0}}, one = {{{", ".join(["1"] * LANES)}}};
static inline real choose(mask m, real a, real b) {{
  return (real)(((mask)a & m) | ((mask)b & ~m));
}}
static inline real root(real a) {{
  real b;
  for (int i = 0; i < L; i++) b[i] = sqrt(a[i]);
  return b;
}}
static inline real each(double (*f)(double), real a) {{
  real b;
  for (int i = 0; i < L; i++) b[i] = f(a[i]);
  return b;
}}
static inline real both(double (*f)(double, double), real a, real b) {{
  for (int i = 0; i < L; i++) a[i] = f(a[i], b[i]);
  return a;
}}
"""

# x, row, theta, lam_f, lam_c -> entries, added up at their places; a block is L elements
_LOOP = """
void {name}_sum(long blocks, const double *x, const int *index, const double *table,
                const double *theta, double lam_f, const double *lam, const int *rows,
                const int *place, double *sum) {{
  enum {{ NX = {nx}, NP = {np}, NT = {nt}, NC = {nc}, NO = {no} }};
  real X[NX + 1], P[NP + 1], T[NT + 1], F[1] = {{zero + lam_f}}, C[NC + 1], O[NO];
  for (int i = 0; i < NT; i++) T[i] = zero + theta[i];
  for (long b = 0; b < blocks; b++) {{
    for (int i = 0; i < NX; i++, index += L)
      for (int l = 0; l < L; l++) X[i][l] = x[index[l]];
    for (int i = 0; i < NC; i++, rows += L)
      for (int l = 0; l < L; l++) C[i][l] = lam[rows[l]];
    memcpy(P, table + b * NP * L, NP * sizeof(real));
    {name}(X, P, T, F, C, O);
    for (int i = 0; i < NO; i++, place += L)
      for (int l = 0; l < L; l++) sum[place[l]] += O[i][l];
  }}
}}
"""


def c_source(function: ca.Function) -> str:
    """C of an SX function with one output, on vectors, and the loop over its table.

    Args:
        function: (x, row, theta) or (x, row, theta, lam_f, lam_c) -> (k,), of `OPERATIONS` only.
    """
    f, name = function, function.name()
    lines = []
    for op, to, source, constant in instructions(f):
        if op == ca.OP_INPUT:
            lines.append(f"a{to[0]} = in{source[0]}[{source[1]}];")
        elif op == ca.OP_OUTPUT:
            lines.append(f"out[{to[1]}] = a{source[0]};")
        elif op == ca.OP_CONST:
            lines.append(f"a{to[0]} = zero + ({constant!r});")
        else:
            term = operation(op).c.format(*(f"a{i}" for i in source))
            lines.append(f"a{to[0]} = {term};")
    used = f.sz_w()
    size = input_sizes(f)
    head = (
        f"static void {name}(const real *in0, const real *in1, const real *in2,"
        " const real *in3, const real *in4, real *out) {"
    )
    declared = f"  real {', '.join(f'a{i}' for i in range(used))};" if used else ""
    loop = _LOOP.format(name=name, nx=size[0], np=size[1], nt=size[2], nc=size[4], no=f.nnz_out(0))
    return "\n".join([head, declared, *lines, "}", loop])


@lru_cache(maxsize=100)
def _text(function: ca.Function) -> str:
    """What the C of a function depends on; equal kernels share their functions."""
    return str(function.serialize())


def compile_lanes(functions: Sequence[ca.Function]) -> ctypes.CDLL | None:
    """Machine code of functions with distinct names, cached by content; None without a compiler."""
    # what the source depends on, in a tenth of the time that writing it takes
    translation = "".join(op.c for op in OPERATIONS.values()) + _HEAD + _LOOP
    key = "\0".join([translation, *map(_text, functions)])
    path = shared_library(key, lambda: "\n".join([_HEAD, *(c_source(f) for f in functions)]))
    try:
        return None if path is None else ctypes.CDLL(str(path))
    except OSError as error:
        log.warning("compiled kernels cannot be loaded: %s", error)
        return None


class Summed:
    """One function of a kernel as machine code, summed over the kernel's table."""

    def __init__(
        self,
        library: ctypes.CDLL,
        function: ca.Function,
        blocks: Blocks,
        target: NDArray[np.integer],
        size: int,
    ) -> None:
        """Find the function.

        Args:
            library: Of `compile_lanes`.
            function: (x, row, theta) or (x, row, theta, lam_f, lam_c) -> (k,).
            blocks: The kernel's table in blocks of LANES, with 32-bit indices.
            target: (E, k) where each entry is added.
            size: Of the vector; what pads the last block is added behind it.
        """
        self._call = library[f"{function.name()}_sum"]
        self._call.restype = None
        self._arrays = *blocks, in_blocks(target, LANES, np.int32, fill=size)

    def add(self, out: Float, x: Float, theta: Float, lam_f: float, lam_g: Float | None) -> None:
        """Add the elements' entries to `out`.

        Args:
            out: Added to.
            x: (nx,) variables.
            theta: Shared parameters.
            lam_f: Multiplier of f, for Hessians.
            lam_g: (ng,) multipliers of g, for Hessians.
        """
        index, data, rows, target = map(_pointer, self._arrays)
        lam = x if lam_g is None else lam_g
        blocks, factor = ctypes.c_long(len(self._arrays[0])), ctypes.c_double(lam_f)
        first = blocks, _pointer(x), index, data, _pointer(theta), factor
        self._call(*first, _pointer(lam), rows, target, _pointer(out))


def _pointer(array: NDArray[Any]) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)
