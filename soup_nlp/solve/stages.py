"""From a start to a solution: tangent presolve with continuation, then the constrained NLP."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soup_nlp.geometry.plane import tilt_to_camera
from soup_nlp.geometry.soup import Soup
from soup_nlp.model import oracle
from soup_nlp.model.compile import compiler_seconds
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.layout import Chart
from soup_nlp.model.matrix import build_matrix_nlp
from soup_nlp.model.nlp import NLP
from soup_nlp.solve.continuation import KEEP, MAJORANT, narrow
from soup_nlp.solve.descent import Descent
from soup_nlp.solve.ipopt import Ipopt, Listener, Stage, Watch
from soup_nlp.solve.kkt import UNMET, feasible, residuals
from soup_nlp.solve.phase import Phase
from soup_nlp.solve.solver_options import SolverOptions
from soup_nlp.solve.tangent_problem import TangentProblem
from soup_nlp.solve.warm import WARM, warm_start

Float = NDArray[np.float64]


POLISH = "presolve polish"
"""Name of the phase with the exact Hessian."""
STOPPED = ("Interrupted", "Time_Limit")
"""Status of a stage after which no other begins."""


@dataclass(frozen=True)
class Solution:
    """What the constrained NLP ended with.

    Attributes:
        soup: Solution: Ipopt's answer (best iterate when not converged), or the presolve's or the
            start where that has the lower exact energy, with rounding-size constraint violations
            retracted.
        status: Ipopt's status of the constrained NLP, or why it was stopped.
        converged: Its claim.
        stages: Phases of the presolve, then Ipopt's of the constrained NLP.
        energy_start: Exact energy by term of the start.
        energy: Exact energy by term of the solution.
        residuals: Largest violation by kind of constraint, recomputed from the arrays, and the
            dual infeasibility and complementarity of the NLP at the solution.
        multipliers: lam_g by constraint name, lam_x.
        nlp: Sizes of the constrained NLP.
        description: The NLP as it prints itself.
        seconds: Wall time of "presolve", "build" and "solve"; "compile" is CPU time of the C
            compiler in them.
        cpu_seconds: CPU time of this process in the same.
        delivered: What `soup` is: "constrained NLP", "presolve" or "start".
        far: Whether the presolve ended far from a minimum, so that Ipopt had few iterations.
        ends: Exact energy where the "start", the "presolve" and the "constrained NLP" ended.
    """

    soup: Soup
    status: str
    converged: bool
    stages: tuple[Stage, ...]
    energy_start: Mapping[str, float]
    energy: Mapping[str, float]
    residuals: Mapping[str, float]
    multipliers: Mapping[str, Float] = field(repr=False)
    nlp: Mapping[str, int]
    description: str = field(repr=False)
    seconds: Mapping[str, float]
    cpu_seconds: Mapping[str, float] = field(default_factory=dict)
    delivered: str = "constrained NLP"
    far: bool = False
    ends: Mapping[str, float] = field(default_factory=dict)

    @property
    def found_by(self) -> str:
        """Who found the minimum: "presolve", "Ipopt", or "nobody" where none was reached."""
        if not self.converged:
            return "nobody"
        # Ipopt only confirms a point that it does not move
        descent = any(s.name.startswith("presolve") for s in self.stages)
        return "presolve" if descent and not self.stages[-1].iterations else "Ipopt"

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
    options: SolverOptions | None = None,
    *,
    listener: Listener | None = None,
    stop: threading.Event | None = None,
    say: Callable[[str], None] | None = None,
    log_file: str | None = None,
) -> Solution:
    """Minimise E from a start.

    Args:
        start: Initial soup.
        data: Pixels, graphs and weights of the pair.
        weights: Constants of the energy.
        form: Formulation of the constrained NLP.
        options: Stages and limits.
        listener: Called at every iteration.
        stop: Set it to end at the next iteration with the best iterate.
        say: Called with a line after every stage.
        log_file: Ipopt's own log is appended here.

    Returns:
        The solution; a solve that fails is a Solution with its status, not an exception.
    """
    form, o = form or Formulation(), options or SolverOptions()
    watch = Watch(listener, stop or threading.Event(), say or (lambda line: None), log_file)
    laps, compiling = _Laps(), compiler_seconds()
    deadline = laps.begin + o.max_seconds
    stages: list[Stage] = []
    presolved, rim = None, None
    if o.presolve:
        limit = laps.begin + 0.7 * o.max_seconds
        presolved, rim = _presolve(start, data, weights, form, o, stages, watch, limit)
    laps.end("presolve")

    def energy(soup: Soup) -> float:
        return oracle.energy(soup, data, weights)["total"]

    near, far = bool(stages) and _near(stages[-1]), _far(stages)
    # far from its minimum the presolve may have raised the exact energy
    worse = not near and presolved is not None and energy(presolved) > energy(start)
    soup = start if presolved is None or worse else presolved
    nlp, layout = build_matrix_nlp(soup, data, weights, form.replace(eps=o.eps, eps_pixel=o.eps))
    watch.say(str(nlp))
    warm: dict[str, Any] = {}
    limit, x0 = o.max_iter, nlp.x0
    if not o.presolve and o.continuation and o.max_iter:
        majorant = form.replace(eps=o.eps, eps_pixel=o.eps, hessian=MAJORANT)
        second, _ = build_matrix_nlp(soup, data, weights, majorant)
        stages += narrow(second, o, watch, laps.begin + 0.7 * o.max_seconds)
        # the last stage does the polish's work as well
        limit, x0 = o.max_iter + o.polish_iterations, stages[-1].x
        warm = {"lam_x0": stages[-1].lam_x, "lam_g0": stages[-1].lam_g}
        laps.end("continuation")
    # the lifted truncation has another solution than the presolve's
    if form.truncation == "smooth" and soup is presolved and o.polish_iterations and near:
        assert rim is not None
        warm = warm_start(nlp, data, soup, rim)
    kept = (WARM if o.presolve else KEEP) if warm else {}
    solver = Ipopt(nlp, {**kept, **o.ipopt})
    laps.end("build")
    if far:
        watch.say(
            f"far from a minimum: Ipopt has {o.far_iterations} iterations (solver.far_iterations)"
        )
    stage = solver(
        x0=x0,
        **warm,
        max_iter=min(limit, o.far_iterations) if far else limit,
        tol=o.tol,
        seconds=max(1.0, deadline - time.perf_counter()),
        stage="constrained NLP",
        listener=listener,
        stop=watch.stop,
        log_file=log_file,
    )
    laps.end("solve")
    stages.append(stage)
    watch.say(str(stage))
    found = {"constrained NLP": layout.unpack(stage.x), "presolve": presolved, "start": start}
    ends = {k: s.normalised(data.share).retracted() for k, s in found.items() if s is not None}
    held = {k: s for k, s in ends.items() if feasible(s, data.rim_ray, form.min_facing)}
    if not held:
        # nothing that breaks its constraints is delivered
        rays = data.visibility_ray(form.depth_ratio)
        tilted = tilt_to_camera(start, data.anchor_ray, rays, form.min_facing)
        held = {"start": tilted.normalised(data.share).retracted()}
    delivered = min(held, key=lambda k: energy(held[k]))
    final = held[delivered]
    # the solver's word is not taken for it
    broken = stage.converged and "constrained NLP" not in held
    return Solution(
        soup=final,
        status=UNMET if broken else stage.status,
        converged=stage.converged and not broken,
        stages=tuple(stages),
        energy_start=oracle.energy(start, data, weights),
        energy=oracle.energy(final, data, weights),
        residuals=residuals(nlp, final, stage, data, form.min_facing),
        multipliers=_multipliers(nlp, stage),
        nlp=nlp.sizes(),
        description=str(nlp),
        seconds={**laps.wall, "compile": compiler_seconds() - compiling},
        cpu_seconds=laps.cpu,
        delivered=delivered,
        far=far,
        ends={k: energy(ends[k]) for k in ("start", "presolve", "constrained NLP") if k in ends},
    )


class _Laps:
    """Wall and CPU seconds of consecutive stages."""

    def __init__(self) -> None:
        self.wall: dict[str, float] = {}
        self.cpu: dict[str, float] = {}
        self.begin = self._wall = time.perf_counter()
        self._cpu = time.process_time()

    def end(self, stage: str) -> None:
        """A stage ends here."""
        wall, cpu = time.perf_counter(), time.process_time()
        self.wall[stage], self.cpu[stage] = wall - self._wall, cpu - self._cpu
        self._wall, self._cpu = wall, cpu


def _near(stage: Stage) -> bool:
    """Whether the presolve has come so near that its multipliers are worth starting from."""
    return stage.converged or bool(stage.history["inf_du"][-1] < 1.0)


def _far(stages: Sequence[Stage]) -> bool:
    """Whether the polish ended, by itself or at its limit, where Ipopt would find no minimum."""
    last = stages[-1] if stages else None
    ended = last is not None and last.name == POLISH and last.status not in STOPPED
    return ended and not _near(stages[-1])


def _phases(o: SolverOptions) -> list[Phase]:
    """The reweighted phases: barriers from 1e-3 down to 1e-5 while the smoothing shrinks."""
    last = len(o.presolve_eps) - 1
    barriers = np.geomspace(1e-3, 1e-5, last + 1) if last else np.array([1e-5])
    return [
        Phase(
            name=f"presolve {eps:g}",
            hessian="gauss-newton",
            eps=eps,
            barrier=float(barrier),
            iterations=o.presolve_iterations,
            stagnation=o.stagnation * (0.01 if k == last else 1.0),
            tol=o.presolve_tol,
        )
        for k, (eps, barrier) in enumerate(zip(o.presolve_eps, barriers))
    ]


def _presolve(
    start: Soup,
    data: EnergyData,
    weights: Weights,
    form: Formulation,
    o: SolverOptions,
    stages: list[Stage],
    watch: Watch,
    deadline: float,
) -> tuple[Soup, Float]:
    """The presolve's soup and its multipliers of rim visibility; appends its phases to stages."""
    problem = TangentProblem(start, data, weights, form, exact=False)
    descent = Descent(problem, watch=watch, deadline=deadline)
    for phase in _phases(o):
        stages.append(descent.run(phase))
        watch.say(str(stages[-1]))
        if stages[-1].status in STOPPED:
            return descent.soup, descent.rim
    if o.polish_iterations:
        # on inverse depths the superpixels of a plane move with it in straight lines; reweighting
        # on depths ends at lower energies. The paper's units need a length unit that is linear.
        chart: Chart = "inverse-depth" if data.local_units else "depth"
        problem = TangentProblem(descent.soup, data, weights, form, chart=chart)
        descent = Descent(problem, after=descent, watch=watch, deadline=deadline)
        polish = Phase(
            name=POLISH,
            hessian="exact",
            eps=o.eps,
            barrier=1e-10,
            iterations=o.polish_iterations,
            stagnation=0.0,
            tol=o.presolve_tol,
            beyond=True,
            highest=1e-5,
        )
        stages.append(descent.run(polish))
        watch.say(str(stages[-1]))
    return descent.soup, descent.rim


def _multipliers(nlp: NLP, stage: Stage) -> dict[str, Float]:
    """lam_g cut into its kinds of constraint, and lam_x."""
    out = {"lam_x": stage.lam_x}
    for group in nlp.groups:
        if group.kernel.nc:
            out[f"lam_g_{group.kernel.name}"] = stage.lam_g[np.unique(group.table.rows)]
    return out
