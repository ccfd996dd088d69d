"""Search along epipolar lines for pixels whose flow is not sure, by semi-global matching.

A dense search in two dimensions loses large displacements and weak texture. Where a pixel moves
with the camera's motion, one unknown is left, its inverse depth. Costs of matching are summed along
paths, in which the inverse depth changes at a price, so that weak texture follows what is around it
(H. Hirschmüller, PAMI 30, 2008; K. Yamaguchi, D. McAllester, R. Urtasun, ECCV 2014). The result is
one more flow among which the round trip and the colours choose, as in `guided_flow`.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float, FloatMap, Image
from soup_nlp.data.flow.consistency import (
    LIMIT,
    SUPPORT,
    SURE,
    confidence_of,
    round_trip_error,
    sampled,
)
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
NEAREST = 0.05
"""Least depth of a point in the next frame, in lengths of its ray before."""
WINDOW = 31
"""Side of the window over which a matching cost is averaged, pixels."""
DARKER = 0.5
"""Least difference to a darker neighbour, grey levels."""
COMPARED = (
    *((-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)),
    *((-2, 0), (2, 0), (0, -2), (0, 2), (-2, -2), (2, 2), (-2, 2), (2, -2)),
)
"""(dv, du) of the neighbours of a descriptor, in strides."""

Cost = NDArray[np.uint8]
Bits = NDArray[np.uint16]


def searched(pair: Pair, R: Float, t: Float) -> Flow:
    """The flow of a pair, searched for along epipolar lines where it is not sure.

    R (3, 3) and the unit translation t (3,) are the motion next_from_ref of the scene. Both images
    have one size. Pixels take the new flow if its score is better by `MARGIN`, and if their
    connected piece has a window of `SUPPORT` pixels in which the new flow is sure.
    """
    assert pair.flow is not None
    flow = pair.flow
    ref, nxt = (cv2.cvtColor(x, cv2.COLOR_RGB2GRAY) for x in (pair.image_ref, pair.image_next))
    new, error = round_trip(ref, nxt, R, t, pair.K_ref, pair.K_next)
    with np.errstate(divide="ignore"):
        # the round-trip error that the confidence stands for
        gap = np.minimum(np.sqrt(-np.log(flow.confidence)), np.float32(LIMIT))
    better = flow_score(ref, nxt, new, error) + MARGIN < flow_score(ref, nxt, flow.uv, gap)
    better &= flow.confidence <= SURE
    sure = (better & (confidence_of(error) > SURE)).astype(np.uint8)
    window = cv2.morphologyEx(sure, cv2.MORPH_OPEN, np.ones((SUPPORT, SUPPORT), np.uint8)) > 0
    piece = cv2.connectedComponents(better.astype(np.uint8), connectivity=4)[1]
    better &= np.isin(piece, piece[window])
    uv = np.where(better[..., None], new, flow.uv)
    return Flow(uv, np.where(better, confidence_of(error), flow.confidence), flow.source)


def round_trip(
    ref: Image, nxt: Image, R: Float, t: Float, K: Float, K_next: Float
) -> tuple[FloatMap, FloatMap]:
    """The flow along epipolar lines, see `epipolar_flow`, and its round-trip error (H, W)."""
    forward = epipolar_flow(ref, nxt, R, t, K, K_next)
    backward = epipolar_flow(nxt, ref, R.T, -R.T @ t, K_next, K)
    return forward, round_trip_error(forward, backward)


def epipolar_flow(ref: Image, nxt: Image, R: Float, t: Float, K: Float, K_next: Float) -> FloatMap:
    """(H, W, 2) flow along the epipolar lines of a motion between two grey images of one size.

    The inverse depth of least cost of every `STRIDE`-th pixel, between levels by a parabola,
    becomes a flow, which the variational step of DIS refines at all pixels.
    """
    levels = REACH * nxt.shape[1] / K_next[0, 0] * np.arange(LEVELS) / (LEVELS - 1)
    # a point at inverse depth m has the homogeneous pixel far + m shift
    far = np.moveaxis(rays(K, pixel_grid(*ref.shape)) @ (K_next @ R).T, -1, 0)
    shift = (K_next @ t)[:, None, None]
    first, second = descriptor(ref)[::STRIDE, ::STRIDE], descriptor(nxt)
    coarse, step = np.ascontiguousarray(far[:, ::STRIDE, ::STRIDE], np.float32), np.float32(shift)
    targets = (_pixels(coarse + np.float32(m) * step) for m in levels)
    cost = np.stack([_differences(first, second, *target) for target in targets], axis=-1)
    best = _between_levels(aggregated(cost)).astype(np.float32)
    v, u = np.mgrid[: ref.shape[0], : ref.shape[1]].astype(np.float32)
    inverse = sampled(cv2.medianBlur(best, 3), u / STRIDE, v / STRIDE) * levels[1]
    x, y = _pixels(far + inverse * shift)
    refinement = cv2.VariationalRefinement.create()
    refinement.setAlpha(ALPHA)
    refinement.setDelta(DELTA)
    refinement.setGamma(GAMMA)
    flow = refinement.calcUV(ref, nxt, (x - u).astype(np.float32), (y - v).astype(np.float32))
    return np.stack(flow, axis=-1)


def _pixels(point: NDArray[np.floating]) -> tuple[NDArray[np.floating], ...]:
    """x and y (H, W) of homogeneous pixels (3, H, W); those behind the camera are far outside."""
    ahead = np.maximum(point[2], NEAREST)
    return point[0] / ahead, point[1] / ahead


def _differences(
    first: Bits, second: Bits, x: NDArray[np.floating], y: NDArray[np.floating]
) -> Cost:
    """(H, W) bits in which descriptors differ from those at pixels (x, y) of (H, W)."""
    height, width = second.shape
    column = np.rint(np.clip(x, -1, width)).astype(np.int32)
    row = np.rint(np.clip(y, -1, height)).astype(np.int32)
    inside = (column >= 0) & (row >= 0) & (column < width) & (row < height)
    other = second.ravel().take(row * width + column, mode="clip")
    return np.where(inside, np.bitwise_count(first ^ other), np.uint8(OUTSIDE))


def matching_cost(ref: Image, nxt: Image, flow: FloatMap) -> FloatMap:
    """(H, W) bits in which descriptors differ along a flow, mean over a window."""
    x, y = np.moveaxis(pixel_grid(*ref.shape) + flow, -1, 0)
    bits = _differences(descriptor(ref), descriptor(nxt), x, y).astype(np.float32)
    return np.asarray(cv2.blur(bits, (WINDOW, WINDOW)), np.float32)


def descriptor(image: Image) -> Bits:
    """(H, W) census transform of a grey image: a bit for each darker one of the neighbours."""
    grey = cv2.GaussianBlur(image.astype(np.float32), (0, 0), STRIDE / 2)
    pad, (height, width) = 2 * STRIDE, grey.shape
    framed, bits = np.pad(grey, pad, mode="edge"), np.zeros(grey.shape, np.uint16)
    for k, (dv, du) in enumerate(COMPARED):
        v, u = pad + STRIDE * dv, pad + STRIDE * du
        darker = framed[v : v + height, u : u + width] < grey - DARKER
        bits |= darker.astype(np.uint16) << np.uint16(k)
    return bits


def aggregated(cost: Cost) -> Cost:
    """Costs (H, W, D) summed along the paths from the left, the right, above and below.

    L(p, d) = C(p, d) + min(L(q, d), L(q, d +- 1) + SMALL, min_k L(q, k) + LARGE) - min_k L(q, k)
    with q the pixel before p. Sums stay below 256, since C has at most 16 bits.
    """
    total = np.zeros(cost.shape, np.uint8)
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
