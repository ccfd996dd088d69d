"""Depth maps for other programs: .npy, .pfm; 16-bit PNG is `figures.write_clipped_depth_png16`."""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import NDArray

from soup_nlp.storage.atomic import PathLike, write_bytes

Float = NDArray[np.floating]


def write_npy(path: PathLike, depth: Float) -> None:
    """Write a depth map (H, W) as float32 .npy; NaN where unknown."""
    packed = io.BytesIO()
    np.save(packed, depth.astype(np.float32))
    write_bytes(path, packed.getvalue())


def write_pfm(path: PathLike, depth: Float) -> None:
    """Write a depth map (H, W) as portable float map, little endian; inf where unknown.

    Rows run from the bottom up, as Middlebury's files have them.
    """
    z = np.where(np.isfinite(depth) & (depth > 0), depth, np.inf).astype("<f4")
    header = f"Pf\n{z.shape[1]} {z.shape[0]}\n-1\n"
    write_bytes(path, header.encode("ascii") + z[::-1].tobytes())
