"""Ipopt's stages before the constrained NLP: less smoothing, then ever more exact Hessians.

The program is the whole energy in nine coordinates per superpixel, with SO(3) and unit normals by
construction. The first stages use the majorant Hessian (theta = 0), a model above every norm of a
linear residual, so that no inertia has to be corrected. The next ones leave out a growing share
theta of the curvature along each residual, which the exact Hessian does not have either. The exact
Hessian ends the sequence, near enough to its minimum to converge fast.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from soup_nlp.arrays import Float
from soup_nlp.geometry.soup import Soup
from soup_nlp.model import oracle
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.kernel import Hessian
from soup_nlp.model.layout import Chart, Layout, MatrixLayout
from soup_nlp.model.nlp import NLP
from soup_nlp.model.programs import build_matrix_nlp, build_tangent_nlp, exact_chart, majorant
from soup_nlp.solve.ipopt import Stage, run_ipopt, warm
from soup_nlp.solve.solver_options import Stages
from soup_nlp.storage.progress import Watch

_BOTH: Mapping[str, Any] = {
    # the approximate minimum fill ordering
    "mumps_pivot_order": 2,
    "mumps_mem_percent": 100,
    **warm(1e-8),
}
KEEP: Mapping[str, Any] = {
    **_BOTH,
    "mumps_scaling": 0,  # coordinates in units of their superpixel are scaled already
    # a filter takes steps that raise f for a smaller violation of nearly linear rows; with these,
    # f has to fall in every step
    "delta": 1e-20,
    "theta_min_fact": 1e6,
    "theta_max_fact": 1e8,
}
"""Ipopt options of all these stages: MUMPS, and the start from a point and its multipliers."""
KEEP_IN_MATRICES: Mapping[str, Any] = {
    **_BOTH,
    # R'R = I and |n| = 1 have no diagonal entries; delayed pivots would double the time
    "mumps_pivtol": 0.0,
    "mumps_pivtolmax": 0.0,
}
"""The same on the constrained NLP, whose rows are curved: the filter has to take its course."""
LAST: Mapping[str, Any] = {"mu_init": 1e-10}
"""Options of the last stage. A larger barrier would push at constraints that the constrained NLP
does not have in the same variables, and that would then have to iterate."""
THETAS: Mapping[float, float] = {0.5: 0.1, 0.9: 0.1, 0.98: 1e-3}
"""Gauss-Newton stages: theta, and the share of `stagnation` that ends each."""
PATIENT: Mapping[float, float] = {0.98: 1e-4}
"""The same of the last one where all surfaces bend: the exact Hessian has many negative directions
there, and would begin too far from the minimum."""
RIDGE = 1e-2
"""Added to their diagonal: theta leaves some directions without curvature."""
UNTRUNCATED: Mapping[float, float] = {1.0: 0.3, 0.3: 1.0, 0.1: 1.0}
"""Stages of the second strategy with the exact Hessian: smoothing widths, and the share of
`stagnation` that ends each. So smooth, the energy is nearly convex; relief, of which each
reweighted step brings a little, follows the curvature of the residuals at once."""
STOPPED = ("Interrupted", "Time_Limit")
"""Statuses of a stage after which no further stage begins."""


@dataclass
class Presolve:
    """The stages before the constrained NLP.

    Attributes:
        soup: Where the last stage ended.
        data, weights, form, o, watch: Those of `solve_soup`.
        deadline: `time.process_time` at which they end.
        rim: (N, V) multipliers of rim visibility, rows divided by the facing of the anchor, after
            the last stage; None where the presolve ended before it.
        stages: Those that have ended.
    """

    soup: Soup
    data: EnergyData
    weights: Weights
    form: Formulation
    o: Stages
    watch: Watch
    deadline: float
    rim: Float | None = None
    stages: list[Stage] = field(default_factory=list)

    def run(self) -> None:
        """All stages, until one of them is stopped."""
        start, o = self.soup, self.o
        program = self._program(start)
        self._run(program, [_Planned(f"majorant {eps:g}", eps) for eps in o.presolve_eps])
        if o.untruncated and np.isfinite(self.weights.sigma_arap) and not self._stopped():
            program = self._untruncated(start, program)
        if o.exact_iterations and not self._stopped():
            self._to_the_minimum(program)

    def _stopped(self) -> bool:
        return self.stages[-1].status in STOPPED

    def _energy(self, soup: Soup) -> float:
        return oracle.energy(soup, self.data, self.weights)["total"]

    def _program(
        self, soup: Soup, weights: Weights | None = None, chart: Chart = "depth"
    ) -> _Program:
        energy = self.data, weights or self.weights, majorant(self.form)
        if self.o.coordinates == "matrix":
            return _Program(*build_matrix_nlp(soup, *energy))
        nlp, layout = build_tangent_nlp(soup, *energy, chart)
        if chart == "inverse-depth":
            # visibility bounds inverse depths and slopes by itself
            free = np.full(nlp.nx, np.inf)
            nlp = replace(nlp, lbx=-free, ubx=free)
        return _Program(nlp, layout)

    def _untruncated(self, start: Soup, before: _Program) -> _Program:
        """The second strategy: E_arap without its truncation first, then with it; the program of
        the strategy whose soup has the lower energy, which is `soup` then."""
        first, o = self.soup, self.o
        program = self._program(start, self.weights.replace(sigma_arap=np.inf))
        widest = max(UNTRUNCATED)
        self._run(program, [_Planned(f"majorant untruncated {widest:g}", widest, 10.0)])
        exact = [
            _Planned(f"untruncated exact {eps:g}", eps, share) for eps, share in UNTRUNCATED.items()
        ]
        self._run(program, exact, hessian="exact")
        if not self._stopped():
            other = self._program(self.soup)
            other.lam_x, other.lam_g = program.lam_x, program.lam_g
            last = o.presolve_eps[-2:]
            self._run(other, [_Planned(f"majorant truncated {eps:g}", eps) for eps in last])
            if self._energy(self.soup) < self._energy(first):
                return other
        self.soup = min(self.soup, first, key=self._energy)
        return before

    def _to_the_minimum(self, before: _Program) -> None:
        """Gauss-Newton stages with growing theta, then the exact Hessian, at the final smoothing.

        On inverse depths if the energy's units allow it; at their base, charts agree to first
        order, so that the multipliers of the program before serve both.
        """
        o = self.o
        program = before
        if self.o.coordinates == "tangent":
            program = self._program(self.soup, chart=exact_chart(self.data))
            program.lam_g = before.lam_g
            if not self.data.local_units:
                program.lam_x = before.lam_x
        thetas = {**THETAS, **(PATIENT if o.untruncated else {})}
        growing = [
            _Planned(f"Gauss-Newton {theta:g}", o.eps, share, {"theta": theta, "ridge": RIDGE})
            for theta, share in thetas.items()
        ]
        self._run(program, growing, options={"mu_init": 1e-6})
        if not self._stopped():
            last, limit = [_Planned("exact", o.eps, 0.0)], o.exact_iterations
            self._run(program, last, hessian="exact", options=LAST, max_iter=limit)
            self.rim = _rim(program, self.soup, self.data)

    def _run(
        self,
        program: _Program,
        stages: Sequence[_Planned],
        *,
        hessian: Hessian | None = None,
        options: Mapping[str, Any] | None = None,
        max_iter: int | None = None,
    ) -> None:
        """Run stages until one is stopped; `soup` and the program's numbers move along.

        `options` of Ipopt are added to `KEEP`; `max_iter` is `presolve_iterations` by default.
        """
        o, nlp = self.o, program.nlp
        nlp = nlp if hessian is None else replace(nlp, hessian_kind=hessian)
        keep = KEEP if o.coordinates == "tangent" else KEEP_IN_MATRICES
        below = {**keep, **(options or {})}
        for planned in stages:
            if self.stages and self._stopped():
                break
            stage = run_ipopt(
                nlp,
                o.ipopt,
                below,
                x0=program.x,
                lam_x0=program.lam_x,
                lam_g0=program.lam_g,
                p=nlp.thetas(eps=planned.eps, eps_pixel=planned.eps, **planned.theta),
                tol=o.presolve_tol,
                seconds=self.deadline - time.process_time(),
                watch=self.watch,
                max_iter=o.presolve_iterations if max_iter is None else max_iter,
                stagnation=o.stagnation * planned.share,
                stage=planned.name,
            )
            program.x, program.lam_x, program.lam_g = stage.x, stage.lam_x, stage.lam_g
            self.soup = program.layout.unpack(stage.x)
            self.stages.append(stage)
            self.watch.say(str(stage))


class _Planned(NamedTuple):
    """A stage to run: its name, smoothing width, share of `stagnation` that ends it, and further
    parameters of the NLP."""

    name: str
    eps: float
    share: float = 1.0
    theta: Mapping[str, float] = MappingProxyType({})


@dataclass
class _Program:
    """A program of the presolve, with point and multipliers where its last stage ended."""

    nlp: NLP
    layout: Layout

    def __post_init__(self) -> None:
        self.x, self.lam_x, self.lam_g = self.nlp.x0, np.zeros(self.nlp.nx), np.zeros(self.nlp.ng)


def _rim(program: _Program, soup: Soup, data: EnergyData) -> Float:
    """(N, V) multipliers of rim visibility, its rows divided by the facing of the anchor."""
    name = "visible" if isinstance(program.layout, MatrixLayout) else "t_visible"
    rows = next(g for g in program.nlp.groups if g.kernel.name == name).rows
    multipliers = -program.lam_g[rows]
    if isinstance(program.layout, MatrixLayout):
        # the first row is the anchor's
        return multipliers[:, 1:] * -np.einsum("nc,nc->n", soup.n, data.anchor_ray)[:, None]
    return multipliers if program.layout.chart == "depth" else multipliers * program.x[::9, None]
