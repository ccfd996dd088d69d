"""The surface of a reconstruction: its connected parts, hidden pixels and triangles."""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.geometry.camera import pixel_grid, rays
from soup_nlp.geometry.soup import Reconstruction

BEHIND = 0.05
"""Share of its depth by which a hidden point lies behind the nearest surface."""
JUMP = 0.1
"""Share of the depth by which two pixels may differ where they meet."""


def hidden(rec: Reconstruction) -> Mask:
    """(H, W) True where a reference pixel lies behind a nearer surface in the next frame, or
    outside its image, which then does not determine its depth."""
    height, width = rec.depth_next.shape
    target = rec.flow + pixel_grid(*rec.depth_ref.shape)
    z = rec.points_next[..., 2]
    with np.errstate(invalid="ignore"):
        u, v = np.floor(target[..., 0] + 0.5), np.floor(target[..., 1] + 0.5)
        inside = (z > 0) & (u >= 0) & (v >= 0) & (u < width) & (v < height)
    u, v = (np.where(inside, x, 0).astype(np.int64) for x in (u, v))
    return ~inside | ~(z <= rec.depth_next[v, u] * (1 + BEHIND))


def joined(
    planes: Float, labels: NDArray[np.integer], group: NDArray[np.integer], K: Float, detail: Float
) -> tuple[Mask, Mask]:
    """Whether pixels are on one continuous surface with those to the right, (H, W - 1), and below.

    They are if they belong to one `group` (H, W), such as a rigid component, and their depths are
    nearly the same halfway: those of the `planes` (N, 3) of their superpixels `labels` (H, W), m
    with depth 1 / (m . ray), with their `detail` (H, W).
    """
    ray = rays(K, pixel_grid(*labels.shape))
    out = []
    for a, b in (np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:]):
        across, step = labels[a] != labels[b], detail[a] - detail[b]
        between = 0.5 * (ray[a][across] + ray[b][across])
        ends = [np.sum(planes[labels[x][across]] * between, axis=1) for x in (a, b)]
        with np.errstate(divide="ignore", invalid="ignore"):
            step[across] += np.log(ends[1] / ends[0])
        out.append((group[a] == group[b]) & (np.abs(step) <= np.log1p(JUMP)))
    return out[0], out[1]


def at_jumps(right: Mask, below: Mask) -> Mask:
    """(H, W) True for the pixels on both sides of a break of the surface, see `joined`.

    Images and flow mix two surfaces there, and a mesh would stretch from one to the other.
    """
    out = np.zeros((len(right), right.shape[1] + 1), bool)
    for a, b, continuous in ((out[:, :-1], out[:, 1:], right), (out[:-1], out[1:], below)):
        a |= ~continuous
        b |= ~continuous
    return out


def whole_cells(right: Mask, below: Mask, keep: Mask, step: int = 1) -> Mask:
    """((H - 1) / step, (W - 1) / step) cells of `step` pixels that no break of the surface crosses.

    `right` and `below` are those of `joined`; `keep` (H, W) are the pixels of the surface.
    """
    height, width = keep.shape
    if min(height, width) <= step:
        return np.zeros(((height - 1) // step, (width - 1) // step), bool)

    def full(mask: Mask, tall: int, wide: int) -> Mask:
        """(h, w) whether a mask is True in the whole tall x wide window of every cell."""
        cells = sliding_window_view(mask, (tall, wide))[::step, ::step]
        return np.asarray(cells.all(axis=(2, 3)))

    whole = full(keep, step + 1, step + 1)
    return whole & full(right, step + 1, step) & full(below, step, step + 1)


def triangles(cells: Mask, width: int, step: int = 1) -> Int:
    """(M, 3) two triangles of every cell, counter-clockwise as the camera sees them.

    A pixel has the number v `width` + u in an image of that width; see `whole_cells`.
    """
    v, u = np.nonzero(cells)
    a = (v * width + u) * step
    b, c = a + step, a + step * width
    d = c + step
    # the image's y axis points down, so a, c, b is counter-clockwise for the camera
    return np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])
