"""Diagonal blocks of the inverse of a sparse matrix, by a block tridiagonal Cholesky factorisation.

The matrix has one block row per superpixel. The superpixels are cut into layers across the image,
such that a layer is coupled to the one before it and the one after it alone; elimination goes from
the first layer to the last, and the inverse, restricted to each layer, comes back. A sparse
library's solves for all columns of the inverse cost several times more.
"""

import numpy as np
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve

from soup_nlp.arrays import Float, Int

RIDGE = 1e-11
"""Added to the diagonal of the matrix, which is scaled to 1: directions without information."""


class BlockCholesky:
    """Factorisation of a sparse symmetric positive semidefinite matrix of equal blocks."""

    def __init__(self, matrix: sparse.csr_matrix, position: Float) -> None:
        """Factorise.

        Args:
            matrix: (N B, N B), both triangles. A row with a zero on the diagonal is an error.
            position: (N, 2) positions of the blocks, for the layers.

        Raises:
            ArithmeticError: The matrix is not positive definite, even with `RIDGE`.
        """
        self.block = matrix.shape[0] // len(position)
        diagonal = matrix.diagonal()
        if not (diagonal > 0).all():
            raise ArithmeticError("a diagonal entry is not positive")
        self._scale = 1.0 / np.sqrt(diagonal)
        scaling = sparse.diags(self._scale)
        scaled = (scaling @ matrix @ scaling + RIDGE * sparse.eye(len(diagonal))).tocsr()
        # variables of every layer, its factor F, and F^-1 times its coupling to the next layer
        self._layers = [
            (self.block * layer[:, None] + np.arange(self.block)).ravel()
            for layer in layers(_coupled(matrix, self.block), position)
        ]
        self._factors: list[tuple[Float, bool]] = []
        self._coupling: list[Float] = []
        before = np.zeros((0, 0))
        for k, layer in enumerate(self._layers):
            rows = scaled[layer]
            F = rows[:, layer].toarray()
            if k:
                F -= before.T @ self._coupling[-1]
            try:
                self._factors.append(cho_factor(F, lower=True, check_finite=False))
            except np.linalg.LinAlgError as error:
                raise ArithmeticError("the matrix is not positive definite") from error
            if k + 1 < len(self._layers):
                before = rows[:, self._layers[k + 1]].toarray()
                self._coupling.append(cho_solve(self._factors[-1], before, check_finite=False))

    def solve(self, b: Float) -> Float:
        """The solution (N B, ...) of `matrix x = b`."""
        x = (b.T * self._scale).T
        for k, layer in enumerate(self._layers):
            if k:
                x[layer] -= self._coupling[k - 1].T @ x[self._layers[k - 1]]
        for k in reversed(range(len(self._layers))):
            layer = self._layers[k]
            x[layer] = cho_solve(self._factors[k], x[layer], check_finite=False)
            if k + 1 < len(self._layers):
                x[layer] -= self._coupling[k] @ x[self._layers[k + 1]]
        return np.asarray((x.T * self._scale).T)

    def inverse_blocks(self) -> Float:
        """(N, B, B) diagonal blocks of the inverse."""
        size = self.block
        out, later = np.empty((len(self._scale) // size, size, size)), np.zeros((0, 0))
        for k in reversed(range(len(self._layers))):
            layer = self._layers[k]
            Z = cho_solve(self._factors[k], np.eye(len(layer)), check_finite=False)
            if k + 1 < len(self._layers):
                Z += self._coupling[k] @ later @ self._coupling[k].T
            later = Z
            inner = np.arange(len(layer)).reshape(-1, size)
            scale = self._scale[layer].reshape(-1, size)
            blocks = Z[inner[:, :, None], inner[:, None]]
            out[layer[::size] // size] = blocks * scale[:, :, None] * scale[:, None]
        return out


def _coupled(matrix: sparse.csr_matrix, block: int) -> sparse.csr_matrix:
    """(N, N) pattern of the blocks of a matrix."""
    blocks = matrix.tobsr((block, block))
    ones = np.ones(len(blocks.indices), bool)
    return sparse.csr_matrix((ones, blocks.indices, blocks.indptr))


def layers(coupled: sparse.csr_matrix, position: Float) -> list[Int]:
    """Sets of superpixels, each coupled to the set before it and the one after it alone.

    They are the numbers of steps in the graph from the superpixels at one end of the image.

    Args:
        coupled: (N, N) symmetric pattern.
        position: (N, 2) positions; layers run across the longer side.
    """
    along = position[:, int(np.argmax(np.ptp(position, axis=0)))]
    left, out = np.ones(len(position), bool), []
    while left.any():
        remaining = np.flatnonzero(left)
        # as many as stand in a column
        layer = remaining[
            np.argsort(along[remaining], kind="stable")[: int(np.ceil(np.sqrt(len(remaining))))]
        ]
        while len(layer):
            out.append(layer)
            left[layer] = False
            near = np.unique(coupled[layer].indices)
            layer = near[left[near]]
    return out
