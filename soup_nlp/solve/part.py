"""Newton steps of a few superpixels while the others are fixed.

On a large pair most superpixels have converged after a few steps with the exact Hessian, while some
still move to another minimum. These make the matrix indefinite, so that a step of all superpixels
costs several factorisations. A step of these and their neighbours costs a hundredth of that.
(Nonlinear elimination: Cai and Keyes 2002.)
"""

from __future__ import annotations

import numpy as np
from scipy import sparse

from soup_nlp.arrays import Float, Mask
from soup_nlp.solve.factor import Back, Factorise, factorisation, numbered

WORST = 0.01
"""Superpixels whose residual is above this share of the largest are moved, and their neighbours."""
MOST = 0.3
"""Largest share of the superpixels that forms a part; otherwise all superpixels move."""
STEPS = 15
"""Largest number of steps of one part."""


class Part:
    """Which superpixels move: all, or those that the dual infeasibility comes from.

    Attributes:
        some: (N,) the superpixels that move, None for all.
        factorise: As `Factorise`, for the superpixels that move; the step of the others is zero.
    """

    factorise: Factorise

    def __init__(self, upper: sparse.csc_matrix) -> None:
        """Set up; all superpixels move.

        Args:
            upper: (9 N, 9 N) pattern of the upper triangle, its values number the nonzeros.
        """
        self.some: Mask | None = None
        self._upper, self._steps = upper, 0
        self._columns = np.repeat(np.arange(upper.shape[0]), np.diff(upper.indptr))
        self._neighbours: sparse.csr_matrix | None = None

    def choose(self, residual: Float, slow: bool) -> None:
        """Keep moving a part while its residual dominates; then move all superpixels once.

        Args:
            residual: (N,) largest component of the Lagrangian's gradient by superpixel.
            slow: Whether the last step hardly lowered the merit.
        """
        if self.some is not None:
            self._steps += 1
            last = residual[self.some].max() <= residual[~self.some].max()
            if slow or last or self._steps >= STEPS:
                self.some = None
            return
        some = self._with_neighbours(residual > WORST * residual.max())
        if some.mean() <= MOST:
            self.some, self._steps, self.factorise = some, 0, self._within(some)

    def _with_neighbours(self, some: Mask) -> Mask:
        """Superpixels and those that share a nonzero of the Hessian with them."""
        if self._neighbours is None:
            n = len(some)
            pairs = self._upper.indices // 9, self._columns // 9
            one = sparse.coo_matrix((np.ones(len(pairs[0]), np.int32), pairs), (n, n)).tocsr()
            self._neighbours = one + one.T
        return np.asarray(self._neighbours @ some.astype(np.int32) > 0)

    def _within(self, some: Mask) -> Factorise:
        """Factorisation of the block of some superpixels."""
        moves, rows, columns = np.repeat(some, 9), self._upper.indices, self._columns
        kept = np.flatnonzero(moves[rows] & moves[columns])
        new = np.cumsum(moves) - 1
        _, block = factorisation(numbered(new[rows[kept]], new[columns[kept]], int(moves.sum())))

        def factorise(nonzeros: Float) -> Back:
            back = block(nonzeros[kept])

            def within(b: Float) -> Float:
                out = np.zeros_like(b)
                out[moves] = back(b[moves])
                return out

            return within

        return factorise
