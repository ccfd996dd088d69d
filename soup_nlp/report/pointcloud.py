"""Coloured point clouds as binary PLY files (Stanford polygon format 1.0)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from soup_nlp.report.result import Result
from soup_nlp.storage.atomic import PathLike, write_bytes

AXES = "x right, y down, z ahead"
"""Axes of a camera, in words."""


def write_ply(
    path: PathLike,
    xyz: ArrayLike,
    rgb: ArrayLike,
    normals: ArrayLike | None = None,
    scalars: Mapping[str, ArrayLike] | None = None,
    comments: Sequence[str] = (),
) -> int:
    """Write a coloured point cloud (binary little endian, float32 and uchar) atomically.

    Points with a number that is not a finite float32 are left out.

    Args:
        path: File to write; its folder must exist.
        xyz: (..., 3) positions, camera frame (x right, y down, z forward), any length unit.
        rgb: (..., 3) uint8 colours, same leading shape.
        normals: (..., 3) unit normals, same leading shape, or None.
        scalars: (...) numbers by the name of their property, such as "confidence".
        comments: Lines of the header, ASCII.

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
        *(f"comment {line}" for line in comments),
        f"element vertex {len(table)}",
        *(f"property float {name}" for name in floats),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
        "end_header",
    ]
    text = "\n".join(header) + "\n"
    write_bytes(path, text.encode("ascii", "replace") + table.tobytes())
    return len(table)


def write_cloud(path: PathLike, result: Result, frame: int) -> int:
    """Write the points of the reference image in frame 0 or 1 as PLY; returns their number.

    Properties beside position, normal and colour: `confidence` of the flow, `component`, and
    `sigma_log_depth` if it is known. Points that are not `result.sure` are left out.
    """
    keep = result.sure
    scalars = {"confidence": result.flow_confidence, "component": result.components.of_pixel}
    if result.sigma is not None:
        scalars["sigma_log_depth"] = result.sigma
    name = ("reference", "next")[frame]
    comments = [
        f"{result.name}: points of the reference image in the {name} frame",
        f"frame: camera of the {name} frame, {AXES}",
        f"unit: {result.unit}",
        "confidence: of the flow, 0 to 1; component: what moves as one, 0 is the background",
        f"{keep.mean():.1%} of the pixels: without hidden ones, those at jumps of the depth, and"
        " guesses (output.min_confidence=0 keeps them)",
    ]
    return write_ply(
        path,
        result.points[frame][keep],
        result.images[0][keep],
        result.normals[frame][keep],
        {key: value[keep] for key, value in scalars.items()},
        comments,
    )
