"""Kernel and table, the parts of every nonlinear program of this package; patterns of its matrices.

A kernel is the symbolic objective and constraints of ONE element; a table says, for every element,
which variables it reads, which rows of g it adds to, and its data. Nothing here knows the soup.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from typing import Any, Literal, get_args

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from soup_nlp.arrays import Float, Int
from soup_nlp.errors import ModelError

Hessian = Literal["exact", "gauss-newton", "gauss-newton+constraints"]
HESSIANS: tuple[Hessian, ...] = get_args(Hessian)
"""gauss-newton: positive semidefinite part of the objective, without curvature of constraints."""

BLOCK = 4096
"""Largest number of elements of a block: more cost fewer calls, fewer fit into the cache."""

_once = lru_cache(maxsize=1000)
"""Derivatives are taken once: the programs of a solve share the kernels of the energy."""


@dataclass(frozen=True, eq=False)
class Kernel:
    """Symbolic element of an NLP.

    Attributes:
        name: Identifier, also of the generated functions.
        x: (nx,) local variables.
        row: (np,) data of one element.
        theta: (nt,) parameters that all elements and kernels share.
        objective: Scalar added to f, or None.
        constraints: (nc,) added to rows of g, or None.
        curvature: (nx, nx) positive semidefinite majorant of the objective, or None
            for none (then "gauss-newton" uses the exact one).
    """

    name: str
    x: ca.SX
    row: ca.SX
    theta: ca.SX
    objective: ca.SX | None = None
    constraints: ca.SX | None = None
    curvature: ca.SX | None = None

    def __str__(self) -> str:
        return f"Kernel({self.name}, {self.nx} variables, {self.row.numel()} data, {self.nc} rows)"

    @property
    def nx(self) -> int:
        """Number of local variables."""
        return int(self.x.numel())

    @property
    def nc(self) -> int:
        """Number of local constraint rows."""
        return 0 if self.constraints is None else int(self.constraints.numel())

    @_once
    def first_order(self) -> dict[str, ca.Function]:
        """Functions "f" and "grad", "con" and "jac" (sparse) of (x, row, theta) of one element;
        absent where there is nothing to compute."""
        out: dict[str, ca.SX] = {}
        if self.objective is not None:
            out["f"] = self.objective
            out["grad"] = ca.densify(ca.gradient(self.objective, self.x))
        if self.constraints is not None:
            out["con"] = ca.densify(self.constraints)
            out["jac"] = ca.jacobian(self.constraints, self.x)
        args = [self.x, self.row, self.theta]
        return {k: ca.Function(f"{self.name}_{k}", args, ca.cse([v])) for k, v in out.items()}

    @_once
    def second_order(self, hessian: str) -> dict[str, ca.Function]:
        """Function "hess" of (x, row, theta, lam_f, lam_c), absent where it is 0: upper triangle of
        the Hessian of one element, of a kind of HESSIANS, sparse."""
        lam_f, lam_c = ca.SX.sym("lam_f"), ca.SX.sym("lam_c", self.nc)
        H = ca.SX(self.nx, self.nx)
        if self.objective is not None:
            majorant = None if hessian == "exact" else self.curvature
            H += lam_f * (ca.hessian(self.objective, self.x)[0] if majorant is None else majorant)
        if self.constraints is not None and hessian != "gauss-newton":
            H += ca.hessian(ca.dot(lam_c, self.constraints), self.x)[0]
        H = ca.sparsify(ca.triu(H))
        if not H.nnz():
            return {}
        args = [self.x, self.row, self.theta, lam_f, lam_c]
        return {"hess": ca.Function(f"{self.name}_hess", args, ca.cse([H]))}


@dataclass(frozen=True)
class Group:
    """A kernel with its table: the elements of one kind.

    Attributes:
        kernel: Of one element.
        index: (E, nx) global variable of every local one.
        data: (E, np) data rows.
        rows: (E, nc) global constraint row of every local one; rows may repeat (sums).

    Raises:
        ModelError: table and kernel do not fit, or data is not finite.
    """

    kernel: Kernel
    index: Int
    data: Float
    rows: Int

    def __post_init__(self) -> None:
        k = self.kernel
        expected = [(len(self), width) for width in (k.nx, k.row.numel(), k.nc)]
        shapes = [a.shape for a in (self.index, self.data, self.rows)]
        if shapes != expected:
            raise ModelError(
                "table does not fit its kernel",
                where=k.name,
                found=f"index, data, rows {shapes}",
                expected=f"index, data, rows {expected}",
            )
        if not np.isfinite(self.data).all():
            raise ModelError("table has NaN or infinite data", where=k.name)

    def __len__(self) -> int:
        return len(self.index)

    @property
    def block_size(self) -> int:
        """Number of elements of a block: all blocks are of equal size."""
        return max(1, -(-len(self) // -(-len(self) // BLOCK)))

    @cached_property
    def blocks(self) -> list[tuple[Any, ...]]:
        """Index, data and rows of every block, one row for each column of the table; all functions
        of the kernel share them."""
        tables = self.index, self.data, self.rows
        return list(zip(*(in_blocks(t, self.block_size, t[-1:]) for t in tables)))


def in_blocks(table: NDArray[Any], width: int, last: NDArray[Any]) -> NDArray[Any]:
    """(E, k) table as (B, k, width), filled up with a last row (1, k)."""
    full = np.concatenate([table, np.repeat(last, -len(table) % width, axis=0)])
    full = full.astype(np.float64 if full.dtype.kind == "f" else np.int64)
    blocks = full.reshape(len(full) // width, width, table.shape[1])
    return np.ascontiguousarray(blocks.transpose(0, 2, 1))


# --- patterns of sparse matrices ------------------------------------------------------------------

Entries = tuple[NDArray[np.integer], NDArray[np.integer]]
"""(E, k) rows and columns of the nonzeros of a set of elements."""


@dataclass(frozen=True, eq=False)
class Pattern:
    """Union of the nonzeros of many elements, by columns.

    Attributes:
        shape: Of the matrix.
        sets: Makes the nonzeros of each set of elements. They take much more memory than their
            union, and `places` of the constrained NLP are rarely needed.
    """

    shape: tuple[int, int]
    sets: Callable[[], Iterable[Entries]] = field(repr=False)

    @cached_property
    def _union(self) -> sparse.csc_array:
        union = sparse.csc_array(self.shape, dtype=bool)
        for rows, columns in self.sets():
            ones = np.ones(rows.size, bool)
            entries = sparse.coo_array((ones, (rows.ravel(), columns.ravel())), self.shape)
            union = union + entries.tocsc()
        union.sort_indices()
        return union

    @property
    def rows(self) -> Int:
        """Row of every nonzero."""
        return self._union.indices

    @cached_property
    def columns(self) -> Int:
        """Column of every nonzero."""
        return np.repeat(np.arange(self.shape[1]), np.diff(self._union.indptr))

    @cached_property
    def places(self) -> list[NDArray[np.int32]]:
        """(E, k) number of every nonzero of each set of elements."""
        keys = self.columns * self.shape[0] + self.rows
        sets = ((rows, columns.astype(np.int64)) for rows, columns in self.sets())
        return [np.searchsorted(keys, c * self.shape[0] + r).astype(np.int32) for r, c in sets]

    @cached_property
    def sparsity(self) -> ca.Sparsity:
        """For CasADi."""
        return ca.Sparsity(*self.shape, self._union.indptr.tolist(), self.rows.tolist(), True)

    def filled(self, nonzeros: Float) -> sparse.csc_matrix:
        """The matrix with these nonzeros."""
        return sparse.csc_matrix((nonzeros, self.rows, self._union.indptr), self.shape)


def _nonzeros(function: ca.Function | None) -> Iterable[Int]:
    """Rows and columns of the nonzeros of a function's matrix, in storage order."""
    places = ([], []) if function is None else function.sparsity_out(0).get_triplet()
    return (np.asarray(k, np.int64) for k in places)


def jacobian_entries(groups: Sequence[Group]) -> Iterator[Entries]:
    """Nonzeros of g's Jacobian; one set for every group."""
    for group in groups:
        r, c = _nonzeros(group.kernel.first_order().get("jac"))
        yield group.rows[:, r], group.index[:, c]


def hessian_entries(groups: Sequence[Group], hessian: str) -> Iterator[Entries]:
    """Nonzeros of the upper triangle of the Lagrangian's Hessian; one set for every group."""
    for group in groups:
        # half the bytes sort in half the time
        index = group.index.astype(np.int32)
        one, two = (index[:, k] for k in _nonzeros(group.kernel.second_order(hessian).get("hess")))
        yield np.minimum(one, two), np.maximum(one, two)
