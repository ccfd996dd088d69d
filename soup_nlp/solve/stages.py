"""Solve from an initialisation: Ipopt in tangent coordinates, then on the constrained NLP."""

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from soup_nlp.arrays import Float
from soup_nlp.geometry.constraints import constraints
from soup_nlp.geometry.plane import tilt_to_camera
from soup_nlp.geometry.soup import Soup
from soup_nlp.model import oracle
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.nlp import NLP
from soup_nlp.model.programs import build_matrix_nlp
from soup_nlp.solve.ipopt import Stage, run_ipopt
from soup_nlp.solve.kkt import UNMET, WARM, residuals, warm_start
from soup_nlp.solve.presolve import Presolve
from soup_nlp.solve.solver_options import Stages
from soup_nlp.storage.progress import Watch

SAME = 1 + 1e-6
"""Ratio of exact energies up to which they are the same."""


@dataclass(frozen=True, eq=False)
class Solution:
    """Result of a solve.

    Attributes:
        soup: Solution: Ipopt's answer (best iterate when not converged), or the presolve's or the
            start where that has the lower exact energy, with rounding-size constraint violations
            retracted.
        status: Ipopt's status of the constrained NLP, or why it was stopped.
        converged: Whether Ipopt reports success and the constraints hold.
        stages: Ipopt's of the presolve, then that of the constrained NLP.
        energy_start: Exact energy by term of the start.
        energy: Exact energy by term of the solution.
        residuals: Largest violation by kind of constraint, recomputed from the arrays, and the
            dual infeasibility and complementarity of the NLP at the solution.
        multipliers: lam_g by constraint name, lam_x.
        nlp: Sizes of the constrained NLP.
        seconds: Wall time of "presolve", "build" and "solve".
        delivered: What `soup` is: "constrained NLP", "presolve" or "start".
        ends: Exact energy where the "start", the "presolve" and the "constrained NLP" ended.
    """

    soup: Soup
    status: str
    converged: bool
    stages: tuple[Stage, ...]
    energy_start: Mapping[str, float]
    energy: Mapping[str, float]
    residuals: Mapping[str, float]
    multipliers: Mapping[str, Float] = field(default_factory=dict, repr=False)
    nlp: Mapping[str, int] = field(default_factory=dict)
    seconds: Mapping[str, float] = field(default_factory=dict)
    delivered: str = "constrained NLP"
    ends: Mapping[str, float] = field(default_factory=dict)

    def __str__(self) -> str:
        return (
            f"Solution({self.status}, E {self.energy_start['total']:.4g} ->"
            f" {self.energy['total']:.4g}, {sum(s.iterations for s in self.stages)} iterations)"
        )

    __repr__ = __str__


def solve_soup(
    start: Soup,
    data: EnergyData,
    weights: Weights,
    form: Formulation | None = None,
    options: Stages | None = None,
    *,
    watch: Watch | None = None,
) -> Solution:
    """Minimise E from a start.

    Args:
        start: Initial soup.
        data: Pixels, graphs and weights of the pair.
        weights: Constants of the energy.
        form: Formulation of the constrained NLP.
        options: Stages and limits.
        watch: Listeners, stop event and log; a stop keeps the best iterate.

    Returns:
        The solution; a solve that fails is a Solution with its status, not an exception.
    """
    form, o, watch = form or Formulation(), options or Stages(), watch or Watch()
    begin, seconds, mark = time.process_time(), dict[str, float](), time.perf_counter()

    def ended(stage: str) -> None:
        seconds[stage] = time.perf_counter() - mark - sum(seconds.values())

    def energy(soup: Soup) -> float:
        return oracle.energy(soup, data, weights)["total"]

    # the last stage has the rest of the time
    first = Presolve(start, data, weights, form, o, watch, begin + 0.7 * o.max_seconds)
    if o.presolve_iterations:
        first.run()
    ended("presolve")
    near = bool(first.stages) and _near(first.stages[-1])
    # far from its minimum the presolve may have raised the exact energy
    worse = not near and energy(first.soup) > energy(start)
    soup = start if worse else first.soup
    nlp, layout = build_matrix_nlp(soup, data, weights, form.replace(eps=o.eps, eps_pixel=o.eps))
    watch.say(str(nlp))
    # a presolve that was stopped before its last stage has no multipliers
    given: dict[str, Any] = {}
    if first.rim is not None and near and not worse:
        given = warm_start(nlp, data, soup, first.rim)
    ended("build")
    stage = run_ipopt(
        nlp,
        o.ipopt,
        WARM if given else {},
        x0=nlp.x0,
        **given,
        max_iter=o.max_iter,
        tol=o.tol,
        seconds=begin + o.max_seconds - time.process_time(),
        stage="constrained NLP",
        watch=watch,
    )
    ended("solve")
    watch.say(str(stage))
    candidates = {"start": start, "presolve": first.soup, "constrained NLP": layout.unpack(stage.x)}
    if not o.presolve_iterations:
        del candidates["presolve"]
    ends = {k: s.normalised(data.share).retracted() for k, s in candidates.items()}
    admissible = _admissible(ends, start, data, form)

    def rank(name: str) -> float:
        # energies at one minimum differ by what the smoothing hides
        same = stage.converged and name == "constrained NLP"
        return energy(admissible[name]) / (SAME if same else 1.0)

    # the later one of equals
    delivered = min(reversed(admissible), key=rank)
    final = admissible[delivered]
    # a reported success counts only where the constraints hold
    broken = stage.converged and "constrained NLP" not in admissible
    return Solution(
        soup=final,
        status=UNMET if broken else stage.status,
        converged=stage.converged and not broken,
        stages=(*first.stages, stage),
        energy_start=oracle.energy(start, data, weights),
        energy=oracle.energy(final, data, weights),
        residuals=residuals(nlp, final, stage, data, form.min_facing),
        multipliers=multipliers(nlp, stage),
        nlp=nlp.sizes(),
        seconds=seconds,
        delivered=delivered,
        ends={k: energy(s) for k, s in ends.items()},
    )


def _near(stage: Stage) -> bool:
    """Whether the presolve ended so near a minimum that Ipopt should start from its multipliers."""
    # Ipopt that fails at its first point has no history
    dual = stage.history.get("inf_du", np.array([np.inf]))
    return stage.converged or bool(dual[-1] < 1.0)


def _admissible(
    ends: Mapping[str, Soup], start: Soup, data: EnergyData, form: Formulation
) -> dict[str, Soup]:
    """Soups that satisfy the constraints; if none does, the start with tilted planes."""
    facing = form.min_facing
    kept = {k: s for k, s in ends.items() if constraints(s, data.rim_ray, facing).within()}
    if kept:
        return kept
    rays = data.visibility_ray(form.depth_ratio)
    tilted = tilt_to_camera(start, data.anchor_ray, rays, facing)
    return {"start": tilted.normalised(data.share).retracted()}


def multipliers(nlp: NLP, stage: Stage) -> dict[str, Float]:
    """lam_g of a stage cut into its kinds of constraint, and lam_x."""
    out = {"lam_x": stage.lam_x}
    for group in nlp.groups:
        if group.kernel.nc:
            out[f"lam_g_{group.kernel.name}"] = stage.lam_g[np.unique(group.rows)]
    return out
