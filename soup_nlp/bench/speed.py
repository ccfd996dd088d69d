"""One run with clocks: seconds, energy and memory of every stage, beside the reference solver."""

from __future__ import annotations

import resource
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soup_nlp.bench.processes import alone
from soup_nlp.bench.reference_solvers import EPS, ReferenceSolve, levenberg_marquardt
from soup_nlp.bench.rows import Job, Row, Say, measure_all
from soup_nlp.config.problem import Problem, dump_problem, make_problem
from soup_nlp.evaluate.scoring import score_depths
from soup_nlp.geometry.soup import reconstruct
from soup_nlp.pipeline import Case, make_run, prepare
from soup_nlp.report.folder import prepare_folder, write_folder
from soup_nlp.solve.solver_options import SolverOptions
from soup_nlp.solve.stages import solve_soup

Float = NDArray[np.float64]

REFERENCES = ("same", "wide")
"""Levenberg-Marquardt on the solver's own smoothing widths, or from a wide smoothing."""
REFERENCE_ITERATIONS = 100
"""Limit of Levenberg-Marquardt's steps for every smoothing width."""


@dataclass(frozen=True)
class Spec:
    """One run.

    Attributes:
        scene: A rendered scene, or "motorcycle".
        superpixels: Wanted number N.
        neighbours: K of the K-NN graph.
        seed: Of the scene and of all draws.
        width: Columns of a rendered scene.
        height: Rows of a rendered scene.
        references: Of REFERENCES.
        overrides: Of the problem, e.g. "solver.max_iter=200".
    """

    scene: str
    superpixels: int
    neighbours: int
    seed: int = 0
    width: int = 1024
    height: int = 436
    references: tuple[str, ...] = ("same",)
    overrides: tuple[str, ...] = ()

    @property
    def key(self) -> str:
        """What identifies the run, whatever the code: street-N250-K10-s0-1024x436."""
        size = "" if self.scene == "motorcycle" else f"-{self.width}x{self.height}"
        own = "".join(f"-{text}" for text in self.overrides)
        name = f"{self.scene}-N{self.superpixels}-K{self.neighbours}-s{self.seed}"
        return name + size + own

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Spec:
        """The spec that `dataclasses.asdict` took apart."""
        lists = {k: tuple(values[k]) for k in ("references", "overrides")}
        return cls(**{**values, **lists})


def plan(
    scenes: Sequence[str],
    sizes: Sequence[int],
    neighbours: Sequence[int],
    seeds: Sequence[int],
    **others: Any,
) -> list[Spec]:
    """Every combination, small ones first; the motorcycle is one pair, so it has the first seed."""
    out = []
    for n, k, scene, seed in product(sorted(sizes), sorted(neighbours), scenes, seeds):
        if scene != "motorcycle" or seed == seeds[0]:
            out.append(Spec(scene, n, k, seed, **others))
    return out


def run_alone(spec: Spec, seconds: float = 7200.0) -> Row:
    """`measure` in a process of its own with one thread; {"error": ...} where it failed."""
    with tempfile.TemporaryDirectory() as folder:
        return alone(partial(measure, spec), Path(folder), seconds)


def measure_specs(
    specs: Sequence[Spec],
    path: Path,
    *,
    fresh: bool = False,
    work: Callable[[Spec], Row] = run_alone,
    say: Say | None = None,
    after: Callable[[list[Row]], None] | None = None,
) -> list[Row]:
    """The row of every spec, measured where the file does not hold it yet; see `measure_all`.

    Args:
        specs: Runs.
        path: JSON-lines file.
        fresh: Measure again what is there.
        work: Measures one run.
        say: Called after every new row.
        after: Called with all rows so far after every new row.
    """
    jobs = [Job({"key": s.key, "spec": asdict(s)}, partial(work, s), fresh) for s in specs]
    return measure_all(jobs, path, say=say, after=after)


class Clocks:
    """Wall and CPU seconds by stage."""

    def __init__(self) -> None:
        self.wall: dict[str, float] = {}
        self.cpu: dict[str, float] = {}
        self.restart()

    def restart(self) -> None:
        """Start the next lap now."""
        self._wall, self._cpu = time.perf_counter(), time.process_time()

    def lap(self, stage: str) -> None:
        """End a lap."""
        wall, cpu = time.perf_counter(), time.process_time()
        self.wall[stage] = self.wall.get(stage, 0.0) + wall - self._wall
        self.cpu[stage] = self.cpu.get(stage, 0.0) + cpu - self._cpu
        self._wall, self._cpu = wall, cpu

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """A lap of its own."""
        self.restart()
        yield
        self.lap(name)


def problem_of(spec: Spec) -> Problem:
    """The merged problem of a spec; the NLP alone, without refinement.

    Raises:
        ConfigError: an override is wrong.
    """
    source: dict[str, Any] = {"kind": "motorcycle"}
    if spec.scene != "motorcycle":
        source = {"kind": "scene", "scene": spec.scene, "seed": spec.seed}
        source |= {"width": spec.width, "height": spec.height}
    raw = {
        "name": spec.scene,
        "seed": spec.seed,
        "input": source,
        "segmentation": {"superpixels": spec.superpixels, "neighbours": spec.neighbours},
        "refine": {"enabled": False},
    }
    return make_problem(raw, spec.overrides, where="bench speed")


def measure(spec: Spec) -> dict[str, Any]:
    """Solve a problem and say what every stage cost.

    Args:
        spec: What to solve.

    Returns:
        Plain numbers: "sizes", "wall" and "cpu" (seconds by stage; build, functions and linear
        algebra are parts of nlp's wall time, presolve, build and solve of its CPU time),
        "stages", "iterations" in all, "status", "energy", "mre", "residuals", "peak_bytes"
        (before the reference solver), and "reference" with its own.

    Raises:
        SoupError: the input cannot be used.
    """
    clocks = Clocks()
    problem = problem_of(spec)
    case = prepare(problem, on_stage=clocks.lap)
    clocks.lap("weights")
    with clocks.stage("nlp"):
        solution = solve_soup(case.soup, case.data, case.weights, case.formulation(), case.options)
    clocks.cpu["compiler"] = solution.seconds["compile"]
    with clocks.stage("evaluation"):
        run = make_run(case, solution)
    run = replace(run, seconds=dict(clocks.wall))
    with clocks.stage("output"), tempfile.TemporaryDirectory() as folder:
        write_folder(prepare_folder(folder), run, dump_problem(problem), "")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    stages = solution.stages
    functions = sum(sum(s.calls.values()) for s in stages)
    ipopt = sum(s.seconds for s in stages)
    split = {
        # what the NLP's wall time is made of; all but Ipopt and its functions is building
        "build": max(0.0, clocks.wall["nlp"] - ipopt),
        "functions": functions,
        "linear algebra": max(0.0, ipopt - functions),
    }
    return {
        "sizes": {
            "superpixels": len(case),
            "knn_edges": len(case.segmentation.edges),
            "pairs": len(case.segmentation.pairs),
            **solution.nlp,
        },
        "wall": {**clocks.wall, **split},
        "cpu": {**clocks.cpu, **solution.cpu_seconds},
        "iterations": sum(s.iterations for s in stages),
        "stages": [
            {
                "name": s.name,
                "status": s.status,
                "iterations": s.iterations,
                "seconds": s.seconds,
                **{k: _last(s.history.get(k)) for k in ("inf_du", "inf_pr")},
            }
            for s in stages
        ],
        "status": solution.status,
        "converged": solution.converged,
        "delivered": run.delivered,
        "energy": dict(solution.energy),
        "energy_start": dict(solution.energy_start),
        "mre": {k: m.mre for k, m in run.metrics.items()},
        "residuals": dict(solution.residuals),
        "peak_bytes": peak,
        "reference": {kind: _reference(case, kind) for kind in spec.references},
    }


def _last(values: Float | None) -> float | None:
    """Last entry of an array; None where there is none."""
    return None if values is None or not len(values) else float(values[-1])


def schedule(kind: str, options: SolverOptions) -> tuple[float, ...]:
    """Widths of the reference solver: the solver's own ("same") or from a wide start ("wide")."""
    if kind == "wide":
        return EPS
    own = tuple(options.presolve_eps) if options.presolve else ()
    return own if own and own[-1] <= options.eps else (*own, options.eps)


def _reference(case: Case, kind: str) -> dict[str, Any]:
    """Levenberg-Marquardt from the same start on the same energy."""
    y: ReferenceSolve = levenberg_marquardt(
        case.soup,
        case.data,
        case.weights,
        case.formulation(),
        eps=schedule(kind, case.options),
        iterations=REFERENCE_ITERATIONS,
        seconds=case.options.max_seconds,
    )
    mre = None
    if case.pair.truth is not None:
        pair, size = case.pair, (case.pair.image_next.shape[0], case.pair.image_next.shape[1])
        dense = reconstruct(y.soup, case.segmentation.labels, pair.K_ref, pair.K_next, size)
        depth = dense.depth_ref
        expected = case.problem.expected
        scores = score_depths(case.pair.truth, {"y": depth}, expected.scale, expected.cap)
        mre = scores["y"].mre if scores else None
    return {
        "name": y.name,
        "status": y.status,
        "energy": dict(y.energy),
        "iterations": y.iterations,
        "seconds": y.seconds,
        "cpu_seconds": y.cpu_seconds,
        "mre": mre,
        "history": np.round(_thin(y.history), 6).tolist(),
    }


def _thin(history: Float, most: int = 60) -> Float:
    """At most `most` rows, first and last among them: enough for a plot."""
    index = np.linspace(0, len(history) - 1, min(most, len(history))).round().astype(int)
    return history[index]
