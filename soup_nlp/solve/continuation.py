"""Ipopt alone: the smoothing narrowed from stage to stage, each from where the last one ended.

The majorant Hessian (theta = 0) comes first: it lies above every norm, so that full steps descend
and no inertia has to be corrected. The exact Hessian comes at the end.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soup_nlp.model.nlp import NLP
from soup_nlp.solve.ipopt import Ipopt, Stage, Watch
from soup_nlp.solve.solver_options import SolverOptions

Float = NDArray[np.float64]

MAJORANT = "gauss-newton+constraints"
"""Hessian of the stages: the majorant of the norms, the exact one of the constraints."""
PUSH = 1e-8
KEEP: Mapping[str, Any] = {
    "warm_start_init_point": "yes",
    "warm_start_bound_push": PUSH,
    "warm_start_bound_frac": PUSH,
    "warm_start_slack_bound_push": PUSH,
    "warm_start_slack_bound_frac": PUSH,
    "warm_start_mult_bound_push": PUSH,
}
"""Options by which Ipopt goes on from a point and its multipliers."""


def narrow(nlp: NLP, o: SolverOptions, watch: Watch, deadline: float) -> list[Stage]:
    """The stages before the last: `presolve_eps` with the majorant, until f stagnates.

    Args:
        nlp: With the Hessian MAJORANT.
        o: Widths, limits and stagnation, those of the presolve.
        watch: Who follows.
        deadline: `time.perf_counter` at which they end.
    """
    stages: list[Stage] = []
    given: dict[str, Any] = {"x0": nlp.x0}
    last = len(o.presolve_eps) - 1
    for k, eps in enumerate(o.presolve_eps):
        stage = Ipopt(nlp, {**(KEEP if stages else {}), **o.ipopt})(
            **given,
            p=nlp.with_theta(eps=eps, eps_pixel=eps, theta=0.0),
            max_iter=o.presolve_iterations,
            tol=o.presolve_tol,
            seconds=max(1.0, deadline - time.perf_counter()),
            stagnation=o.stagnation * (0.01 if k == last else 1.0),
            stage=f"continuation {eps:g}",
            listener=watch.listener,
            stop=watch.stop,
            log_file=watch.log_file,
        )
        stages.append(stage)
        watch.say(str(stage))
        if stage.status in ("Interrupted", "Time_Limit"):
            break
        given = {"x0": stage.x, "lam_x0": stage.lam_x, "lam_g0": stage.lam_g}
    return stages
