"""Steps of the presolve's damped Newton system: factorised, or by the factor of an earlier one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from scipy import sparse

from soup_nlp.arrays import Float, Int
from soup_nlp.solve.dissection import dissected
from soup_nlp.solve.factor import Back, Factorise, diagonal_places, factorisation, same_pattern
from soup_nlp.solve.line_search import Point, merit_gradient
from soup_nlp.solve.part import Block, Part
from soup_nlp.solve.reuse import held, preconditioned
from soup_nlp.solve.tangent_problem import HessianKind, TangentProblem

Curvature = Callable[[HessianKind], Float]

BLENDS = (0.0, 0.1, 0.3, 1.0)
"""Shares of the majorant in the exact Hessian, tried until the step is a descent direction."""
REUSE = 4000
"""Least number of superpixels for which a factor serves several iterations, a part of them may move
alone and the image is dissected; with fewer, a factorisation costs little."""
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


class Newton:
    """Solves the damped system of one tangent problem.

    Attributes:
        library: Library that factorises.
    """

    library: str
    _factorise: Factorise

    def __init__(self, problem: TangentProblem, after: Newton | None = None) -> None:
        """Analyse the pattern of the Hessian.

        Args:
            problem: Energy and slacks.
            after: Of a problem in another chart; its analysis is used where the pattern is equal.
        """
        self.problem = problem
        if after and same_pattern(problem.upper, after.problem.upper):
            self.library, self._factorise = after.library, after._factorise
        else:
            large = problem.layout.count >= REUSE
            self.library, self._factorise = factorisation(
                problem.upper, self._order if large else None
            )
        self._diagonal = diagonal_places(problem.upper)
        self.begin()

    def begin(self) -> None:
        """Begin a phase: forget earlier factors, and move all superpixels."""
        count = self.problem.layout.count
        self._last: Back | None = None
        self._part = Part(self.problem.upper) if count >= REUSE else None
        # by `_parted`; on a large pair one trial costs too much to begin without the majorant
        self._blend = {False: BLENDS[2] if self._part else 0.0, True: 0.0}

    def _order(self) -> Int:
        """Order of elimination of a large problem."""
        return dissected(self.problem.upper, self.problem.layout.anchor[:, :2])

    @property
    def moving(self) -> Block | None:
        """The superpixels that move, the others held; None for all."""
        return self._part.block if self._part else None

    @property
    def _parted(self) -> bool:
        return self.moving is not None

    def _where(self) -> tuple[sparse.csc_matrix, Int, Int | slice]:
        """Upper triangle of the Hessian of what moves, its diagonal, and the unknowns it is of."""
        block = self.moving
        if block:
            return block.pattern, block.diagonal, block.unknowns
        return self.problem.upper, self._diagonal, slice(None)

    def choose(self, residual: Float, slow: bool) -> None:
        """Choose which superpixels move next; see `Part.choose`."""
        if self._part:
            self._part.choose(residual, slow)

    def accept(self, step: Step) -> None:
        """The line search found a point along a step."""
        self._blend[self._parted] = step.blend

    def refuse(self, step: Step) -> None:
        """The line search found none: the next step has more of the majorant and a new factor."""
        self._last = None
        self._blend[self._parted] = min(1.0, max(BLENDS[1], 9 * step.blend))

    def step(
        self,
        at: Point,
        curvature: Curvature,
        gradient: Float,
        barrier: float,
        kind: HessianKind,
        damping: Float,
    ) -> Step:
        """Step of the damped system, with as much of the majorant as makes it descend.

        Args:
            at: Point.
            curvature: Nonzeros of a Hessian by its kind, of the superpixels that move; made when
                first asked for.
            gradient: Of f.
            barrier: b of the merit.
            kind: Of the Hessian.
            damping: (N,) of every superpixel.
        """
        damping = np.repeat(damping, 9)
        blend, right = self._blend[self._parted], merit_gradient(at, gradient, barrier)
        a = self.problem.length(at.x)
        shares = [blend, *(s for s in BLENDS if s > blend)] if kind == "exact" else [1.0]
        h, bent, newton = np.zeros_like(at.x), np.zeros_like(at.x), held(np.zeros_like, a)
        part = self._part if self._parted else None
        _, diagonal, own = self._where()
        for share in shares:
            H = _blended(curvature, share)
            times = self._times(H, damping)
            if self._last and not part:
                newton = held(self._last, a)
                near = preconditioned(times, newton, right, INEXACT[kind])
                if near.solved:
                    h, bent = near.h, near.product
                    self._last = None if near.worn else self._last
                    break
                if near.indefinite and share < 1:
                    # its factorisation would fail
                    self._last = None
                    continue
            damped = H.copy()
            damped[diagonal] += damping[own]
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
                    self._last = back if self.problem.layout.count >= REUSE else None
                break
        return Step(h, bent - damping * h, share / 3 if share > 0.02 else 0.0, newton)

    def _times(self, H: Float, damping: Float) -> Callable[[Float], Float]:
        """Product of a damped Hessian, given by its nonzeros, with a vector; zero for superpixels
        that are held."""
        pattern, diagonal, own = self._where()
        U = sparse.csc_matrix((H, pattern.indices, pattern.indptr), pattern.shape)
        lower, twice = U.T, damping[own] - H[diagonal]

        def times(h: Float) -> Float:
            out = np.zeros_like(h)
            out[own] = U @ h[own] + lower @ h[own] + twice * h[own]
            return out

        return times


def _blended(curvature: Curvature, share: float) -> Float:
    """Nonzeros of the Hessian with a share of the majorant."""
    if share in (0.0, 1.0):
        return curvature("gauss-newton" if share else "exact")
    out = (1 - share) * curvature("exact")
    out += share * curvature("gauss-newton")
    return out
