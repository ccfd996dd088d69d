"""Pairs at other sizes: a working size, and frames of different focal lengths at one scale."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float
from soup_nlp.data.formats.images import DataWarning
from soup_nlp.data.pair import Flow, Pair, Truth

Size = tuple[int, int]

ALIKE = 1.1
"""Largest ratio of two focal lengths of which flow methods find displacements reliably."""
FEW = 0.2
"""Share of usable pixels below which the focal lengths are doubted."""


def working_size(pair: Pair, megapixels: float | None) -> Pair:
    """The pair reduced to a reference image of at most `megapixels`, None for no limit.

    Images and flow are averaged, the flow with its confidence as weight. Depths and labels of the
    truth are those of the nearest pixel.
    """
    height, width = pair.size
    if megapixels is None or height * width <= megapixels * 1e6:
        return pair
    factor = np.sqrt(megapixels * 1e6 / (height * width))
    ref, following = (_smaller(i.shape, factor) for i in (pair.image_ref, pair.image_next))
    small = replace(
        pair,
        image_ref=resized(pair.image_ref, ref),
        image_next=resized(pair.image_next, following),
        K_ref=scaled_camera(pair.K_ref, pair.image_ref.shape, ref),
        K_next=scaled_camera(pair.K_next, pair.image_next.shape, following),
        flow=None,
        truth=None if pair.truth is None else _truth(pair.truth, pair, ref, following),
        depth_prior=None if pair.depth_prior is None else _nearest(pair.depth_prior, ref),
    )
    return small if pair.flow is None else small.with_flow(resized_flow(pair.flow, pair, small))


def scaled_camera(K: Float, old: tuple[int, ...], new: Size) -> Float:
    """(3, 3) intrinsics of an image (height, width, ...) that is resized to (height, width)."""
    scale = np.array([new[1] / old[1], new[0] / old[0], 1.0])
    out: Float = K * scale[:, None]
    # pixel centres are at whole numbers
    out[:2, 2] += 0.5 * scale[:2] - 0.5
    return out


def resized_flow(flow: Flow, pair: Pair, other: Pair) -> Flow:
    """The flow of a pair at the sizes of `other`, the resized pair."""
    size = other.size
    confidence = resized(flow.confidence, size)
    known = np.maximum(confidence, np.finfo(np.float32).tiny)
    mean = resized(flow.uv * flow.confidence[..., None], size) / known[..., None]
    uv = np.empty((*size, 2), np.float32)
    at = np.mgrid[0 : size[0], 0 : size[1]].astype(np.float32)[::-1]
    for k in range(2):
        own = pair.size[1 - k] / size[1 - k]
        next_ = other.image_next.shape[1 - k] / pair.image_next.shape[1 - k]
        # target of the centre of a pixel, in pixels of the resized next image
        uv[..., k] = ((at[k] + 0.5) * own + mean[..., k]) * next_ - 0.5 - at[k]
    uv[confidence == 0] = 0
    return Flow(uv, np.clip(confidence, 0, 1), flow.source)


def _smaller(shape: tuple[int, ...], factor: float) -> Size:
    return max(1, round(shape[0] * factor)), max(1, round(shape[1] * factor))


def resized(image: NDArray[Any], size: Sequence[int]) -> NDArray[Any]:
    """An image or a flow at a size (height, width): the mean of pixels; if larger, the nearest one.

    Interpolation would make displacements between those of two objects.
    """
    how = cv2.INTER_AREA if size[0] <= image.shape[0] else cv2.INTER_NEAREST_EXACT
    return np.asarray(cv2.resize(image, (int(size[1]), int(size[0])), interpolation=how))


def _nearest(values: NDArray[Any], size: Size) -> NDArray[Any]:
    rows, columns = (
        ((np.arange(n) + 0.5) * old / n).astype(int) for n, old in zip(size, values.shape)
    )
    return values[rows[:, None], columns]


def _truth(truth: Truth, pair: Pair, ref: Size, following: Size) -> Truth:
    """The truth at the sizes of the smaller images."""
    (height, width) = pair.size
    changed: dict[str, Any] = {}
    for name in truth.known():
        value = getattr(truth, name)
        if name == "motions":
            continue
        if name == "points":
            scale = np.array([ref[1] / width, ref[0] / height])
            changed[name] = np.column_stack([(value[:, :2] + 0.5) * scale - 0.5, value[:, 2:]])
        else:
            changed[name] = _nearest(value, following if name == "depth_next" else ref)
    if truth.flow is not None:
        scale = np.array([following[1], following[0]]) / pair.image_next.shape[1::-1]
        changed["flow"] = changed["flow"] * scale
    return replace(truth, **changed)


def at_common_focal(pair: Pair) -> Pair:
    """The pair with one image reduced to the focal lengths of the other one.

    The finer one is reduced, since a blurred image shifts against a sharp one. It is the same pair
    if the focal lengths differ by less than a tenth.
    """
    ratio = np.diag(pair.K_next)[1::-1] / np.diag(pair.K_ref)[1::-1]
    if 1 / ALIKE <= np.sqrt(ratio.prod()) <= ALIKE:
        return pair
    shapes = np.array([pair.image_ref.shape[:2], pair.image_next.shape[:2]])
    factors = np.minimum([ratio, 1 / ratio], 1.0)
    sizes = np.maximum(1, np.rint(shapes * factors)).astype(int)
    (ref, following), cameras = sizes, (pair.K_ref, pair.K_next)
    K_ref, K_next = (scaled_camera(*own) for own in zip(cameras, shapes, sizes))
    return replace(
        pair,
        image_ref=resized(pair.image_ref, ref),
        image_next=resized(pair.image_next, following),
        K_ref=K_ref,
        K_next=K_next,
        flow=None,
        truth=None,
    )


def in_own_pixels(flow: Flow, near: Pair, pair: Pair, compute: Callable[[Pair], Flow]) -> Flow:
    """The flow of `near`, which is `at_common_focal(pair)`, in the pixels of both frames.

    Where hardly any of it is usable, but the images match as they are, that flow (of `compute`) is
    taken.

    Warns:
        DataWarning: the images match as they are, which the focal lengths contradict.
    """
    found = resized_flow(flow, near, pair)
    if found.usable >= FEW:
        return found
    plain = compute(pair)
    if plain.usable < 2 * FEW:
        return found
    warnings.warn(
        f"the images match as they are ({plain.usable:.0%} of the pixels), but not at their focal"
        f" lengths, {pair.K_ref[0, 0]:g} and {pair.K_next[0, 0]:g} px ({found.usable:.0%}): these"
        " are probably wrong",
        DataWarning,
        stacklevel=2,
    )
    return plain
