"""The presolve's energy as a descent method wants it: numbers, blocks and slacks per superpixel."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from soup_nlp.geometry.soup import Soup
from soup_nlp.model.energy import EnergyData, Weights
from soup_nlp.model.formulation import Formulation, build_tangent_nlp
from soup_nlp.model.layout import Chart
from soup_nlp.model.nlp import other_hessian
from soup_nlp.solve.buffered import Buffered
from soup_nlp.solve.factor import numbered

Float = NDArray[np.float64]
Int = NDArray[np.int64]
HessianKind = Literal["gauss-newton", "exact"]


class TangentProblem:
    """min f(x) with slacks c(x) >= 0 of every superpixel by itself, and the simplex.

    Slacks (N, R) are rim visibility (concave, so the set is convex) and the bounds of
    scale and slopes; they depend on the first three of a superpixel's nine variables.

    Attributes:
        nlp: The tangent NLP with the reweighted Gauss-Newton Hessian.
        layout: Turns its vectors into soups.
        share: (N,) coefficients of the simplex row, `share . scale = 1` (scale = 1 / rho).
        rims: V, rim pixels of a superpixel.
        upper: (9 N, 9 N) pattern of Hessians, upper triangle, its values number the nonzeros.
        block: (N, 45) nonzeros of every superpixel's own triangle, in the order of `triangle`.
        triangle: (2, 45) rows and columns of that triangle.
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
        # theta = 0 and no ridge: reweighted least squares, sum c psi / s J^T J
        majorant = replace(
            form,
            norm="smooth",
            truncation="smooth",
            hessian="gauss-newton+constraints",
            theta=0.0,
            ridge=0.0,
        )
        self.nlp, self.layout = build_tangent_nlp(start, data, weights, majorant, chart)
        nlp = self.nlp
        hessians: dict[HessianKind, ca.Function] = {"gauss-newton": nlp.hess_lag}
        if exact:
            hessians["exact"] = other_hessian(nlp, "exact", form.compiled)
        tables = {g.kernel.name: g.table for g in nlp.groups}
        self._visible = tables["t_visible"].rows
        self.rims = self._visible.shape[1]
        self._simplex = int(tables["t_simplex"].rows[0, 0])
        self.share = tables["t_simplex"].data[:, 0]
        self._low, self._high = nlp.lbx.reshape(-1, 9), nlp.ubx.reshape(-1, 9)
        self._bound = nlp.lbg[self._visible]
        self._p = nlp.p

        x, p = nlp.oracle.mx_in()
        self._f = Buffered(ca.Function("f", [x, p], [nlp.oracle(x, p)[0]]))
        self._gradient, self._rows = Buffered(nlp.grad_f), Buffered(nlp.jac_g)
        self._hessian = {kind: Buffered(h) for kind, h in hessians.items()}
        row, _ = _triplet(nlp.jac_g.sparsity_out(1))
        # derivatives of a row of visibility, by slopes and in "inverse-depth" by rho: found by row
        order = np.argsort(row, kind="stable")
        first = np.searchsorted(row[order], self._visible)
        self._entries = order[first[..., None] + np.arange(2 if chart == "depth" else 3)]
        self.triangle = np.array(np.triu_indices(9))
        self._pattern(hessians)

    def _pattern(self, hessians: Mapping[HessianKind, ca.Function]) -> None:
        """Union of the Hessians' patterns, and where the nonzeros of each stand in it."""
        r, c = self.triangle
        nx, n = self.nlp.nx, self.layout.count
        own = 9 * np.arange(n)[:, None]
        keys = [((own + c) * nx + own + r).ravel()]
        for hessian in hessians.values():
            row, column = _triplet(hessian.sparsity_out(0))
            keys.append(column * nx + row)
        unique, place = np.unique(np.concatenate(keys), return_inverse=True)
        block, *rest = np.split(place.ravel(), np.cumsum([len(k) for k in keys])[:-1])
        self.block: Int = block.reshape(n, -1)
        self._place = dict(zip(hessians, rest))
        self.upper: sparse.csc_matrix = numbered(unique % nx, unique // nx, nx)

    def smoothing(self, eps: float) -> None:
        """Set both smoothing widths, pixels."""
        self._p = self.nlp.with_theta(eps=eps, eps_pixel=eps)

    def value(self, x: Float) -> float:
        """Smoothed energy."""
        return float(self._f(x, self._p)[0][0])

    def gradient(self, x: Float) -> Float:
        """Gradient of the smoothed energy, (9 N,)."""
        return self._gradient(x, self._p)[1].copy()

    def hessian(self, x: Float, z: Float, kind: HessianKind) -> Float:
        """Nonzeros (in the order of `upper`) of the Hessian of `f - z . c`.

        Args:
            x: (9 N,) point.
            z: (N, R) multipliers of the slacks.
            kind: "exact", or "gauss-newton" for f's reweighted stand-in.
        """
        out = np.zeros(self.upper.nnz)
        out[self._place[kind]] = self._hessian[kind](x, self._p, 1.0, self._lam_g(z))[0]
        return out

    def slacks(self, x: Float) -> tuple[Float, Float]:
        """Slacks (N, R) and their derivatives by scale and slopes (N, R, 3)."""
        g, jacobian = self._rows(x, self._p)
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
            a[:, 0] /= self.share @ a[:, 0]
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
        out[::9] = -self.share / x[::9] ** 2 if inverse else self.share
        return out

    def calls(self) -> dict[str, float]:
        """Seconds so far in f, grad_f, jac_g (with g) and hess_lag."""
        return {
            "f": self._f.seconds,
            "grad_f": self._gradient.seconds,
            "jac_g": self._rows.seconds,
            "hess_lag": sum(h.seconds for h in self._hessian.values()),
        }

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


def _triplet(pattern: ca.Sparsity) -> tuple[Int, Int]:
    row, column = pattern.get_triplet()
    return np.asarray(row, np.int64), np.asarray(column, np.int64)
