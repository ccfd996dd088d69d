"""Pairs at a working size or at one focal length, and depth back at the size of their images."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from soup_nlp.arrays import Float, FloatMap, Image, Int, Labels
from soup_nlp.data.pair import Flow, Pair, Truth
from soup_nlp.geometry.camera import rays
from soup_nlp.geometry.soup import LEAST_FACING

Size = tuple[int, int]

ALIKE = 1.1
"""Largest ratio of two focal lengths between which flow methods are reliable."""


def working_size(pair: Pair, megapixels: float | None) -> Pair:
    """The pair reduced to a reference image of at most `megapixels`, None for no limit.

    Images and flow are averaged, depths and labels are those of the nearest pixel.
    """
    height, width = pair.size
    if megapixels is None or height * width <= megapixels * 1e6:
        return pair
    factor = np.sqrt(megapixels * 1e6 / (height * width))
    small = _at_sizes(pair, np.array([[factor], [factor]]))
    truth, prior = pair.truth, pair.depth_prior
    if truth is not None:
        small = replace(small, truth=_truth(truth, pair, small))
    if prior is not None:
        small = replace(small, depth_prior=_nearest(prior, small.size))
    return small if pair.flow is None else small.with_flow(resized_flow(pair.flow, pair, small))


def _at_sizes(pair: Pair, factors: Float) -> Pair:
    """The images and cameras of a pair, reduced by factors (2, 2) or (2, 1) (height, width)."""
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
    uv = np.empty((*size, 2), np.float32)
    at = np.mgrid[0 : size[0], 0 : size[1]].astype(np.float32)[::-1]
    for k in range(2):
        ref_scale = pair.size[1 - k] / size[1 - k]
        next_scale = other.image_next.shape[1 - k] / pair.image_next.shape[1 - k]
        # target of the centre of a pixel, in pixels of the resized next image
        uv[..., k] = ((at[k] + 0.5) * ref_scale + mean[..., k]) * next_scale - 0.5 - at[k]
    uv[confidence == 0] = 0
    return Flow(uv, np.clip(confidence, 0, 1), flow.source)


def resized(image: NDArray[Any], size: Sequence[int]) -> NDArray[Any]:
    """An image or a flow resized to (height, width): pixel means, or nearest pixels to enlarge."""
    # interpolation would mix the displacements of two objects
    how = cv2.INTER_AREA if size[0] <= image.shape[0] else cv2.INTER_NEAREST_EXACT
    return np.asarray(cv2.resize(image, (int(size[1]), int(size[0])), interpolation=how))


def _nearest(values: NDArray[Any], size: Size) -> NDArray[Any]:
    rows, columns = (
        ((np.arange(n) + 0.5) * old / n).astype(int) for n, old in zip(size, values.shape)
    )
    return values[rows[:, None], columns]


def _truth(truth: Truth, pair: Pair, small: Pair) -> Truth:
    """The truth at the sizes of the smaller images."""
    ref, following = (
        np.divide(image.shape[1::-1], old.shape[1::-1])
        for image, old in ((small.image_ref, pair.image_ref), (small.image_next, pair.image_next))
    )
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
    if 1 / ALIKE <= np.sqrt(ratio.prod()) <= ALIKE:
        return pair
    return _at_sizes(pair, np.minimum([ratio, 1 / ratio], 1.0))


# --- depth at the size of the images --------------------------------------------------------------

COLOUR = 0.1
"""Standard deviation of colour differences, colours in [0, 1], of the weights of neighbours."""
SPREAD = 0.7
"""Standard deviation of distances, pixels of the small image."""
ROWS = 128
"""Rows per block of computation."""


def full_depth(
    labels: Labels, small: Image, image: Image, normal: Float, offset: Float, K: Float
) -> FloatMap:
    """Depth (H, W) of planes at the size of a large image, borders of superpixels along its edges.

    Joint bilateral upsampling (Kopf et al., 2007) of labels: near a border the 3 x 3 nearest pixels
    of the small image vote, with more weight the closer they are in position and colour. It is NaN
    where the label is -1, which is a label too, or a plane turns away.

    Args:
        labels: (h, w) superpixel of every pixel of the small image.
        small: (h, w, 3) small image.
        image: (H, W, 3) large image.
        normal: (N, 3) normals of the planes `normal . X + offset = 0`, towards the camera.
        offset: (N,) offsets.
        K: (3, 3) intrinsics of the large image.
    """
    (h, w), (height, width) = labels.shape, image.shape[:2]
    # pixels with more than one label among the 3 x 3 pixels around them
    border = ndimage.maximum_filter(labels, 3) != ndimage.minimum_filter(labels, 3)
    x = (np.arange(width) + 0.5) * (w / width) - 0.5
    column = np.rint(x).astype(np.int64).clip(0, w - 1)
    out = np.empty((height, width), np.float32)
    for top in range(0, height, ROWS):
        rows = np.arange(top, min(top + ROWS, height))
        y = (rows + 0.5) * (h / height) - 0.5
        row = np.rint(y).astype(np.int64).clip(0, h - 1)
        plane = labels[row[:, None], column]
        v, u = np.nonzero(border[row[:, None], column])
        position = np.stack([y[v], x[u]])
        plane[v, u] = _voted(labels, small, image[top + v, u], position, row[v], column[u])
        uv = np.stack(np.meshgrid(np.arange(width), rows), axis=-1)
        facing = -np.einsum("hwc,hwc->hw", normal[plane], rays(K, uv))
        with np.errstate(divide="ignore", invalid="ignore"):
            z = offset[plane] / facing
        out[rows] = np.where((plane >= 0) & (facing > LEAST_FACING) & (z > 0), z, np.nan)
    return out


def _voted(
    labels: Labels, small: Image, colour: Image, position: Float, row: Int, column: Int
) -> Labels:
    """(P,) label with the most votes for pixels of a colour (P, 3) at positions (2, P) (y, x)."""
    h, w = labels.shape
    votes, weights = [], []
    for dv in (-1, 0, 1):
        for du in (-1, 0, 1):
            r, c = (row + dv).clip(0, h - 1), (column + du).clip(0, w - 1)
            far = (position[0] - r) ** 2 + (position[1] - c) ** 2
            difference = ((small[r, c].astype(np.float32) - colour) ** 2).sum(-1) / 255.0**2
            weights.append(np.exp(-far / (2 * SPREAD**2) - difference / (2 * COLOUR**2)))
            votes.append(labels[r, c])
    score = [sum(w * (vote == candidate) for w, vote in zip(weights, votes)) for candidate in votes]
    best = np.argmax(score, axis=0)
    return np.asarray(np.stack(votes)[best, np.arange(len(best))], np.int32)
