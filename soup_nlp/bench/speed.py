"""A timed run: seconds, energy and memory by stage, and the reference solver on the same pair."""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from soup_nlp.bench.reference_solver import levenberg_marquardt
from soup_nlp.bench.studies import Settings, grid
from soup_nlp.config.problem import Problem, dump_problem, make_problem
from soup_nlp.evaluate.scoring import score_depths
from soup_nlp.geometry.soup import reconstruct
from soup_nlp.pipeline import Case, make_run, prepare
from soup_nlp.report.folder import prepare_folder, write_folder
from soup_nlp.solve.solver_options import SolverOptions
from soup_nlp.solve.stages import Solution, solve_soup
from soup_nlp.storage.folders import scratch
from soup_nlp.storage.rows import Row

REFERENCE_ITERATIONS = 100
"""Limit of the steps of Levenberg-Marquardt for every smoothing width."""
HISTORY_POINTS = 60
"""Points of the reference solver's history that a row stores for the plot."""


def plan(
    scenes: Sequence[str],
    sizes: Sequence[int],
    neighbours: Sequence[int],
    seeds: Sequence[int],
    **others: Any,
) -> list[Settings]:
    """Settings of all runs, small sizes first; the motorcycle has one seed, as it is one pair."""
    every = grid(superpixels=sorted(sizes), neighbours=sorted(neighbours), scene=scenes, seed=seeds)
    return [
        {**own, **others}
        for own in every
        if own["scene"] != "motorcycle" or own["seed"] == seeds[0]
    ]


class Clocks:
    """Wall and CPU seconds by stage."""

    def __init__(self) -> None:
        self.wall: dict[str, float] = {}
        self.cpu: dict[str, float] = {}
        self.last = time.perf_counter(), time.process_time()

    def lap(self, stage: str) -> None:
        """Add the time since the last call to a stage."""
        now = time.perf_counter(), time.process_time()
        for clock, begin, end in zip((self.wall, self.cpu), self.last, now):
            clock[stage] = clock.get(stage, 0.0) + end - begin
        self.last = now

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time the block as a stage."""
        self.last = time.perf_counter(), time.process_time()
        yield
        self.lap(name)


def problem_of(
    scene: str,
    superpixels: int,
    neighbours: int,
    seed: int = 0,
    width: int = 1024,
    height: int = 436,
    overrides: Sequence[str] = (),
) -> Problem:
    """The merged problem of a run, with the NLP but without refinement.

    Raises:
        ConfigError: an override is wrong.
    """
    source: dict[str, Any] = {"kind": "motorcycle"}
    if scene != "motorcycle":
        source = {"kind": "scene", "scene": scene, "seed": seed, "width": width, "height": height}
    raw = {
        "name": scene,
        "seed": seed,
        "input": source,
        "segmentation": {"superpixels": superpixels, "neighbours": neighbours},
        "refine": {"enabled": False},
    }
    return make_problem(raw, overrides, where="bench speed")


def measure(**settings: Any) -> Row:
    """Solve a problem and measure the cost of every stage.

    Returns:
        Plain numbers: "sizes"; "wall" and "cpu" (seconds by stage, where "build", "functions" and
        "linear algebra" are parts of the wall time of "nlp", and "presolve", "build" and "solve"
        parts of its CPU time); "iterations" in all; "status", "energy", "mre", "residuals";
        "peak_bytes" before the reference solver runs; "reference" with the same of that solver.

    Raises:
        SoupError: the input cannot be used.
    """
    clocks = Clocks()
    problem = problem_of(**settings)
    case = prepare(problem, on_stage=clocks.lap)
    clocks.lap("weights")
    with clocks.stage("nlp"):
        solution = solve_soup(case.soup, case.data, case.weights, case.formulation(), case.options)
    with clocks.stage("evaluation"):
        run = make_run(case, solution)
    run = replace(run, seconds=dict(clocks.wall))
    with clocks.stage("output"), scratch() as folder:
        write_folder(prepare_folder(folder / "result"), run, dump_problem(problem), "")
    return {
        "sizes": {
            "superpixels": len(case),
            "knn_edges": len(case.segmentation.edges),
            "pairs": len(case.segmentation.pairs),
            **solution.nlp,
        },
        "wall": {**clocks.wall, **_parts(clocks.wall["nlp"], solution)},
        "cpu": {**clocks.cpu, **solution.cpu_seconds, "compiler": solution.seconds["compile"]},
        "iterations": sum(s.iterations for s in solution.stages),
        "status": solution.status,
        "converged": solution.converged,
        "energy": dict(solution.energy),
        "energy_start": dict(solution.energy_start),
        "mre": {k: m.mre for k, m in run.metrics.items()},
        "residuals": dict(solution.residuals),
        "peak_bytes": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024,
        "reference": _reference(case),
    }


def _parts(wall: float, solution: Solution) -> dict[str, float]:
    """Wall seconds of the parts of the NLP; all time outside the stages counts as building."""
    functions = sum(sum(s.calls.values()) for s in solution.stages)
    stages = sum(s.seconds for s in solution.stages)
    return {
        "build": max(0.0, wall - stages),
        "functions": functions,
        "linear algebra": max(0.0, stages - functions),
    }


def schedule(options: SolverOptions) -> tuple[float, ...]:
    """Smoothing widths of the reference solver: those of the presolve and of Ipopt."""
    own = tuple(options.presolve_eps) if options.presolve else ()
    return own if own and own[-1] <= options.eps else (*own, options.eps)


def _reference(case: Case) -> dict[str, Any]:
    """Result of Levenberg-Marquardt from the same start on the same energy."""
    y = levenberg_marquardt(
        case.soup,
        case.data,
        case.weights,
        case.formulation(),
        eps=schedule(case.options),
        iterations=REFERENCE_ITERATIONS,
        seconds=case.options.max_seconds,
    )
    mre = None
    if case.pair.truth is not None:
        pair, size = case.pair, (case.pair.image_next.shape[0], case.pair.image_next.shape[1])
        dense = reconstruct(y.soup, case.segmentation.labels, pair.K_ref, pair.K_next, size)
        expected = case.problem.expected
        depths = {"y": dense.depth_ref}
        scores = score_depths(case.pair.truth, depths, expected.scale, expected.cap)
        mre = scores["y"].mre if scores else None
    kept = np.linspace(0, len(y.history) - 1, min(HISTORY_POINTS, len(y.history)))
    return {
        "status": y.status,
        "energy": dict(y.energy),
        "iterations": y.iterations,
        "seconds": y.seconds,
        "cpu_seconds": y.cpu_seconds,
        "mre": mre,
        "history": np.round(y.history[kept.round().astype(int)], 6).tolist(),
    }
