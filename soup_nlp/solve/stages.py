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
from soup_nlp.solve.ipopt import Ipopt, Stage
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
        description: The NLP as it prints itself.
        seconds: Wall time of "presolve", "build" and "solve".
        cpu_seconds: CPU time of this process in the same.
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
    description: str = field(default="", repr=False)
    seconds: Mapping[str, float] = field(default_factory=dict)
    cpu_seconds: Mapping[str, float] = field(default_factory=dict)
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
    rest = form or Formulation(), options or Stages(), watch or Watch()
    return _Solve(start, data, weights, *rest).run()


class _Laps:
    """Wall and CPU seconds of consecutive stages."""

    def __init__(self) -> None:
        self.wall: dict[str, float] = {}
        self.cpu: dict[str, float] = {}
        self._wall = time.perf_counter()
        self.begin = self._cpu = time.process_time()

    def end(self, stage: str) -> None:
        wall, cpu = time.perf_counter(), time.process_time()
        self.wall[stage], self.cpu[stage] = wall - self._wall, cpu - self._cpu
        self._wall, self._cpu = wall, cpu


def _near(stage: Stage) -> bool:
    """Whether the presolve ended so near a minimum that Ipopt should start from its multipliers."""
    # Ipopt that fails at its first point has no history
    dual = stage.history.get("inf_du", np.array([np.inf]))
    return stage.converged or bool(dual[-1] < 1.0)


@dataclass(frozen=True)
class _Solve:
    """State of one solve: its inputs and the stages that have ended."""

    start: Soup
    data: EnergyData
    weights: Weights
    form: Formulation
    o: Stages
    watch: Watch
    stages: list[Stage] = field(default_factory=list)
    laps: _Laps = field(default_factory=_Laps)

    def run(self) -> Solution:
        """Run all stages; the result is the best of their final points."""
        presolved, rim = self.presolve()
        near = bool(self.stages) and _near(self.stages[-1])
        # far from its minimum the presolve may have raised the exact energy
        worse = not near and self.energy(presolved) > self.energy(self.start)
        soup = self.start if worse else presolved
        form = self.form.replace(eps=self.o.eps, eps_pixel=self.o.eps)
        nlp, layout = build_matrix_nlp(soup, self.data, self.weights, form)
        self.watch.say(str(nlp))
        first: dict[str, Any] = {"x0": nlp.x0}
        # a presolve that was stopped before its last stage has no multipliers
        if rim is not None and near and not worse:
            first |= warm_start(nlp, self.data, soup, rim)
        stage = self.ipopt(nlp, first)
        candidates = {"start": self.start, "presolve": presolved}
        if not self.o.presolve_iterations:
            del candidates["presolve"]
        candidates["constrained NLP"] = layout.unpack(stage.x)
        ends = {k: s.normalised(self.data.share).retracted() for k, s in candidates.items()}
        admissible = self.admissible(ends)

        def rank(name: str) -> float:
            energy = self.energy(admissible[name])
            # energies at one minimum differ by what the smoothing hides
            return energy / SAME if stage.converged and name == "constrained NLP" else energy

        # the later one of equals
        delivered = min(reversed(admissible), key=rank)
        final = admissible[delivered]
        # a reported success counts only where the constraints hold
        broken = stage.converged and "constrained NLP" not in admissible
        return Solution(
            soup=final,
            status=UNMET if broken else stage.status,
            converged=stage.converged and not broken,
            stages=tuple(self.stages),
            energy_start=oracle.energy(self.start, self.data, self.weights),
            energy=oracle.energy(final, self.data, self.weights),
            residuals=residuals(nlp, final, stage, self.data, self.form.min_facing),
            multipliers=multipliers(nlp, stage),
            nlp=nlp.sizes(),
            description=str(nlp),
            seconds=self.laps.wall,
            cpu_seconds=self.laps.cpu,
            delivered=delivered,
            ends={k: self.energy(s) for k, s in ends.items()},
        )

    def energy(self, soup: Soup) -> float:
        return oracle.energy(soup, self.data, self.weights)["total"]

    def presolve(self) -> tuple[Soup, Float | None]:
        """Soup and multipliers of rim visibility of the presolve; the start where it is off."""
        # the last stage has the rest of the time
        end = self.laps.begin + 0.7 * self.o.max_seconds
        energy = self.data, self.weights, self.form
        first = Presolve(self.start, *energy, self.o, self.watch, end, stages=self.stages)
        if self.o.presolve_iterations:
            first.run()
        self.laps.end("presolve")
        return first.soup, first.rim

    def ipopt(self, nlp: NLP, first: dict[str, Any]) -> Stage:
        """The last stage, from a point with multipliers if there are any."""
        o = self.o
        solver = Ipopt(nlp, o.ipopt, WARM if "lam_g0" in first else {})
        self.laps.end("build")
        stage = solver(
            **first,
            max_iter=o.max_iter,
            tol=o.tol,
            seconds=self.laps.begin + o.max_seconds - time.process_time(),
            stage="constrained NLP",
            watch=self.watch,
        )
        self.laps.end("solve")
        self.stages.append(stage)
        self.watch.say(str(stage))
        return stage

    def admissible(self, ends: Mapping[str, Soup]) -> dict[str, Soup]:
        """Soups that satisfy the constraints; if none does, the start with tilted planes."""
        data, facing = self.data, self.form.min_facing
        kept = {k: s for k, s in ends.items() if constraints(s, data.rim_ray, facing).within()}
        if kept:
            return kept
        rays = data.visibility_ray(self.form.depth_ratio)
        tilted = tilt_to_camera(self.start, data.anchor_ray, rays, facing)
        return {"start": tilted.normalised(data.share).retracted()}


def multipliers(nlp: NLP, stage: Stage) -> dict[str, Float]:
    """lam_g of a stage cut into its kinds of constraint, and lam_x."""
    out = {"lam_x": stage.lam_x}
    for group in nlp.groups:
        if group.kernel.nc:
            out[f"lam_g_{group.kernel.name}"] = stage.lam_g[np.unique(group.rows)]
    return out
