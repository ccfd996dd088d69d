"""One cloud of the static scene of a sequence, and clouds of what moves, frame by frame."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.report.models import thinned
from soup_nlp.sequence.chain import Chain

VOXEL = 0.004
"""Side of a voxel relative to the median distance of the points from the first camera."""
MOST = 300_000
"""Largest number of points that enter the fusion, all frames together."""
OF_MOVER = 4_000
"""Largest number of points of what moves in a frame."""
IN_FRONT = 0.8
"""A point contradicts a view if it stands before what the view shows, by more than this ratio."""
SHOWN = 3
"""Least number of frames of a track that is shown; shorter ones are mostly no real bodies."""


@dataclass(frozen=True)
class Cloud:
    """Points in world coordinates.

    Attributes:
        points: (M, 3) positions in the unit of the chain.
        colours: (M, 3) uint8 RGB.
        sigma: (M,) standard deviation of log depth.
        label: (M,) frame of the static scene's points, track of moving points.
    """

    points: Float
    colours: NDArray[np.uint8]
    sigma: Float
    label: Int

    def __len__(self) -> int:
        return len(self.points)

    def kept(self, keep: NDArray[np.generic]) -> Cloud:
        """The points of a mask or of indices."""
        parts = (self.points, self.colours, self.sigma, self.label)
        return Cloud(*(part[keep] for part in parts))

    def thinned(self, most: int) -> Cloud:
        """At most so many points: each k-th one."""
        return self.kept(np.arange(0, len(self), max(1, -(-len(self) // most))))


def fuse(chain: Chain) -> Cloud:
    """The static scene of all frames: guesses left out, conflicts resolved, one point per voxel.

    A point that stands before the static surface which a neighbouring frame sees gives way where
    that frame is surer. In a voxel the surest point is kept.
    """
    masks = [_static(chain, k) for k in range(len(chain.pairs))]
    share = MOST / max(sum(int(mask.sum()) for mask in masks), 1)
    clouds = []
    for k, mask in enumerate(masks):
        cloud = _cloud(chain, k, thinned(mask, max(share * mask.sum(), 1)), k)
        fits = np.ones(len(cloud), bool)
        for other in (k - 2, k - 1, k + 1, k + 2):
            if 0 <= other < len(chain.pairs):
                fits &= ~_contradicts(chain, cloud, other)
        clouds.append(cloud.kept(fits))
    cloud = _joined(clouds)
    if not len(cloud):
        return cloud
    side = VOXEL * float(np.median(np.linalg.norm(cloud.points, axis=1)))
    voxel = np.floor(cloud.points / side).astype(np.int64)
    order = np.lexsort((cloud.sigma, *voxel.T))
    first = np.ones(len(order), bool)
    first[1:] = (np.diff(voxel[order], axis=0) != 0).any(axis=1)
    return cloud.kept(order[first])


def shown_tracks(chain: Chain) -> list[int]:
    """Tracks that last long enough to be shown."""
    return [t for t in chain.track_numbers if len(chain.path(t)) >= SHOWN]


def movers(chain: Chain, frame: int) -> Cloud:
    """Points of what moves, where they are in a frame; in the last one moved there."""
    pair = min(frame, len(chain.pairs) - 1)
    result, shown = chain.pairs[pair].result, set(shown_tracks(chain))
    clouds = []
    for label, track in chain.tracks[pair].items():
        mask = result.sure & (result.components.of_pixel == label)
        if track in shown and mask.any():
            cloud = _cloud(chain, pair, thinned(mask, OF_MOVER), track)
            points = cloud.points if pair == frame else chain.motion(pair, label)(cloud.points)
            clouds.append(replace(cloud, points=points))
    return _joined(clouds)


def _static(chain: Chain, frame: int) -> Mask:
    """(H, W) pixels of the static scene that are sure."""
    result = chain.pairs[frame].result
    return np.asarray(result.sure & (result.components.of_pixel == 0))


def _cloud(chain: Chain, frame: int, mask: Mask, label: int) -> Cloud:
    """The points of a mask."""
    result = chain.pairs[frame].result
    sigma = np.zeros(mask.shape) if result.sigma is None else result.sigma
    points = chain.points(frame)[mask]
    return Cloud(points, result.images[0][mask], sigma[mask], np.full(len(points), label))


def _joined(clouds: list[Cloud]) -> Cloud:
    nothing = Cloud(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0), np.zeros(0, int))
    parts = [(c.points, c.colours, c.sigma, c.label) for c in (nothing, *clouds)]
    return Cloud(*(np.concatenate(part) for part in zip(*parts)))


def projected(chain: Chain, points: Float, frame: int) -> tuple[Mask, Int, Int, Float]:
    """Points (M, 3) of the world in a frame.

    Returns:
        Mask of the points in the image, their rows and columns, and their depths.
    """
    local = chain.world_from_camera[frame].inverse(points)
    height, width = chain.image(frame).shape[:2]
    z = local[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        uv = (local @ chain.camera(frame).T)[:, :2] / z[:, None]
        inside = (z > 0) & (uv >= -0.5).all(1) & (uv < [width - 0.5, height - 0.5]).all(1)
    u, v = np.rint(np.where(inside[:, None], uv, 0)).astype(np.int64).T
    return inside, v, u, z


def _contradicts(chain: Chain, cloud: Cloud, frame: int) -> Mask:
    """(M,) points before the static surface that a frame sees and is surer of."""
    inside, v, u, z = projected(chain, cloud.points, frame)
    result = chain.pairs[frame].result
    sigma = np.zeros(result.images[0].shape[:2]) if result.sigma is None else result.sigma
    seen = _static(chain, frame)[v, u] & inside
    with np.errstate(invalid="ignore"):
        before = z < IN_FRONT * chain.depth(frame)[v, u]
    return np.asarray(seen & before & (sigma[v, u] <= cloud.sigma))
