"""Flow by the dense inverse search of OpenCV, with forward-backward confidence.

A coarse-to-fine search loses large displacements with a change of scale, such as those of the
ground near a driving camera. The dominant homographies of a first flow explain most of such a
motion. The flow is therefore computed again on images that a homography aligns: the remaining
displacements are small. The new flow is used where its round trip closes better.
"""

from collections.abc import Callable

import cv2
import numpy as np

from soup_nlp.arrays import Float, FloatMap, Image
from soup_nlp.data.flow.consistency import LIMIT, SUPPORT, confidence_of, round_trip_error
from soup_nlp.data.pair import Flow
from soup_nlp.errors import DataError

Match = Callable[[Image, Image], tuple[FloatMap, FloatMap]]
"""Forward and backward flow of two grey images."""

PLANES = 4
"""Dominant homographies under which the flow is computed again."""
LEAST_SHARE = 0.03
"""Share of the confident pixels that a homography must explain."""
MARGIN = 0.3
"""By how much the round trip of a flow under a homography must close better, pixels."""
STRIDE, ITERATIONS, ALPHA, DELTA = 2, 20, 30.0, 1.0
"""Denser patches than OpenCV's medium preset (stride 3), and a longer and smoother refinement with
less weight on intensities (5, 20, 5): the error falls on driving, indoor and rendered pairs."""
MIN_SIDE = 16
"""Smallest image side for DIS, pixels; smaller than 64, images are padded."""


def dominant_homographies(flow: FloatMap, confidence: FloatMap, count: int) -> list[Float]:
    """Up to `count` homographies that fit most of a flow, found one after the other (MAGSAC).

    Args:
        flow: (H, W, 2), pixels.
        confidence: (H, W), in [0, 1].
        count: Largest number of homographies.

    Returns:
        (3, 3) maps from reference to next pixels, the dominant one first.
    """
    # every fourth pixel of both directions
    v, u = np.nonzero(confidence[::4, ::4] > 0.5)
    ref = 4.0 * np.stack([u, v], axis=-1)
    target = ref + flow[4 * v, 4 * u]
    least = max(20.0, LEAST_SHARE * len(ref))
    out: list[Float] = []
    while len(out) < count and len(ref) >= least:
        H, inlier = cv2.findHomography(ref, target, cv2.USAC_MAGSAC, 2.0, maxIters=2000)
        if H is None or inlier is None or inlier.sum() < least:
            break
        out.append(np.asarray(H, dtype=np.float64))
        outlier = inlier.ravel() == 0
        ref, target = ref[outlier], target[outlier]
    return out


def guided_flow(ref: Image, nxt: Image, match: Match) -> tuple[FloatMap, FloatMap]:
    """The best, for each pixel, of a flow and of flows found under its dominant homographies.

    The score of a flow is the mean over a window of its limited round-trip error. A flow under a
    homography must be better than the first flow by `MARGIN`.

    Args:
        ref: (H, W) grey reference image.
        nxt: (H', W') grey next image.
        match: The flow method.

    Returns:
        (H, W, 2) flow and (H, W) its round-trip error, both in pixels.
    """
    best, backward = match(ref, nxt)
    gap = round_trip_error(best, backward)
    score = _score(gap)
    # a small window: the near ground has usable flow in small pieces
    for H in dominant_homographies(best, confidence_of(gap, support=5), PLANES):
        flow, error = _under(H, ref, nxt, match)
        new = _score(error) + MARGIN
        better = new < score
        best[better], gap[better], score[better] = flow[better], error[better], new[better]
    return best, gap


def _under(H: Float, ref: Image, nxt: Image, match: Match) -> tuple[FloatMap, FloatMap]:
    """Flow and round-trip error after the next image has been warped to the first by H."""
    height, width = ref.shape
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    near = cv2.warpPerspective(
        nxt, H, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE
    )
    residual, back = match(ref, near)
    v, u = np.mgrid[0:height, 0:width].astype(np.float64)
    at = np.stack([u + residual[..., 0], v + residual[..., 1], np.ones_like(u)], axis=-1) @ H.T
    behind = at[..., 2] <= 1e-6
    at = at[..., :2] / np.where(behind, 1.0, at[..., 2])[..., None]
    gap = round_trip_error(residual, back)
    inside = (at >= 0).all(axis=-1) & (at <= np.array(nxt.shape[::-1]) - 1.0).all(axis=-1)
    gap[behind | ~inside] = np.inf
    flow = np.stack([at[..., 0] - u, at[..., 1] - v], axis=-1)
    flow[behind] = 0.0
    return flow.astype(np.float32), gap


def _score(gap: FloatMap) -> FloatMap:
    score = cv2.blur(np.minimum(gap, LIMIT), (SUPPORT, SUPPORT))
    return np.where(np.isfinite(gap), score, 2 * LIMIT).astype(np.float32)


def dis_flow(image_ref: Image, image_next: Image, consistency: bool = True) -> Flow:
    """Dense inverse search flow (Kroeger et al., ECCV 2016) with forward-backward confidence.

    It is computed in both directions, and again after
    each of the dominant homographies has aligned the images (`guided_flow`). The confidence follows
    from the round-trip error (`confidence_of`). A wrong but consistent flow, as on weak texture,
    keeps its confidence. An image without contrast (standard deviation below one grey level) gives
    a zero flow with confidence 0.

    Args:
        image_ref: (H, W, 3) uint8 RGB reference image.
        image_next: (H', W', 3) uint8 RGB next image; it may differ in size.
        consistency: If false, the confidence is 1 wherever the round trip stays in the images.

    Raises:
        DataError: an image is too small.
    """
    for where, image in (("image_ref", image_ref), ("image_next", image_next)):
        if min(image.shape[:2]) < MIN_SIDE:
            raise DataError(
                "image is too small for DIS flow",
                where=where,
                found=f"{image.shape[1]}x{image.shape[0]}",
                expected=f"at least {MIN_SIDE} pixels on each side",
            )
    ref, nxt = (cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (image_ref, image_next))
    if min(float(ref.std()), float(nxt.std())) < 1.0:
        zero = np.zeros((*ref.shape, 3), np.float32)
        return Flow(zero[..., :2], zero[..., 2], "dis")
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    dis.setFinestScale(0)
    dis.setPatchStride(STRIDE)
    dis.setVariationalRefinementIterations(ITERATIONS)
    dis.setVariationalRefinementAlpha(ALPHA)
    dis.setVariationalRefinementDelta(DELTA)

    def match(first: Image, second: Image) -> tuple[FloatMap, FloatMap]:
        size = np.maximum(np.maximum(first.shape, second.shape), 4 * MIN_SIDE)
        # the last row and column are repeated up to a common size
        a, b = (
            np.pad(image, [(0, n - m) for n, m in zip(size, image.shape, strict=True)], mode="edge")
            for image in (first, second)
        )
        (h1, w1), (h2, w2) = first.shape, second.shape
        return dis.calc(a, b, None)[:h1, :w1], dis.calc(b, a, None)[:h2, :w2]

    uv, gap = guided_flow(ref, nxt, match)
    confidence = confidence_of(gap) if consistency else np.isfinite(gap)
    return Flow(np.ascontiguousarray(uv), confidence.astype(np.float32), "dis")
