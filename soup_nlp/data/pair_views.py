"""The same pair seen otherwise, mirrored or cropped, with its truth: what luck has to do with it.

Superpixels, flow and choices come out differently on pixels that are the same but for their order
and their margin, so a figure that holds on all of them is worth more than one on a single pair.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soup_nlp.data.flow_check import leaves
from soup_nlp.data.pair import Flow, Pair
from soup_nlp.errors import DataError

Float = NDArray[np.float64]

_FLIP = np.diag([-1.0, 1.0, 1.0])


def mirrored(pair: Pair) -> Pair:
    """The pair as a mirror beside the camera shows it: columns run backwards, x points left.

    Depths stay; intrinsics, flow, motions, points and scene flow are those of the mirrored world.
    """
    width, there = pair.image_ref.shape[1], pair.image_next.shape[1]

    truth = pair.truth
    if truth is not None:
        own: dict[str, Any] = {
            k: _backwards(v)
            for k in ("depth_ref", "depth_next", "occluded", "bodies")
            if (v := getattr(truth, k)) is not None
        }
        if truth.flow is not None:
            own["flow"] = _mirrored_uv(truth.flow, there - width)
        if truth.scene_flow is not None:
            own["scene_flow"] = _backwards(truth.scene_flow) @ _FLIP
        if truth.points is not None:
            own["points"] = truth.points * [-1, 1, 1] + [width - 1, 0, 0]
        if truth.motions is not None:
            turn = np.diag([-1.0, 1.0, 1.0, 1.0])
            own["motions"] = turn @ truth.motions @ turn
        truth = replace(truth, **own)
    return replace(
        pair,
        image_ref=_backwards(pair.image_ref),
        image_next=_backwards(pair.image_next),
        K_ref=_mirrored_camera(pair.K_ref, width),
        K_next=_mirrored_camera(pair.K_next, there),
        flow=pair.flow and _mirrored_flow(pair.flow, there - width),
        truth=truth,
    )


def _mirrored_flow(flow: Flow, wider: int) -> Flow:
    uv, confidence = _mirrored_uv(flow.uv, wider), _backwards(flow.confidence)
    uv[confidence == 0] = 0.0
    return Flow(uv, confidence, flow.source)


def _mirrored_uv(uv: NDArray[Any], wider: int) -> NDArray[Any]:
    """Flow in the mirror, where the next image has so many columns more than the reference."""
    out = _backwards(uv)
    out[..., 0] = wider - out[..., 0]
    return out


def _backwards(array: NDArray[Any]) -> NDArray[Any]:
    return array[:, ::-1].copy()


def _mirrored_camera(K: Float, width: int) -> Float:
    out = K.copy()
    out[0, 1], out[0, 2] = -K[0, 1], width - 1 - K[0, 2]
    return out


def cropped(pair: Pair, left: int, top: int, right: int = 0, bottom: int = 0) -> Pair:
    """The pair without the margins of both images; depths, flow and motions are what they were.

    Args:
        pair: The pair.
        left: Columns taken away on the left, and so on.
        top: Rows.
        right: Columns.
        bottom: Rows.

    Raises:
        DataError: nothing would be left.
    """
    for image in (pair.image_ref, pair.image_next):
        if left + right >= image.shape[1] or top + bottom >= image.shape[0]:
            raise DataError(
                "margins are wider than the image",
                where=pair.name,
                found=f"{left} + {right} columns, {top} + {bottom} rows",
                expected=f"less than {image.shape[1]} and {image.shape[0]}",
            )

    def cut(array: NDArray[Any]) -> NDArray[Any]:
        rows, columns = array.shape[:2]
        return array[top : rows - bottom, left : columns - right].copy()

    corner = np.array([left, top, 0.0])
    truth = pair.truth
    if truth is not None:
        images = ("depth_ref", "depth_next", "flow", "occluded", "bodies", "scene_flow")
        own: dict[str, Any] = {k: cut(v) for k in images if (v := getattr(truth, k)) is not None}
        if "flow" in own and "occluded" in own:
            # what moves into the margin is not seen there any more
            gone = leaves(own["flow"], cut(pair.image_next).shape[:2])
            own["occluded"] = own["occluded"] | (np.isfinite(own["flow"]).all(axis=2) & gone)
        if truth.points is not None:
            # a point belongs to the pixel that it is nearest to
            pixel = np.floor(truth.points[:, :2] + 0.5)
            end = np.array([pair.size[1] - right, pair.size[0] - bottom])
            inside = ((pixel >= corner[:2]) & (pixel < end)).all(axis=1)
            own["points"] = truth.points[inside] - corner
        truth = replace(truth, **own)
    return replace(
        pair,
        image_ref=cut(pair.image_ref),
        image_next=cut(pair.image_next),
        K_ref=_cropped_camera(pair.K_ref, corner),
        K_next=_cropped_camera(pair.K_next, corner),
        flow=pair.flow and Flow(cut(pair.flow.uv), cut(pair.flow.confidence), pair.flow.source),
        truth=truth,
    )


def _cropped_camera(K: Float, corner: Float) -> Float:
    out = K.copy()
    out[:2, 2] -= corner[:2]
    return out
