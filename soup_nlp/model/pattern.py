"""Patterns of sparse matrices: the union of many elements' nonzeros, and where each stands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from soup_nlp.arrays import Float, Int
from soup_nlp.model.kernel import Group


class Entries(NamedTuple):
    """Where the nonzeros of a set of elements stand.

    Attributes:
        rows, columns: (E, k).
    """

    rows: NDArray[np.integer]
    columns: NDArray[np.integer]


@dataclass(frozen=True, eq=False)
class Pattern:
    """Union of the nonzeros of many elements, by columns.

    Attributes:
        shape: Of the matrix.
        sets: Nonzeros of each set of elements.
    """

    shape: tuple[int, int]
    sets: Sequence[Entries] = field(repr=False)

    @cached_property
    def _union(self) -> sparse.csc_array:
        if not self.sets:
            return sparse.csc_array(self.shape)
        rows, columns = (np.concatenate([e[k].ravel() for e in self.sets]) for k in (0, 1))
        union = sparse.coo_array((np.ones(len(rows), bool), (rows, columns)), self.shape).tocsc()
        union.sum_duplicates()
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
        every = (e.columns.astype(np.int64) * self.shape[0] + e.rows for e in self.sets)
        return [np.searchsorted(keys, own).astype(np.int32) for own in every]

    def sparsity(self) -> ca.Sparsity:
        """For CasADi."""
        return ca.Sparsity(*self.shape, self._union.indptr.tolist(), self.rows.tolist(), True)

    def filled(self, nonzeros: Float) -> sparse.csc_matrix:
        """The matrix with these nonzeros."""
        return sparse.csc_matrix((nonzeros, self.rows, self._union.indptr), self.shape)


def jacobian_pattern(groups: Sequence[Group], ng: int, nx: int) -> Pattern:
    """Pattern of g's Jacobian; one set for every group that has constraints."""
    sets = []
    for group in groups:
        if group.kernel.nc:
            r, c = group.kernel.jacobian_pattern()
            sets.append(Entries(group.table.rows[:, r], group.table.index[:, c]))
    return Pattern((ng, nx), sets)


def hessian_pattern(groups: Sequence[Group], nx: int, hessian: str) -> Pattern:
    """Pattern of the upper triangle of the Lagrangian's Hessian; one set for every group."""
    sets = []
    for group in groups:
        # half the bytes sort in half the time
        index = group.table.index.astype(np.int32)
        one, two = (index[:, k] for k in group.kernel.hessian_pattern(hessian))
        sets.append(Entries(np.minimum(one, two), np.maximum(one, two)))
    return Pattern((nx, nx), sets)
