"""Scores of the depths of a run and of simpler methods against the truth."""

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from soup_nlp.arrays import Float, Mask
from soup_nlp.data.flow.consistency import SURE as SURE_FLOW
from soup_nlp.data.formats.images import array_of, read_image
from soup_nlp.data.formats.map_files import read_depth
from soup_nlp.data.pair import Pair, Truth
from soup_nlp.errors import DataError
from soup_nlp.evaluation.metrics import (
    MEDIAN,
    Convention,
    DepthMetrics,
    Scale,
    depth_metrics,
    sample_at_points,
)
from soup_nlp.geometry.camera import pixel_grid, rays
from soup_nlp.start import epipolar
from soup_nlp.storage.files import as_path
from soup_nlp.storage.store import read_h5, require

DEPTHS = {"solution": "ref", "nlp": "nlp_ref", "start": "start_ref", "rigid": "rigid_ref"}
"""Depth maps of the reference frame that a result stores, by the name of their metrics."""
SURE = {"solution_90": 0.9, "solution_70": 0.7}
"""Shares of the pixels with a true depth, by least sigma, that are scored separately."""


def score_depths(
    truth: Truth | None,
    depths: Mapping[str, Float],
    convention: Convention = MEDIAN,
    depth_next: Float | None = None,
    sigma: Float | None = None,
) -> dict[str, DepthMetrics]:
    """Metrics of named depth maps, and of a constant depth, against dense or sparse truth.

    The depths (H, W) are those of the reference frame, `depth_next` (H', W') is that of the next
    one, and sigma (H, W) is the uncertainty of the depth "solution".

    Returns:
        Metrics by the same names, "constant", "solution_next" for the next frame, and the names of
        `SURE` for the pixels of least sigma; a depth map without true pixels has none.
    """
    out: dict[str, DepthMetrics] = {}
    if truth is None:
        return out
    for name, depth in depths.items():
        if truth.depth_ref is None and truth.points is None:
            break
        estimate, gt = at_truth(truth, depth)
        if not convention.counts(gt):
            break
        out[name] = depth_metrics(estimate, gt, convention)
        if "constant" not in out:
            out["constant"] = depth_metrics(np.ones(gt.shape), gt, convention)
    if sigma is not None and "solution" in out:
        estimate, gt = at_truth(truth, depths["solution"])
        for name, sure_gt in surest(gt, at_truth(truth, sigma)[0]).items():
            if convention.counts(sure_gt):
                out[name] = depth_metrics(estimate, sure_gt, convention)
    gt_next = truth.depth_next
    if depth_next is not None and gt_next is not None and convention.counts(gt_next):
        out["solution_next"] = depth_metrics(depth_next, gt_next, convention)
    return out


def at_truth(truth: Truth, image: Float) -> tuple[Float, Float]:
    """Values of an image (H, W) where truth is known, and the true depth there."""
    if truth.depth_ref is not None:
        return image, truth.depth_ref
    assert truth.points is not None
    return sample_at_points(image, truth.points)


def surest(gt: Float, sigma: Float) -> dict[str, Float]:
    """True depths by the names of `SURE`: NaN except for the share with the least sigma."""
    true = MEDIAN.mask(gt) & np.isfinite(sigma)
    limits = {k: np.quantile(sigma[true], v) if true.any() else 0.0 for k, v in SURE.items()}
    return {k: np.where(true & (sigma <= limit), gt, np.nan) for k, limit in limits.items()}


def evaluate(
    result: object,
    depth: str | Path | Float,
    *,
    scale: Scale = "median",
    cap: float | None = None,
    depth_scale: float | None = None,
    moving: str | Path | Mask | None = None,
) -> dict[str, DepthMetrics]:
    """Score a depth against the truth.

    Args:
        result: Result folder, `Run`, stored result, or depth of the reference frame (H, W).
        depth: True depth of the reference frame (H, W), or a file: .dpt, .npy, .pfm, 16-bit .png.
        scale: "median", "mre", "lsq", "affine" (scale and shift) or "none".
        cap: Truth beyond this depth is dropped, positive.
        depth_scale: Values per unit of length of a .png; None for 1000, with a warning.
        moving: (H, W) True where something moves by itself, or a picture that is not black there:
            "static" and "moving" are then scored by themselves, at the scale of all pixels.

    Returns:
        Metrics by "solution", "start", "nlp" and "rigid" (if known) and "constant".

    Raises:
        DataError: the cap is not positive, a file is missing, sizes differ, or the truth has no
            pixel.
    """
    convention = Convention(scale=scale, cap=cap)
    depths = _depths(result)
    where = depth if isinstance(depth, str | Path) else "truth"
    gt = _map(depth, "truth") if where == "truth" else read_depth(where, depth_scale)
    expected = depths["solution"].shape
    if gt.shape != expected:
        raise DataError(
            "truth and result differ in size", where=where, found=gt.shape, expected=expected
        )
    if not convention.counts(gt):
        raise DataError(
            "truth has no pixel to compare with",
            where=where,
            found="no finite, positive depth" + ("" if cap is None else f" up to the cap {cap:g}"),
        )
    scores = score_depths(Truth(depth_ref=gt), depths, convention)
    if moving is not None:
        values = read_image(moving).any(axis=2) if isinstance(moving, str | Path) else moving
        boolean = isinstance(values, np.ndarray) and values.dtype == bool
        mask = _map(values.astype(np.uint8) if boolean else values, "mask") > 0
        if mask.shape != expected:
            raise DataError("mask and result differ in size", found=mask.shape, expected=expected)
        m = scores["solution"]
        aligned = m.scale * depths["solution"] + m.shift
        for name, part in (("static", ~mask), ("moving", mask)):
            if convention.counts(gt_part := np.where(part, gt, np.nan)):
                scores[name] = depth_metrics(aligned, gt_part, Convention("none", cap))
    return scores


def _depths(result: object) -> dict[str, Float]:
    """Depth maps of the reference frame by the name of their metrics."""
    if isinstance(result, str | os.PathLike):
        tree = read_h5(as_path(result, "result folder") / "result.h5")
        stored = tree.get("depth", {})
        require(tree, "depth/ref")
        return {k: require(tree, f"depth/{v}") for k, v in DEPTHS.items() if v in stored}
    maps: Mapping[str, Float] | None = getattr(result, "depth_maps", None)
    return {"solution": _map(result, "depth")} if maps is None else dict(maps)


def _map(values: object, what: str) -> Float:
    """(H, W) numbers; DataError for values that are no map of numbers."""
    expected = "(H, W) numbers, or a file; NaN where unknown"
    return array_of(values, what, "evaluate", expected, axes="(H, W)").astype(np.float64)


# --- one rigid motion for all pixels, which methods for dynamic scenes have to beat --------------

INLIER, TIGHT = 1.0, 0.1
"""Sampson distances of an inlier, pixels, with which the motion is estimated."""

FAR = 100.0
"""Depths beyond this multiple of the median depth count as unknown: there is no parallax left.
True depths of driving and indoor pairs reach 14 times their median."""


def rigid_depth(pair: Pair, seed: int = 0) -> Float | None:
    """Depth under one rigid motion for the whole image, triangulated pixel by pixel.

    The essential matrix (RANSAC, then a robust refinement of the Sampson distance) is estimated at
    two inlier distances, and the motion with the smaller Cauchy cost is kept: in small images a
    moving component can lie within one pixel of a wrong motion. Each pixel with confidence is then
    triangulated by itself without smoothing, so far points with little parallax can have wild
    depths; only those beyond `FAR` times the median are dropped.

    It is (H, W) z of the reference frame in lengths of the translation; NaN where the flow has no
    confidence, the triangulated point is not in front of both cameras, or it is too far. None where
    there are too few pixels with flow, or no motion fits for lack of parallax.
    """
    if pair.flow is None:
        return None
    matches = epipolar.flow_matches(pair, pair.flow.confidence > SURE_FLOW, seed)
    tried = [epipolar.estimate(matches, distance) for distance in (INLIER, TIGHT)]
    motions = [motion for motion in tried if motion is not None]
    if not motions:
        return None

    def cost(motion: epipolar.Motion) -> float:
        return float(matches.weight @ np.log1p((matches.distance(motion) / TIGHT) ** 2))

    used = pair.flow.confidence > 0
    at = pixel_grid(*pair.size)[used]
    r, q = rays(pair.K_ref, at), rays(pair.K_next, at + pair.flow.uv[used])
    z, z_next = epipolar.triangulate(min(motions, key=cost), r, q)
    front = (z > 0) & (z_next > 0)
    if front.any():
        front &= z <= FAR * np.median(z[front])
    depth = np.full(pair.size, np.nan)
    depth[used] = np.where(front, z, np.nan)
    return depth
