"""Depth against truth: what a run scores, and what knowing less would score."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from soup_nlp.data.formats.map_files import read_depth
from soup_nlp.data.pair import Pair, Truth
from soup_nlp.errors import DataError
from soup_nlp.evaluate.baselines import RigidBaseline, rigid_depth
from soup_nlp.evaluate.metrics import (
    DepthMetrics,
    Scale,
    constant_depth_metrics,
    depth_metrics,
    sample_at_points,
)
from soup_nlp.geometry.soup import Reconstruction
from soup_nlp.storage.store import read_h5, require

Float = NDArray[np.float64]

DEPTHS = {"solution": "ref", "nlp": "nlp_ref", "start": "start_ref", "rigid": "rigid_ref"}
"""Depth maps of the reference frame that a result stores, by the name of their metrics."""


def rigid_baseline(pair: Pair) -> RigidBaseline | None:
    """One rigid motion for the whole image, where there is truth to compare with and it fits."""
    if pair.truth is not None:
        with contextlib.suppress(DataError):
            return rigid_depth(pair)
    return None


def score(
    pair: Pair,
    before: Reconstruction,
    after: Reconstruction,
    rigid: RigidBaseline | None = None,
    scale: Scale = "median",
    cap: float | None = None,
    nlp: Reconstruction | None = None,
) -> dict[str, DepthMetrics]:
    """Metrics of solution, start, a constant depth and one rigid motion; {} without truth.

    Args:
        pair: For its truth.
        before: Start.
        after: Solution.
        rigid: The baseline, if there is one.
        scale: Rule of the one global scale of each depth map.
        cap: Truth beyond this depth is left out.
        nlp: The NLP's solution, where it was refined.
    """
    if pair.truth is None:
        return {}
    depths = {"solution": after.depth_ref, "start": before.depth_ref}
    if nlp is not None:
        depths["nlp"] = nlp.depth_ref
    if rigid is not None:
        depths["rigid"] = rigid.depth
    out = score_depths(pair.truth, depths, scale, cap)
    if pair.truth.depth_next is not None and _any_truth(pair.truth.depth_next, cap):
        gt = pair.truth.depth_next
        out["solution_next"] = depth_metrics(after.depth_next, gt, scale=scale, cap=cap)
    return out


def score_depths(
    truth: Truth, depths: Mapping[str, Float], scale: Scale = "median", cap: float | None = None
) -> dict[str, DepthMetrics]:
    """Metrics of named depth maps against dense or sparse truth, constant depth beside them.

    Args:
        truth: Dense `depth_ref`, or else sparse `points`.
        depths: (H, W) z of the reference frame by name.
        scale: Scale rule.
        cap: Truth beyond this depth is left out.

    Returns:
        By the same names, and "constant"; {} where no pixel has a truth.
    """
    out: dict[str, DepthMetrics] = {}
    for name, depth in depths.items():
        if truth.depth_ref is not None:
            estimate, gt = depth, truth.depth_ref
        elif truth.points is not None:
            estimate, gt = sample_at_points(depth, truth.points)
        else:
            return {}
        if not _any_truth(gt, cap):
            return {}
        out[name] = depth_metrics(estimate, gt, scale=scale, cap=cap)
        if "constant" not in out:
            out["constant"] = constant_depth_metrics(gt, scale=scale, cap=cap)
    return out


def _any_truth(gt: Float, cap: float | None) -> bool:
    known = np.isfinite(gt) & (gt > 0)
    return bool((known if cap is None else known & (gt <= cap)).any())


def evaluate(
    folder: str | Path,
    depth: str | Path,
    *,
    scale: Scale = "median",
    cap: float | None = None,
    depth_scale: float = 1000.0,
) -> dict[str, DepthMetrics]:
    """Score the depth of a result folder against a truth file.

    Args:
        folder: Result folder.
        depth: .dpt, .npy, .pfm or 16-bit .png depth of the reference frame.
        scale: "median", "mre", "lsq" or "none".
        cap: Truth beyond this depth is dropped, positive.
        depth_scale: Values per unit of length of a .png.

    Returns:
        Metrics by "solution", "start", "nlp" and "rigid" (if stored) and "constant".

    Raises:
        DataError: the cap is not positive, a file is missing, sizes differ, or the truth knows no
            pixel.
    """
    # false for NaN too
    if cap is not None and not cap > 0:
        raise DataError(
            "depth cap must be positive",
            where="cap",
            found=f"{cap:g}",
            expected="a depth in the unit of the truth, such as 70",
        )
    tree = read_h5(Path(folder) / "result.h5")
    depths = {k: require(tree, f"depth/{v}") for k, v in DEPTHS.items() if v in tree["depth"]}
    gt = read_depth(Path(depth), depth_scale)
    expected = require(tree, "depth/ref").shape
    if gt.shape != expected:
        raise DataError(
            "truth and result differ in size", where=depth, found=gt.shape, expected=expected
        )
    if not _any_truth(gt, cap):
        raise DataError(
            "truth has no pixel to compare with",
            where=depth,
            found="no finite, positive depth" + ("" if cap is None else f" up to the cap {cap:g}"),
        )
    return score_depths(Truth(depth_ref=gt), depths, scale, cap)
