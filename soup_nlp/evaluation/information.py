"""The information of the energy at an answer, and the marginal variances that follow from it.

See docs/confidence.md. The information is in nine coordinates per superpixel. Of its inverse the
blocks of the planes are kept: marginal variances, which include the uncertainty of neighbours, not
conditional variances, which would take the neighbours as exact.

These blocks follow from a block tridiagonal Cholesky factorisation. The matrix has one block row
per superpixel. The superpixels are cut into layers across the image, such that a layer is coupled
to the one before it and the one after it alone. A sparse library's solves for all columns of the
inverse cost several times more.
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import csgraph

from soup_nlp.arrays import Float, Int, Labels
from soup_nlp.geometry.camera import pixel_grid, rays
from soup_nlp.geometry.soup import Soup
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.formulation import Formulation, FormulationOptions
from soup_nlp.model.layout import TangentLayout
from soup_nlp.model.programs import build_tangent_nlp, majorant

SMOOTHING = 0.03
"""Width in pixels within which a norm is treated as a square: no flow is more exact."""


@dataclass(frozen=True, eq=False)
class Information:
    """Gauss-Newton information of the energy at a soup.

    Attributes:
        matrix: (9 N, 9 N) `sum c J^T J` over all norms, c their weight over their smoothed length,
            both triangles. Coordinates of a superpixel: relative inverse depth at the anchor and
            its two slopes, rotation (3), shift of the moved anchor over depth (3).
        growth: (9 N,) direction in which all depths grow by one factor; the information is 0 there.
        plane: (N, 3) relative inverse depth and slopes at the soup.
        layout: Anchors and radii of the coordinates.
    """

    matrix: sparse.csr_matrix
    growth: Float
    plane: Float
    layout: TangentLayout


def information(
    soup: Soup, data: EnergyData, weights: Weights, form: FormulationOptions
) -> Information:
    """The information of the energy at a soup; constraints carry none."""
    whole = majorant(Formulation(**dict(form)))
    nlp, layout = build_tangent_nlp(soup, data, weights, whole, "inverse-depth")
    x, theta = nlp.x0, nlp.thetas(eps=SMOOTHING, eps_pixel=SMOOTHING)
    matrix = nlp.hessian(x, np.zeros(nlp.ng), theta=theta).tocsr()
    plane, growth = x.reshape(-1, 9)[:, :3], np.zeros((len(data), 9))
    growth[:, :3] = -plane
    return Information(matrix, growth.ravel(), plane, layout)


def marginals(info: Information, sizes: Int, component: Int) -> tuple[Float, Float]:
    """Marginal covariances with the mean log depth of all pixels fixed.

    The superpixels have `sizes` (N,) in pixels, and belong to a `component` (N,) from 0 to C - 1.

    Returns:
        (N, 3, 3) covariance of a superpixel's relative inverse depth and slopes, and (C,) variance
        of the mean log depth of every component.

    Raises:
        ArithmeticError: the information is no positive semidefinite matrix.
    """
    n, g = len(sizes), info.growth
    diagonal = info.matrix.diagonal()
    # coordinates without any information get a negligible one, so that the matrix is regular
    least = 1e-12 * float(diagonal.max()) or 1.0
    weight = np.where(diagonal > least, 0.0, least)
    # any weight on the global scale makes the matrix definite; its value cancels below
    largest = 9 * int(np.argmax(sizes))
    weight[largest] += max(diagonal[largest], least)
    solver = BlockCholesky(info.matrix + sparse.diags(weight), info.layout.anchor[:, :2])
    mean = _mean_log_depth(info, sizes, np.zeros(n, np.int64))[:, 0]
    mean /= mean @ g
    h = solver.solve(mean)
    # covariance of P x, with P = I - g mean^T: depths relative to their mean
    covariance = solver.inverse_blocks()[:, :3, :3]
    g3, h3 = (v.reshape(n, -1)[:, :3] for v in (g, h))
    cross = g3[:, :, None] * h3[:, None]
    mean_terms = g3[:, :, None] * g3[:, None] * (mean @ h)
    plane = covariance - cross - cross.transpose(0, 2, 1) + mean_terms
    rows = _mean_log_depth(info, sizes, component)
    solved = solver.solve(rows)
    along = g @ rows
    spread = np.einsum("xc,xc->c", rows, solved) - 2 * along * (h @ rows) + along**2 * (mean @ h)
    return plane, np.maximum(spread, 0.0)


def _mean_log_depth(info: Information, sizes: Int, component: Int) -> Float:
    """(9 N, C) derivatives of the components' mean log depth, by pixels."""
    count = int(component.max()) + 1
    share = sizes / np.bincount(component, sizes, minlength=count)[component]
    rows = np.zeros((len(sizes), 9, count))
    rows[np.arange(len(sizes)), 0, component] = -share / info.plane[:, 0]
    return rows.reshape(-1, count)


def spread_in_image(info: Information, plane: Float, labels: Labels, K_ref: Float) -> Float:
    """(H, W) standard deviation of log depth of every pixel, by marginal covariances of the planes
    (N, 3, 3)."""
    ray = rays(K_ref, pixel_grid(*labels.shape))[..., :2]
    layout = info.layout
    off = (ray - layout.anchor[labels][..., :2]) / layout.radius[labels][..., None]
    # log depth is -log(rho + slope . off)
    a = np.concatenate([np.ones((*labels.shape, 1)), off], axis=-1)
    a /= np.einsum("hwc,hwc->hw", a, info.plane[labels])[..., None]
    return np.asarray(np.sqrt(np.maximum(np.einsum("hwi,hwij,hwj->hw", a, plane[labels], a), 0.0)))


# --- diagonal blocks of the inverse ---------------------------------------------------------------

RIDGE = 1e-11
"""Added to the diagonal of the matrix, which is scaled to 1: directions without information."""


class BlockCholesky:
    """Factorisation of a sparse symmetric positive semidefinite matrix of equal blocks."""

    def __init__(self, matrix: sparse.csr_matrix, position: Float) -> None:
        """Factorise a matrix (N B, N B) with both triangles; `layers` need positions (N, 2).

        Raises:
            ArithmeticError: The matrix is not positive definite, even with `RIDGE`, or has a zero
                on its diagonal.
        """
        self.block = size = matrix.shape[0] // len(position)
        diagonal = matrix.diagonal()
        if not (diagonal > 0).all():
            raise ArithmeticError("a diagonal entry is not positive")
        self._scale = 1.0 / np.sqrt(diagonal)
        scaling = sparse.diags(self._scale)
        scaled = (scaling @ matrix @ scaling + RIDGE * sparse.eye(len(diagonal))).tocsr()
        blocks = matrix.tobsr((size, size))
        ones = np.ones(len(blocks.indices), bool)
        coupled = sparse.csr_matrix((ones, blocks.indices, blocks.indptr))
        # variables of every layer, its factor F, and F^-1 times its coupling to the next layer
        self._layers = [
            (size * layer[:, None] + np.arange(size)).ravel() for layer in layers(coupled, position)
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


def layers(coupled: sparse.csr_matrix, position: Float) -> list[Int]:
    """Sets of superpixels, each coupled to the set before it and the one after it alone.

    They are the numbers of steps in the graph, a symmetric pattern (N, N), from the superpixels at
    one end of the image; by their positions (N, 2), layers run across the longer side.
    """
    along = position[:, int(np.argmax(np.ptp(position, axis=0)))]
    # as many as stand in a column
    first = np.argsort(along, kind="stable")[: int(np.ceil(np.sqrt(len(along))))]
    steps = csgraph.dijkstra(coupled, indices=first, unweighted=True, min_only=True)
    return [np.flatnonzero(steps == k) for k in np.unique(steps)]
