"""Patterns of sparse matrices: the union of many elements' nonzeros, and where each stands."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from soup_nlp.arrays import Float, Int
from soup_nlp.model.kernel import Group, nonzeros

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

    def sparsity(self) -> ca.Sparsity:
        """For CasADi."""
        return ca.Sparsity(*self.shape, self._union.indptr.tolist(), self.rows.tolist(), True)

    def filled(self, nonzeros: Float) -> sparse.csc_matrix:
        """The matrix with these nonzeros."""
        return sparse.csc_matrix((nonzeros, self.rows, self._union.indptr), self.shape)


def jacobian_entries(groups: Sequence[Group]) -> Iterator[Entries]:
    """Nonzeros of g's Jacobian; one set for every group."""
    for group in groups:
        r, c = nonzeros(group.kernel.first_order().get("jac"))
        yield group.rows[:, r], group.index[:, c]


def hessian_entries(groups: Sequence[Group], hessian: str) -> Iterator[Entries]:
    """Nonzeros of the upper triangle of the Lagrangian's Hessian; one set for every group."""
    for group in groups:
        # half the bytes sort in half the time
        index = group.index.astype(np.int32)
        one, two = (index[:, k] for k in nonzeros(group.kernel.second_order(hessian).get("hess")))
        yield np.minimum(one, two), np.maximum(one, two)
