"""Pairs at a working size or at one focal length, and depth back at the size of their images."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float, FloatMap, Labels
from soup_nlp.data.pair import Flow, Pair, Truth
from soup_nlp.geometry.camera import pixel_grid, rays
from soup_nlp.geometry.soup import LEAST_FACING

SAME_SHAPE = 1.1
"""Largest ratio of two focal lengths between which flow methods are reliable."""


def working_size(pair: Pair, megapixels: float | None) -> Pair:
    """The pair reduced to a reference image of at most `megapixels`, None for no limit.

    Images and flow are averaged, depths and labels are those of the nearest pixel.
    """
    height, width = pair.size
    if megapixels is None or height * width <= megapixels * 1e6:
        return pair
    small = _at_sizes(pair, np.sqrt(megapixels * 1e6 / (height * width)))
    truth, prior, flow = pair.truth, pair.depth_prior, pair.flow
    return replace(
        small,
        truth=truth and _truth(truth, pair, small),
        depth_prior=None if prior is None else _nearest(prior, small.size),
        flow=flow and resized_flow(flow, pair, small),
    )


def _at_sizes(pair: Pair, factors: Float | float) -> Pair:
    """The images and cameras of a pair, reduced by one factor or by (2, 2) (height, width)."""
    images = pair.image_ref, pair.image_next
    shapes = np.array([image.shape[:2] for image in images])
    sizes = np.maximum(1, np.rint(shapes * factors)).astype(int)
    ref, following = map(resized, images, sizes)
    K_ref, K_next = map(scaled_camera, (pair.K_ref, pair.K_next), shapes, sizes)
    small = replace(pair, flow=None, truth=None, depth_prior=None)
    return replace(small, image_ref=ref, image_next=following, K_ref=K_ref, K_next=K_next)


def scaled_camera(K: Float, old: Sequence[int], new: Sequence[int]) -> Float:
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
    weight = np.maximum(confidence, np.finfo(np.float32).tiny)
    mean = resized(flow.uv * flow.confidence[..., None], size) / weight[..., None]
    at = pixel_grid(*size).astype(np.float32)
    ref_scale = np.float32(np.divide(pair.size[::-1], size[::-1]))
    next_scale = np.divide(other.image_next.shape[1::-1], pair.image_next.shape[1::-1])
    # target of the centre of a pixel, in pixels of the resized next image
    uv = ((at + np.float32(0.5)) * ref_scale + mean) * np.float32(next_scale) - 0.5 - at
    uv[confidence == 0] = 0
    return Flow(uv, np.clip(confidence, 0, 1), flow.source)


def resized(image: NDArray[Any], size: Sequence[int]) -> NDArray[Any]:
    """An image or a flow resized to (height, width): pixel means, or nearest pixels to enlarge."""
    # interpolation would mix the displacements of two objects
    how = cv2.INTER_AREA if size[0] <= image.shape[0] else cv2.INTER_NEAREST_EXACT
    return np.asarray(cv2.resize(image, (int(size[1]), int(size[0])), interpolation=how))


def _nearest(values: NDArray[Any], size: Sequence[int]) -> NDArray[Any]:
    rows, columns = (
        ((np.arange(n) + 0.5) * old / n).astype(int) for n, old in zip(size, values.shape)
    )
    return values[rows[:, None], columns]


def _truth(truth: Truth, pair: Pair, small: Pair) -> Truth:
    ref = np.divide(small.image_ref.shape[1::-1], pair.image_ref.shape[1::-1])
    following = np.divide(small.image_next.shape[1::-1], pair.image_next.shape[1::-1])
    changed: dict[str, Any] = {}
    for name in truth.known():
        value = getattr(truth, name)
        if name == "points":
            changed[name] = np.column_stack([(value[:, :2] + 0.5) * ref - 0.5, value[:, 2:]])
        elif name != "motions":
            image = small.image_next if name == "depth_next" else small.image_ref
            changed[name] = _nearest(value, image.shape[:2])
    if truth.flow is not None:
        changed["flow"] = changed["flow"] * following
    return replace(truth, **changed)


def at_common_focal(pair: Pair) -> Pair:
    """The pair with the finer image reduced to the focal lengths of the other one, if they differ.

    A blurred image would shift against a sharp one.
    """
    ratio = np.diag(pair.K_next)[1::-1] / np.diag(pair.K_ref)[1::-1]
    if 1 / SAME_SHAPE <= np.sqrt(ratio.prod()) <= SAME_SHAPE:
        return pair
    return _at_sizes(pair, np.minimum([ratio, 1 / ratio], 1.0))


def full_depth(
    labels: Labels, size: Sequence[int], normal: Float, offset: Float, K: Float
) -> FloatMap:
    """Depth (H, W) of the planes of superpixels (h, w) at the size of a larger image, camera K.

    Planes are `normal . X + offset = 0`, (N, 3) and (N,), normals towards the camera. It is NaN
    where the label is -1 or a plane turns away.
    """
    plane, (height, width) = _nearest(labels, size), size
    out, u = np.empty((height, width), np.float32), np.arange(width)
    for v, row in enumerate(plane):
        facing = -np.einsum("wc,wc->w", normal[row], rays(K, np.stack([u, 0 * u + v], axis=-1)))
        with np.errstate(divide="ignore", invalid="ignore"):
            z = offset[row] / facing
        out[v] = np.where((row >= 0) & (facing > LEAST_FACING) & (z > 0), z, np.nan)
    return out
