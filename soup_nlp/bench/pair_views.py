"""Mirrored, reversed and cropped versions of a pair with its truth.

Superpixels, flow and discrete decisions differ between such versions of the same scene. Measuring
all of them shows how much a figure depends on chance.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float
from soup_nlp.data.flow.consistency import leaves
from soup_nlp.data.pair import Pair, Truth
from soup_nlp.errors import DataError

Change = Callable[[NDArray[Any]], NDArray[Any]]

IMAGES = ("depth_ref", "depth_next", "flow", "occluded", "components", "scene_flow")
"""Parts of a truth with a value for every pixel."""
_FLIP = np.diag([-1.0, 1.0, 1.0, 1.0])


def mirrored(pair: Pair) -> Pair:
    """The pair mirrored left to right: the columns are reversed and x changes its sign.

    Depths do not change; intrinsics, flow, motions, points and scene flow are mirrored.
    """
    width, there = pair.image_ref.shape[1], pair.image_next.shape[1]

    def turned(uv: NDArray[Any]) -> NDArray[Any]:
        out = uv.copy()
        out[..., 0] = (there - width) - out[..., 0]
        return out

    seen = _each_image(pair, lambda array: array[:, ::-1].copy())
    flow, truth = seen.flow, seen.truth
    if flow is not None:
        known = flow.confidence[..., None] > 0
        flow = replace(flow, uv=np.where(known, turned(flow.uv), np.float32(0.0)))
    if truth is not None:
        changes: dict[str, Change] = {
            "flow": turned,
            "scene_flow": lambda flow: flow @ _FLIP[:3, :3],
            "points": lambda points: points * [-1, 1, 1] + [width - 1, 0, 0],
            "motions": lambda motions: _FLIP @ motions @ _FLIP,
        }
        truth = _changed(truth, changes)
    K_ref, K_next = _mirrored_camera(pair.K_ref, width), _mirrored_camera(pair.K_next, there)
    return replace(seen, K_ref=K_ref, K_next=K_next, flow=flow, truth=truth)


def backwards(pair: Pair) -> Pair:
    """The pair with its two frames exchanged and without a flow.

    Raises:
        DataError: the depth of the next frame is not known.
    """
    truth = pair.truth
    if truth is None or truth.depth_next is None:
        raise DataError(
            "frames cannot be exchanged without a truth for the next one",
            where=pair.name,
            expected="truth.depth_next",
        )
    motions = None
    if truth.motions is not None:
        motions = np.asarray(np.linalg.inv(truth.motions), np.float64)
    turned = Truth(truth.depth_next, truth.depth_ref, motions=motions, unit=truth.unit)
    return replace(
        pair,
        image_ref=pair.image_next,
        image_next=pair.image_ref,
        K_ref=pair.K_next,
        K_next=pair.K_ref,
        flow=None,
        truth=turned,
    )


def _mirrored_camera(K: Float, width: int) -> Float:
    out = K.copy()
    out[0, 1], out[0, 2] = -K[0, 1], width - 1 - K[0, 2]
    return out


def _changed(truth: Truth, changes: Mapping[str, Change]) -> Truth:
    """The truth with the known parts of these names changed."""
    own: dict[str, Any] = {
        k: change(v) for k, change in changes.items() if (v := getattr(truth, k)) is not None
    }
    return replace(truth, **own)


def _each_image(pair: Pair, change: Change) -> Pair:
    """The pair with every per-pixel array changed; cameras and sparse truth do not change."""
    flow, truth = pair.flow, pair.truth
    if flow is not None:
        flow = replace(flow, uv=change(flow.uv), confidence=change(flow.confidence))
    if truth is not None:
        truth = _changed(truth, dict.fromkeys(IMAGES, change))
    image_ref, image_next = change(pair.image_ref), change(pair.image_next)
    return replace(pair, image_ref=image_ref, image_next=image_next, flow=flow, truth=truth)


def cropped(pair: Pair, left: int, top: int, right: int = 0, bottom: int = 0) -> Pair:
    """The pair without margins (pixels) of both images; depths, flow and motions do not change.

    Raises:
        DataError: a margin is negative, or nothing would be left.
    """
    margins = (left, top, right, bottom)
    height, width = np.minimum(pair.image_ref.shape[:2], pair.image_next.shape[:2])
    if min(margins) < 0 or left + right >= width or top + bottom >= height:
        raise DataError(
            "margins do not fit the images",
            where=pair.name,
            found=f"left, top, right, bottom {margins}",
            expected=f"0 or more, less than {width} columns and {height} rows together",
        )

    def cut(array: NDArray[Any]) -> NDArray[Any]:
        rows, columns = array.shape[:2]
        return array[top : rows - bottom, left : columns - right].copy()

    corner = np.array([left, top, 0.0])
    seen = _each_image(pair, cut)
    truth = seen.truth
    if truth is not None and truth.flow is not None and truth.occluded is not None:
        # pixels that move into the margin are no longer visible
        known = np.isfinite(truth.flow).all(axis=2)
        gone = known & leaves(truth.flow, seen.image_next.shape[:2])
        truth = replace(truth, occluded=truth.occluded | gone)
    if truth is not None and truth.points is not None:
        # a point is kept if its nearest pixel is
        pixel = np.floor(truth.points[:, :2] + 0.5) - corner[:2]
        inside = ((pixel >= 0) & (pixel < seen.size[::-1])).all(axis=1)
        truth = replace(truth, points=truth.points[inside] - corner)
    K_ref, K_next = pair.K_ref.copy(), pair.K_next.copy()
    for K in (K_ref, K_next):
        K[:2, 2] -= corner[:2]
    return replace(seen, K_ref=K_ref, K_next=K_next, truth=truth)
