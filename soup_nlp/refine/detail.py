"""Detail: how far pixels are from the planes of their superpixels, by plane plus parallax.

The plane and motion of a superpixel predict where its pixels move. What their flow differs from
that along the epipolar lines is the parallax of points before or behind the plane (M. Irani,
P. Anandan, ECCV 1996). Errors of the flow have no such direction: what it differs across the lines
tells how much of the parallax is error, and so does the round trip of a pixel.
"""

import numpy as np

from soup_nlp.arrays import Float, Mask
from soup_nlp.data.pair import Flow
from soup_nlp.geometry.camera import pixel_grid
from soup_nlp.geometry.soup import Reconstruction

NEAREST, FARTHEST = 1.0, -0.5
"""Largest and least change of inverse depth, relative to the plane: a point at less than half or
more than twice its depth is on another surface."""
TINY = float(np.finfo(float).tiny)


def detail(planes: Reconstruction, flow: Flow, K_next: Float, used: Mask) -> Float:
    """(H, W) log depth of the pixels relative to the planes of their superpixels, equation 30.

    Args:
        planes: Dense 3D of a soup without detail.
        flow: The flow of the solve.
        K_next: (3, 3) intrinsics of the next frame.
        used: (N,) superpixels that move rigidly by a motion that explains their flow; the others
            have no detail.
    """
    labels, confidence = planes.labels, flow.confidence.astype(float)
    with np.errstate(divide="ignore", invalid="ignore"):
        # with the inverse depth (1 + x) / Z the image of R X + T moves by x g
        turned = planes.points_next - planes.soup.translation[labels]
        shown = pixel_grid(*labels.shape) + planes.flow
        g = (shown * turned[..., 2:] - turned @ K_next[:2].T) / planes.points_next[..., 2:]
        e, length = flow.uv - planes.flow, np.linalg.norm(g, axis=-1)
        along = np.einsum("hwc,hwc->hw", e, g) / length
        across = (e[..., 0] * g[..., 1] - e[..., 1] * g[..., 0]) / length
        x = along / length
        counts = used[labels] & (confidence > 0) & (x >= FARTHEST) & (x <= NEAREST)
    along, across, x, c = (np.where(counts, a, 0.0) for a in (along, across, x, confidence))
    of = labels.ravel()

    def squares(values: Float) -> Float:
        """(H, W) weighted mean of the squares over the superpixel."""
        total, weight = (np.bincount(of, a.ravel(), len(used)) for a in (c * values**2, c))
        return np.asarray((total / np.maximum(weight, TINY))[labels])

    # the confidence is exp(-gap^2), and the flows of both directions share the gap
    error = squares(across) - np.log(np.where(counts, c, 1.0)) / 2
    share = np.maximum(1.0 - error / np.maximum(squares(along), TINY), 0.0)
    return np.asarray(-np.log1p(c * share * x))
