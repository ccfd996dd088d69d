"""Newton steps of a few superpixels while the others are fixed.

On a large pair most superpixels have converged after a few steps with the exact Hessian, while some
still move to another minimum. These make the matrix indefinite, so that a step of all superpixels
costs several factorisations. A step of these and their neighbours costs a hundredth of that.
(Nonlinear elimination: Cai and Keyes 2002.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.solve.factor import Back, Factorise, diagonal_places, factorisation, numbered

WORST = 0.01
"""Superpixels whose residual is above this share of the largest are moved, and their neighbours."""
MOST = 0.3
"""Largest share of the superpixels that forms a part; otherwise all superpixels move."""
STEPS = 15
"""Largest number of steps of one part."""


@dataclass(frozen=True, eq=False)
class Block:
    """Superpixels, and the block of their unknowns in the Hessian.

    Attributes:
        some: (N,) the superpixels.
        unknowns: (n,) their unknowns.
        nonzeros: (k,) nonzeros of the whole upper triangle that are in the block.
        pattern: (n, n) upper triangle of the block, its values number its nonzeros.
        diagonal: (n,) where the diagonal stands among them.
    """

    some: Mask
    unknowns: Int
    nonzeros: Int
    pattern: sparse.csc_matrix
    diagonal: Int

    @classmethod
    def of(cls, upper: sparse.csc_matrix, some: Mask) -> Block:
        """Some superpixels (N,) of a pattern (9 N, 9 N) as in `Part`."""
        moves, rows = np.repeat(some, 9), upper.indices
        columns = np.repeat(np.arange(len(moves)), np.diff(upper.indptr))
        kept = np.flatnonzero(moves[rows] & moves[columns])
        new, unknowns = np.cumsum(moves) - 1, np.flatnonzero(moves)
        pattern = numbered(new[rows[kept]], new[columns[kept]], len(unknowns))
        return cls(some, unknowns, kept, pattern, diagonal_places(pattern))


class Part:
    """Which superpixels move: all, or those that the dual infeasibility comes from.

    Attributes:
        block: The superpixels that move, None for all.
        factorise: As `Factorise`, from the nonzeros of their block; the step of the others is zero.
    """

    factorise: Factorise

    def __init__(self, upper: sparse.csc_matrix) -> None:
        """Set up; all superpixels move.

        Args:
            upper: (9 N, 9 N) pattern of the upper triangle, its values number the nonzeros.
        """
        self.block: Block | None = None
        self._upper, self._steps = upper, 0
        self._neighbours: sparse.csr_matrix | None = None

    def choose(self, residual: Float, slow: bool) -> None:
        """Keep moving a part while its residual dominates; then move all superpixels once.

        Args:
            residual: (N,) largest component of the Lagrangian's gradient by superpixel.
            slow: Whether the last step hardly lowered the merit.
        """
        if self.block is not None:
            self._steps += 1
            some = self.block.some
            last = residual[some].max() <= residual[~some].max()
            if slow or last or self._steps >= STEPS:
                self.block = None
            return
        some = self._with_neighbours(residual > WORST * residual.max())
        if some.mean() <= MOST:
            self.block, self._steps = Block.of(self._upper, some), 0
            self.factorise = _within(self.block)

    def _with_neighbours(self, some: Mask) -> Mask:
        """Superpixels and those that share a nonzero of the Hessian with them."""
        if self._neighbours is None:
            n = len(some)
            columns = np.repeat(np.arange(9 * n), np.diff(self._upper.indptr))
            pairs = self._upper.indices // 9, columns // 9
            one = sparse.coo_matrix((np.ones(len(pairs[0]), np.int32), pairs), (n, n)).tocsr()
            self._neighbours = one + one.T
        return np.asarray(self._neighbours @ some.astype(np.int32) > 0)


def _within(block: Block) -> Factorise:
    """Factorisation of a block; what it solves for is zero outside."""
    _, own = factorisation(block.pattern)

    def factorise(nonzeros: Float) -> Back:
        back = own(nonzeros)

        def within(b: Float) -> Float:
            out = np.zeros_like(b)
            out[block.unknowns] = back(b[block.unknowns])
            return out

        return within

    return factorise
