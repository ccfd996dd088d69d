"""Search along epipolar lines for pixels whose flow is not sure, by semi-global matching.

A dense search in two dimensions loses large displacements and weak texture. Where a pixel moves
with the camera's motion, one unknown is left, its inverse depth. Costs of matching are summed along
paths, in which the inverse depth changes at a price, so that weak texture follows what is around it
(H. Hirschmueller, PAMI 30, 2008; K. Yamaguchi, D. McAllester, R. Urtasun, ECCV 2014). The result is
one more flow among which the round trip and the colours choose, as in `guided_flow`.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float, FloatMap, Image
from soup_nlp.data.flow.consistency import LIMIT, confidence_of, round_trip_error, sampled
from soup_nlp.data.flow.dis import ALPHA, DELTA, GAMMA, MARGIN, flow_score
from soup_nlp.data.pair import Flow, Pair
from soup_nlp.geometry.camera import pixel_grid, rays

LEVELS, REACH = 128, 0.25
"""Number of inverse depths, and displacement by the largest of them at unit distance from the
epipole, in widths of the image."""
STRIDE = 2
"""Distance between the pixels that are searched, and between those that a descriptor compares."""
SMALL, LARGE = 3, 24
"""Price of a change of the inverse depth by one level and by more, in bits of the descriptor."""
OUTSIDE = 8
"""Cost of a target outside of the image: half of the bits."""
SURE = 0.5
"""Confidence of a flow from which on it is not searched again."""
COMPARED = (
    *((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)),
    *((-2, 0), (2, 0), (0, -2), (0, 2), (-2, -2), (2, 2), (-2, 2), (2, -2)),
)
"""(dv, du) of the neighbours of a descriptor, in strides."""

Cost = NDArray[np.uint8]


def searched(pair: Pair, R: Float, t: Float) -> Flow:
    """The flow of a pair, searched for along epipolar lines where it is not sure.

    R (3, 3) and the unit translation t (3,) are the motion next_from_ref of the scene. Both images
    have one size. A pixel takes the new flow if its score is better by `MARGIN`.
    """
    assert pair.flow is not None
    flow = pair.flow
    ref, nxt = (cv2.cvtColor(x, cv2.COLOR_RGB2GRAY) for x in (pair.image_ref, pair.image_next))
    forward = epipolar_flow(ref, nxt, R, t, pair.K_ref, pair.K_next)
    backward = epipolar_flow(nxt, ref, R.T, -R.T @ t, pair.K_next, pair.K_ref)
    error = round_trip_error(forward, backward)
    with np.errstate(divide="ignore"):
        gap = np.minimum(np.sqrt(-np.log(flow.confidence)), LIMIT)
    better = flow_score(ref, nxt, forward, error) + MARGIN < flow_score(ref, nxt, flow.uv, gap)
    better &= flow.confidence <= SURE
    uv = np.where(better[..., None], forward, flow.uv)
    return Flow(uv, np.where(better, confidence_of(error), flow.confidence), flow.source)


def epipolar_flow(ref: Image, nxt: Image, R: Float, t: Float, K: Float, K_next: Float) -> FloatMap:
    """(H, W, 2) flow along the epipolar lines of a motion between two grey images of one size.

    The inverse depth of least cost of every `STRIDE`-th pixel, between levels by a parabola,
    becomes a flow, which the variational step of DIS refines at all pixels.
    """
    levels = REACH * nxt.shape[1] / K_next[0, 0] * np.arange(LEVELS) / (LEVELS - 1)
    ray = rays(K, pixel_grid(*ref.shape)) @ R.T
    first, second = descriptor(ref)[::STRIDE, ::STRIDE], descriptor(nxt)
    cost = np.empty((*first.shape, LEVELS), np.uint8)
    coarse = np.ascontiguousarray(ray[::STRIDE, ::STRIDE])
    for k, inverse in enumerate(levels):
        x, y = np.moveaxis(np.rint(_projected(coarse + inverse * t, K_next)).astype(int), -1, 0)
        inside = (x >= 0) & (y >= 0) & (x < nxt.shape[1]) & (y < nxt.shape[0])
        other = second[np.where(inside, y, 0), np.where(inside, x, 0)]
        cost[..., k] = np.where(inside, np.bitwise_count(first ^ other), OUTSIDE)
    best = _between_levels(aggregated(cost)).astype(np.float32)
    v, u = np.mgrid[: ref.shape[0], : ref.shape[1]].astype(np.float32) / STRIDE
    inverse = sampled(cv2.medianBlur(best, 3), u, v) * levels[1]
    flow = _projected(ray + inverse[..., None] * t, K_next) - pixel_grid(*ref.shape)
    refinement = cv2.VariationalRefinement.create()
    refinement.setAlpha(ALPHA)
    refinement.setDelta(DELTA)
    refinement.setGamma(GAMMA)
    parts = (np.ascontiguousarray(flow[..., k], np.float32) for k in (0, 1))
    return np.stack(refinement.calcUV(ref, nxt, *parts), axis=-1)


def _projected(point: Float, K: Float) -> Float:
    """(..., 2) pixels of points (..., 3); those behind the camera are far outside."""
    ahead = np.maximum(point[..., 2:], 0.05)
    return point[..., :2] / ahead * K.diagonal()[:2] + K[:2, 2]


def descriptor(image: Image) -> NDArray[np.uint16]:
    """(H, W) census transform of a grey image: a bit for each darker one of the neighbours."""
    grey = cv2.GaussianBlur(image.astype(np.float32), (0, 0), STRIDE / 2)
    pad, (height, width) = 2 * STRIDE, grey.shape
    framed, bits = np.pad(grey, pad, mode="edge"), np.zeros(grey.shape, np.uint16)
    for k, (dv, du) in enumerate(COMPARED):
        v, u = pad + STRIDE * dv, pad + STRIDE * du
        darker = framed[v : v + height, u : u + width] < grey - 0.5
        bits |= darker.astype(np.uint16) << np.uint16(k)
    return bits


def aggregated(cost: Cost) -> Cost:
    """Costs (H, W, D) summed along the paths from the left, the right, above and below.

    L(p, d) = C(p, d) + min(L(q, d), L(q, d +- 1) + SMALL, min_k L(q, k) + LARGE) - min_k L(q, k)
    with q the pixel before p. Sums stay below 256, since C has at most 16 bits.
    """
    total = np.zeros_like(cost)
    for axes in ((0, 1, 2), (1, 0, 2)):
        along = np.ascontiguousarray(cost.transpose(axes))
        for step in (1, -1):
            rows, sums = along[::step], total.transpose(axes)[::step]
            path = rows[0].copy()
            sums[0] += path
            for row, out in zip(rows[1:], sums[1:]):
                path -= path.min(axis=1, keepdims=True)
                least = np.minimum(path, LARGE)
                np.minimum(least[:, 1:], path[:, :-1] + SMALL, out=least[:, 1:])
                np.minimum(least[:, :-1], path[:, 1:] + SMALL, out=least[:, :-1])
                path = least + row
                out += path
    return total


def _between_levels(cost: Cost) -> Float:
    """(H, W) position of the least cost (H, W, D), by a parabola through its two neighbours."""
    best = cost.argmin(axis=2)
    at = np.clip(best, 1, cost.shape[2] - 2)
    before, here, after = (
        np.take_along_axis(cost, (at + d)[..., None], 2)[..., 0].astype(float) for d in (-1, 0, 1)
    )
    bend = np.maximum(before - 2 * here + after, 1.0)
    return best + np.where(best == at, 0.5 * (before - after) / bend, 0.0)
