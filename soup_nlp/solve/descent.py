"""The presolve: a condensed primal-dual Newton method on tangent coordinates.

Every iteration solves one symmetric positive definite system of 9 N unknowns,

    (H + diag(mu_i) + sum_r z_r / c_r dc_r dc_r^T) h + nu a = -(df - sum_r b / c_r dc_r)
    a . h = 0

with slacks c, their multipliers z, gradients d and the barrier b. Every slack depends on one
superpixel, so that eliminating it causes no fill; Ipopt, which keeps slacks, factorises an
indefinite system of twice the size. H is at first the reweighted Gauss-Newton majorant of the
norms, whose full steps descend, then the exact Hessian.

Damping mu_i, fraction to the boundary and step length are each superpixel's own, so that a few
that move to another minimum do not slow down the others. Steps are doubled while the merit falls:
components slide along valleys of equal re-projection error in a few iterations.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Mapping
from contextlib import suppress
from functools import cache, partial

import numpy as np

from soup_nlp.arrays import Float
from soup_nlp.geometry.soup import Soup
from soup_nlp.solve.ipopt import Stage
from soup_nlp.solve.line_search import (
    TO_BOUNDARY,
    Move,
    Point,
    Search,
    along,
    evaluate,
    inside,
    less_forces,
    merit,
    reach,
)
from soup_nlp.solve.newton import Curvature, Newton
from soup_nlp.solve.phase import Convergence, Phase
from soup_nlp.solve.tangent_problem import HessianKind, TangentProblem
from soup_nlp.storage.progress import Progress, Watch

DAMPING = (1e-7, 1e6)
"""Least and most damping mu of a superpixel."""
HELD = 1e-3
"""Least damping of a superpixel whose step went too far."""
FRESH: Mapping[HessianKind, float] = {"gauss-newton": 1e-2, "exact": 1e-4}
"""Largest damping at the begin of a phase, and after PATIENCE iterations of slow descent."""
SLOW, PATIENCE = 1e-6, 10
"""Relative decrease below which descent is slow, and iterations between two such resets."""


class Descent:
    """A descent from the start of a tangent problem, phase by phase."""

    newton: Newton

    def __init__(
        self,
        problem: TangentProblem,
        *,
        after: Descent | None = None,
        deadline: float = np.inf,
        watch: Watch | None = None,
    ) -> None:
        """Set up; nothing is solved.

        Args:
            problem: Energy and slacks.
            after: A descent in another chart, whose soup is this problem's base: its point,
                multipliers and damping are where this one begins.
            deadline: Of time.perf_counter().
            watch: Listener, stop and log file.
        """
        self.problem, self.deadline, self.watch = problem, deadline, watch or Watch()
        # ordering and symbolic analysis of the other chart serve here as well
        self.newton = Newton(problem, after.newton if after else None)
        self.x: Float = problem.nlp.x0
        self.z: Float | None = None
        self.damping: Float = np.full(problem.layout.count, 1e-2)
        if after:
            # at their base charts agree to first order
            self.x, self.z, self.damping = problem.layout.pack(after.soup), after.z, after.damping
        self.x = inside(problem, self.x)

    @property
    def soup(self) -> Soup:
        """The present iterate."""
        return self.problem.layout.unpack(self.x)

    @property
    def rim(self) -> Float:
        """(N, V) multipliers of rim visibility, its rows divided by the facing of the anchor."""
        assert self.z is not None
        own = self.z[:, : self.problem.rims]
        return own if self.problem.layout.chart == "depth" else own * self.x[::9, None]

    def run(self, phase: Phase) -> Stage:
        """Descend until the phase ends; x, multipliers and damping stay for the next one."""
        begin, problem, newton = time.perf_counter(), self.problem, self.newton
        calls = problem.calls()
        at, gradient = self._begin(phase)
        assert self.z is not None
        curvature: Curvature | None = None
        small, patient, slow, least = 0, PATIENCE, False, np.inf
        barrier = max(phase.highest, phase.barrier)
        history: list[tuple[float, ...]] = []
        convergence = Convergence(phase)
        for iteration in itertools.count():
            nu, residual = self._dual(gradient, at.jacobian)
            dual, gap = float(residual.max()), float((at.slack * self.z).max())
            history.append((at.f, dual, gap, float(np.median(self.damping)), 0.0))
            self._tell(phase, iteration, history[-1], begin)
            if convergence.met(at, self.z, history[-1]):
                break
            if not phase.stagnation and dual < least:
                # near the solution the merit's decrease is below its rounding, the gradient's not
                small = 0
            least = min(least, dual)
            status = self._stopped(phase, iteration, small)
            if status:
                break
            barrier = max(phase.barrier, min(barrier, 1e-6 * dual))
            newton.choose(residual, slow)
            if problem.move(newton.moving, at.x):
                # the same f but for its rounding, which can exceed a step's decrease
                at, curvature = at._replace(f=problem.value(at.x)), None
            at = at._replace(merit=merit(at.f, at.slack, barrier))
            if curvature is None:
                curvature = cache(partial(self._curvature, at, nu))
            step = newton.step(at, curvature, gradient, barrier, phase.hessian, self.damping)
            search = Search(problem, at, step.h, barrier, step.newton)
            move = search.run(gradient, step.bent)
            self._adapt(move)
            history[-1] = (*history[-1][:4], float(move.length.min()))
            if move.point is None:
                # steps of the majorant, and of a new factor, are descent directions
                newton.refuse(step)
                continue
            newton.accept(step)
            fell = at.merit - move.point.merit
            small = small + 1 if fell <= phase.stagnation * abs(at.f) else 0
            slow = fell <= max(phase.stagnation, SLOW) * abs(at.f)
            if phase.hessian == "exact" and fell < SLOW * abs(at.f) and iteration >= patient:
                # a superpixel with large damping moves too little for its own slope to show, and
                # its damping would never fall
                self.damping = np.minimum(self.damping, FRESH["exact"])
                patient = iteration + PATIENCE
            self._step_multipliers(at, step.h, barrier, move.point)
            at, self.x, curvature = move.point, move.point.x, None
            gradient = search.gradient(at.x)
        problem.move(None, at.x)
        if convergence.reached:
            status = "Solve_Succeeded"
            # the last step may have made the residual larger
            at, self.z, history[-1] = convergence.reached
            self.x = at.x
            nu, _ = self._dual(problem.gradient(at.x), at.jacobian)
        spent = {k: v - calls[k] for k, v in problem.calls().items()}
        return self._stage(phase, status, at, nu, history, time.perf_counter() - begin, spent)

    def _begin(self, phase: Phase) -> tuple[Point, Float]:
        """Set the problem, multipliers and damping for a phase; the iterate and its gradient."""
        self.problem.smoothing(phase.eps)
        self.problem.move(None, self.x)
        at = evaluate(self.problem, self.x, phase.barrier)
        assert at is not None, "the iterate is inside its bounds"
        if self.z is None:
            self.z = phase.barrier / at.slack
        self.damping = np.minimum(self.damping, FRESH[phase.hessian])
        self.newton.begin()
        return at, self.problem.gradient(at.x)

    def _stopped(self, phase: Phase, iteration: int, small: int) -> str:
        """Status of a phase that ends here without having converged, else nothing."""
        if small >= 2:
            return "Stagnated"
        if self.watch.stop.is_set():
            return "Interrupted"
        if time.perf_counter() > self.deadline:
            return "Time_Limit"
        return "Maximum_Iterations_Exceeded" if iteration == phase.iterations else ""

    def _stage(
        self,
        phase: Phase,
        status: str,
        at: Point,
        nu: float,
        history: list[tuple[float, ...]],
        seconds: float,
        calls: Mapping[str, float],
    ) -> Stage:
        """The record of a phase that ended at a point with the simplex's multiplier nu."""
        assert self.z is not None
        lam_x, lam_g = self.problem.multipliers(self.z, nu)
        names = ("obj", "inf_du", "mu", "regularization_size", "alpha_pr")
        return Stage(
            name=phase.name,
            status=status,
            converged=status == "Solve_Succeeded",
            x=at.x,
            lam_x=lam_x,
            lam_g=lam_g,
            objective=at.f,
            iterations=len(history) - 1,
            seconds=seconds,
            history={"inf_pr": np.zeros(len(history)), **dict(zip(names, np.array(history).T))},
            calls=calls,
        )

    def _tell(self, phase: Phase, iteration: int, row: tuple[float, ...], begin: float) -> None:
        """Pass an iteration on to the listener and to the log file."""
        now = time.perf_counter() - begin
        if self.watch.listener:
            self.watch.listener(Progress(phase.name, iteration, row[0], 0.0, now))
        if self.watch.log_file:
            # a full disk must not end the solve
            with suppress(OSError), open(self.watch.log_file, "a") as log:
                if not iteration:
                    log.write(f"\n{phase.name}: {phase.hessian} Hessian, {self.newton.library}\n")
                    log.write("iter    objective    inf_du   compl  damping\n")
                log.write("{:4d} {:14.7e} {:.2e} {:.2e} {:.2e}\n".format(iteration, *row[:4]))

    def _dual(self, gradient: Float, jacobian: Float) -> tuple[float, Float]:
        """Multiplier of the simplex and the dual infeasibility of every superpixel (N,).

        The multiplier is the slope of the Lagrangian as the whole soup grows. Where E does not
        depend on scale it is near 0 also far from the solution, unlike a least-squares estimate.
        """
        assert self.z is not None
        rest = less_forces(gradient, jacobian, self.z)
        nu = -float(self.problem.growth(self.x) @ rest)
        whole = np.abs(rest + nu * self.problem.length(self.x))
        return nu, whole.reshape(-1, 9).max(axis=1)

    def _curvature(self, at: Point, nu: float, kind: HessianKind) -> Float:
        """Nonzeros of a Hessian with the condensed slacks, of the superpixels that move."""
        assert self.z is not None
        problem = self.problem
        some = problem.moving
        J, ratio = at.jacobian[some], (self.z / at.slack)[some]
        condensed = np.zeros((len(J), 9, 9))
        condensed[:, :3, :3] = np.einsum("nrc,nr,nrd->ncd", J, ratio, J)
        H = problem.hessian(at.x, self.z, kind, nu)
        H[problem.triangles] += condensed[:, problem.triangle[0], problem.triangle[1]]
        return H

    def _adapt(self, move: Move) -> None:
        """Change the damping of every superpixel according to its step."""
        moved, damping = move.point is not None, self.damping
        raised = np.clip(damping * (4 if moved else 8), HELD, DAMPING[1])
        if moved:
            fall = np.where(move.eager, 16.0, np.where(move.calm, 4.0, 1.0))
            damping = np.maximum(damping / fall, DAMPING[0])
        elif not move.far.any():
            damping = np.maximum(8 * damping, HELD)
        self.damping = np.where(move.far, raised, damping)

    def _step_multipliers(self, at: Point, h: Float, barrier: float, moved: Point) -> None:
        """Newton's step of the slacks' multipliers, kept near barrier / slack."""
        assert self.z is not None
        z, b = self.z, barrier
        step = b / at.slack - z - z / at.slack * along(at.jacobian, h)
        z = z + np.minimum(1.0, TO_BOUNDARY * reach(z, step))[:, None] * step
        self.z = np.clip(z, 1e-8 * b / moved.slack, 1e8 * b / moved.slack)
