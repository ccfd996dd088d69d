"""Reference solvers without Ipopt on the same energy: Levenberg-Marquardt and L-BFGS.

Both work on the 9 tangent coordinates per superpixel of `build_tangent_nlp` (scale, two slopes,
Cayley vector, translation; one chart about the start) and take f, its gradient and the reweighted
normal matrix from its kernels. A step of the null space keeps the simplex, which is linear in the
scales; a projection of the trial point keeps bounds and visibility, and the point is refused where
f does not fall.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.optimize import minimize

from soup_nlp.geometry.soup import Soup
from soup_nlp.model import oracle
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.layout import TangentLayout
from soup_nlp.model.nlp import NLP, to_scipy
from soup_nlp.model.tangent_nlp import build_tangent_nlp
from soup_nlp.solve.factor import diagonal_places, factorisation

Float = NDArray[np.float64]

EPS = (1.0, 0.3, 0.1, 0.03, 0.01)
"""Continuation of the smoothing widths, large to small, in the energy's units (pixels)."""
LEAST_DAMPING, MOST_DAMPING = 1e-6, 1e12
TOLERANCE, STAGNATION = 1e-5, 1e-3
"""Levenberg-Marquardt ends the last width, and the others, when f falls by less than this share
twice in a row."""
LBFGS_TOLERANCE = 1e-7
LBFGS_MEMORY = 20
PENALTY = 1e2
"""Factor of the half squares of violated constraints in L-BFGS."""


@dataclass(frozen=True)
class ReferenceSolve:
    """How far a method without Ipopt came.

    Attributes:
        name: "levenberg-marquardt" (with its factorisation) or "l-bfgs".
        soup: The iterate of lowest exact energy; its constraints hold.
        energy: Exact energy by term of the soup.
        iterations: Steps tried, refused ones included (L-BFGS: its own count).
        seconds: Wall time: building and steps, without the exact energies of `history`.
        cpu_seconds: The same in CPU time of this process.
        history: (I, 2) seconds and exact energy after every accepted step, the start first.
        status: "Converged", "Iteration_Limit" or "Time_Limit".
    """

    name: str
    soup: Soup
    energy: Mapping[str, float]
    iterations: int
    seconds: float
    cpu_seconds: float
    history: Float = field(repr=False)
    status: str


class _Tangent:
    """f, gradient and normal matrix of the presolve's smoothed energy; its feasible set."""

    def __init__(
        self, start: Soup, data: EnergyData, weights: Weights, form: Formulation | None
    ) -> None:
        # theta = 0 and no ridge: the Hessian is that of reweighted least squares, sum w/s J^T J
        form = (form or Formulation()).replace(
            norm="smooth", truncation="smooth", hessian="gauss-newton", theta=0.0, ridge=0.0
        )
        self.nlp: NLP
        self.layout: TangentLayout
        self.nlp, self.layout = build_tangent_nlp(start, data, weights, form)
        nlp = self.nlp
        self.p = ca.DM(nlp.p)
        # every constraint is linear: g = A x + g0
        g, A = nlp.jac_g(nlp.x0, nlp.p)
        A = to_scipy(A).tocsr()
        constant = np.asarray(g).ravel() - A @ nlp.x0
        equal = nlp.lbg == nlp.ubg
        self.simplex = A[np.flatnonzero(equal)].toarray().sum(axis=0)
        rows = np.flatnonzero(~equal)
        self.rows, self.lower = A[rows], nlp.lbg[rows] - constant[rows]
        # a row of visibility reads the slopes of one superpixel
        self.owner = self.rows.indices[self.rows.indptr[:-1]] // 9
        pattern = nlp.hess_lag.sparsity_out(0)
        self.upper = sparse.csc_matrix(
            (
                np.arange(pattern.nnz(), dtype=float),
                np.asarray(pattern.row()),
                np.asarray(pattern.colind()),
            ),
            shape=pattern.shape,
        )

    def smoothing(self, eps: float) -> None:
        """Set both smoothing widths."""
        self.p = ca.DM(self.nlp.with_theta(eps=eps, eps_pixel=eps, theta=0.0, ridge=0.0))

    def value(self, x: Float) -> float:
        """Smoothed energy."""
        return float(self.nlp.oracle(x, self.p)[0])

    def gradient(self, x: Float) -> tuple[float, Float]:
        """Smoothed energy and its gradient (9 N,)."""
        f, gradient = self.nlp.grad_f(x, self.p)
        return float(f), np.asarray(gradient).ravel()

    def normal_matrix(self, x: Float) -> Float:
        """Nonzeros of the upper triangle, in the order of `upper`."""
        H = self.nlp.hess_lag(x, self.p, 1.0, np.zeros(self.nlp.ng))
        return np.array(H.nonzeros())

    def diagonal(self, nonzeros: Float) -> Float:
        """Diagonal of the normal matrix (9 N,)."""
        column = np.repeat(np.arange(self.nlp.nx), np.diff(self.upper.indptr))
        out = np.zeros(self.nlp.nx)
        on = self.upper.indices == column
        out[column[on]] = nonzeros[on]
        return out

    def project(self, x: Float) -> Float:
        """The point with bounds kept and slopes shrunk until every rim pixel is visible."""
        x = np.clip(x, self.nlp.lbx, self.nlp.ubx)
        value = self.rows @ x
        # the bounds are negative and rows homogeneous in the slopes: shrinking always helps
        factor = np.ones(len(value))
        np.divide(self.lower, value, out=factor, where=value < self.lower)
        worst = np.ones(self.layout.count)
        np.minimum.at(worst, self.owner, factor)
        x.reshape(-1, 9)[:, 1:3] *= worst[:, None]
        return x


class _Record:
    """Clocks that stand still while exact energies are taken, and the best soup."""

    def __init__(self, data: EnergyData, weights: Weights) -> None:
        self.data, self.weights = data, weights
        self.wall, self.cpu = time.perf_counter(), time.process_time()
        self.history: list[tuple[float, float]] = []
        self.best: tuple[Mapping[str, float], Soup] | None = None

    def seconds(self) -> float:
        """Wall time so far."""
        return time.perf_counter() - self.wall

    def note(self, soup: Soup) -> None:
        """Take the exact energy of an iterate."""
        wall, cpu = time.perf_counter(), time.process_time()
        energy = oracle.energy(soup, self.data, self.weights)
        self.history.append((wall - self.wall, energy["total"]))
        if self.best is None or energy["total"] < self.best[0]["total"]:
            self.best = energy, soup
        self.wall += time.perf_counter() - wall
        self.cpu += time.process_time() - cpu

    def finish(self, name: str, iterations: int, status: str) -> ReferenceSolve:
        """The record that is returned."""
        assert self.best is not None
        seconds, cpu = self.seconds(), time.process_time() - self.cpu
        energy, soup = self.best
        history = np.array(self.history)
        return ReferenceSolve(name, soup, energy, iterations, seconds, cpu, history, status)


def levenberg_marquardt(
    start: Soup,
    data: EnergyData,
    weights: Weights,
    form: Formulation | None = None,
    *,
    eps: Sequence[float] = EPS,
    iterations: int = 60,
    seconds: float = np.inf,
) -> ReferenceSolve:
    """Reweighted least squares with Levenberg's damping, smaller and smaller smoothing.

    With residuals v of weight c, s = sqrt(|v|^2 + eps^2) and truncation slope psi the step solves
    `(sum c psi / s J^T J + mu I) h = -grad f`, `sum_i a_i h_i = 0` for the simplex. mu follows the
    gain ratio (Nielsen's rule). The smoothed energy f never rises within an eps.

    Args:
        start: Initial soup.
        data: Pixels, graphs and weights of the pair.
        weights: Constants of the energy.
        form: Visibility; its norm, truncation and Hessian are not used.
        eps: Smoothing widths in turn.
        iterations: Limit of steps for every eps.
        seconds: Time limit.
    """
    record = _Record(data, weights)
    problem = _Tangent(start, data, weights, form)
    library, factorise = factorisation(problem.upper)
    a, diagonal = problem.simplex, diagonal_places(problem.upper)
    x = problem.project(problem.nlp.x0)
    record.note(problem.layout.unpack(x))
    count, status = 0, "Converged"
    damping, growth = 1e-2, 2.0
    for k, width in enumerate(eps):
        last = k == len(eps) - 1
        problem.smoothing(width)
        f, gradient = problem.gradient(x)
        H = problem.normal_matrix(x)
        small = 0
        for step in range(iterations + 1):
            if record.seconds() > seconds:
                return record.finish(f"levenberg-marquardt ({library})", count, "Time_Limit")
            if step == iterations:
                status = "Iteration_Limit" if last else status
                break
            count += 1
            damped = H.copy()
            damped[diagonal] += damping
            back = factorise(damped)
            u, v = back(gradient), back(a)
            h = -u + v * (a @ u) / (a @ v)
            trial = problem.project(x + h)
            h = trial - x
            fresh = problem.value(trial)
            U = problem.upper.copy()
            U.data = H
            curved = 2 * (h @ (U @ h)) - np.sum(U.diagonal() * h**2)
            promised = -(gradient @ h + 0.5 * curved)
            gain = (f - fresh) / promised if promised > 0 else -1.0
            if np.isfinite(fresh) and fresh < f and gain > 0:
                small = (
                    small + 1 if f - fresh <= (TOLERANCE if last else STAGNATION) * abs(f) else 0
                )
                x = trial
                f, gradient = problem.gradient(x)
                H = problem.normal_matrix(x)
                record.note(problem.layout.unpack(x))
                damping = max(LEAST_DAMPING, damping * max(1 / 3, 1 - (2 * gain - 1) ** 3))
                growth = 2.0
            else:
                damping, growth = damping * growth, 2 * growth
                # no descent at any length: the point is as good as this eps makes it
                small = 2 if damping > MOST_DAMPING else small
            if small >= 2:
                damping, growth = min(damping, 1e-2), 2.0
                break
    return record.finish(f"levenberg-marquardt ({library})", count, status)


def lbfgs(
    start: Soup,
    data: EnergyData,
    weights: Weights,
    form: Formulation | None = None,
    *,
    eps: Sequence[float] = EPS,
    iterations: int = 1000,
    seconds: float = np.inf,
) -> ReferenceSolve:
    """scipy's L-BFGS-B on the same tangent problem, smaller and smaller smoothing.

    Variables are scaled by the diagonal of the normal matrix where an eps begins. Bounds are its
    own; simplex and visibility are half squares of their violation in f, and every iterate is
    projected before its exact energy is taken.

    Args:
        start: Initial soup.
        data: Pixels, graphs and weights of the pair.
        weights: Constants of the energy.
        form: Visibility; its norm, truncation and Hessian are not used.
        eps: Smoothing widths in turn.
        iterations: Limit for every eps.
        seconds: Time limit.
    """
    record = _Record(data, weights)
    problem = _Tangent(start, data, weights, form)
    a, A, lower = problem.simplex, problem.rows, problem.lower
    x = problem.project(problem.nlp.x0)
    total = float(a @ x)
    record.note(problem.layout.unpack(x))

    def objective(z: Float) -> tuple[float, Float]:
        x = z * unit
        f, gradient = problem.gradient(x)
        off = float(a @ x) - total
        hidden = np.minimum(A @ x - lower, 0.0)
        f += 0.5 * PENALTY * (off**2 + float(hidden @ hidden))
        return f, unit * (gradient + PENALTY * (off * a + A.T @ hidden))

    count, status = 0, "Converged"

    def iterate(z: Float) -> None:
        nonlocal count
        count += 1
        record.note(problem.layout.unpack(problem.project(z * unit)))
        if record.seconds() > seconds:
            raise StopIteration

    bounds = np.column_stack([problem.nlp.lbx, problem.nlp.ubx])
    for width in eps:
        problem.smoothing(width)
        # units in which the normal matrix has a diagonal of ones
        unit = 1 / np.sqrt(problem.diagonal(problem.normal_matrix(x)) + 1e-2)
        out = minimize(
            objective,
            x / unit,
            jac=True,
            method="L-BFGS-B",
            bounds=bounds / unit[:, None],
            callback=iterate,
            options={
                "maxiter": iterations,
                "maxfun": 2 * iterations,
                "maxcor": LBFGS_MEMORY,
                "ftol": LBFGS_TOLERANCE,
                "gtol": 1e-8,
            },
        )
        if record.seconds() > seconds:
            status = "Time_Limit"
            break
        x = np.asarray(out.x) * unit
        status = "Iteration_Limit" if out.status == 1 else "Converged"
    return record.finish("l-bfgs", count, status)
