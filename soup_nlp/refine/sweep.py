"""Plane sweep over depth under the most common motions: proposals that do not depend on the flow.

Every superpixel is tried at evenly spaced steps along its epipolar line, under each of a few
motions and orientations, and scored by the images alone. Costs are averaged with neighbours of
similar colour, because a small patch is ambiguous.
"""

from __future__ import annotations

import numpy as np

from soup_nlp.arrays import Float
from soup_nlp.geometry.soup import Soup
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.refine.costs import Particles
from soup_nlp.refine.photometric import Photometric

LEVELS = 64
"""Depths that are tried."""
NORMALS = 3
"""Orientations common to all superpixels: parallel to the image, and clusters of the soup's."""
NEAREST = 1.5
"""The nearest depth tried is that of the 2 % nearest superpixels over this."""
VOTE = 0.6
"""Weight of a neighbour whose boundary and colour bind it well, beside the superpixel's own 1."""
STEEP = 0.08
"""`-n . ray` below which an orientation is replaced by one parallel to the image."""


def swept(
    soup: Soup, R: Float, T: Float, data: EnergyData, photo: Photometric, keep: int
) -> Particles:
    """(N, keep) particles of lowest photometric cost among the local minima over depth.

    With y = R r a point at inverse depth mu comes to `(y + mu T)_xy / (y + mu T)_z`, which runs
    along its epipolar line in proportion to `s = mu / (y_z + mu T_z)`: equal steps of s are equal
    steps in pixels, and nearly the same depths for all superpixels.

    Args:
        soup: Current belief; gives orientations and the range of depths.
        R: (M, 3, 3) rotations of the motions tried.
        T: (M, 3) translations.
        data: Anchors and neighbours.
        photo: Photometric term.
        keep: Particles wanted.
    """
    n, ray = len(soup), data.anchor_ray
    most = NEAREST / np.quantile(soup.depth_at(ray), 0.02)
    frontal = np.array([0.0, 0.0, -1.0])
    normals = [np.broadcast_to(c, (n, 3)) for c in common_normals(soup.n, NORMALS)] + [soup.n]
    tried, cost, unit = [], [], photo.unit(soup)
    for turn, shift in zip(R, T, strict=True):
        # the nearest depth may lie behind a camera that moves forward: the line has no end then
        last = most / max(1 + most * shift[2], 0.2)
        s = (np.arange(LEVELS) + 0.5) / LEVELS * last
        mu = s * (ray @ turn.T)[:, 2:] / np.maximum(1 - s * shift[2], 1e-6)
        Z = 1 / np.maximum(mu, 1e-9)
        for normal in normals:
            facing = -np.sum(normal * ray, axis=1)
            slanted = np.where((facing < STEEP)[:, None], frontal, normal)
            p = Particles(
                np.broadcast_to(slanted[:, None], (n, LEVELS, 3)),
                Z * -np.sum(slanted * ray, axis=1)[:, None],
                np.broadcast_to(turn, (n, LEVELS, 3, 3)),
                np.broadcast_to(shift, (n, LEVELS, 3)),
            )
            tried.append(p)
            cost.append(photo.costs(p, unit))
    value = _voted(np.stack(cost, axis=1), data)
    sides = np.pad(value, ((0, 0), (0, 0), (1, 1)), constant_values=np.inf)
    low = (value <= sides[..., :-2]) & (value <= sides[..., 2:])
    value = np.where(low, value, np.inf).reshape(n, -1)
    which = np.argsort(value, axis=1, kind="stable")[:, :keep]
    return tried[0].joined(*tried[1:]).take(which)


def _voted(cost: Float, data: EnergyData) -> Float:
    """Costs (N, ...) as weighted means with those of the neighbours."""
    from scipy.sparse import coo_matrix

    if not len(data.pairs):
        return cost
    n = len(cost)
    i, k = data.pairs.T
    bound = np.quantile(data.pair_weight, 0.8)
    w = VOTE * np.minimum(data.pair_weight / max(bound, 1e-12), 1.0)
    link = coo_matrix((np.tile(w, 2), (np.r_[i, k], np.r_[k, i])), shape=(n, n)).tocsr()
    flat = cost.reshape(n, -1)
    total = 1.0 + np.asarray(link.sum(axis=1)).reshape(n, 1)
    return np.asarray((flat + link @ flat) / total).reshape(cost.shape)


def common_normals(n: Float, count: int) -> Float:
    """(count, 3) a plane parallel to the image and medians of clusters of unit normals (N, 3).

    Each cluster starts at a normal that is farther from those before than nine in ten are.
    """
    centre = np.array([[0.0, 0.0, -1.0]])
    for _ in range(count - 1):
        gap = 1 - (n @ centre.T).max(axis=1)
        centre = np.vstack([centre, n[np.argsort(gap, kind="stable")[int(0.9 * len(n))]]])
    for _ in range(10):
        nearest = (n @ centre.T).argmax(axis=1)
        for c in range(1, count):
            if (nearest == c).any():
                middle = np.median(n[nearest == c], axis=0)
                centre[c] = middle / max(np.linalg.norm(middle), 1e-12)
    return centre
