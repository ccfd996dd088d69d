"""Diagonal blocks of the inverse of a sparse matrix, by a multifrontal Cholesky factorisation.

The matrix has one block row per superpixel. Nested dissection cuts the image plane into halves
whose superpixels are not coupled once those of a separator are eliminated; every separator and
every piece that is not cut any further is one dense front. Elimination goes from the pieces to the
root; the inverse, restricted to each front, comes back from the root to the pieces. A sparse
library's solves for all columns of the inverse cost several times more (docs/solving.md).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve

from soup_nlp.arrays import Float, Int

PIECE = 24
"""Largest number of superpixels that are not cut any further."""
RIDGE = 1e-11
"""Added to the diagonal of the matrix, which is scaled to 1: directions without information."""


@dataclass(frozen=True)
class Front:
    """Superpixels that are eliminated together.

    Attributes:
        own: (s,) superpixels that are eliminated here.
        above: (b,) superpixels that they are coupled to and that are eliminated later.
        parent: Number of the front that takes the Schur complement; -1 for the last.
    """

    own: Int
    above: Int
    parent: int


@dataclass(frozen=True)
class _Factor:
    """Elimination of a front: factor of its own block F_ss, and W = F_ss^-1 F_sb."""

    own: Int
    above: Int
    cholesky: tuple[Float, bool]
    W: Float


class BlockCholesky:
    """Factorisation of a sparse symmetric positive semidefinite matrix of equal blocks."""

    def __init__(self, matrix: sparse.csr_matrix, place: Float) -> None:
        """Factorise.

        Args:
            matrix: (N B, N B), both triangles. A row with a zero on the diagonal is an error.
            place: (N, 2) positions of the blocks, for the nested dissection.

        Raises:
            ArithmeticError: The matrix is not positive definite, even with `RIDGE`.
        """
        count = len(place)
        self.block = matrix.shape[0] // count
        diagonal = matrix.diagonal()
        if not (diagonal > 0).all():
            raise ArithmeticError("a diagonal entry is not positive")
        self._scale = 1.0 / np.sqrt(diagonal)
        scaling = sparse.diags(self._scale)
        scaled = (scaling @ matrix @ scaling + RIDGE * sparse.eye(len(diagonal))).tocsr()
        self.fronts = dissect(_coupled(matrix, self.block), place)
        self._factors = self._factorise(scaled)

    def _variables(self, blocks: Int) -> Int:
        return np.asarray((self.block * blocks[:, None] + np.arange(self.block)).ravel())

    def _factorise(self, matrix: sparse.csr_matrix) -> list[_Factor]:
        factors: list[_Factor] = []
        schur: dict[int, list[tuple[Int, Float]]] = {}
        column = np.full(matrix.shape[0], -1)
        for number, front in enumerate(self.fronts):
            own, above = self._variables(front.own), self._variables(front.above)
            every, s = np.concatenate([own, above]), len(own)
            column[every] = np.arange(len(every))
            F = np.zeros((len(every), len(every)))
            rows = matrix[own]
            at, inside = np.repeat(np.arange(s), np.diff(rows.indptr)), column[rows.indices]
            kept = inside >= 0
            F[at[kept], inside[kept]] = rows.data[kept]
            for index, complement in schur.pop(number, []):
                where = column[index]
                F[where[:, None], where] += complement
            column[every] = -1
            try:
                cholesky = cho_factor(F[:s, :s], lower=True, check_finite=False)
            except np.linalg.LinAlgError as error:
                raise ArithmeticError("the matrix is not positive definite") from error
            coupling = F[:s, s:]
            W = cho_solve(cholesky, coupling, check_finite=False)
            factors.append(_Factor(own, above, cholesky, W))
            if front.parent >= 0:
                rest = F[s:, s:] - coupling.T @ W
                schur.setdefault(front.parent, []).append((above, rest))
        return factors

    def solve(self, b: Float) -> Float:
        """The solution (N B, ...) of `matrix x = b`."""
        x = (b.T * self._scale).T
        for f in self._factors:
            x[f.above] -= f.W.T @ x[f.own]
            x[f.own] = cho_solve(f.cholesky, x[f.own], check_finite=False)
        for f in reversed(self._factors):
            x[f.own] -= f.W @ x[f.above]
        return np.asarray((x.T * self._scale).T)

    def inverse_blocks(self) -> Float:
        """(N, B, B) diagonal blocks of the inverse."""
        size = self.block
        out = np.empty((len(self._scale) // size, size, size))
        position = np.full(len(self._scale), -1)
        inverse: dict[int, tuple[Int, Float]] = {}
        waiting = np.bincount([f.parent for f in self.fronts if f.parent >= 0])
        for number in reversed(range(len(self.fronts))):
            front, f = self.fronts[number], self._factors[number]
            s = len(f.own)
            Z = np.empty((s + len(f.above),) * 2)
            Z[:s, :s] = cho_solve(f.cholesky, np.eye(s), check_finite=False)
            if front.parent >= 0:
                index, whole = inverse[front.parent]
                position[index] = np.arange(len(index))
                at = position[f.above]
                Z[s:, s:] = whole[at[:, None], at]
                position[index] = -1
                Z[:s, s:] = -f.W @ Z[s:, s:]
                Z[s:, :s] = Z[:s, s:].T
                Z[:s, :s] -= Z[:s, s:] @ f.W.T
                waiting[front.parent] -= 1
                if not waiting[front.parent]:
                    del inverse[front.parent]
            if number < len(waiting) and waiting[number]:
                inverse[number] = np.concatenate([f.own, f.above]), Z
            own = np.arange(s).reshape(-1, size)
            scale = self._scale[f.own].reshape(-1, size)
            out[front.own] = Z[own[:, :, None], own[:, None]] * scale[:, :, None] * scale[:, None]
        return out


def _coupled(matrix: sparse.csr_matrix, block: int) -> sparse.csr_matrix:
    """(N, N) pattern of the blocks of a matrix."""
    own = matrix.tocoo()
    pattern = sparse.coo_matrix(
        (np.ones(own.nnz, np.int8), (own.row // block, own.col // block)),
        (matrix.shape[0] // block,) * 2,
    )
    return pattern.tocsr()


def dissect(coupled: sparse.csr_matrix, place: Float) -> list[Front]:
    """Fronts of a nested dissection, children before their parents.

    Args:
        coupled: (N, N) symmetric pattern.
        place: (N, 2) positions; a piece is cut across its longer side.
    """
    pieces: list[tuple[Int, int]] = []

    def cut(own: Int) -> list[int]:
        """Append the fronts of a set of superpixels; the numbers of those without a parent."""
        if len(own) > PIECE:
            at = place[own]
            along = at[:, int(np.argmax(np.ptp(at, axis=0)))]
            low = along < np.median(along)
            left, right = own[low], own[~low]
            between = coupled[left][:, right]
            separator = min(
                left[np.diff(between.indptr) > 0], right[np.unique(between.indices)], key=len
            )
            rest = [part[~np.isin(part, separator)] for part in (left, right)]
            if all(map(len, rest)):
                below = cut(rest[0]) + cut(rest[1])
                if not len(separator):
                    return below
                for number in below:
                    pieces[number] = pieces[number][0], len(pieces)
                own = separator
        pieces.append((own, -1))
        return [len(pieces) - 1]

    cut(np.arange(len(place)))
    return _with_borders(pieces, coupled)


def _with_borders(pieces: list[tuple[Int, int]], coupled: sparse.csr_matrix) -> list[Front]:
    """The fronts of pieces: what each is coupled to after the elimination of those before it."""
    turn = np.empty(coupled.shape[0], np.int64)
    for number, (own, _) in enumerate(pieces):
        turn[own] = number
    passed: dict[int, list[Int]] = {}
    fronts = []
    for number, (own, parent) in enumerate(pieces):
        near = np.unique(np.concatenate([coupled[own].indices, *passed.pop(number, [])]))
        above = near[turn[near] > number]
        fronts.append(Front(own, above, parent))
        if parent >= 0:
            passed.setdefault(parent, []).append(above)
    return fronts
