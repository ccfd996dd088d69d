"""Ipopt alone: stages of decreasing smoothing, then the exact Hessian.

The program is that of the presolve, in nine coordinates per superpixel with SO(3) and unit normals
by construction, but Ipopt takes every step. The first stages use the majorant Hessian (theta = 0),
whose model lies above every norm: full steps descend, and no inertia has to be corrected.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from soup_nlp.arrays import Float
from soup_nlp.geometry.soup import Soup
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
    "warm_start_init_point": "yes",
    "warm_start_bound_push": PUSH,
    "warm_start_bound_frac": PUSH,
    "warm_start_slack_bound_push": PUSH,
    "warm_start_slack_bound_frac": PUSH,
    "warm_start_mult_bound_push": PUSH,
}
"""Ipopt options for a warm start from a point and its multipliers."""
LAST: Mapping[str, Any] = {"mu_init": 1e-6, "mu_target": 1e-10}
"""Options of the stage with the exact Hessian: its barrier ends where the constrained NLP's is."""


@dataclass
class Continuation:
    """The stages before the constrained NLP.

    Attributes:
        soup: Where the last stage ended.
        data: Pixels, graphs and weights of the pair.
        weights: Constants of the energy.
        form: Visibility, and whether kernels are compiled.
        o: Widths, limits and stagnation, those of the presolve.
        watch: Listeners, stop event and log.
        deadline: `time.perf_counter` at which they end.
        rim: (N, V) multipliers of rim visibility as in `Descent.rim`, after the exact Hessian.
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
        o, form = self.o, majorant(self.form)
        nlp, layout = build_tangent_nlp(self.soup, self.data, self.weights, form)
        given: dict[str, Any] = {"x0": nlp.x0}
        last = len(o.presolve_eps) - 1
        for k, eps in enumerate(o.presolve_eps):
            stage = self._stage(
                nlp,
                {**(KEEP if k else {}), **o.ipopt},
                **given,
                p=nlp.thetas(eps=eps, eps_pixel=eps),
                max_iter=o.presolve_iterations,
                stagnation=o.stagnation * (0.01 if k == last else 1.0),
                stage=f"continuation {eps:g}",
            )
            self.soup = layout.unpack(stage.x)
            if stage.status in ("Interrupted", "Time_Limit"):
                return
            given = {"x0": stage.x, "lam_x0": stage.lam_x, "lam_g0": stage.lam_g}
        if o.polish_iterations:
            self._exact(form.replace(hessian="exact"))

    def _exact(self, form: Formulation) -> None:
        o, chart = self.o, polish_chart(self.data)
        nlp, layout = build_tangent_nlp(self.soup, self.data, self.weights, form, chart)
        stage = self._stage(
            nlp,
            {**LAST, **o.ipopt},
            x0=nlp.x0,
            p=nlp.thetas(eps=o.eps, eps_pixel=o.eps),
            max_iter=o.polish_iterations,
            stage="continuation exact",
        )
        self.soup, self.rim = layout.unpack(stage.x), _rim(nlp, layout, stage)

    def _stage(self, nlp: NLP, options: Mapping[str, Any], **given: Any) -> Stage:
        stage = Ipopt(nlp, options)(
            **given,
            tol=self.o.presolve_tol,
            seconds=max(1.0, self.deadline - time.perf_counter()),
            watch=self.watch,
        )
        self.stages.append(stage)
        self.watch.say(str(stage))
        return stage


def _rim(nlp: NLP, layout: TangentLayout, stage: Stage) -> Float:
    """(N, V) multipliers of rim visibility, its rows divided by the facing of the anchor."""
    rows = next(g for g in nlp.groups if g.kernel.name == "t_visible").table.rows
    own = -stage.lam_g[rows]
    return own if layout.chart == "depth" else own * stage.x[::9, None]
