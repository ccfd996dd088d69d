"""Flow computed again on images that a dominant homography aligns.

A coarse-to-fine search loses large displacements with a change of scale, as of the ground near a
driving camera. The dominant homographies of a first flow explain most of such a motion: what
remains is small, and where its round trip closes better than the first flow's, it is taken.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from soup_nlp.arrays import Float, FloatMap, Image
from soup_nlp.data.flow.consistency import confidence_of, round_trip_error

Match = Callable[[Image, Image], tuple[FloatMap, FloatMap]]
"""Forward and backward flow of two grey images of one size."""

_STEP = 4  # homographies are fitted to every fourth pixel of both directions
_SURE = 0.5  # confidence above which a pixel is fitted
_LEAST = 0.03  # share of the confident pixels that a homography must explain
_INLIER = 2.0  # pixels
_ROUND_TRIP_CAP = 3.0  # pixels
_WINDOW = 25  # side of the window of a score, pixels
_MARGIN = 0.3  # by how much a flow under a homography must be better, pixels
_GREY_CAP, _PER_GREY = 30.0, 0.05  # pixels that one grey level of difference counts for


def dominant_homographies(flow: FloatMap, confidence: FloatMap, count: int) -> list[Float]:
    """Up to `count` homographies that fit most of a flow, found one after the other (MAGSAC).

    Args:
        flow: (H, W, 2), pixels.
        confidence: (H, W), in [0, 1].
        count: Largest number of homographies.

    Returns:
        (3, 3) maps from reference to next pixels, the dominant one first.
    """
    height, width = confidence.shape
    v, u = np.mgrid[0:height:_STEP, 0:width:_STEP]
    sure = confidence[::_STEP, ::_STEP] > _SURE
    ref = np.stack([u[sure], v[sure]], axis=-1).astype(np.float64)
    target = ref + flow[::_STEP, ::_STEP][sure]
    least = max(20.0, _LEAST * len(ref))
    out: list[Float] = []
    while len(out) < count and len(ref) >= least:
        H, inlier = cv2.findHomography(ref, target, cv2.USAC_MAGSAC, _INLIER, maxIters=2000)
        if H is None or inlier is None or inlier.sum() < least:
            break
        out.append(np.asarray(H, dtype=np.float64))
        rest = inlier.ravel() == 0
        ref, target = ref[rest], target[rest]
    return out


def guided_flow(
    ref: Image,
    nxt: Image,
    match: Match,
    forward: FloatMap,
    backward: FloatMap,
    planes: int,
) -> tuple[FloatMap, FloatMap]:
    """The best, for each pixel, of a flow and of flows found under its dominant homographies.

    The score of a flow is the mean over a window of its round-trip error and of the grey-level
    difference between a pixel and its target. A flow under a homography must be better than the
    first flow by a margin.

    Args:
        ref: (H, W) grey reference image.
        nxt: (H', W') grey next image.
        match: The flow method.
        forward: (H, W, 2) first flow.
        backward: (H', W', 2) first flow in the other direction.
        planes: Number of homographies.

    Returns:
        (H, W, 2) flow and (H, W) its round-trip error, both in pixels.
    """
    gap = round_trip_error(forward, backward)
    maps = dominant_homographies(forward, confidence_of(gap, support=5), planes) if planes else []
    best, best_gap = forward.copy(), gap
    best_score = _score(ref, nxt, forward, gap)
    for H in maps:
        flow, error = _under(H, ref, nxt, match)
        score = _score(ref, nxt, flow, error) + _MARGIN
        better = score < best_score
        best[better], best_gap[better] = flow[better], error[better]
        best_score = np.minimum(score, best_score)
    return best, best_gap


def _under(H: Float, ref: Image, nxt: Image, match: Match) -> tuple[FloatMap, FloatMap]:
    """Flow and round-trip error after the next image has been warped to the first by H."""
    height, width = ref.shape
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    near = cv2.warpPerspective(
        nxt, H, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE
    )
    rest, back = match(ref, near)
    v, u = np.mgrid[0:height, 0:width].astype(np.float64)
    at = np.stack([u + rest[..., 0], v + rest[..., 1], np.ones_like(u)], axis=-1) @ H.T
    behind = at[..., 2] <= 1e-6
    at = at[..., :2] / np.where(behind, 1.0, at[..., 2])[..., None]
    gap = round_trip_error(rest, back)
    inside = (at >= 0).all(axis=-1) & (at <= np.array(nxt.shape[::-1]) - 1.0).all(axis=-1)
    gap[behind | ~inside] = np.inf
    flow = np.stack([at[..., 0] - u, at[..., 1] - v], axis=-1)
    flow[behind] = 0.0
    return flow.astype(np.float32), gap


def _score(ref: Image, nxt: Image, flow: FloatMap, gap: FloatMap) -> FloatMap:
    height, width = ref.shape
    v, u = np.mgrid[0:height, 0:width].astype(np.float32)
    x, y = u + flow[..., 0], v + flow[..., 1]
    there = cv2.remap(
        nxt.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    grey = np.minimum(np.abs(there - ref), _GREY_CAP)
    cost = np.minimum(gap, _ROUND_TRIP_CAP) + np.float32(_PER_GREY) * grey
    score = cv2.blur(cost.astype(np.float32), (_WINDOW, _WINDOW))
    score[~np.isfinite(gap)] = 2 * (_ROUND_TRIP_CAP + _PER_GREY * _GREY_CAP)
    return np.asarray(score, dtype=np.float32)
