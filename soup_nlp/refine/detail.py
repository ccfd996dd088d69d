"""Detail: how far pixels are from the planes of their superpixels, by flow and by neighbours.

By plane plus parallax: the plane and motion of a superpixel predict where its pixels move. What
their flow differs from that along the epipolar lines is the parallax of points before or behind the
plane (M. Irani, P. Anandan, ECCV 1996). Errors of the flow have no such direction: what it differs
across the lines tells how much of the parallax is error, and so does the round trip of a pixel.
Superpixels that are drawn, whose depth nothing tells, move between their neighbours. What is not
measured is lifted to the ground where it would lie below.
"""

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import spsolve

from soup_nlp.arrays import Float, Mask
from soup_nlp.data.pair import Flow
from soup_nlp.geometry.camera import pixel_grid, rays
from soup_nlp.geometry.soup import Reconstruction
from soup_nlp.model.energy_data import EnergyData

NEAREST, FARTHEST = 1.0, -0.5
"""Largest and least change of inverse depth, relative to the plane: a point at less than half or
more than twice its depth is on another surface."""
STEP = 0.3
"""Standard deviation of the step of log depth between two neighbours with a usual border. MRE of 27
families hardly depends on it (0.2 and 0.4: within 0.2 %)."""
GROUND_SIGMA = 0.05
"""Standard deviation of the log depth of the ground: what differs less is taken to lie on it."""
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


def shrinkage(
    planes: Reconstruction, data: EnergyData, likeness: Float, sigma: Float, drawn: Mask
) -> Float:
    """(N,) change of the log depth of superpixels towards their neighbours, equation 31.

    Superpixels that are mostly `drawn` (H, W) change, by how unsure they are: `sigma` (N,) is the
    standard deviation of log depth. The `likeness` (P,) of two neighbours weighs their border.
    """
    soup, of, n = planes.soup, planes.labels.ravel(), len(planes.soup)
    free = np.bincount(of, drawn.ravel(), n) > np.bincount(of, minlength=n) / 2
    variance, out = sigma**2, np.zeros(n)
    if not free.any() or not len(data.pairs):
        return out
    anchor = np.log(soup.depth_across(np.arange(n)[:, None], data.anchor_ray)[0])
    # slopes are unsure as well: a step half-way from the anchors to the border
    border = np.log(soup.depth_across(data.pairs, data.boundary_ray.mean(axis=1)))
    step = np.diff(anchor[data.pairs.T] + border, axis=0)[0] / 2
    # a step that is large for both sigmas is one of the scene, as is one that an occlusion shows
    surface = np.exp(-(step**2) / (2 * variance[data.pairs].sum(axis=1)))
    weight = np.where(data.order_weight == 0, surface * likeness, 0.0)
    weight /= likeness.mean() * STEP**2
    rows = np.repeat(np.arange(len(step))[:, None], 2, axis=1)
    values = np.broadcast_to([-1.0, 1.0], rows.shape)
    change = sparse.csr_matrix((values.ravel(), (rows.ravel(), data.pairs.ravel())), (len(step), n))
    change = change[:, free]
    matrix = change.T @ sparse.diags(weight) @ change + sparse.diags(1 / variance[free])
    out[free] = spsolve(matrix.tocsc(), -change.T @ (weight * step))
    return out


def above_ground(
    planes: Reconstruction, beside: Float, ground: Float, K_ref: Float, sigma: Float
) -> Float:
    """(H, W) log depth relative to the planes, from `beside` (H, W), equation 32.

    What is below the `ground` (3,), see `start.scales.ground`, is lifted to it, less where it is
    surer: sigma (H, W) is the standard deviation of log depth.
    """
    inverse = np.maximum(rays(K_ref, pixel_grid(*beside.shape)) @ ground, 0.0)
    with np.errstate(divide="ignore"):
        below = np.fmax(beside + np.log(inverse * planes.depth_ref), 0.0)
    return np.asarray(beside - below * sigma**2 / (sigma**2 + GROUND_SIGMA**2))
