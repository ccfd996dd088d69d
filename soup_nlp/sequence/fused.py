"""One cloud of the static scene of a sequence, and clouds of its moving components by frame."""

from collections.abc import Sequence
from typing import TypeAlias

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
"""Largest number of points of a moving component in a frame."""
IN_FRONT = 0.8
"""A point contradicts a frame if its depth is below this share of the depth of the frame there."""
SHOWN = 3
"""Smallest number of frames of a track that is shown; shorter tracks are mostly no objects."""

Cloud: TypeAlias = NDArray[np.void]
"""(M,) points with the fields of POINT."""
POINT = np.dtype([("points", float, 3), ("colours", "u1", 3), ("sigma", float), ("label", int)])
"""Position in world coordinates in the unit of the chain, RGB, standard deviation of log depth, and
the frame of a point of the static scene or the track of a moving one."""


def fuse(chain: Chain, most: int = MOST) -> Cloud:
    """The static scene of all frames: guesses left out, conflicts resolved, one point per voxel.

    A point in front of the static surface of a neighbouring frame is removed if that frame is more
    certain there. A voxel keeps its most certain point. Of more than `most` points each k-th one is
    returned.
    """
    masks = [pair.static for pair in chain.pairs]
    share = MOST / max(sum(int(mask.sum()) for mask in masks), 1)
    clouds = []
    for k, mask in enumerate(masks):
        cloud = _cloud(chain, k, thinned(mask, max(share * mask.sum(), 1)), k)
        fits = np.ones(len(cloud), bool)
        for other in (k - 2, k - 1, k + 1, k + 2):
            if 0 <= other < len(chain.pairs):
                fits &= ~_contradicts(chain, cloud, other)
        clouds.append(cloud[fits])
    cloud = _joined(clouds)
    if not len(cloud):
        return cloud
    side = VOXEL * float(np.median(np.linalg.norm(cloud["points"], axis=1)))
    cloud = cloud[np.argsort(cloud["sigma"], kind="stable")]
    voxel = np.floor(cloud["points"][:, ::-1] / side).astype(np.int64)
    _, first = np.unique(voxel, axis=0, return_index=True)
    return every_kth(cloud[first], most)


def every_kth(cloud: Cloud, most: int) -> Cloud:
    """At most so many points of a cloud: each k-th one."""
    return cloud[:: max(1, -(-len(cloud) // most))]


def shown_tracks(chain: Chain) -> list[int]:
    """Tracks that last long enough to be shown."""
    return [t for t in chain.track_numbers if len(chain.path(t)) >= SHOWN]


def movers(chain: Chain, frame: int) -> Cloud:
    """Points of moving components at their positions in a frame.

    Those of the last frame come from the frame before, moved by their components.
    """
    pair = min(frame, len(chain.pairs) - 1)
    result, shown = chain.pairs[pair].result, set(shown_tracks(chain))
    clouds = []
    for label, track in chain.tracks[pair].items():
        mask = result.sure & (result.components.of_pixel == label)
        if track in shown and mask.any():
            cloud = _cloud(chain, pair, thinned(mask, OF_MOVER), track)
            if pair != frame:
                cloud["points"] = chain.motion(pair, label)(cloud["points"])
            clouds.append(cloud)
    return _joined(clouds)


def _cloud(chain: Chain, frame: int, mask: Mask, label: int) -> Cloud:
    """The points of a mask."""
    out = np.empty(int(mask.sum()), POINT)
    out["points"], out["colours"] = chain.points(frame)[mask], chain.image(frame)[mask]
    out["sigma"], out["label"] = chain.pairs[frame].result.sigma[mask], label
    return out


def _joined(clouds: Sequence[Cloud]) -> Cloud:
    return np.concatenate([np.empty(0, POINT), *clouds])


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
    """(M,) points in front of the static surface of a frame that is more certain there."""
    inside, v, u, z = projected(chain, cloud["points"], frame)
    with np.errstate(invalid="ignore"):
        in_front = z < IN_FRONT * chain.depth(frame)[v, u]
    more_certain = chain.pairs[frame].result.sigma[v, u] <= cloud["sigma"]
    return np.asarray(chain.pairs[frame].static[v, u] & inside & in_front & more_certain)
