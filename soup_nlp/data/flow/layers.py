"""Correction of flow that follows a static layer, such as a reflection in a windscreen.

Where the layer has more contrast than the scene, the flow follows the layer: it is zero, consistent
and fully confident, and the depth of the road becomes infinite. The motion of the scene becomes
visible when the gradients that both images share at the same pixel are removed. The flow of the
scene is then searched along the epipolar lines of the rigid motion of the remaining flow.
"""

from collections.abc import Callable
from itertools import product

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.fft import dctn, idctn

from soup_nlp.arrays import Float, FloatMap, Image
from soup_nlp.data.census import census, census_at
from soup_nlp.data.pair import Flow
from soup_nlp.geometry.camera import pixel_grid, rays

LEVELS, REACH = 64, 0.25
"""Number of depths that are tried for each kind of plane, and largest displacement tried, in widths
of the image, at unit distance from the epipole."""
WINDOW, STRIDE = 31, 4
"""Side of the window over which costs are averaged, and distance between the examined pixels."""
TAU = 0.35
"""Truncation of the census cost."""
STILL_PX, MOVES_PX = 0.5, 2.0
"""Largest displacement of a static pixel, and least difference to it of one that moves, pixels."""
MIN_GAIN_STATIC, MIN_GAIN = 0.02, -0.01
"""Smallest reduction of the cost by the new flow for a static pixel to count as contradicted, and
for any pixel to be replaced once enough static pixels are contradicted."""
MIN_CONTRADICTED = 0.002
"""Smallest share of contradicted pixels for a correction."""
MAX_COST = 0.25
"""Largest cost of a confident new flow."""


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
    return near & (flow.confidence > 0.5)


def corrected(
    ref: Image, nxt: Image, flow: Flow, R: Float, t: Float, K_ref: Float, K_next: Float
) -> Flow | None:
    """The flow corrected where it follows a static layer instead of the scene.

    `ref` and `nxt` are grey images without the layer (`without_still_layer`); R (3, 3) and the unit
    translation t (3,) are the rigid motion of the pixels that do not follow it. The confidence at
    corrected pixels decreases with the distance in pixels from the epipolar line. None if too few
    static pixels are contradicted.
    """
    height, width = nxt.shape
    census_ref = np.ascontiguousarray(census(ref)[:, ::STRIDE, ::STRIDE])
    census_next, side = census(nxt), max(1, WINDOW // STRIDE)

    def cost_at(x: FloatMap, y: FloatMap) -> FloatMap:
        """Mean census difference over a window to pixels (x, y) of the next image, or `TAU`."""
        inside = (x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1)
        c = np.abs(census_at(census_next, x, y) - census_ref).sum(axis=(0, 3)) / 16
        c = np.where(inside, np.minimum(c, TAU), TAU).astype(np.float32)
        return np.asarray(cv2.blur(c, (side, side)), np.float32)

    pixels = pixel_grid(*ref.shape)
    u, v = np.moveaxis(pixels[::STRIDE, ::STRIDE].astype(np.float32), 2, 0)
    swept, cost = _swept(
        cost_at, u, v, rays(K_ref, pixels[::STRIDE, ::STRIDE]), R, t, K_next, width
    )
    now = flow.uv[::STRIDE, ::STRIDE]
    gain = cost_at(u + now[..., 0], v + now[..., 1]) - cost
    moved = np.linalg.norm(swept - now, axis=2)
    contradicted = still(flow)[::STRIDE, ::STRIDE] & (gain > MIN_GAIN_STATIC) & (moved > MOVES_PX)
    if contradicted.mean() < MIN_CONTRADICTED:
        return None

    def full(coarse: FloatMap) -> FloatMap:
        size = coarse.shape[1] * STRIDE, coarse.shape[0] * STRIDE
        return np.asarray(cv2.resize(coarse, size)[: ref.shape[0], : ref.shape[1]], np.float32)

    gain = cv2.blur(gain, (9, 9))
    wrong = (full(gain) > MIN_GAIN) & (full(moved) > MOVES_PX)
    guess = np.where(wrong[..., None], full(swept), flow.uv).astype(np.float32)
    # DIS on the two finest scales
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    dis.setFinestScale(0)
    dis.setCoarsestScale(1)
    dis.setVariationalRefinementIterations(10)
    uv = dis.calc(ref, nxt, guess.copy())
    line = np.cross(t, rays(K_ref, pixels) @ R.T)
    across = np.maximum(np.linalg.norm(line[..., :2], axis=2), 1e-12)
    off = K_next[0, 0] * np.abs(np.sum(line * rays(K_next, pixels + uv), axis=2)) / across
    sure = (np.linalg.norm(uv - guess, axis=2) < 3) & (full(cost) < MAX_COST)
    # pixels without confidence mostly leave the image, so that the search finds a wrong match
    sure &= flow.confidence > 0.3
    confidence = np.where(wrong, np.exp(-(off**2)) * sure, flow.confidence)
    uv = np.where(wrong[..., None], uv, flow.uv)
    return Flow(uv, confidence.astype(np.float32), flow.source)


def _swept(
    cost_at: Callable[[FloatMap, FloatMap], FloatMap],
    u: FloatMap,
    v: FloatMap,
    ray: Float,
    R: Float,
    t: Float,
    K: Float,
    width: int,
) -> tuple[FloatMap, FloatMap]:
    """Flow of least cost of pixels (u, v) along their epipolar lines, and its cost.

    Planes are swept over depth; K and width are those of the next image. The planes are parallel to
    the image, or horizontal like the ground in an upright image.
    """
    turned = (ray @ R.T).astype(np.float32)
    cost, flow = np.full(u.shape, np.inf, np.float32), np.zeros((*u.shape, 2), np.float32)
    level = np.maximum(ray[..., 1], 0.0) / max(float(ray[..., 1].max()), 1e-6)
    most = REACH * width / K[0, 0]
    for plane, share in product((np.ones_like(level), level), (np.arange(LEVELS) + 0.5) / LEVELS):
        point = turned + (most * share * plane[..., None] * t).astype(np.float32)
        ahead = np.maximum(point[..., 2], 0.05)
        x = (point[..., 0] / ahead * K[0, 0] + K[0, 2]).astype(np.float32)
        y = (point[..., 1] / ahead * K[1, 1] + K[1, 2]).astype(np.float32)
        c = cost_at(x, y)
        better = c < cost
        cost[better] = c[better]
        flow[better] = np.stack([x - u, y - v], axis=-1)[better]
    return flow, cost
