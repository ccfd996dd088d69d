"""Data of the 3D view of the page: planes, motions and cameras."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float, Mask
from soup_nlp.geometry.motion import RigidMotion
from soup_nlp.geometry.plane import inverse_depth
from soup_nlp.geometry.rotation import log, nearest
from soup_nlp.geometry.surface import hidden, triangles
from soup_nlp.report.result import Result
from soup_nlp.start.components import TIES

MOST_PIXELS = 600_000
"""Larger images are subsampled for the view."""


def make_scene(result: Result) -> dict[str, Any]:
    """The 3D view of a result, in the shown unit and the reference camera's axes.

    Returns:
        Arrays, numbers and lists by the names that page.js reads. The arrays have the types in
        which they are packed:

        "labels": (h, w) superpixel of the shown pixels, every "step"-th in both directions.
        "planes": (N, 3) m with depth 1 / (m . ray).
        "motion": (N, 9) motion of every superpixel relative to the background: rotation vector w,
            pivot p and shift s; at time t a point X is at exp(t w) (X - p) + p + t s.
        "motionCamera": (N, 9) the same relative to the camera.
        "guess": (N,) the depth comes from neighbours.
        "component": (N,) what moves as one. "tie": (N,) index in "ties", the source of its scale.
        "seen": (h, w) pixels that are visible in the next frame.
        "sigma": (h, w) standard deviation of log depth, 0 to 254 for 0 to 0.5; 255 where unknown.
        "surface": bits of the (h - 1, w - 1) cells of four pixels without a jump of the depth.
        "camera": (4, 4) reference_from_next; the identity if surfaces bend.
        "middle", "far", "deepest": median depth, depth beyond which points are hidden at first,
            largest depth.
    """
    rec = result.reconstruction
    step = int(np.ceil(np.sqrt(max(rec.labels.size / MOST_PIXELS, 1.0))))
    every = slice(None, None, step)
    n, lam, scale = result.soup("n"), result.soup("lam"), result.scale
    R, T = nearest(result.soup("R")), scale * lam[:, None] * result.soup("t")
    pivot = _pivots(result)
    camera = RigidMotion(np.eye(3), np.zeros(3))
    if not result.bending:
        pose = result.components.camera.inverse
        camera = RigidMotion(pose.R, scale * pose.t)
    z = scale * rec.depth_ref[np.isfinite(rec.depth_ref)]
    far, deepest = _far(z)
    labels, start = rec.labels[every, every], result.tree["start"]
    surface = np.packbits(surface_cells(result, step), bitorder="little")
    return {
        "labels": labels.astype(np.uint16),
        "planes": _single(inverse_depth(n, scale * lam * result.soup("d"))),
        "motion": _single(_motion(camera.R @ R, camera(T), pivot)),
        "motionCamera": _single(_motion(R, T, pivot)),
        "guess": (np.asarray(start["borrowed"], bool) & ~result.bends).astype(np.uint8),
        "seen": (~hidden(rec)[every, every]).astype(np.uint8),
        "sigma": _sigma(result)[every, every],
        "component": result.components.of_superpixel.astype(np.uint16),
        "tie": np.asarray(start["tie"], np.uint8),
        "surface": surface,
        "count": len(n),
        "step": step,
        "size": rec.labels.shape[::-1],
        "grid": labels.shape[::-1],
        "sizeNext": rec.depth_next.shape[::-1],
        "K": result.K[0].tolist(),
        "KNext": result.K[1].tolist(),
        "camera": camera.matrix.tolist(),
        "middle": float(np.median(z)) if z.size else 1.0,
        "far": far,
        "deepest": deepest,
        "unit": result.length,
        "ties": TIES,
    }


def _single(values: Float) -> NDArray[np.float32]:
    """Numbers in single precision; those of a diverged solve are limited to its range."""
    limits = np.finfo(np.float32)
    return np.clip(values, limits.min, limits.max).astype(np.float32)


def surface_cells(result: Result, step: int) -> Mask:
    """(h - 1, w - 1) cells of four shown pixels without a jump of the depth."""
    rec = result.reconstruction
    height, width = rec.labels.shape
    faces = triangles(*result.surface, np.isfinite(rec.depth_ref), step)
    # every cell has two triangles; the first begins at its upper left pixel
    v, u = np.divmod(faces[: len(faces) // 2, 0], width)
    out = np.zeros(((height - 1) // step, (width - 1) // step), bool)
    out[v // step, u // step] = True
    return out


def _sigma(result: Result) -> NDArray[np.uint8]:
    """(H, W) sigma as a byte, see `make_scene`."""
    sigma = result.array("depth/sigma_ref")
    if sigma is None:
        return np.zeros(result.labels.shape, np.uint8)
    byte = np.rint(np.clip(sigma / 0.5, 0, 1) * 254)
    return np.where(np.isfinite(sigma), byte, 255).astype(np.uint8)


def _far(z: Float) -> tuple[float, float]:
    """Depth at which the view ends at first, and largest depth."""
    if not z.size:
        return 1.0, 1.0
    deepest = float(z.max())
    # sky and horizon may be orders of magnitude behind the rest
    return min(float(np.percentile(z, 99.5)), 4.0 * float(np.percentile(z, 70))), deepest


def _pivots(result: Result) -> Float:
    """(N, 3) centre of the component of every superpixel, or of the superpixel if it bends."""
    parts, rec = result.components, result.reconstruction
    known = np.isfinite(rec.depth_ref)
    at, count = rec.labels[known], len(parts.of_superpixel)
    sums = [np.bincount(at, x, count) for x in rec.points_ref[known].T]
    centroid = np.stack(sums, axis=1) / np.maximum(np.bincount(at, minlength=count), 1)[:, None]
    common = np.stack([part.centre for part in parts])[parts.of_superpixel]
    centre = np.where(result.bends[:, None], centroid, common)
    return np.asarray(result.scale * np.nan_to_num(centre))


def _motion(R: Float, T: Float, pivot: Float) -> Float:
    """(N, 9) rotation vectors, pivots and shifts of motions X' = R X + T."""
    shift = np.einsum("nij,nj->ni", R, pivot) + T - pivot
    return np.concatenate([log(R), pivot, shift], axis=1)
