"""A reference solver without Ipopt on the same energy: Levenberg-Marquardt on the manifold.

It works on the 9 tangent coordinates per superpixel of `build_tangent_nlp` (scale, two slopes,
Cayley vector, translation; one chart about the start) and takes f, its gradient and the reweighted
normal matrix from its kernels. A step of the null space keeps the simplex, which is linear in the
scales; a projection of the trial point keeps bounds and visibility, and the point is refused where
f does not fall.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from soup_nlp.arrays import Float
from soup_nlp.geometry.soup import Soup
from soup_nlp.model import oracle
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.tangent_nlp import build_tangent_nlp

EPS = (1.0, 0.3, 0.1, 0.03, 0.01)
"""Smoothing widths of the continuation, in the units of the energy (pixels)."""
FIRST_DAMPING, LEAST_DAMPING, MOST_DAMPING = 1e-2, 1e-6, 1e12
TOLERANCE, STAGNATION = 1e-5, 1e-3
"""Steps with one smoothing width end after two steps in a row that lower f by less than this share;
TOLERANCE is for the last width, STAGNATION for the others."""


@dataclass(frozen=True)
class ReferenceSolve:
    """Result of the reference solver.

    Attributes:
        soup: The iterate of lowest exact energy; it satisfies the constraints.
        energy: Exact energy by term of the soup.
        iterations: Number of steps, rejected ones included.
        cpu_seconds: CPU time of building and steps.
        status: "Converged", "Iteration_Limit" or "Time_Limit".
    """

    soup: Soup
    energy: Mapping[str, float]
    iterations: int
    cpu_seconds: float
    status: str


class Descent:
    """A feasible iterate of the smoothed energy f; a step lowers f or raises the damping.

    Attributes:
        nlp, layout: The tangent program; its Hessian is the normal matrix.
        simplex: (nx,) gradient of the simplex.
        rows, lower: Visibility as `rows @ x >= lower`.
        x: (nx,) iterate, at first the start.
        path: All accepted iterates.
    """

    def __init__(
        self, start: Soup, data: EnergyData, weights: Weights, form: Formulation | None
    ) -> None:
        # theta = 0 and no ridge: the Hessian is that of reweighted least squares, sum w/s J^T J
        form = (form or Formulation()).replace(
            norm="smooth", hessian="gauss-newton", theta=0.0, ridge=0.0
        )
        self.nlp, self.layout = build_tangent_nlp(start, data, weights, form)
        nlp = self.nlp
        self.theta = nlp.thetas()
        # every constraint is linear: g = A x + g0
        A = nlp.jacobian(nlp.x0)
        constant = nlp.constraints(nlp.x0) - A @ nlp.x0
        equal = nlp.lbg == nlp.ubg
        self.simplex = A[np.flatnonzero(equal)].toarray().sum(axis=0)
        rows = np.flatnonzero(~equal)
        self.rows, self.lower = A[rows], nlp.lbg[rows] - constant[rows]
        # a visibility row depends on the slopes of one superpixel only
        self.owner = self.rows.indices[self.rows.indptr[:-1]] // 9
        self.x = self.project(nlp.x0)
        self.path = [self.x]
        self.damping, self.growth = FIRST_DAMPING, 2.0

    def project(self, x: Float) -> Float:
        """The point clipped to the bounds, its slopes shrunk until every rim pixel is visible."""
        x = np.clip(x, self.nlp.lbx, self.nlp.ubx)
        value = self.rows @ x
        # bounds are negative and rows are homogeneous in the slopes, so shrinking always works
        factor = np.ones(len(value))
        np.divide(self.lower, value, out=factor, where=value < self.lower)
        worst = np.ones(self.layout.count)
        np.minimum.at(worst, self.owner, factor)
        x.reshape(-1, 9)[:, 1:3] *= worst[:, None]
        return x

    def value(self, x: Float) -> float:
        """Smoothed energy."""
        return self.nlp.value(x, self.theta)

    def smoothing(self, eps: float) -> None:
        """Set both smoothing widths, and lower a damping that steps raised."""
        self.theta = self.nlp.thetas(eps=eps, eps_pixel=eps, theta=0.0, ridge=0.0)
        self.damping, self.growth = min(self.damping, FIRST_DAMPING), 2.0
        self._move(self.x)

    def _move(self, x: Float) -> None:
        nlp, theta = self.nlp, self.theta
        self.x, self.f, self.gradient = x, self.value(x), nlp.gradient(x, theta)
        self.H = nlp.hessian(x, np.zeros(nlp.ng), theta=theta)

    def step(self) -> float | None:
        """Try a step; returns the relative decrease of f, or None if the step is rejected."""
        a, gradient = self.simplex, self.gradient
        damped = self.H + self.damping * sparse.eye(len(gradient), format="csc")
        options = {"SymmetricMode": True}
        factor = splu(damped, "MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
        u, v = factor.solve(gradient), factor.solve(a)
        trial = self.project(self.x - u + v * (a @ u) / (a @ v))
        h = trial - self.x
        fresh = self.value(trial)
        promised = -(gradient @ h + 0.5 * h @ (self.H @ h))
        gain = (self.f - fresh) / promised if promised > 0 else -1.0
        if not (np.isfinite(fresh) and fresh < self.f and gain > 0):
            self.damping, self.growth = self.damping * self.growth, 2 * self.growth
            return None
        fall = (self.f - fresh) / abs(self.f)
        self._move(trial)
        self.path.append(trial)
        # Nielsen's update of the damping
        self.damping = max(LEAST_DAMPING, self.damping * max(1 / 3, 1 - (2 * gain - 1) ** 3))
        self.growth = 2.0
        return float(fall)

    def run(self, eps: Sequence[float], iterations: int, end: float) -> tuple[int, str]:
        """Descend with every smoothing width in turn until the time `end`; steps and status."""
        count, status = 0, "Converged"
        for width in eps:
            last = width == eps[-1]
            self.smoothing(width)
            steps = small = 0
            while small < 2:
                if time.perf_counter() > end:
                    return count, "Time_Limit"
                if steps == iterations:
                    status = "Iteration_Limit" if last else status
                    break
                steps, count = steps + 1, count + 1
                fall = self.step()
                if fall is not None:
                    small = small + 1 if fall <= (TOLERANCE if last else STAGNATION) else 0
                elif self.damping > MOST_DAMPING:
                    # no step length lowers f: the point is optimal for this smoothing width
                    small = 2
        return count, status


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
    """Minimise by reweighted least squares with damping and decreasing smoothing widths.

    With residuals v of weight c, s = sqrt(|v|^2 + eps^2) and truncation slope psi the step solves
    `(sum c psi / s J^T J + mu I) h = -grad f`, `sum_i a_i h_i = 0` for the simplex. mu follows the
    gain ratio. The smoothed energy f never rises within an eps.

    Args:
        start: Initial soup.
        data: Pixels, graphs and weights of the pair.
        weights: Constants of the energy.
        form: Visibility constraint; its norm, truncation and Hessian are not used.
        eps: Smoothing widths, one after the other.
        iterations: Limit of steps for every width.
        seconds: Limit of the wall time.
    """
    end, cpu = time.perf_counter() + seconds, time.process_time()
    descent = Descent(start, data, weights, form)
    count, status = descent.run(eps, iterations, end)
    spent = time.process_time() - cpu
    # computed here, so that the time excludes the exact energies
    soups = [descent.layout.unpack(x) for x in descent.path]
    energies = [oracle.energy(soup, data, weights) for soup in soups]
    best = int(np.argmin([energy["total"] for energy in energies]))
    return ReferenceSolve(soups[best], energies[best], count, spent, status)
