"""Line search of the presolve with a separate step length for every superpixel.

A step that is too long for a few superpixels is first shortened for these alone, then for all by
the same factor, and finally to the length that the bounds allow for every superpixel. A step that
still descends at its end is doubled, first for all and then for the superpixels that still descend,
since an evaluation of the energy costs a tenth of an iteration. A step that leaves the floor of a
curved valley is corrected by further Newton steps with the same matrix.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from soup_nlp.arrays import Float, Mask
from soup_nlp.solve.tangent_problem import TangentProblem

TO_BOUNDARY = 0.99
"""Fraction-to-the-boundary rule: share of the step to a vanishing slack that is taken."""
LEAST_SLACK = 1e-3
"""A slack keeps at least this share of itself."""
TRIES = 4
"""Largest number of shorter steps that are tried after the full one."""
SHORTER = 0.25
"""Factor by which a step is shortened."""
BACK = 3
"""Most corrections that bring a superpixel back inside curved bounds."""
CORRECTIONS = 6
"""Most further Newton steps with one matrix."""
WORTH = 0.05
"""Least decrease of the merit by such a step, as a share of the decrease before it."""


class Point(NamedTuple):
    """A point with its energy and slacks.

    Attributes:
        x: (9 N,) variables.
        f: Smoothed energy.
        merit: f - barrier x sum log slack.
        slack: (N, R) slacks.
        jacobian: (N, R, 3) their derivatives by scale and slopes.
    """

    x: Float
    f: float
    merit: float
    slack: Float
    jacobian: Float


class Move(NamedTuple):
    """Result of a line search.

    Attributes:
        point: New point, or None: the merit falls at no length.
        length: (N,) share of the step that every superpixel took.
        far: (N,) superpixels that went past their minimum.
        calm: (N,) those that ended where the quadratic model predicts.
        eager: (N,) those that still descend at the end: the step was short for them.
    """

    point: Point | None
    length: Float
    far: Mask
    calm: Mask
    eager: Mask


def own(h: Float, other: Float) -> Float:
    """(N,) inner products of every superpixel's share of two vectors (9 N,)."""
    return np.einsum("nc,nc->n", h.reshape(-1, 9), other.reshape(-1, 9))


def reach(value: Float, change: Float) -> Float:
    """(N,) share of a change (N, R) at which the first positive value (N, R) would vanish."""
    with np.errstate(divide="ignore"):
        return np.where(change < 0, -value / change, np.inf).min(axis=1)


def along(jacobian: Float, h: Float) -> Float:
    """(N, R) changes of the slacks along a step (9 N,)."""
    return np.einsum("nrc,nc->nr", jacobian, h.reshape(-1, 9)[:, :3])


def merit_gradient(at: Point, gradient: Float, barrier: float) -> Float:
    """(9 N,) gradient of `f - barrier sum log slack` at a point, from that of f."""
    return less_forces(gradient, at.jacobian, barrier / at.slack)


def less_forces(gradient: Float, jacobian: Float, force: Float) -> Float:
    """(9 N,) gradient less the forces (N, R) of the slacks, whose derivatives are (N, R, 3)."""
    out = gradient.reshape(-1, 9).copy()
    out[:, :3] -= np.einsum("nrc,nr->nc", jacobian, force)
    return out.ravel()


def inside(problem: TangentProblem, x: Float) -> Float:
    """x on the simplex, with slopes shrunk until every slack is positive."""
    x = problem.normalise(x)
    for _ in range(200):
        out = (problem.slacks(x)[0] <= 0).any(axis=1)
        if not out.any():
            break
        x.reshape(-1, 9)[out, 1:3] *= 0.9
    return x


def restored(
    problem: TangentProblem, x: Float, aim: Float, floor: Float
) -> tuple[Float, Float, Float]:
    """x with superpixels that left a curved bound brought back; its slacks and their derivatives.

    A step along a curved bound leaves it by the square of its length, however small the slack. The
    shortest change restores the slack that the linearisation predicts, bound by bound.

    Args:
        problem: Slacks.
        x: (9 N,) end of a step.
        aim: (N, R) linearised slacks, positive.
        floor: (N, R) least slacks.
    """
    slack, jacobian = problem.slacks(x)
    for _ in range(BACK):
        out = np.flatnonzero((slack <= floor).any(axis=1))
        if not len(out):
            break
        worst = np.argmin(slack[out] - aim[out], axis=1)
        normal = jacobian[out, worst]
        lacks = (aim - slack)[out, worst] / np.einsum("nc,nc->n", normal, normal)
        x = x.copy()
        x.reshape(-1, 9)[out, :3] += lacks[:, None] * normal
        x = problem.normalise(x)
        slack, jacobian = problem.slacks(x)
    return x, slack, jacobian


def evaluate(
    problem: TangentProblem, x: Float, barrier: float, floor: Float | float = 0.0
) -> Point | None:
    """Energy and slacks at x; None where a slack is not above `floor`."""
    slack, jacobian = problem.slacks(x)
    return None if (slack <= floor).any() else _point(problem, x, slack, jacobian, barrier)


def _point(
    problem: TangentProblem, x: Float, slack: Float, jacobian: Float, barrier: float
) -> Point:
    f = problem.value(x)
    return Point(x, f, merit(f, slack, barrier), slack, jacobian)


def merit(f: float, slack: Float, barrier: float) -> float:
    """`f - barrier sum log slack`, infinite where that is not finite."""
    value = f - barrier * float(np.log(slack).sum())
    return value if np.isfinite(value) else np.inf


class Search:
    """The search along one step from one point."""

    def __init__(
        self,
        problem: TangentProblem,
        at: Point,
        h: Float,
        barrier: float,
        newton: Callable[[Float], Float],
    ) -> None:
        """Prepare; nothing is evaluated.

        Args:
            problem: Energy and slacks.
            at: Where the step begins.
            h: (9 N,) the step.
            barrier: b of `f - b sum log c`.
            newton: Newton step (9 N,) for a gradient of the merit (9 N,), by the matrix of h.
        """
        self.problem, self.at, self.h, self.barrier = problem, at, h, barrier
        self.newton = newton
        self._known: tuple[Float, Float] | None = None

    def gradient(self, x: Float) -> Float:
        """Gradient of f at a point of the search (9 N,); the last one is kept."""
        if self._known is None or self._known[0] is not x:
            self._known = x, self.problem.gradient(x)
        return self._known[1]

    def _at(self, length: Float) -> Float:
        return self.problem.normalise(self.at.x + (length[:, None] * self.h.reshape(-1, 9)).ravel())

    def _slope(self, x: Float) -> Float:
        return own(self.h, self.gradient(x))

    def run(self, gradient: Float, bent: Float) -> Move:
        """Find a lower merit.

        Args:
            gradient: (9 N,) of f at the point.
            bent: (9 N,) Hessian times step.
        """
        at, h = self.at, self.h
        length = np.minimum(1.0, TO_BOUNDARY * reach(at.slack, along(at.jacobian, h)))
        before = own(h, gradient)
        scale = np.abs(own(h, bent)) + np.abs(before) + 1e-5 * abs(at.f) / len(length)
        # where the predicted decrease is tiny, energies are equal up to rounding
        promised = -0.5 * float(gradient @ h)
        rounding = (1e-10 if promised < 1e-9 * abs(at.f) else 1e-12) * abs(at.merit)
        far, whole, least = np.zeros(len(length), bool), length, 1.0
        calm = eager = far
        for attempt in range(TRIES + 1):
            trial, length = self._feasible(length)
            if not attempt:
                least = float(length.min())
            slope = self._slope(trial.x)
            corrected = self._corrected(trial)
            # past its minimum along the step, by more than the quadratic model allows
            here = ~(slope <= 0.5 * scale)
            far = far | here
            calm = (slope <= 0.1 * scale) & ~far
            # still descending at half the first rate
            eager = (slope < 0.5 * before) & (slope < -0.02 * scale) & ~far
            falls = trial.merit < at.merit + rounding
            better = corrected is not None and corrected.merit < min(trial.merit, at.merit)
            if better and not falls:
                # the step left the curved valley, but was not too long
                none = np.zeros_like(far)
                return Move(corrected, length, none, none, none)
            if falls:
                moved = self._longer(trial, length, eager, before, rounding)
                if corrected is not None and better and corrected.merit < moved.merit:
                    moved = corrected
                return Move(moved, length, far, calm, eager)
            if here.any() and attempt < TRIES // 2:
                length = np.where(here, SHORTER * length, length)
            elif attempt < TRIES - 1:
                # stiff norms between neighbours oppose steps that differ
                length, whole = SHORTER * whole, SHORTER * whole
            elif least < 1:
                # bounds made them differ: all take the share that the bounds leave to every one
                length = np.full_like(length, min(SHORTER, least))
            else:
                break
        return Move(None, length, far, calm, eager)

    def _corrected(self, trial: Point) -> Point | None:
        """The trial after further Newton steps with the same matrix, or None.

        Norms near zero are stiff: a step along their curved valley leaves its floor by the square
        of the step, and would have to be short without correction. A correction costs a tenth of a
        factorisation.
        """
        best = None
        for _ in range(CORRECTIONS):
            right = merit_gradient(trial, self.gradient(trial.x), self.barrier)
            c = self.newton(right)
            length = np.minimum(1.0, TO_BOUNDARY * reach(trial.slack, along(trial.jacobian, c)))
            x = self.problem.normalise(trial.x + (length[:, None] * c.reshape(-1, 9)).ravel())
            floor = LEAST_SLACK * self.at.slack
            aim = trial.slack + length[:, None] * along(trial.jacobian, c)
            x, slack, jacobian = restored(self.problem, x, np.maximum(aim, 2 * floor), floor)
            if (slack <= floor).any():
                return best
            moved = _point(self.problem, x, slack, jacobian, self.barrier)
            if best is not None:
                fell = best.merit - moved.merit
                if not fell > WORTH * abs(self.at.merit - best.merit):
                    return moved if fell > 0 else best
            best = trial = moved
        return best

    def _feasible(self, length: Float) -> tuple[Point, Float]:
        """The point at these lengths and the lengths, halved where a slack would vanish."""
        length, floor = length.copy(), LEAST_SLACK * self.at.slack
        change = along(self.at.jacobian, self.h)
        for _ in range(40):
            aim = self.at.slack + length[:, None] * change
            x, slack, jacobian = restored(self.problem, self._at(length), aim, floor)
            out = (slack <= floor).any(axis=1)
            if not out.any():
                return _point(self.problem, x, slack, jacobian, self.barrier), length
            length[out] *= 0.5
        return self.at, np.zeros_like(length)

    def _longer(
        self, moved: Point, length: Float, eager: Mask, before: Float, rounding: float
    ) -> Point:
        """Double the step while the merit falls: of all, then of those that still descend.

        A decrease within rounding does not count.
        """
        for every in (True, False):
            some = np.ones_like(eager) if every else eager
            for _ in range(7):
                if not some.any():
                    break
                longer = np.where(some, 2 * length, length)
                x = self._at(longer)
                trial = evaluate(self.problem, x, self.barrier, LEAST_SLACK * self.at.slack)
                if trial is None or not trial.merit < moved.merit - rounding:
                    break
                moved, length = trial, longer
                if not every:
                    some = some & (self._slope(x) < 0.5 * before)
        return moved
