"""Ipopt's stages before the constrained NLP: less smoothing, then ever more exact Hessians.

The program is the whole energy in nine coordinates per superpixel, with SO(3) and unit normals by
construction; Ipopt takes every step. The first stages use the majorant Hessian (theta = 0), whose
model lies above every norm: full steps descend, and no inertia has to be corrected. The next ones
leave out a growing share theta of the curvature along each residual, which the exact Hessian does
not have either. The exact Hessian ends the sequence, near enough to its minimum to converge fast.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from soup_nlp.arrays import Float
from soup_nlp.geometry.soup import Soup
from soup_nlp.model import oracle
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.layout import TangentLayout
from soup_nlp.model.nlp import NLP
from soup_nlp.model.tangent_nlp import build_tangent_nlp, majorant, polish_chart
from soup_nlp.solve.ipopt import Ipopt, Stage
from soup_nlp.solve.solver_options import SolverOptions
from soup_nlp.storage.progress import Watch

PUSH = 1e-8
KEEP: Mapping[str, Any] = {
    # the approximate minimum fill ordering, and no matching, which the constrained NLP needs
    "mumps_pivot_order": 2,
    "mumps_permuting_scaling": 0,
    "mumps_mem_percent": 100,
    "warm_start_init_point": "yes",
    "warm_start_bound_push": PUSH,
    "warm_start_bound_frac": PUSH,
    "warm_start_slack_bound_push": PUSH,
    "warm_start_slack_bound_frac": PUSH,
    "warm_start_mult_bound_push": PUSH,
}
"""Ipopt options of all these stages: MUMPS, and the start from a point and its multipliers."""
LAST: Mapping[str, Any] = {"mu_init": 1e-8, "mu_target": 1e-10}
"""Options of the stage with the exact Hessian. A larger barrier would push at constraints that the
constrained NLP does not have in the same variables, and that would then have to iterate."""
THETAS: Mapping[float, float] = {0.5: 0.1, 0.9: 1e-3}
"""Gauss-Newton stages: theta, and the share of `stagnation` that ends each."""
RIDGE = 1e-2
"""Added to their diagonal: theta leaves some directions without curvature."""
EXACT = "exact"
"""Name of the stage with the exact Hessian."""
STOPPED = ("Interrupted", "Time_Limit")
"""Statuses of a stage after which no further stage begins."""


@dataclass
class Continuation:
    """The stages before the constrained NLP.

    Attributes:
        soup: Where the last stage ended.
        data: Pixels, graphs and weights of the pair.
        weights: Constants of the energy.
        form: Visibility, and whether kernels are compiled.
        o: Widths, limits and stagnation.
        watch: Listeners, stop event and log.
        deadline: `time.perf_counter` at which they end.
        rim: (N, V) multipliers of rim visibility, rows divided by the facing of the anchor, after
            the exact Hessian.
        stages: Those that have ended.
    """

    soup: Soup
    data: EnergyData
    weights: Weights
    form: Formulation
    o: SolverOptions
    watch: Watch
    deadline: float
    rim: Float = field(default_factory=lambda: np.zeros(0))
    stages: list[Stage] = field(default_factory=list)

    def run(self) -> None:
        """All stages, until one of them is stopped."""
        start, widths, sigma = self.soup, self.o.presolve_eps, self.weights.sigma_arap
        given = self._majorant(start, widths)
        if self.o.untruncated and np.isfinite(sigma) and not self._stopped():
            given = self._untruncated(start, given)
        if self.o.polish_iterations and not self._stopped():
            self._newton(given)

    def _stopped(self) -> bool:
        return self.stages[-1].status in STOPPED

    def _untruncated(self, start: Soup, given: dict[str, Any]) -> dict[str, Any]:
        """The second strategy: E_arap without its truncation first, then with it.

        Returns:
            Multipliers of the strategy whose soup has the lower energy, which is `soup` then.
        """
        first, o = self.soup, self.o
        whole = self.weights.replace(sigma_arap=np.inf)
        self._majorant(start, o.presolve_eps, whole, "untruncated ")
        if not self._stopped():
            other = self._majorant(self.soup, o.presolve_eps[-1:], kind="truncated ")
            if self._energy(self.soup) < self._energy(first):
                return other
        self.soup = min(self.soup, first, key=self._energy)
        return given

    def _energy(self, soup: Soup) -> float:
        return oracle.energy(soup, self.data, self.weights)["total"]

    def _majorant(
        self, start: Soup, widths: tuple[float, ...], weights: Weights | None = None, kind: str = ""
    ) -> dict[str, Any]:
        """Stages with theta = 0 of decreasing smoothing, on depths; `soup` is where they end.

        Returns:
            The multipliers there, for `lam_x0` and `lam_g0`.
        """
        o, form = self.o, majorant(self.form)
        nlp, layout = build_tangent_nlp(start, self.data, weights or self.weights, form)
        solver, x, given = Ipopt(nlp, {**KEEP, **o.ipopt}), nlp.x0, _no_multipliers(nlp)
        for eps in widths:
            stage = self._stage(
                solver,
                x0=x,
                **given,
                p=nlp.thetas(eps=eps, eps_pixel=eps),
                max_iter=o.presolve_iterations,
                stagnation=o.stagnation,
                stage=f"majorant {kind}{eps:g}",
            )
            x, given = stage.x, {"lam_x0": stage.lam_x, "lam_g0": stage.lam_g}
            self.soup = layout.unpack(x)
            if self._stopped():
                break
        return given

    def _newton(self, given: dict[str, Any]) -> None:
        """Gauss-Newton stages with growing theta, then the exact Hessian, at the final smoothing.

        On inverse depths if the energy's units allow it; at their base, charts agree to first
        order, so that the multipliers serve both.
        """
        o, form, chart = self.o, majorant(self.form), polish_chart(self.data)
        nlp, layout = build_tangent_nlp(self.soup, self.data, self.weights, form, chart)
        if chart == "inverse-depth":
            # visibility bounds inverse depths and slopes by itself
            free = np.full(nlp.nx, np.inf)
            nlp = replace(nlp, lbx=-free, ubx=free)
            given = {**given, "lam_x0": np.zeros(nlp.nx)}
        x, solver = nlp.x0, Ipopt(nlp, {**KEEP, "mu_init": 1e-6, **o.ipopt})
        for theta, share in THETAS.items():
            stage = self._stage(
                solver,
                x0=x,
                **given,
                p=nlp.thetas(eps=o.eps, eps_pixel=o.eps, theta=theta, ridge=RIDGE),
                max_iter=o.presolve_iterations,
                stagnation=o.stagnation * share,
                stage=f"Gauss-Newton {theta:g}",
            )
            x, given = stage.x, {"lam_x0": stage.lam_x, "lam_g0": stage.lam_g}
            self.soup = layout.unpack(x)
            if self._stopped():
                return
        stage = self._stage(
            Ipopt(replace(nlp, hessian="exact"), {**KEEP, **LAST, **o.ipopt}),
            x0=x,
            **given,
            p=nlp.thetas(eps=o.eps, eps_pixel=o.eps),
            max_iter=o.polish_iterations,
            stage=EXACT,
        )
        self.soup, self.rim = layout.unpack(stage.x), _rim(nlp, layout, stage)

    def _stage(self, solver: Ipopt, **given: Any) -> Stage:
        stage = solver(
            **given,
            tol=self.o.presolve_tol,
            seconds=max(1.0, self.deadline - time.perf_counter()),
            watch=self.watch,
        )
        self.stages.append(stage)
        self.watch.say(str(stage))
        return stage


def _no_multipliers(nlp: NLP) -> dict[str, Any]:
    return {"lam_x0": np.zeros(nlp.nx), "lam_g0": np.zeros(nlp.ng)}


def _rim(nlp: NLP, layout: TangentLayout, stage: Stage) -> Float:
    """(N, V) multipliers of rim visibility, its rows divided by the facing of the anchor."""
    rows = next(g for g in nlp.groups if g.kernel.name == "t_visible").table.rows
    own = -stage.lam_g[rows]
    return own if layout.chart == "depth" else own * stage.x[::9, None]
