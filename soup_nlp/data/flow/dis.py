"""Flow by the dense inverse search of OpenCV, with forward-backward confidence.

A coarse-to-fine search loses large displacements with a change of scale, such as those of the
ground near a driving camera. The dominant homographies of a first flow explain most of such a
motion. The flow is therefore computed again on images that a homography aligns: the remaining
displacements are small. The new flow is used where its round trip closes better than the first one.
"""

from collections.abc import Callable

import cv2
import numpy as np

from soup_nlp.arrays import Float, FloatMap, Image
from soup_nlp.data.flow.consistency import LIMIT, SURE, confidence_of, round_trip_error, sampled
from soup_nlp.data.pair import Flow
from soup_nlp.geometry.camera import pixel_grid

Match = Callable[[Image, Image], tuple[FloatMap, FloatMap]]
"""Forward and backward flow of two grey images of one size."""

_STEP = 4  # homographies are fitted to every fourth pixel of both directions
_LEAST = 0.03  # share of the confident pixels that a homography must explain
_INLIER = 2.0  # pixels
_WINDOW = 25  # side of the window of a score, pixels
_GREY_CAP, _PER_GREY = 30.0, 0.05  # cap of a difference in grey levels; pixels per grey level


def dominant_homographies(flow: FloatMap, confidence: FloatMap, count: int) -> list[Float]:
    """Up to `count` homographies (3, 3) that fit most of a flow, one after the other (MAGSAC).

    They map reference to next pixels of the flow (H, W, 2) with this confidence (H, W).
    """
    height, width = confidence.shape
    v, u = np.mgrid[0:height:_STEP, 0:width:_STEP]
    sure = confidence[::_STEP, ::_STEP] > SURE
    ref = np.stack([u[sure], v[sure]], axis=-1).astype(np.float64)
    target = ref + flow[::_STEP, ::_STEP][sure]
    least = max(20.0, _LEAST * len(ref))
    out: list[Float] = []
    while len(out) < count and len(ref) >= least:
        H, inlier = cv2.findHomography(ref, target, cv2.USAC_MAGSAC, _INLIER, maxIters=2000)
        if H is None or inlier is None or inlier.sum() < least:
            break
        out.append(np.asarray(H, dtype=np.float64))
        outlier = inlier.ravel() == 0
        ref, target = ref[outlier], target[outlier]
    return out


def guided_flow(
    ref: Image, nxt: Image, match: Match, forward: FloatMap, backward: FloatMap
) -> tuple[FloatMap, FloatMap]:
    """The best, for each pixel, of a flow and of flows found under its dominant homographies.

    The score of a flow is the mean over a window of its round-trip error and of the grey-level
    difference between a pixel and its target. A flow under a homography must be better than the
    first flow, `forward` (H, W, 2) and `backward` (H', W', 2), by a margin. Images are grey.
    Returns the flow and its round-trip error (H, W).
    """
    gap = round_trip_error(forward, backward)
    maps = dominant_homographies(forward, confidence_of(gap, support=5), PLANES)
    best, best_gap = forward.copy(), gap
    best_score = flow_score(ref, nxt, forward, gap)
    for H in maps:
        flow, error = _under(H, ref, nxt, match)
        score = flow_score(ref, nxt, flow, error) + MARGIN
        better = score < best_score
        best[better], best_gap[better] = flow[better], error[better]
        best_score = np.minimum(score, best_score)
    return best, best_gap


def _under(H: Float, ref: Image, nxt: Image, match: Match) -> tuple[FloatMap, FloatMap]:
    """Flow and round-trip error after the next image has been warped to the first by H."""
    flags, edge = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, cv2.BORDER_REPLICATE
    near = cv2.warpPerspective(nxt, H, ref.shape[::-1], flags=flags, borderMode=edge)
    residual, back = match(ref, near)
    pixel = pixel_grid(*ref.shape)
    at = np.dstack([pixel + residual, np.ones(ref.shape)]) @ H.T
    behind = at[..., 2] <= 1e-6
    at = at[..., :2] / np.where(behind, 1.0, at[..., 2])[..., None]
    gap = round_trip_error(residual, back)
    inside = (at >= 0).all(axis=-1) & (at <= np.array(nxt.shape[::-1]) - 1.0).all(axis=-1)
    gap[behind | ~inside] = np.inf
    flow = at - pixel
    flow[behind] = 0.0
    return flow.astype(np.float32), gap


def flow_score(ref: Image, nxt: Image, flow: FloatMap, gap: FloatMap) -> FloatMap:
    """(H, W) mean over a window of the round-trip error (H, W) and of the difference in grey levels
    between a pixel and its target, pixels; large where the round trip leaves the image."""
    height, width = ref.shape
    v, u = np.mgrid[0:height, 0:width].astype(np.float32)
    target = sampled(nxt, u + flow[..., 0], v + flow[..., 1])
    grey = np.minimum(np.abs(target - ref), _GREY_CAP)
    cost = np.minimum(gap, LIMIT) + np.float32(_PER_GREY) * grey
    score = cv2.blur(cost.astype(np.float32), (_WINDOW, _WINDOW))
    score[~np.isfinite(gap)] = 2 * (LIMIT + _PER_GREY * _GREY_CAP)
    return np.asarray(score, dtype=np.float32)


FINEST_SCALE, PATCH_SIZE, PATCH_STRIDE = 0, 8, 2
"""Full resolution, and denser patches than in OpenCV's medium preset (stride 3)."""
ITERATIONS, ALPHA, DELTA, GAMMA = 20, 30.0, 1.0, 10.0
"""Longer and smoother refinement than the preset (5 iterations, alpha 20), with less weight on
intensities (preset: delta 5): the error falls on driving, indoor and rendered pairs."""
PLANES = 4
"""Dominant homographies under which the flow is computed again."""
MARGIN = 0.3
"""By how much another flow must be better than the first one, pixels."""

_FLAT = 1.0  # standard deviation in grey levels of an image without contrast
_WORK_SIDE = 64  # DIS gets images of at least this side; smaller ones are padded


def dis_flow(image_ref: Image, image_next: Image, consistency: bool = True) -> Flow:
    """Dense inverse search flow (Kroeger et al., ECCV 2016) of two RGB images, of any two sizes.

    The flow is computed in both directions, and again after each of the dominant homographies
    (`PLANES`) has aligned the images. The better one is used for each pixel (`guided_flow`), since
    displacements near a driving camera are too large for a coarse-to-fine search alone.

    The confidence follows from the round-trip error (`confidence_of`); without `consistency` it is
    1 wherever the round trip stays in the images. A wrong but consistent flow, as on weak texture,
    keeps its confidence. An image without contrast (standard deviation below one grey level) gives
    a zero flow with confidence 0.
    """
    ref, nxt = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (image_ref, image_next))
    if min(float(ref.std()), float(nxt.std())) < _FLAT:
        return Flow(np.zeros((*ref.shape, 2), np.float32), np.zeros(ref.shape, np.float32), "dis")
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    dis.setFinestScale(FINEST_SCALE)
    dis.setPatchSize(PATCH_SIZE)
    dis.setPatchStride(PATCH_STRIDE)
    dis.setVariationalRefinementIterations(ITERATIONS)
    dis.setVariationalRefinementAlpha(ALPHA)
    dis.setVariationalRefinementDelta(DELTA)
    dis.setVariationalRefinementGamma(GAMMA)

    def match(first: Image, second: Image) -> tuple[FloatMap, FloatMap]:
        size = np.maximum(np.maximum(first.shape, second.shape), _WORK_SIDE)
        # the last row and column are repeated up to a common size
        a, b = (
            np.pad(image, [(0, n - m) for n, m in zip(size, image.shape, strict=True)], mode="edge")
            for image in (first, second)
        )
        (h1, w1), (h2, w2) = first.shape, second.shape
        return dis.calc(a, b, None)[:h1, :w1], dis.calc(b, a, None)[:h2, :w2]

    uv, gap = guided_flow(ref, nxt, match, *match(ref, nxt))
    confidence = confidence_of(gap) if consistency else np.isfinite(gap)
    return Flow(np.ascontiguousarray(uv), confidence.astype(np.float32), "dis")
