"""The way through the house: a problem in, a run with reconstruction and metrics out."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from soup_nlp.config import Problem, make_problem
from soup_nlp.data.pair import Pair
from soup_nlp.geometry.graph import Segmentation, build_segmentation
from soup_nlp.geometry.soup import Reconstruction, Soup, reconstruct
from soup_nlp.geometry.superpixels import segment
from soup_nlp.inputs import load_flow_of, load_pair
from soup_nlp.model.energy import EnergyData, Weights, build_energy_data, in_pixels
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.layout import MatrixLayout
from soup_nlp.report.baselines import RigidBaseline
from soup_nlp.report.metrics import DepthMetrics
from soup_nlp.scoring import evaluate, rigid_baseline, score
from soup_nlp.solve.ipopt import Listener
from soup_nlp.solve.soup import Solution, SolverOptions, solve_soup
from soup_nlp.start.propose import Start, StartOptions, propose

__all__ = ["Run", "evaluate", "load_pair", "run", "solve_pair"]


@dataclass(frozen=True)
class Run:
    """Everything that a solve made.

    Attributes:
        problem: The merged problem.
        pair: Images, cameras, flow, truth.
        segmentation: Superpixels and graphs.
        start: The unorganised soup.
        data: Numbers of the energy.
        weights: Constants of the energy.
        solution: What the constrained NLP ended with.
        answer: Ipopt's own answer to the constrained NLP (the best iterate where it did not
            converge), before anything is made of it: constraints hold to its tolerance only.
        delivered: What `solution.soup` is made of: "constrained NLP", or "presolve" where that
            has the lower exact energy.
        start_reconstruction: Dense 3D of the start.
        reconstruction: Dense 3D of the solution.
        rigid: One rigid motion for the whole image; None without truth or where none fits.
        metrics: By "solution", "start", "constant", "rigid", and "solution_next" for the next
            frame; a key without truth is absent.
        seconds: Wall time by stage; those that start with nlp_ are parts of "nlp".
    """

    problem: Problem
    pair: Pair
    segmentation: Segmentation
    start: Start
    data: EnergyData
    weights: Weights
    solution: Solution
    answer: Soup
    delivered: str
    start_reconstruction: Reconstruction
    reconstruction: Reconstruction
    rigid: RigidBaseline | None
    metrics: Mapping[str, DepthMetrics] = field(repr=False)
    seconds: Mapping[str, float]

    @property
    def soup(self) -> Soup:
        """The solution's soup."""
        return self.solution.soup


def _tell(say: Callable[[str], None] | None, line: object) -> None:
    if say:
        say(str(line))


def run(
    problem: Problem,
    *,
    pair: Pair | None = None,
    listener: Listener | None = None,
    stop: threading.Event | None = None,
    say: Callable[[str], None] | None = None,
    ipopt_log: str | None = None,
) -> Run:
    """Solve a problem.

    Args:
        problem: See `config.load_problem`.
        pair: Images and cameras, instead of the problem's input; its flow is used when it has one.
        listener: Called at every iteration of Ipopt.
        stop: Set it to end with the best iterate.
        say: Called with a line after every stage.
        ipopt_log: File for Ipopt's own log.

    Raises:
        SoupError: the input cannot be used.
    """
    seconds: dict[str, float] = {}
    clock = time.perf_counter()

    def lap(stage: str) -> None:
        nonlocal clock
        now = time.perf_counter()
        seconds[stage] = seconds.get(stage, 0.0) + now - clock
        clock = now

    pair = pair or load_pair(problem)
    lap("load")
    flow = pair.flow or load_flow_of(problem, pair)
    pair = pair.with_flow(flow)
    lap("flow")
    _tell(say, pair)
    s = problem.segmentation
    labels = segment(pair.image_ref, s.superpixels, s.method, s.compactness, s.smoothing_px)
    samples = None if s.boundary_samples == "all" else s.boundary_samples
    seg = build_segmentation(labels, pair.image_ref, s.neighbours, s.beta, s.beta_colour, samples)
    lap("segmentation")
    _tell(say, seg)
    options = StartOptions(**{**problem.start.model_dump(), "seed": problem.seed})
    start = propose(seg, flow, pair.K_ref, pair.K_next, options)
    lap("start")
    _tell(say, start)
    e = problem.energy
    pixels = None if e.pixel_samples == "all" else e.pixel_samples
    data = build_energy_data(
        seg, flow, pair.K_ref, pair.K_next, pixels, problem.seed, e.arap_at_anchors
    )
    if e.units == "pixel":
        data = in_pixels(data, start.soup, seg, e.rotation_px)
    weights = Weights(**e.weights.model_dump())
    solver = problem.solver.model_dump()
    solver["presolve_eps"] = tuple(solver["presolve_eps"])
    form = Formulation(**problem.formulation.model_dump())
    solution = solve_soup(
        start.soup,
        data,
        weights,
        form,
        SolverOptions(**solver),
        listener=listener,
        stop=stop,
        say=say,
        log_file=ipopt_log,
    )
    lap("nlp")
    size = pair.image_next.shape[0], pair.image_next.shape[1]
    before, after = (
        reconstruct(x, labels, pair.K_ref, pair.K_next, size) for x in (start.soup, solution.soup)
    )
    answer = MatrixLayout(data.share, form.gauge).unpack(solution.stages[-1].x)
    own = np.array_equal(answer.retracted().lam, solution.soup.lam)
    rigid = rigid_baseline(pair)
    metrics = score(pair, before, after, rigid, problem.expected.scale, problem.expected.cap)
    lap("evaluation")
    return Run(
        problem=problem,
        pair=pair,
        segmentation=seg,
        start=start,
        data=data,
        weights=weights,
        solution=solution,
        answer=answer,
        delivered="constrained NLP" if own else "presolve",
        start_reconstruction=before,
        reconstruction=after,
        rigid=rigid,
        metrics=metrics,
        seconds={**seconds, **{f"nlp_{k}": v for k, v in solution.seconds.items()}},
    )


def solve_pair(pair: Pair, **options: Any) -> Run:
    """Solve a pair that is in memory.

    Args:
        pair: Images, cameras, and a flow if there is one (else OpenCV DIS).
        options: Sections of a problem file, e.g. `segmentation={"superpixels": 500}`.

    Raises:
        ConfigError: an option is wrong.
        DataError: the pair cannot be used.
    """
    raw = {"name": pair.name, "input": {"kind": "motorcycle"}, **options}
    return run(make_problem(raw, where="solve_pair"), pair=pair)
