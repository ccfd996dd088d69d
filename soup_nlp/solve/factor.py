"""Factorisation of sparse symmetric positive definite matrices by CHOLMOD or SuperLU."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

Float = NDArray[np.float64]
Int = NDArray[np.int64]
Back = Callable[[Float], Float]
Factorise = Callable[[Float], Back]
"""Nonzeros of the upper triangle -> (b -> H^-1 b). Raises ArithmeticError where the library finds
that the matrix is not positive definite."""


def numbered(rows: Int, columns: Int, size: int) -> sparse.csc_matrix:
    """(size, size) matrix whose values number its nonzeros in storage order.

    Args:
        rows: Row of every nonzero; columns ascending, rows ascending in a column.
        columns: Column of every nonzero.
        size: Rows and columns.
    """
    start = np.searchsorted(columns, np.arange(size + 1))
    return sparse.csc_matrix((np.arange(len(rows), dtype=float), rows, start), (size, size))


def diagonal_places(upper: sparse.csc_matrix) -> Int:
    """(n,) where the diagonal stands among the nonzeros of a `numbered` matrix.

    Raises:
        ValueError: A diagonal entry is no nonzero.
    """
    columns = np.repeat(np.arange(upper.shape[1]), np.diff(upper.indptr))
    places = np.flatnonzero(upper.indices == columns)
    if len(places) != upper.shape[0]:
        raise ValueError("a diagonal entry is not among the nonzeros of the matrix")
    return places


def same_pattern(one: sparse.csc_matrix, other: sparse.csc_matrix) -> bool:
    """Whether two `numbered` matrices have the same nonzeros, so that one analysis serves both."""
    return np.array_equal(one.indptr, other.indptr) and np.array_equal(one.indices, other.indices)


def cholmod(upper: sparse.csc_matrix, order: Callable[[], Int] | None = None) -> Factorise:
    """CHOLMOD of cvxopt (an extra); the symbolic analysis is made once.

    Args:
        upper: (n, n) upper triangle whose values number its nonzeros in storage order.
        order: Makes the order of elimination (n,); default CHOLMOD's own, by minimum degree.

    Raises:
        ImportError: cvxopt is not installed.
    """
    import cvxopt
    from cvxopt import cholmod as library

    n = upper.shape[0]
    column = np.repeat(np.arange(n), np.diff(upper.indptr))
    places = (cvxopt.matrix(i.astype(np.int64)) for i in (upper.indices, column))
    A = cvxopt.spmatrix(1.0, *places, (n, n))
    # CHOLMOD would transpose a lower triangle once more for every factorisation
    given = {"p": cvxopt.matrix(order().astype(np.int64))} if order else {}
    factor = library.symbolic(A, **given, uplo="U")

    def factorise(nonzeros: Float) -> Back:
        A.V = cvxopt.matrix(nonzeros)
        library.numeric(A, factor)

        def back(b: Float) -> Float:
            out = cvxopt.matrix(b)
            library.solve(factor, out)
            return np.array(out).ravel()

        return back

    return factorise


def superlu(upper: sparse.csc_matrix) -> Factorise:
    """scipy's SuperLU, a symmetric ordering and no pivoting off the diagonal."""
    rows, columns = upper.indices, np.repeat(np.arange(upper.shape[0]), np.diff(upper.indptr))
    options: dict[str, Any] = {"diag_pivot_thresh": 0.0, "options": {"SymmetricMode": True}}

    def factorise(nonzeros: Float) -> Back:
        U = sparse.csc_matrix((nonzeros, (rows, columns)), shape=upper.shape)
        full = U + sparse.triu(U, 1).T
        try:
            return splu(full.tocsc(), "MMD_AT_PLUS_A", **options).solve
        except RuntimeError as error:
            raise ArithmeticError(str(error)) from error

    return factorise


def factorisation(
    upper: sparse.csc_matrix, order: Callable[[], Int] | None = None
) -> tuple[str, Factorise]:
    """CHOLMOD where cvxopt is installed (the extra "fast"), else SuperLU, five times slower.

    CasADi's MUMPS, twice as slow as CHOLMOD, is not used: it prints when it is destroyed.

    Args:
        upper: (n, n) upper triangle whose values number its nonzeros in storage order.
        order: Makes an order of elimination (n,) for CHOLMOD.

    Returns:
        Its name, and the function that factorises.
    """
    try:
        return "CHOLMOD", cholmod(upper, order)
    except ImportError:
        return "SuperLU", superlu(upper)
