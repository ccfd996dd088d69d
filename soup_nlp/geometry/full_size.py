"""Depth at the full size of an image: superpixels grown along its edges, planes evaluated there."""

import numpy as np
from scipy import ndimage

from soup_nlp.arrays import Float, FloatMap, Image, Int, Labels
from soup_nlp.geometry.camera import rays
from soup_nlp.geometry.soup import LEAST_FACING

COLOUR = 0.1
"""Standard deviation of colour differences, colours in [0, 1], of the weights of neighbours."""
SPREAD = 0.7
"""Standard deviation of distances, pixels of the small image."""
ROWS = 128
"""Rows per block of computation."""


def full_depth(
    labels: Labels, small: Image, image: Image, normal: Float, offset: Float, K: Float
) -> FloatMap:
    """Depth of planes at the size of a large image, borders of superpixels along its edges.

    Joint bilateral upsampling (Kopf et al., 2007) of labels: near a border the 3 x 3 nearest pixels
    of the small image vote, with more weight the closer they are in position and colour.

    Args:
        labels: (h, w) superpixel of every pixel of the small image; -1 is a label too.
        small: (h, w, 3) small image.
        image: (H, W, 3) large image.
        normal: (N, 3) normals of the planes `normal . X + offset = 0`, towards the camera.
        offset: (N,) offsets.
        K: (3, 3) intrinsics of the large image.

    Returns:
        (H, W) z; NaN where the label is -1 or a plane turns away.
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
        if len(v):
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
