"""Cutting the reference image into connected superpixels."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from soup_nlp.arrays import Image, Labels
from soup_nlp.errors import DataError

LEAST_PIECE = 0.25
"""Pieces smaller than this share of the mean area join a neighbour."""
ENOUGH = 0.5
"""Share of the wanted number below which superpixels are not what was asked for."""


def segment(
    image: Image,
    count: int,
    method: Literal["slic", "grid"] = "slic",
    compactness: float = 10.0,
    sigma: float = 0.0,
) -> Labels:
    """Superpixel labels of an image.

    Args:
        image: (H, W, 3) uint8 RGB.
        count: Wanted number of superpixels; the answer may differ by a few per cent.
        method: "slic" (Achanta et al. 2012, skimage) or "grid" (the paper's worst case).
        compactness: SLIC's balance of colour and distance.
        sigma: Gaussian pre-smoothing of SLIC, pixels; more where texture shatters superpixels
            so that less than half of their number are left, and a grid where that does not help.

    Returns:
        (H, W) int32 labels 0..N-1, each connected (4-neighbourhood) and not empty.

    Raises:
        DataError: count is not between 1 and a quarter of the pixels.
    """
    height, width = image.shape[:2]
    if not 1 <= count <= height * width // 4:
        raise DataError(
            "number of superpixels does not fit the image",
            where="segmentation.superpixels",
            found=count,
            expected=f"1 to {height * width // 4} for {width}x{height}",
        )
    if count == 1:
        return np.zeros((height, width), np.int32)
    if method == "grid" or np.ptp(image) == 0:
        # SLIC has nothing to follow on an image of one colour: its limit is the grid
        return _grid(height, width, count)
    least = int(LEAST_PIECE * height * width / count)
    from skimage.segmentation import slic

    # texture as fine as pixels shatters SLIC's clusters, and shards join to a few large ones
    for smoothing in (sigma, *(wider for wider in (1.0, 2.0, 4.0) if wider > sigma)):
        raw = slic(
            image,
            n_segments=count,
            compactness=compactness,
            sigma=smoothing,
            start_label=0,
            min_size_factor=LEAST_PIECE,
            max_size_factor=4,
        )
        labels = split_components(raw.astype(np.int32), least)
        if labels.max() + 1 >= ENOUGH * count:
            return labels
    return _grid(height, width, count)


def _grid(height: int, width: int, count: int) -> Labels:
    rows = max(1, round(np.sqrt(count * height / width)))
    columns = max(1, round(count / rows))
    v = np.arange(height) * rows // height
    u = np.arange(width) * columns // width
    return (v[:, None] * columns + u[None, :]).astype(np.int32)


def split_components(labels: Labels, min_size: int) -> Labels:
    """Make every label one 4-connected piece; pieces below min_size pixels join a neighbour.

    A small piece takes the label of the nearest pixel (Euclidean) of a piece that stays.
    """
    from skimage.measure import label

    pieces = label(labels, background=-1, connectivity=1).astype(np.int32) - 1
    sizes = np.bincount(pieces.ravel())
    small = sizes < max(1, min_size)
    if small.all():
        small[np.argmax(sizes)] = False
    if small.any():
        lost = small[pieces]
        nearest = ndimage.distance_transform_edt(lost, return_distances=False, return_indices=True)
        pieces = pieces[tuple(nearest)]
        # filling may leave a fragment cut off from its new owner: one more pass settles it
        return split_components(_relabel(pieces), 1)
    return _relabel(pieces)


def _relabel(labels: NDArray[np.int32]) -> Labels:
    _, inverse = np.unique(labels, return_inverse=True)
    return inverse.reshape(labels.shape).astype(np.int32)
