"""Cutting the reference image into connected superpixels."""

import math
from typing import Literal

import numpy as np
from scipy import ndimage

from soup_nlp.arrays import Image, Labels
from soup_nlp.errors import DataError

LEAST_PIECE = 0.25
"""Pieces smaller than this share of the mean area join a neighbour."""
ENOUGH = 0.5
"""Share of the wanted number below which texture has broken the clusters into fragments."""
NEAR = 0.03
"""Largest share by which the number of superpixels differs from the wanted one."""
MORE_CALLS = 4
"""Largest number of further calls of SLIC for more superpixels."""
COMPACTNESS = 10.0
"""SLIC's balance of colour and distance; scikit-image's default."""
SMOOTHING_PX = (0.0, 1.0, 2.0, 4.0)
"""Gaussian smoothing before SLIC, pixels, tried in turn: texture as fine as pixels breaks clusters
into fragments, which are then merged into a few large superpixels. A grid is the last resort."""


def segment(image: Image, count: int, method: Literal["slic", "grid"] = "slic") -> Labels:
    """Superpixel labels (H, W) of an RGB image, each connected (4-neighbourhood) and not empty.

    The number differs from `count`, 1 to a quarter of the pixels, by at most 3 %, or by one; a grid
    has a whole number of rows and columns. The method is "slic" (Achanta et al. 2012, skimage) or
    "grid" (the paper's worst case).
    """
    height, width = image.shape[:2]
    check_count(count, height, width)
    if method == "grid" or count == 1 or np.ptp(image) == 0:
        # on an image of one colour SLIC has no edges to follow and would return the grid
        return _grid(height, width, count)
    for smoothing in SMOOTHING_PX:
        labels = _slic(image, count, smoothing)
        if labels.max() + 1 >= ENOUGH * count:
            return _as_many(image, labels, count, smoothing)
    return _grid(height, width, count)


def check_count(count: int, height: int, width: int) -> None:
    """Raise DataError for fewer superpixels than one, or more than an image has room for."""
    if not 1 <= count <= height * width // 4:
        raise DataError(
            "number of superpixels does not fit the image",
            where="segmentation.superpixels",
            found=count,
            expected=f"1 to {height * width // 4} for {width}x{height}",
        )


def _slic(image: Image, clusters: int, sigma: float) -> Labels:
    """Connected superpixels of SLIC with a given number of clusters."""
    from skimage.segmentation import slic

    raw = slic(
        image,
        n_segments=clusters,
        compactness=COMPACTNESS,
        sigma=sigma,
        start_label=0,
        min_size_factor=LEAST_PIECE,
        max_size_factor=4,
    )
    least = int(LEAST_PIECE * image.shape[0] * image.shape[1] / clusters)
    return split_components(raw.astype(np.int32), least)


def _as_many(image: Image, labels: Labels, count: int, sigma: float) -> Labels:
    """Superpixels whose number is near `count`: of SLIC with more clusters where they are too few,
    since it starts them on a grid of few possible sizes and some vanish; too many are joined."""
    near, clusters = max(1.0, NEAR * count), count
    for _ in range(MORE_CALLS):
        n = int(labels.max()) + 1
        if n >= count - near:
            break
        clusters = min(image.shape[0] * image.shape[1] // 4, math.ceil(clusters * 1.03 * count / n))
        labels = _slic(image, clusters, sigma)
    if labels.max() + 1 <= count + near:
        return labels
    sizes = np.sort(np.bincount(labels.ravel()))
    return split_components(labels, int(sizes[-count]))


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
    small = sizes < min_size
    if small.all():
        small[np.argmax(sizes)] = False
    if small.any():
        hole = small[pieces]
        nearest = ndimage.distance_transform_edt(hole, return_distances=False, return_indices=True)
        # filling may cut a fragment off from the rest of its label: another pass makes it a label
        return split_components(pieces[tuple(nearest)], 1)
    return pieces
