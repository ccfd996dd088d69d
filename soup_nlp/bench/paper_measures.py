"""Measurement of a pair for `bench paper`: scores, energy curves, small depth maps."""

from __future__ import annotations

import json
import time
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soup_nlp.bench.accuracy import scores
from soup_nlp.bench.suite_pairs import Item
from soup_nlp.config.problem import Problem, make_problem
from soup_nlp.data.pair import Pair
from soup_nlp.errors import DataError, SoupError
from soup_nlp.evaluate.metrics import depth_metrics, sample_at_points
from soup_nlp.pipeline.record import Run
from soup_nlp.pipeline.run import run
from soup_nlp.storage.atomic import atomic_path
from soup_nlp.storage.rows import Row

MAP_WIDTH = 240
"""Columns of a small map, at most."""


def has_truth(item: Item) -> bool:
    """Whether the pair can be loaded and has a depth to compare with."""
    try:
        truth = item.problem().load_pair().truth
    except SoupError:
        return False
    return truth is not None and (truth.depth_ref is not None or truth.points is not None)


def loaded(problem: Problem) -> tuple[Pair, float]:
    """The pair of a problem with its flow, and the wall seconds of the flow; cached."""
    own = problem.model_dump(mode="json", include={"input", "flow", "base", "name"})
    return _loaded(json.dumps(own, sort_keys=True))


@lru_cache(maxsize=3)
def _loaded(text: str) -> tuple[Pair, float]:
    problem = make_problem(json.loads(text))
    pair = problem.load_pair()
    begin = time.perf_counter()
    flow = problem.flow.load(pair, problem.path)
    return pair.with_flow(flow), time.perf_counter() - begin


def measure(
    item: Item, overrides: tuple[str, ...] = (), variant: str = "", *, maps: Path | None = None
) -> Row:
    """Solve and score one pair.

    Small depth maps are written to the file `maps`, if given.

    Raises:
        SoupError: the pair cannot be solved or scored.
    """
    problem = item.problem(overrides)
    pair, seconds = loaded(problem)
    result = run(problem, pair=pair)
    row = scores(result, item.presets, fitted=False)
    if not row["metrics"]:
        raise DataError("pair has no true depth", where=item.key, found=", ".join(item.presets))
    if maps is not None:
        write_maps(maps, result)
    stages = {**row["stages"], "flow": seconds}
    return {**row, "stages": stages, "curve": curve(result), "rmse": _rmse(result)}


def _rmse(result: Run) -> float | None:
    """RMSE in the truth's unit after one least-squares scale."""
    truth, z = result.pair.truth, result.reconstruction.depth_ref
    if truth is None:
        return None
    if truth.depth_ref is not None:
        return depth_metrics(z, truth.depth_ref, scale="lsq").rmse
    if truth.points is None:
        return None
    return depth_metrics(*sample_at_points(z, truth.points), scale="lsq").rmse


def curve(result: Run) -> Row:
    """Energies of a run over iterations and rounds.

    "stages" has the smoothed energy by stage and iteration, "exact" the exact energy of the start
    and of the NLP's solution, "rounds" the objective of the refinement before the first round and
    after each.
    """
    s, refined = result.solution, result.refined
    rounds = []
    if refined is not None:
        rounds = [refined.energy_begin["total"], *(r.energy["total"] for r in refined.rounds)]
    return {
        "stages": [
            {"name": stage.name, "objective": [float(f) for f in stage.history.get("obj", ())]}
            for stage in s.stages
        ],
        "exact": [s.energy_start["total"], s.energy["total"]],
        "rounds": rounds,
    }


def write_maps(path: Path, result: Run) -> None:
    """Write image, truth, start and solution as .npz, subsampled to MAP_WIDTH columns."""
    pair = result.pair
    step = max(1, -(-pair.size[1] // MAP_WIDTH))

    def small(values: NDArray[np.floating] | NDArray[np.uint8]) -> NDArray[np.generic]:
        return np.ascontiguousarray(values[::step, ::step])

    maps: dict[str, Any] = {
        "image": small(pair.image_ref),
        "start": small(result.start_reconstruction.depth_ref).astype(np.float32),
        "solution": small(result.reconstruction.depth_ref).astype(np.float32),
    }
    truth = pair.truth
    if truth is not None and truth.depth_ref is not None:
        maps["truth"] = small(truth.depth_ref).astype(np.float32)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **maps)


def read_maps(path: Path) -> dict[str, NDArray[np.generic]]:
    """The maps that `write_maps` wrote; {} if there is no file."""
    if not path.is_file():
        return {}
    with np.load(path) as stored:
        return {name: stored[name] for name in stored.files}
