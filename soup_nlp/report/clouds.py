"""Clouds: the points of a frame as PLY, and one cloud of the static scene of all frames."""

from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.errors import printable
from soup_nlp.geometry.camera import project
from soup_nlp.report.chain import AXES, STILL, Chain, Frame, Lazy
from soup_nlp.storage.files import PathLike, write_bytes

VOXEL = 0.004
"""Side of a voxel relative to the median distance of the points from the first camera."""
MOST = 300_000
"""Largest number of points that enter the fusion, all frames together."""
IN_FRONT = 0.8
"""A point contradicts a frame if its depth is below this share of the depth of the frame there."""

Cloud: TypeAlias = NDArray[np.void]
"""(M,) points with the fields of POINT."""
POINT = np.dtype([("points", float, 3), ("colours", "u1", 3), ("sigma", float), ("frame", int)])
"""Position in world coordinates in the unit of the chain, RGB, standard deviation of log depth, and
the frame that a point is from."""


def write_ply(
    path: PathLike,
    xyz: ArrayLike,
    rgb: ArrayLike,
    normals: ArrayLike | None = None,
    scalars: Mapping[str, ArrayLike] | None = None,
    comments: Sequence[str] = (),
) -> int:
    """Write a coloured point cloud (binary little endian, float32 and uchar).

    Points with a number that is not a finite float32 are left out.

    Args:
        path: File to write; its folder must exist.
        xyz: (..., 3) positions, camera frame (x right, y down, z forward), any length unit.
        rgb: (..., 3) uint8 colours, same leading shape.
        normals: (..., 3) unit normals, same leading shape, or None.
        scalars: (...) numbers by the name of their property, such as "confidence".
        comments: Lines of the header.

    Returns:
        The number of points written.

    Raises:
        DataError: the folder cannot be written.
    """
    parts = [np.reshape(part, (-1, 3)) for part in (xyz, normals) if part is not None]
    parts += [np.reshape(part, (-1, 1)) for part in (scalars or {}).values()]
    numbers = np.concatenate(parts, 1, dtype=np.float64)
    colours = np.reshape(np.asarray(rgb, np.uint8), (-1, 3))
    good = (np.abs(numbers) <= np.finfo(np.float32).max).all(axis=1)
    floats = ["x", "y", "z", *(["nx", "ny", "nz"] if normals is not None else [])]
    floats += list(scalars or {})
    table = np.empty(int(good.sum()), [("numbers", "<f4", (len(floats),)), ("colour", "u1", (3,))])
    table["numbers"], table["colour"] = numbers[good], colours[good]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {printable(line)}" for line in comments),
        f"element vertex {len(table)}",
        *(f"property float {name}" for name in floats),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
        "end_header",
    ]
    text = "\n".join(header) + "\n"
    write_bytes(path, text.encode("ascii", "backslashreplace") + table.tobytes())
    return len(table)


def write_cloud(path: PathLike, chain: Chain, number: int) -> None:
    """Write the points of a frame as PLY: those of its pair's reference image.

    Those of a pair are in the coordinates of the frame's camera, those of a chain in the world's.

    Properties beside position, normal and colour: `confidence` of the flow, `component` and
    `sigma_log_depth`. Points that are not `result.sure` are left out.
    """
    k, side = chain.seen(number)
    result, frame = chain.pairs[k], chain.names[number]
    keep, pose = result.sure, STILL if chain.single else chain.world_from_camera[number]
    scalars = {
        "confidence": result.flow_confidence,
        "component": chain.of_track(k)[result.components.of_pixel],
        "sigma_log_depth": result.sigma,
    }
    axes = "the first frame's camera"
    if chain.single:
        axes = f"camera of the {('reference', 'next')[side]} frame"
    comments = [
        f"{chain.name}: points of the reference image in frame {frame}",
        f"frame: {axes}, {AXES}",
        f"unit: {chain.unit}",
        "confidence: of the flow, 0 to 1; component: what moves as one, 0 is the background",
        f"{keep.mean():.1%} of the pixels: without hidden ones, those at jumps of the depth, and"
        " guesses (output.min_confidence=0 keeps them)",
    ]
    write_ply(
        path,
        pose(result.points[side][keep]),
        result.images[0][keep],
        result.normals[side][keep] @ pose.R.T,
        {name: value[keep] for name, value in scalars.items()},
        comments,
    )


def thinned(mask: Mask, most: float) -> Mask:
    """The pixels of a mask (H, W) in every k-th row and column, about `most` of them or fewer."""
    step = max(1, int(np.ceil(np.sqrt(mask.sum() / most))))
    out = np.zeros_like(mask)
    out[::step, ::step] = mask[::step, ::step]
    return out


def write_fused(path: PathLike, chain: Chain) -> None:
    """Write the static scene of all frames as one cloud."""
    cloud = fuse(chain)
    comments = [
        f"{chain.name}: static scene of {len(chain)} frames, one point per voxel",
        f"frame: the first frame's camera, {AXES}",
        f"unit: {chain.unit}",
        "sigma_log_depth: of the frame that the point is from; guesses are left out",
    ]
    scalars = {"sigma_log_depth": cloud["sigma"], "frame": cloud["frame"]}
    write_ply(path, cloud["points"], cloud["colours"], None, scalars, comments)


def fuse(chain: Chain, most: int = MOST) -> Cloud:
    """The static scene of all frames: guesses left out, conflicts resolved, one point per voxel.

    A point in front of the static surface of a neighbouring frame is removed if that frame is more
    certain there. A voxel keeps its most certain point. Of more than `most` points each k-th one is
    returned.
    """
    count = len(chain.pairs)
    share = MOST / max(sum(int(pair.static.sum()) for pair in chain.pairs), 1)
    frames = Lazy(chain.__getitem__, count)
    clouds = []
    for k, pair in enumerate(chain.pairs):
        chosen = thinned(pair.static, max(share * pair.static.sum(), 1))
        cloud = np.empty(int(chosen.sum()), POINT)
        cloud["points"] = frames[k].pose(pair.points[0][chosen])
        cloud["colours"] = frames[k].image[chosen]
        cloud["sigma"], cloud["frame"] = frames[k].sigma[chosen], k
        fits = np.ones(len(cloud), bool)
        for other in (k - 2, k - 1, k + 1, k + 2):
            if 0 <= other < count:
                fits &= ~_contradicts(cloud, frames[other], chain.pairs[other].static)
        clouds.append(cloud[fits])
    cloud = np.concatenate(clouds)
    if not len(cloud):
        return cloud
    side = VOXEL * float(np.median(np.linalg.norm(cloud["points"], axis=1)))
    cloud = cloud[np.argsort(cloud["sigma"], kind="stable")]
    voxel = np.floor(cloud["points"][:, ::-1] / side).astype(np.int64)
    _, first = np.unique(voxel, axis=0, return_index=True)
    return cloud[first][:: max(1, -(-len(first) // most))]


def projected(frame: Frame, points: Float) -> tuple[Mask, Int, Int, Float]:
    """Points (M, 3) of the world in a frame.

    Returns:
        Mask of the points in the image, their rows and columns, and their depths.
    """
    local = frame.pose.inverse(points)
    height, width = frame.depth.shape
    with np.errstate(divide="ignore", invalid="ignore"):
        uv = project(frame.K, local)
        inside = (uv >= -0.5).all(1) & (uv < [width - 0.5, height - 0.5]).all(1)
    inside &= local[:, 2] > 0
    u, v = np.rint(np.where(inside[:, None], uv, 0)).astype(np.int64).T
    return inside, v, u, local[:, 2]


def _contradicts(cloud: Cloud, frame: Frame, static: Mask) -> Mask:
    """(M,) points in front of the static surface of a frame that is more certain there."""
    inside, v, u, z = projected(frame, cloud["points"])
    with np.errstate(invalid="ignore"):
        in_front = z < IN_FRONT * frame.depth[v, u]
    return np.asarray(static[v, u] & inside & in_front & (frame.sigma[v, u] <= cloud["sigma"]))
