"""Flow by the dense inverse search of OpenCV, with forward-backward confidence."""

from __future__ import annotations

import cv2
import numpy as np

from soup_nlp.arrays import FloatMap, Image
from soup_nlp.data.flow.consistency import confidence_of
from soup_nlp.data.flow.guided import guided_flow
from soup_nlp.data.pair import Flow
from soup_nlp.errors import DataError

MIN_SIDE = 16
"""Smallest image side for DIS, pixels."""

FINEST_SCALE, PATCH_SIZE, PATCH_STRIDE = 0, 8, 2
"""Full resolution, and denser patches than those of OpenCV's medium preset (stride 3)."""
ITERATIONS, ALPHA, DELTA, GAMMA = 20, 30.0, 1.0, 10.0
"""A longer (5) and smoother (alpha 20) refinement than the preset's, which weighs gradients above
intensities (delta 5): the error falls on driving, indoor and rendered pairs."""
PLANES = 4
"""Dominant homographies under which the flow is computed again."""

_FLAT = 1.0  # standard deviation in grey levels of an image without contrast
_WORK_SIDE = 64  # DIS gets images of at least this side; smaller ones are padded


def dis_flow(image_ref: Image, image_next: Image, consistency: bool = True) -> Flow:
    """Dense inverse search flow (Kroeger et al., ECCV 2016) with forward-backward confidence.

    The flow is computed in both directions, and again after each of the dominant homographies
    (`PLANES`) has aligned the images. The better one is used for each pixel (`guided_flow`), since
    displacements near a driving camera are too large for a coarse-to-fine search alone.

    The confidence follows from the round-trip error (`confidence_of`). A wrong but consistent flow,
    as on weak texture, keeps its confidence. An image without contrast (standard deviation below
    one grey level) gives a zero flow with confidence 0.

    Args:
        image_ref: (H, W, 3) or (H, W) uint8 reference image.
        image_next: (H', W', 3) or (H', W') uint8 next image; it may differ in size.
        consistency: If false, the confidence is 1 wherever the round trip stays in the images.

    Raises:
        DataError: an image is not uint8 or too small.
    """
    ref, nxt = _grey(image_ref, "image_ref"), _grey(image_next, "image_next")
    height, width = ref.shape
    if min(float(ref.std()), float(nxt.std())) < _FLAT:
        zero = np.zeros((height, width), np.float32)
        return Flow(np.zeros((height, width, 2), np.float32), zero, "dis")
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

    try:
        forward, backward = match(ref, nxt)
        uv, gap = guided_flow(ref, nxt, match, forward, backward, PLANES)
    except cv2.error as error:
        raise DataError(
            "DIS flow failed", where=f"images {width}x{height}", found=str(error).strip()
        ) from error
    confidence = confidence_of(gap) if consistency else np.isfinite(gap)
    return Flow(np.ascontiguousarray(uv), confidence.astype(np.float32), "dis")


def _grey(image: Image, where: str) -> Image:
    if image.dtype != np.uint8 or image.shape[2:] not in ((), (3,)) or image.ndim < 2:
        raise DataError(
            "image must be 8-bit, grey or RGB",
            where=where,
            found=f"{image.dtype} {image.shape}",
            expected="uint8 (H, W) or (H, W, 3)",
        )
    if min(image.shape[:2]) < MIN_SIDE:
        raise DataError(
            "image is too small for DIS flow",
            where=where,
            found=f"{image.shape[1]}x{image.shape[0]}",
            expected=f"at least {MIN_SIDE} pixels on each side",
        )
    if image.ndim == 3:
        return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY))
    return np.ascontiguousarray(image)
