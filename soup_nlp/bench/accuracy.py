"""One pair measured: solution and rivals under every convention, as one row of plain numbers."""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soup_nlp.bench.rivals import depth_maps, true_depth
from soup_nlp.bench.suites import SUITES, Item
from soup_nlp.bench.truth import true_soup
from soup_nlp.config.problem import Problem, dump_problem
from soup_nlp.data.flow.sources import is_named, is_network
from soup_nlp.data.pair import Pair, Truth
from soup_nlp.errors import DataError
from soup_nlp.evaluate.metrics import sample_at_points, scene_flow_epe, skill
from soup_nlp.evaluate.protocols import Preset, preset
from soup_nlp.model import oracle
from soup_nlp.pipeline.run import Run, run
from soup_nlp.report.folder import prepare_folder, write_folder

Float = NDArray[np.float64]
Row = dict[str, Any]

KEPT = ("mre", "median_relative", "sq_rel", "rmse", "log_rmse", "delta1", "delta2", "delta3")
"""Errors that a row keeps, beside scale, coverage and skill."""


@dataclass(frozen=True)
class Job:
    """One row to be measured; it can be sent to another process.

    Attributes:
        item: Pair and flow.
        overrides: Of its problem.
        variant: Name of the overrides in an analysis; empty for the defaults.
        folder: Where to write the result folder; None to keep the row only.
    """

    item: Item
    overrides: tuple[str, ...] = ()
    variant: str = ""
    folder: Path | None = None

    @property
    def key(self) -> str:
        """Unique in a table."""
        return f"{self.item.key} {self.variant}".strip()


def settings_hash(problem: Problem) -> str:
    """Hash of everything but the input: the same settings on every pair and in every place."""
    out = ("name", "base", "input", "expected")
    return _hash(problem.model_dump(mode="json", exclude=set(out)))


def input_hash(problem: Problem) -> str:
    """Hash of the input but its place: the same frames of the same dataset in every folder."""
    return _hash(problem.input.model_dump(mode="json", exclude={"root", "path"}))


def _hash(tree: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(tree, sort_keys=True).encode()).hexdigest()[:12]


def measure(job: Job, change: Callable[[Pair], Pair] | None = None) -> Row:
    """Solve and score one pair; whatever fails becomes a row with `ok` false and the reason.

    Args:
        job: What to measure.
        change: Makes another pair of the one that was loaded.
    """
    row = head(job)
    begin, cpu = time.perf_counter(), time.process_time()
    try:
        problem = job.item.problem(job.overrides)
        pair = problem.load_pair()
        loaded = time.perf_counter() - begin
        if change is not None:
            source = problem.flow.source
            if not (is_named(source) or is_network(source)):
                # a file fits the pair as it is
                pair = pair.with_flow(problem.flow.load(pair, problem.path))
            pair = change(pair)
        # a dataset without its truth would be solved for nothing, and again every time
        if not any(_applies(pair.truth, preset(name)) for name in job.item.presets):
            raise _no_truth(job.item)
        if job.folder is None:
            result = _timed(run(problem, pair=pair), loaded)
        else:
            folder = prepare_folder(job.folder)
            log = str(folder / "ipopt.log")
            result = _timed(run(problem, pair=pair, ipopt_log=log), loaded)
            write_folder(folder, result, dump_problem(problem), "")
        found = scores(result, job.item.presets)
        if not found["metrics"]:
            raise _no_truth(job.item)
        row |= {"ok": True, "error": None, **found}
    except Exception as error:
        row |= {"ok": False, "error": f"{type(error).__name__}: {error}"}
    row["seconds"] = time.perf_counter() - begin
    row["cpu_seconds"] = time.process_time() - cpu
    return clean(row)


def _timed(result: Run, loaded: float) -> Run:
    """The run with the seconds that its pair took to load or render."""
    return replace(result, seconds={**result.seconds, "load": loaded})


def _no_truth(item: Item) -> DataError:
    """What is missing where no convention gave a number, and where to get it."""
    suite = SUITES.get(item.suite)
    return DataError(
        "pair has no true depth",
        where=item.key,
        found=f"no pixel that counts under {', '.join(item.presets)}",
        expected=suite.layout or None if suite else None,
        hint=f"get it from {suite.source}" if suite and suite.source else None,
    )


def head(job: Job) -> Row:
    """What names a row."""
    item = job.item
    try:
        problem = item.problem(job.overrides)
        settings, source = settings_hash(problem), input_hash(problem)
    except Exception:
        settings = source = "wrong"
    return {
        "key": job.key,
        "suite": item.suite,
        "sequence": item.sequence,
        "pair": item.name,
        "flow": item.flow,
        "variant": job.variant,
        "overrides": list(job.overrides),
        "presets": list(item.presets),
        "settings": settings,
        "input": source,
    }


def scores(result: Run, presets: Sequence[str] = ("paper",)) -> Row:
    """Metrics by convention and method, energies, flow error and scene flow of a run.

    A convention under which the truth has no pixel, or that needs a depth map where the truth is
    sparse points, is left out.
    """
    maps = depth_maps(result)
    s = result.solution
    energy: dict[str, Mapping[str, float]] = {"start": s.energy_start}
    if result.refined is not None:
        energy["nlp"] = s.energy
    energy["solution"] = result.energy
    row: Row = {
        "status": s.status,
        "good": result.good,
        "superpixels": len(result.segmentation),
        "size": list(result.pair.size),
        "stages": dict(result.seconds),
        "iterations": sum(stage.iterations for stage in s.stages),
        "parallax_px": float(np.median(result.start.parallax)),
        "bending_share": float(result.start.bending_share),
        "flow_error": flow_error(result.pair),
        "metrics": {},
    }
    try:
        true = true_soup(result.pair, result.segmentation)
        energy["truth"] = oracle.energy(true.soup, result.data, result.weights)
    except DataError:
        pass  # most real pairs have no true motions
    row["energy"] = {k: dict(v) for k, v in energy.items()}
    for name in presets:
        if table := _table(result, maps, name):
            row["metrics"][name] = table
    row["scene_flow"] = _scene_flow(result, row["metrics"])
    return row


def _applies(truth: Truth | None, convention: Preset) -> bool:
    """Whether a truth has a pixel that counts; a crop needs a depth map."""
    if truth is None:
        return False
    if truth.depth_ref is not None:
        return convention.counts(truth.depth_ref)
    if truth.points is None or convention.crop is not None:
        return False
    return convention.counts(truth.points[:, 2])


def _table(result: Run, maps: Mapping[str, Float], name: str) -> dict[str, dict[str, float]]:
    """Metrics of every method under one convention; {} where it does not apply."""
    truth, convention = result.pair.truth, preset(name)
    if truth is None or true_depth(result) is None or not _applies(truth, convention):
        return {}
    out: dict[str, dict[str, float]] = {}
    for method, depth in maps.items():
        if truth.depth_ref is not None:
            estimate, gt = depth, truth.depth_ref
        else:
            assert truth.points is not None
            estimate, gt = sample_at_points(depth, truth.points)
        if not convention.counts(gt):
            return {}
        m = convention.score(estimate, gt).as_dict()
        out[method] = {k: m[k] for k in (*KEPT, "scale", "coverage", "n_pixels")}
    for m in out.values():
        m["skill"] = skill(m["mre"], out["constant"]["mre"])
    return out


def _scene_flow(result: Run, metrics: Mapping[str, Any]) -> dict[str, float | int] | None:
    """3D end-point error with the depth's own scale; None without truth."""
    truth = result.pair.truth
    if truth is None or truth.scene_flow is None or not metrics:
        return None
    rec = result.reconstruction
    scale = next(iter(metrics.values()))["solution"]["scale"]
    if not math.isfinite(scale):
        return None
    return scene_flow_epe(rec.points_next - rec.points_ref, truth.scene_flow, scale=scale)


def flow_error(pair: Pair) -> dict[str, float] | None:
    """End-point error in pixels of the flow that was used; None without a true flow."""
    if pair.flow is None or pair.truth is None or pair.truth.flow is None:
        return None
    known = np.isfinite(pair.truth.flow).all(axis=2)
    used = known & (pair.flow.confidence > 0)
    if not used.any():
        return None
    gap = np.linalg.norm(pair.flow.uv[used] - pair.truth.flow[used], axis=1)
    weight = pair.flow.confidence[used].astype(np.float64)
    return {
        "mean": float(gap.mean()),
        "weighted_mean": float(np.sum(weight * gap) / weight.sum()),
        "median": float(np.median(gap)),
        "over_3px": float(np.mean(gap > 3)),
        "used": float(used.sum() / known.sum()),
    }


def clean(value: Any) -> Any:
    """Plain JSON: numbers of numpy made plain, what is not finite made None."""
    if isinstance(value, Mapping):
        return {str(k): clean(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [clean(v) for v in value]
    if isinstance(value, np.generic):
        return clean(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
