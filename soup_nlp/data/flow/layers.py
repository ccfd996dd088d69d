"""Correction of flow that follows a static layer, such as a reflection in a windscreen.

Where the layer has more contrast than the scene, the flow follows the layer: it is zero, consistent
and fully confident, and the depth of the road becomes infinite. The motion of the scene becomes
visible when the gradients that both images share at the same pixel are removed. The flow of the
scene is then searched along the epipolar lines of the rigid motion of the remaining flow.
"""

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.fft import dctn, idctn

from soup_nlp.arrays import Float, FloatMap, Image
from soup_nlp.data.flow.consistency import SURE, confidence_of
from soup_nlp.data.flow.epipolar_search import matching_cost, round_trip
from soup_nlp.data.pair import Flow, Pair

STILL_PX, MOVES_PX = 0.5, 2.0
"""Largest displacement of a static pixel, and least difference to it of one that moves, pixels."""
LEAST_GAIN = 1.0
"""Least reduction of the matching cost by the new flow for a static pixel to be contradicted."""
MIN_CONTRADICTED = 0.002
"""Smallest share of contradicted static pixels for a correction."""


def without_still_layer(ref: Image, nxt: Image) -> tuple[Image, Image]:
    """Grey versions (H, W) of two images (H, W, 3) without the gradients that they share.

    If the derivatives of both images at a pixel have the same sign, the smaller one is subtracted
    from both. The images are recovered from the rest by Poisson's equation with free borders
    (cosine transforms). Regions without a static layer lose some contrast in both images.
    """
    images = np.stack([cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (ref, nxt)])
    values = images.astype(np.float32)
    # differences of both images to the pixels on the right and below; 0 at the border
    along = np.diff(values, axis=2, append=values[..., -1:])
    down = np.diff(values, axis=1, append=values[:, -1:])
    for both in (along, down):
        a, b = both
        both -= np.where(a * b > 0, np.sign(a) * np.minimum(np.abs(a), np.abs(b)), 0)
    first, second = (_integrated(along[k], down[k], float(images[k].mean())) for k in (0, 1))
    return first, second


def _integrated(along: FloatMap, down: FloatMap, mean: float) -> Image:
    height, width = along.shape
    divergence = np.diff(along, axis=1, prepend=0) + np.diff(down, axis=0, prepend=0)
    v, u = np.arange(height)[:, None], np.arange(width)
    laplacian = 2 * (np.cos(np.pi * v / height) + np.cos(np.pi * u / width)) - 4
    laplacian[0, 0] = 1.0
    spectrum = dctn(divergence, norm="ortho") / laplacian
    spectrum[0, 0] = 0.0
    image = idctn(spectrum, norm="ortho") + mean
    return np.clip(np.rint(image), 0, 255).astype(np.uint8)


def still(flow: Flow) -> NDArray[np.bool_]:
    """(H, W) static pixels with a confident flow."""
    near: NDArray[np.bool_] = np.linalg.norm(flow.uv, axis=2) < STILL_PX
    return near & (flow.confidence > SURE)


def corrected(pair: Pair, R: Float, t: Float) -> Flow | None:
    """The flow of a pair, corrected where it follows a static layer instead of the scene.

    R (3, 3) and the unit translation t (3,) are the rigid motion of the pixels that do not follow
    it. On images without the layer, flow is searched for along epipolar lines, and matching costs
    are compared. None if too few static pixels are contradicted.
    """
    flow = pair.flow
    assert flow is not None
    images = without_still_layer(pair.image_ref, pair.image_next)
    new, error = round_trip(*images, R, t, pair.K_ref, pair.K_next)
    gain = matching_cost(*images, flow.uv) - matching_cost(*images, new)
    moved = np.linalg.norm(new - flow.uv, axis=2) > MOVES_PX
    if (still(flow) & moved & (gain > LEAST_GAIN)).mean() < MIN_CONTRADICTED:
        return None
    wrong = moved & (gain > 0)
    uv = np.where(wrong[..., None], new, flow.uv)
    confidence = np.where(wrong, confidence_of(error), flow.confidence)
    return Flow(uv, confidence, flow.source)
