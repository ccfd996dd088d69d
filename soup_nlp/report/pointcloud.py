"""Coloured point clouds as binary PLY files (Stanford polygon format 1.0)."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from soup_nlp.storage.atomic import PathLike, write_bytes


def write_ply(
    path: PathLike, xyz: ArrayLike, rgb: ArrayLike, normals: ArrayLike | None = None
) -> int:
    """Write a coloured point cloud (binary little endian, float32 and uchar) atomically.

    Points with a coordinate or normal that is not a finite float32 are left out, so that a depth
    map with unknown pixels can be given as it is.

    Args:
        path: File to write; its folder must exist.
        xyz: (..., 3) positions, camera frame (x right, y down, z forward), any length unit.
        rgb: (..., 3) uint8 colours, same leading shape.
        normals: (..., 3) unit normals, same leading shape, or None.

    Returns:
        The number of points written.

    Raises:
        DataError: the folder cannot be written.
    """
    parts = [xyz] if normals is None else [xyz, normals]
    numbers = np.concatenate([np.reshape(part, (-1, 3)) for part in parts], 1, dtype=np.float64)
    colours = np.reshape(np.asarray(rgb, np.uint8), (-1, 3))
    good = (np.abs(numbers) <= np.finfo(np.float32).max).all(axis=1)
    floats = ("x", "y", "z", "nx", "ny", "nz")[: numbers.shape[1]]
    table = np.empty(int(good.sum()), [("position", "<f4", (len(floats),)), ("colour", "u1", (3,))])
    table["position"], table["colour"] = numbers[good], colours[good]
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"element vertex {len(table)}",
        *(f"property float {name}" for name in floats),
        *(f"property uchar {name}" for name in ("red", "green", "blue")),
        "end_header",
    ]
    write_bytes(path, ("\n".join(header) + "\n").encode("ascii") + table.tobytes())
    return len(table)
