"""Draw sparsity, fill and conditioning of the KKT matrix: `PYTHONPATH=. python docs/kkt.py`.

The matrix is [H J'; J 0] of the rows that are active at the minimum of the stages, on the scene
street; fill is that of SuperLU with minimum degree of K + K'.
"""

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, SuperLU, onenormest, splu

import soup_nlp
from soup_nlp.export.verify import active, least_squares_multipliers

SIZES = 100, 250, 500
SHOWN = 100
"""Superpixels of the patterns."""


def kkt(size: int, coordinates: str) -> tuple[sparse.csc_matrix, SuperLU, float]:
    """The matrix at the minimum, its factors, and its condition in the 1-norm."""
    nlp = soup_nlp.nlp("street", superpixels=size, coordinates=coordinates, presolve=True).record
    x = nlp.x0
    at_lower, at_upper, _ = active(nlp, x)
    J, H = nlp.jacobian(x)[at_lower | at_upper], nlp.hessian(x, least_squares_multipliers(nlp, x))
    K = sparse.csc_matrix(sparse.block_array([[H, J.T], [J, None]]))
    lu = splu(K, "MMD_AT_PLUS_A", diag_pivot_thresh=0.01, options={"SymmetricMode": True})
    # symmetric, so that its inverse is its own adjoint
    inverse = LinearOperator(K.shape, matvec=lu.solve, rmatvec=lu.solve, dtype=float)
    return K, lu, onenormest(K) * onenormest(inverse)


def main() -> None:
    """Print a row per size, and draw."""
    figure, axes = plt.subplots(2, 3, figsize=(13, 8), layout="constrained")
    for (left, middle), coordinates in zip(axes[:, :2], ("matrix", "tangent")):
        found = []
        for size in SIZES:
            K, lu, condition = kkt(size, coordinates)
            found.append((size, K.nnz, lu.L.nnz, condition))
            counts = " | ".join(map(str, (size, K.shape[0], K.nnz, lu.L.nnz)))
            print(f"| {coordinates} | {counts} | {condition:.0e} |", flush=True)
            if size == SHOWN:
                left.spy(K, markersize=0.2)
                left.set_title(f"{coordinates}: K, N = {size}, {K.nnz} nonzeros")
                middle.spy(lu.L, markersize=0.2)
                middle.set_title(f"factor L, {lu.L.nnz} nonzeros")
        size, nonzeros, fill, condition = np.transpose(found)
        axes[0, 2].loglog(size, nonzeros, "o--", label=f"{coordinates}: K")
        axes[0, 2].loglog(size, fill, "o-", label=f"{coordinates}: L")
        axes[1, 2].loglog(size, condition, "o-", label=coordinates)
    for axis, title in zip(axes[:, 2], ("nonzeros by N", "condition by N")):
        axis.set_title(title)
        axis.legend()
    figure.savefig(Path(__file__).parents[1] / "results/solvers/kkt.png", dpi=70)


if __name__ == "__main__":
    main()
