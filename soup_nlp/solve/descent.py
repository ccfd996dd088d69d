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
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from soup_nlp.geometry.soup import Soup
from soup_nlp.solve.factor import Back, Factorise, diagonal_places, factorisation, same_pattern
from soup_nlp.solve.ipopt import Progress, Stage, Watch
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
    merit_gradient,
    reach,
)
from soup_nlp.solve.part import Part
from soup_nlp.solve.phase import Phase, Reached
from soup_nlp.solve.reuse import held, preconditioned
from soup_nlp.solve.tangent_problem import HessianKind, TangentProblem

Float = NDArray[np.float64]

DAMPING = (1e-7, 1e6)
"""Least and most damping mu of a superpixel."""
HELD = 1e-3
"""Least damping of a superpixel whose step went too far."""
FRESH: Mapping[HessianKind, float] = {"gauss-newton": 1e-2, "exact": 1e-4}
"""Most damping with which a phase begins, and to which it returns where it hardly descends."""
SLOW, PATIENCE = 1e-6, 10
"""Relative decrease of an iteration that is hardly any, and iterations between two such returns."""
BLENDS = (0.0, 0.1, 0.3, 1.0)
"""Shares of the majorant in the exact Hessian, tried until the step is a descent direction."""
REUSE = 4000
"""Superpixels from which a factor serves several iterations, and parts of them move apart: below, a
factorisation costs little."""
INEXACT: Mapping[HessianKind, float] = {"gauss-newton": 0.2, "exact": 0.03}
"""Accuracy of steps with an earlier factor; at 0.3 the majorant stagnates early (N = 8,000)."""


class Step(NamedTuple):
    """A step of the damped system.

    Attributes:
        h: (9 N,) the step.
        bent: (9 N,) its matrix without damping times h.
        blend: Share of the majorant to begin with next time.
        newton: Newton step for another gradient of the merit.
    """

    h: Float
    bent: Float
    blend: float
    newton: Callable[[Float], Float]


class Descent:
    """A descent from the start of a tangent problem, phase by phase."""

    def __init__(
        self,
        problem: TangentProblem,
        *,
        after: Descent | None = None,
        deadline: float = np.inf,
        watch: Watch | None = None,
    ) -> None:
        """Prepare; nothing is solved.

        Args:
            problem: Energy and slacks.
            after: A descent in another chart, whose soup is this problem's base: its point,
                multipliers and damping are where this one begins.
            deadline: Of time.perf_counter().
            watch: Listener, stop and log file.
        """
        self.problem, self.deadline, self.watch = problem, deadline, watch or Watch()
        self.library: str
        self._factorise: Factorise
        if after and same_pattern(problem.upper, after.problem.upper):
            # ordering and symbolic analysis of the other chart serve here as well
            self.library, self._factorise = after.library, after._factorise
        else:
            self.library, self._factorise = factorisation(problem.upper)
        self._diagonal = diagonal_places(problem.upper)
        self._last: Back | None = None
        self._part: Part | None = None
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
        begin, problem = time.perf_counter(), self.problem
        calls = problem.calls()
        problem.smoothing(phase.eps)
        at = evaluate(problem, self.x, phase.barrier)
        assert at is not None, "the iterate is inside its bounds"
        if self.z is None:
            self.z = phase.barrier / at.slack
        self.damping = np.minimum(self.damping, FRESH[phase.hessian])
        gradient = problem.gradient(at.x)
        curvature: tuple[Float, Float] | None = None
        self._part = Part(problem.upper) if len(self.damping) >= REUSE else None
        small, patient, slow, self._last = 0, PATIENCE, False, None
        # of steps of all and of parts; on a large pair four trials are not worth their factors
        blend = {False: BLENDS[2] if self._part else 0.0, True: 0.0}
        barrier = max(phase.highest, phase.barrier)
        history: list[tuple[float, ...]] = []
        reached: Reached | None = None
        for iteration in itertools.count():
            nu, residual = self._dual(gradient, at.jacobian)
            dual = float(residual.max())
            gap = float((at.slack * self.z).max())
            history.append((at.f, dual, gap, float(np.median(self.damping)), 0.0))
            self._tell(phase, iteration, history[-1], begin)
            good = dual <= phase.tol and gap <= max(phase.tol, 2 * phase.barrier)
            enough = reached is not None and not (good and reached.less(dual, gap))
            if good and (reached is None or not enough or dual < reached.row[1]):
                reached = Reached(at, self.z, history[-1])
            if enough or (good and not phase.beyond) or (reached and reached.done(phase)):
                break
            status = self._stopped(phase, iteration, small)
            if status:
                break
            barrier = max(phase.barrier, min(barrier, 1e-6 * dual))
            at = at._replace(merit=merit(at.f, at.slack, barrier))
            if self._part:
                self._part.choose(residual, slow)
            parted = self._part is not None and self._part.some is not None
            if curvature is None:
                curvature = self._curvature(at, phase.hessian, nu)
            step = self._newton(at, curvature, blend[parted], gradient, barrier, phase.hessian)
            search = Search(problem, at, step.h, barrier, step.newton)
            move = search.run(gradient, step.bent)
            self._adapt(move)
            history[-1] = (*history[-1][:4], float(move.length.min()))
            if move.point is None:
                # the majorant's steps descend, and steps with a factor of its own
                self._last = None
                blend[parted] = min(1.0, max(BLENDS[1], 9 * step.blend))
                continue
            fell = at.merit - move.point.merit
            small = small + 1 if fell <= phase.stagnation * abs(at.f) else 0
            slow = fell <= max(phase.stagnation, SLOW) * abs(at.f)
            if phase.hessian == "exact" and fell < SLOW * abs(at.f) and iteration >= patient:
                # held back so far, a superpixel's own step is too short for its slope to tell
                # anything but what its neighbours do, and its damping never falls
                self.damping = np.minimum(self.damping, FRESH["exact"])
                patient = iteration + PATIENCE
            self._step_multipliers(at, step.h, barrier, move.point)
            blend[parted] = step.blend
            at, self.x, curvature = move.point, move.point.x, None
            gradient = search.gradient(at.x)
        if reached:
            status = "Solve_Succeeded"
            # the last step may have been one too many
            at, self.z, history[-1] = reached
            self.x = at.x
            nu, _ = self._dual(problem.gradient(at.x), at.jacobian)
        spent = {k: v - calls[k] for k, v in problem.calls().items()}
        return self._stage(phase, status, at, nu, history, time.perf_counter() - begin, spent)

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
            # a full disk takes the log, not the solve
            with suppress(OSError), open(self.watch.log_file, "a") as log:
                if not iteration:
                    log.write(f"\n{phase.name}: {phase.hessian} Hessian, {self.library}\n")
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

    def _curvature(self, at: Point, kind: HessianKind, nu: float = 0.0) -> tuple[Float, Float]:
        """Hessian to use and the majorant, both with the condensed slacks."""
        assert self.z is not None
        inner = np.einsum("nrc,nr,nrd->ncd", at.jacobian, self.z / at.slack, at.jacobian)
        condensed = np.zeros((len(inner), 9, 9))
        condensed[:, :3, :3] = inner
        own = condensed[:, self.problem.triangle[0], self.problem.triangle[1]]
        out = []
        for each in dict.fromkeys((kind, "gauss-newton")):
            H = self.problem.hessian(at.x, self.z, each, nu)
            H[self.problem.block] += own
            out.append(H)
        return out[0], out[-1]

    def _newton(
        self,
        at: Point,
        curvature: tuple[Float, Float],
        blend: float,
        gradient: Float,
        barrier: float,
        kind: HessianKind,
    ) -> Step:
        """Step of the damped system, with as much of the majorant as makes it descend.

        Args:
            at: Point.
            curvature: Hessian and majorant.
            blend: Share of the majorant to begin with.
            gradient: Of f.
            barrier: b of the merit.
            kind: Of the Hessian.
        """
        exact, majorant = curvature
        damping = np.repeat(self.damping, 9)
        right, a = merit_gradient(at, gradient, barrier), self.problem.length(at.x)
        shares = [blend, *(s for s in BLENDS if s > blend)] if kind == "exact" else [1.0]
        h, bent, newton = np.zeros_like(at.x), np.zeros_like(at.x), held(np.zeros_like, a)
        part = self._part if self._part and self._part.some is not None else None
        for share in shares:
            H = _blended(exact, majorant, share)
            times = self._times(H, damping)
            if self._last and not part:
                newton = held(self._last, a)
                near = preconditioned(times, newton, right, INEXACT[kind])
                if near.solved:
                    h, bent = near.h, near.product
                    self._last = None if near.worn else self._last
                    break
            damped = H.copy()
            damped[self._diagonal] += damping
            try:
                back = (part.factorise if part else self._factorise)(damped)
            except ArithmeticError:
                newton = held(np.zeros_like, a)
                self._last = self._last if part else None
                continue
            newton = held(back, a)
            h = newton(right)
            bent = times(h)
            # a library that cannot see definiteness: test the curvature along the step
            # (Chiang and Zavala 2016)
            if np.isfinite(h).all() and float(h @ bent) > 0 and float(right @ h) <= 0:
                if not part:
                    self._last = back if len(self.damping) >= REUSE else None
                break
        return Step(h, bent - damping * h, share / 3 if share > 0.02 else 0.0, newton)

    def _times(self, H: Float, damping: Float) -> Callable[[Float], Float]:
        """Product of a damped Hessian, given by its nonzeros, with a vector."""
        pattern = self.problem.upper
        U = sparse.csc_matrix((H, pattern.indices, pattern.indptr), pattern.shape)
        lower, twice = U.T, damping - H[self._diagonal]
        return lambda h: np.asarray(U @ h + lower @ h + twice * h)

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


def _blended(exact: Float, majorant: Float, share: float) -> Float:
    """Nonzeros of the Hessian with a share of the majorant."""
    if share in (0.0, 1.0):
        return majorant if share else exact
    return (1 - share) * exact + share * majorant
