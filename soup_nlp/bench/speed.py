"""A timed solve: seconds, energy and memory by stage, with the reference solver beside it."""

from __future__ import annotations

import resource
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

from soup_nlp.bench.reference_solver import levenberg_marquardt
from soup_nlp.bench.study import Cell, Overrides
from soup_nlp.bench.suite_pairs import Item
from soup_nlp.config.problem import dump_problem
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


def speed_cell(
    scene: str,
    superpixels: int,
    neighbours: int,
    seed: int = 0,
    width: int = 1024,
    height: int = 436,
    overrides: Sequence[str] = (),
) -> Cell:
    """The cell of a timed run: DIS flow, the NLP without refinement.

    Args:
        scene: A rendered scene, or motorcycle.
        superpixels: Wanted number N.
        neighbours: K of the K-NN graph.
        seed: Of the scene.
        width: Columns of the rendered image.
        height: Its rows.
        overrides: Further overrides.

    Raises:
        ConfigError: an override is wrong.
    """
    source: dict[str, Any] = {"kind": "motorcycle"}
    if scene != "motorcycle":
        source = {"kind": "scene", "scene": scene, "seed": seed, "width": width, "height": height}
    item = Item("speed", scene, f"{scene}, seed {seed}", "dis", source)
    size = f"segmentation.superpixels={superpixels}", f"segmentation.neighbours={neighbours}"
    own = (*size, f"seed={seed}", "refine.enabled=false", *overrides)
    item.problem(own)
    return Cell(item, own, f"N {superpixels}, K {neighbours}")


def speed_cells(
    scenes: Sequence[str],
    sizes: Sequence[int],
    neighbours: Sequence[int],
    seeds: Sequence[int],
    **others: Any,
) -> list[dict[str, Any]]:
    """Arguments of `speed_cell` for all runs, small sizes first; the motorcycle has one seed."""
    every = product(sorted(sizes), sorted(neighbours), scenes, seeds)
    return [
        {"scene": scene, "superpixels": n, "neighbours": k, "seed": seed, **others}
        for n, k, scene, seed in every
        if scene != "motorcycle" or seed == seeds[0]
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
        for clock, begin, end in zip((self.wall, self.cpu), self.last, now, strict=True):
            clock[stage] = clock.get(stage, 0.0) + end - begin
        self.last = now

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time the block as a stage."""
        self.last = time.perf_counter(), time.process_time()
        yield
        self.lap(name)


def measure_speed(item: Item, overrides: Overrides = (), keep: Path | None = None) -> Row:
    """Solve a problem and measure the cost of every stage.

    Returns:
        "wall" and "cpu" seconds by stage ("build", "functions" and "linear algebra" are parts of
        the wall time of "nlp"), "sizes", "iterations", "status", "energy", "error" (MRE by soup),
        "residuals", "peak_bytes" before the reference solver runs, and "reference" with the
        energy, iterations and CPU seconds of that solver.

    Raises:
        SoupError: the input cannot be used.
    """
    clocks = Clocks()
    problem = item.problem(overrides)
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
        "n": len(case),
        "k": problem.segmentation.neighbours,
        "sizes": solution.nlp,
        "wall": {**clocks.wall, **_parts(clocks.wall["nlp"], solution)},
        "cpu": {**clocks.cpu, **solution.cpu_seconds, "compiler": solution.seconds["compile"]},
        "iterations": sum(s.iterations for s in solution.stages),
        "status": solution.status,
        "converged": solution.converged,
        "energy": dict(solution.energy),
        "energy_start": dict(solution.energy_start),
        "errors": {k: m.mre for k, m in run.metrics.items()},
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
    widths = tuple(options.presolve_eps) if options.presolve else ()
    return widths if widths and widths[-1] <= options.eps else (*widths, options.eps)


def _reference(case: Case) -> Row:
    """Result of Levenberg-Marquardt from the same start on the same energy."""
    found = levenberg_marquardt(
        case.soup,
        case.data,
        case.weights,
        case.formulation(),
        eps=schedule(case.options),
        iterations=REFERENCE_ITERATIONS,
        seconds=case.options.max_seconds,
    )
    pair = case.pair
    dense = reconstruct(found.soup, case.segmentation.labels, pair.K_ref, pair.K_next)
    depths = {"lm": dense.depth_ref}
    scores = score_depths(pair.truth, depths)
    return {
        "status": found.status,
        "energy": dict(found.energy),
        "iterations": found.iterations,
        "cpu_seconds": found.cpu_seconds,
        "mre": scores["lm"].mre if scores else None,
    }
