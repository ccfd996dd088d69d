"""Measurement of one pair: a row with the errors of solution and baselines."""

import math
import time
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from soup_nlp.arrays import Float
from soup_nlp.bench.study import Cell
from soup_nlp.bench.suites import SUITES
from soup_nlp.data.pair import Pair, Truth
from soup_nlp.errors import DataError
from soup_nlp.evaluate.metrics import (
    ERRORS,
    MEDIAN,
    UNSCALED,
    DepthMetrics,
    depth_metrics,
    scene_flow_epe,
    skill,
)
from soup_nlp.evaluate.scoring import at_truth, coverage, fill_nearest, score_depths, sparsification
from soup_nlp.geometry.soup import Soup, reconstruct
from soup_nlp.pipeline.record import Run
from soup_nlp.pipeline.run import run
from soup_nlp.storage.rows import Row

METHODS: Mapping[str, str] = {
    "solution": "what the product delivers",
    "solution_90": "the same, on the 90 % of the true pixels where sigma is least",
    "solution_70": "the same, on 70 %",
    "nlp": "the NLP alone, before refinement",
    "start": "the start: shared motions, scales by contact",
    "unorganised": "independent superpixels: each with a translation of length 1, no assembly",
    "solution_rigid": "the solution, only where one rigid motion has a depth",
    "rigid": "one rigid motion, triangulated; only where it has a depth",
    "rigid_filled": "the same, holes filled from the nearest pixel",
    "constant": "a constant depth",
}
"""Descriptions of the depth maps, in the order of the tables."""

BASELINES = ("unorganised", "rigid", "rigid_filled", "constant")
"""Depth maps that the solution is compared with."""
KEPT_METRICS = (*ERRORS, "scale", "coverage", "n_pixels")
"""Depth metrics that a row has beside the skill."""


def measure_pair(cell: Cell) -> Row:
    """Solve and score one pair.

    Raises:
        SoupError: the pair cannot be solved, or has no true depth.
    """
    return scores(solved(cell))


def solved(cell: Cell) -> Run:
    """The run of a pair that can be scored.

    Raises:
        SoupError: the pair cannot be solved, or has no true depth.
    """
    begin, item = time.perf_counter(), cell.item
    problem = item.problem(cell.overrides)
    pair = problem.load_pair()
    loaded = time.perf_counter() - begin
    # do not solve a pair that cannot be scored
    if not has_depth(pair.truth):
        suite = SUITES[item.suite]
        raise DataError(
            "pair has no true depth",
            where=item.key,
            expected=suite.layout or None,
            hint=f"get it from {suite.source}" if suite.source else None,
        )
    result = run(problem, pair=pair)
    return replace(result, seconds={**result.seconds, "load": loaded})


def scores(result: Run) -> Row:
    """Metrics by method, flow error, scene flow and sigma of a run.

    Metrics are of every true pixel after one median scale, without a cap. "guess" is the share of
    the image that is marked as a guess, "within" has the shares of the pixels whose log depth is
    within one and two sigma.
    """
    maps, truth, solution = depth_maps(result), result.pair.truth, result.solution
    sigma = result.reconstruction.sigma_ref
    metrics = _rows(score_depths(truth, maps, sigma=sigma)) if has_depth(truth) else {}
    return {
        "status": solution.status,
        "good": result.solved,
        "stages": dict(result.seconds),
        "iterations": sum(stage.iterations for stage in solution.stages),
        "bending_share": float(result.start.bends.mean()),
        "guess": result.confidence.guessed,
        **_sigma(result),
        "flow_error": flow_error(result.pair),
        "metrics": metrics,
        "scene_flow": _scene_flow(result, metrics["solution"]["scale"]) if metrics else None,
        "moving": moving(result.pair, maps["solution"]) if metrics else None,
    }


def _sigma(result: Run) -> Row:
    """Entries "within" and "sparsification" at true pixels, after a median scale.

    There are none without a true depth or without sigma.
    """
    truth, sigma = result.pair.truth, result.reconstruction.sigma_ref
    if truth is None or sigma is None or not has_depth(truth):
        return {}
    z, gt = at_truth(truth, result.reconstruction.depth_ref)
    true = MEDIAN.mask(gt) & np.isfinite(z)
    if not true.any():
        return {}
    z, gt = z[true] * float(np.median(gt[true] / z[true])), gt[true]
    uncertain = at_truth(truth, sigma)[0][true]
    measured = sparsification(np.abs(z - gt) / gt, uncertain)
    curve = np.round([measured.kept, measured.error, measured.oracle], 5)
    return {
        "within": coverage(np.abs(np.log(z / gt)), uncertain),
        "sparsification": {"ause": measured.ause, "curve": curve.tolist()},
    }


def has_depth(truth: Truth | None) -> bool:
    """Whether there is a depth to compare with."""
    if truth is None:
        return False
    if truth.depth_ref is not None:
        return MEDIAN.counts(truth.depth_ref)
    return truth.points is not None and MEDIAN.counts(truth.points[:, 2])


def _rows(scored: Mapping[str, DepthMetrics]) -> dict[str, dict[str, float]]:
    """Metrics by method, and their skill."""
    constant = scored["constant"].mre
    return {
        method: {**{k: getattr(m, k) for k in KEPT_METRICS}, "skill": skill(m.mre, constant)}
        for method, m in scored.items()
    }


def moving(pair: Pair, depth: Float) -> Row | None:
    """Errors of independently moving pixels and of all other pixels, under one median scale.

    Components move independently if their true motion is not that of the static scene; without
    known motions, all do.

    Args:
        pair: Its truth must have components (0 is the static scene) and dense depth.
        depth: (H, W) z.

    Returns:
        "mre" and "rest", the MRE of moving and of other pixels. None without such a truth or
        without moving pixels.
    """
    truth = pair.truth
    if truth is None or truth.components is None or truth.depth_ref is None:
        return None
    gt, label = truth.depth_ref, truth.components
    moving_part = label > 0
    if truth.motions is not None:
        near = np.isclose(truth.motions, truth.motions[0], rtol=0, atol=1e-9).all(axis=(1, 2))
        moving_part &= ~np.isin(label, np.flatnonzero(near))
    counts = MEDIAN.mask(gt)
    moves, static = counts & moving_part, counts & (label >= 0) & ~moving_part
    if not moves.any() or not static.any():
        return None
    z = depth * depth_metrics(depth, gt).scale
    masks = {"mre": moves, "rest": static}
    return {k: depth_metrics(z, np.where(m, gt, np.nan), UNSCALED).mre for k, m in masks.items()}


def _scene_flow(result: Run, scale: float) -> dict[str, float | int] | None:
    """3D end-point error with the depth's own scale; None without truth."""
    truth = result.pair.truth
    if truth is None or truth.scene_flow is None or not math.isfinite(scale):
        return None
    rec = result.reconstruction
    return scene_flow_epe(rec.points_next - rec.points_ref, truth.scene_flow, scale=scale)


def flow_error(pair: Pair) -> dict[str, float] | None:
    """Mean and median end-point error of the flow, pixels; None without a true flow."""
    if pair.flow is None or pair.truth is None or pair.truth.flow is None:
        return None
    used = np.isfinite(pair.truth.flow).all(axis=2) & (pair.flow.confidence > 0)
    if not used.any():
        return None
    gap = np.linalg.norm(pair.flow.uv[used] - pair.truth.flow[used], axis=1)
    return {"mean": float(gap.mean()), "median": float(np.median(gap))}


def unorganised(soup: Soup) -> Soup:
    """The soup before assembly: the scale of every superpixel makes its translation have length 1.

    Two views determine each plane and motion up to a scale, so this is the result of independent
    superpixels. Superpixels at rest keep their scale.
    """
    length = np.linalg.norm(soup.translation, axis=1)
    tiny = 1e-9 * max(float(length.max(initial=0.0)), 1e-300)
    unit = np.where(length > tiny, length, 1.0)
    return Soup(soup.lam / unit, soup.n, soup.d, soup.R, soup.t)


def depth_maps(run: Run) -> dict[str, Float]:
    """(H, W) depths of the reference frame by method.

    "nlp" is present if the NLP was refined, and the rigid depths if a motion fits.
    """
    pair, seg = run.pair, run.segmentation
    labels = seg.labels
    out = {k: run.depth_maps[k] for k in ("solution", "nlp", "start") if k in run.depth_maps}
    alone = reconstruct(unorganised(run.start.soup), labels, pair.K_ref, pair.K_next)
    out["unorganised"] = alone.depth_ref
    rigid = run.depth_maps.get("rigid")
    if rigid is not None:
        valid = np.isfinite(rigid)
        out["solution_rigid"] = np.where(valid, run.reconstruction.depth_ref, np.nan)
        out["rigid"] = rigid
        if valid.any():
            out["rigid_filled"] = fill_nearest(rigid)
    return out
