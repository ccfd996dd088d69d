"""The presolve's energy for a descent method: numbers, blocks and slacks of every superpixel."""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy import sparse

from soup_nlp.arrays import Float, Mask
from soup_nlp.geometry.soup import Soup
from soup_nlp.model.blocks import Elements
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.layout import Chart
from soup_nlp.model.sums import Sums
from soup_nlp.model.tangent_nlp import build_tangent_nlp, majorant
from soup_nlp.solve.factor import numbered
from soup_nlp.solve.part import Block

HessianKind = Literal["gauss-newton", "exact"]


class TangentProblem:
    """min f(x) with slacks c(x) >= 0, each of one superpixel, and the simplex.

    Slacks (N, R) are rim visibility (concave, so the set is convex) and the bounds of
    scale and slopes; they depend on the first three of a superpixel's nine variables.

    Attributes:
        nlp: The tangent NLP with the reweighted Gauss-Newton Hessian.
        layout: Turns its vectors into soups.
        share: (N,) coefficients of the simplex row, `share . scale = 1` (scale = 1 / rho); in the
            paper's units `share . (scale / |m|) = 1`, m the plane of anchor depth 1.
        rims: V, rim pixels of a superpixel.
        upper: (9 N, 9 N) pattern of Hessians, upper triangle, its values number the nonzeros.
        sums: Its values and derivatives.
        triangles: (M, 45) nonzeros of the own triangle of every superpixel that moves, in the order
            of `triangle`.
        triangle: (2, 45) rows and columns of a superpixel's triangle.
    """

    def __init__(
        self,
        start: Soup,
        data: EnergyData,
        weights: Weights,
        form: Formulation,
        exact: bool = True,
        chart: Chart = "depth",
    ) -> None:
        """Build the program.

        Args:
            start: Base and start.
            data: Pixels, graphs and weights of the pair.
            weights: Constants of the energy.
            form: Visibility, and whether kernels are compiled.
            exact: Also make the exact Hessian.
            chart: Of the coordinates, see TangentLayout.
        """
        self.nlp, self.layout = build_tangent_nlp(start, data, weights, majorant(form), chart)
        nlp, n = self.nlp, self.layout.count
        self._moving: Block | None = None
        self._rest: tuple[Float, float, Float] | None = None
        self._kinds = {"gauss-newton": nlp.hessian, **({"exact": "exact"} if exact else {})}
        self.triangle = np.array(np.triu_indices(9))
        own = Elements(self.layout.of(np.arange(n)), *self.triangle)
        self.sums = Sums(nlp, list(self._kinds.values()), own)
        upper = self.sums.upper
        self._triangles = upper.places[-1].reshape(n, -1)
        self.triangles = self._triangles
        self.upper: sparse.csc_matrix = numbered(upper.rows, upper.columns, nlp.nx)
        tables = {g.kernel.name: g.table for g in nlp.groups}
        self._visible = tables["t_visible"].rows
        self.rims = self._visible.shape[1]
        self._simplex = int(tables["t_simplex"].rows[0, 0])
        unit = tables["t_simplex"].data
        self.share, self._slants = unit[:, 0], unit[:, 1:] if unit.shape[1] > 1 else None
        self._low, self._high = nlp.lbx.reshape(-1, 9), nlp.ubx.reshape(-1, 9)
        self._bound = nlp.lbg[self._visible]
        # derivatives of a row of visibility, by slopes and in "inverse-depth" by rho: found by row
        row = self.sums.jacobian.rows
        order = np.argsort(row, kind="stable")
        first = np.searchsorted(row[order], self._visible)
        self._entries = order[first[..., None] + np.arange(2 if chart == "depth" else 3)]

    def smoothing(self, eps: float) -> None:
        """Set both smoothing widths, pixels."""
        self.sums.theta = self.nlp.thetas(eps=eps, eps_pixel=eps)

    @property
    def moving(self) -> Mask | slice:
        """(N,) the superpixels that move."""
        return self._moving.some if self._moving else slice(None)

    def move(self, block: Block | None, x: Float) -> bool:
        """Let some superpixels move; the others change only in `normalise`.

        Hessians are then of their block. Where E does not depend on scale, only elements with one
        of these are summed from now on: f and gradient have the others' part as it is at x.

        Args:
            block: Those that move; None for all.
            x: (9 N,) present point.

        Returns:
            Whether the choice differs from the last one.
        """
        if block is self._moving:
            return False
        self.sums.only(None)
        self._moving, self._rest, self.triangles = block, None, self._triangles
        if block is None:
            return True
        new = np.empty(self.upper.nnz, np.int64)
        new[block.nonzeros] = np.arange(len(block.nonzeros))
        self.triangles = new[self._triangles[block.some]]
        if self._slants is None:
            f, gradient = self.value(x), self.gradient(x)
            self.sums.only(np.repeat(block.some, 9), block.nonzeros)
            self._rest = x, f - self.sums.value(x), gradient - self.sums.gradient(x)
        else:
            self.sums.only(None, block.nonzeros)
        return True

    def value(self, x: Float) -> float:
        """Smoothed energy."""
        f = self.sums.value(x)
        return f if self._rest is None else f + self._rest[1]

    def gradient(self, x: Float) -> Float:
        """Gradient of the smoothed energy, (9 N,)."""
        out = self.sums.gradient(x)
        if self._rest is None or self._moving is None:
            return out
        before, _, rest = self._rest
        # `normalise` has scaled the variables of those that are held, which divides derivatives
        held = 9 * int(np.argmin(self._moving.some))
        scaled = 1 if self.layout.chart == "depth" else 3
        rest = rest.reshape(-1, 9).copy()
        rest[:, :scaled] *= before[held] / x[held]
        return out + rest.ravel()

    def hessian(self, x: Float, z: Float, kind: HessianKind, nu: float = 0.0) -> Float:
        """Nonzeros (in the order of `upper`) of the Hessian of `f - z . c`, of those that move.

        Args:
            x: (9 N,) point.
            z: (N, R) multipliers of the slacks.
            kind: "exact", or "gauss-newton" for f's reweighted majorant.
            nu: Multiplier of the simplex, whose row is curved in the paper's units.
        """
        lam_g = self._lam_g(z)
        if self._slants is not None and kind == "exact":
            lam_g[self._simplex] = nu
        return self.sums.hessian(self._kinds[kind], x, lam_g)

    def slacks(self, x: Float) -> tuple[Float, Float]:
        """Slacks (N, R) and their derivatives by scale and slopes (N, R, 3)."""
        g, jacobian = self.sums.constraints(x)
        a, n, count = x.reshape(-1, 9), self.layout.count, self.rims
        J = np.zeros((n, count + 5, 3))
        own = jacobian[self._entries]
        J[:, :count, 3 - own.shape[2] :] = own
        J[:, count:] = [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, 0], [0, 0, -1]]
        low, high = a[:, :3] - self._low[:, :3], self._high[:, 1:3] - a[:, 1:3]
        return np.column_stack([g[self._visible] - self._bound, low, high]), J

    def normalise(self, x: Float) -> Float:
        """The same soup with its scales on the simplex."""
        a = x.reshape(-1, 9).copy()
        if self.layout.chart == "depth":
            a[:, 0] /= self.share @ (a[:, 0] * self._facing(a)[0])
        else:
            a[:, :3] *= self.share @ (1 / a[:, 0])
        return a.ravel()

    def growth(self, x: Float) -> Float:
        """Direction in which all depths grow alike, (9 N,); the length unit grows by 1."""
        out = np.zeros((len(x) // 9, 9))
        if self.layout.chart == "depth":
            out[:, 0] = x[::9]
        else:
            out[:, :3] = -x.reshape(-1, 9)[:, :3]
        return out.ravel()

    def length(self, x: Float) -> Float:
        """Gradient of the length unit, the simplex row, (9 N,)."""
        out = np.zeros_like(x)
        inverse = self.layout.chart != "depth"
        if inverse:
            out[::9] = -self.share / x[::9] ** 2
            return out
        facing, by_slopes = self._facing(x.reshape(-1, 9))
        out[::9] = self.share * facing
        out.reshape(-1, 9)[:, 1:3] = (self.share * x[::9])[:, None] * by_slopes
        return out

    def _facing(self, a: Float) -> tuple[Float, Float]:
        """(N,) 1 / |m| of the rows (N, 9) of a vector, 1 where slopes are held; its slopes (N, 2).

        m is `(s / h, 1 - s . r_a / h)`.
        """
        if self._slants is None:
            return np.ones(len(a)), np.zeros((len(a), 2))
        ray, reach = self._slants[:, :2], self._slants[:, 2:]
        s = a[:, 1:3] / reach
        last = 1 - np.sum(s * ray, axis=1, keepdims=True)
        facing = 1 / np.sqrt(np.sum(s**2, axis=1) + last[:, 0] ** 2)
        return facing, -(facing**3)[:, None] * (s - last * ray) / reach

    def calls(self) -> dict[str, float]:
        """Seconds so far in f, grad_f, jac_g (with g) and hess_lag."""
        return dict(self.sums.seconds)

    def _lam_g(self, z: Float) -> Float:
        lam_g = np.zeros(self.nlp.ng)
        lam_g[self._visible] = -z[:, : self.rims]
        return lam_g

    def multipliers(self, z: Float, nu: float) -> tuple[Float, Float]:
        """lam_x (9 N,) and lam_g of the NLP, from those of slacks and simplex."""
        lam_g = self._lam_g(z)
        lam_g[self._simplex] = nu
        lam_x = np.zeros((len(z), 9))
        bound = z[:, self.rims :]
        lam_x[:, :3] = -bound[:, :3]
        lam_x[:, 1:3] += bound[:, 3:]
        return lam_x.ravel(), lam_g
