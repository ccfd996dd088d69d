"""Data of the 3D view of the page: planes, motions and cameras."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float, Mask
from soup_nlp.geometry.motion import RigidMotion
from soup_nlp.geometry.plane import inverse_depth
from soup_nlp.geometry.rotation import log, nearest
from soup_nlp.geometry.surface import hidden, joined, triangles
from soup_nlp.report.result import Result

Int = NDArray[np.integer]

MOST_PIXELS = 600_000
"""Larger images are subsampled for the view."""


@dataclass(frozen=True)
class PageScene:
    """The 3D view of a result, lengths in the shown unit, camera frame (x right, y down, z ahead).

    Attributes:
        step: Every step-th pixel in both directions is shown.
        labels: (h, w) superpixel of the shown pixels.
        planes: (N, 3) m with depth 1 / (m . ray).
        motion: (N, 9) motion of every superpixel relative to the background: rotation vector w,
            pivot p and shift s; at time t a point X is at exp(t w) (X - p) + p + t s.
        motion_camera: (N, 9) the same relative to the camera.
        guess: (N,) the depth comes from neighbours.
        seen: (h, w) pixels that are visible in the next frame.
        sigma: (h, w) standard deviation of log depth, 0 to 254 for 0 to 0.5; 255 where unknown.
        surface: (h - 1, w - 1) cells of four pixels without a jump of the depth.
        camera: (4, 4) pose of the next camera, reference_from_next; the identity if surfaces bend.
        middle: Median depth.
        far: Depth beyond which points are hidden at first.
        deepest: Largest depth.
    """

    step: int
    labels: Int
    planes: Float
    motion: Float
    motion_camera: Float
    guess: Mask
    surface: Mask
    seen: Mask
    sigma: Int
    camera: Float
    middle: float
    far: float
    deepest: float


def make_scene(shown: Result) -> PageScene:
    """The 3D view of a result."""
    rec = shown.reconstruction
    step = int(np.ceil(np.sqrt(max(rec.labels.size / MOST_PIXELS, 1.0))))
    every = slice(None, None, step)
    n, lam, scale = shown.soup("n"), shown.soup("lam"), shown.scale
    R, T = nearest(shown.soup("R")), scale * lam[:, None] * shown.soup("t")
    pivot = _pivots(shown)
    camera = RigidMotion(np.eye(3), np.zeros(3))
    if not shown.bending:
        own = shown.components.camera.inverse
        camera = RigidMotion(own.R, scale * own.t)
    z = scale * rec.depth_ref[np.isfinite(rec.depth_ref)]
    far, deepest = _far(z)
    return PageScene(
        step=step,
        labels=rec.labels[every, every],
        planes=inverse_depth(n, scale * lam * shown.soup("d")),
        motion=_motion(camera.R @ R, camera(T), pivot),
        motion_camera=_motion(R, T, pivot),
        guess=np.asarray(shown.tree["start"]["borrowed"], bool) & ~shown.bends,
        surface=_surface(shown, step),
        seen=~hidden(rec)[every, every],
        sigma=_sigma(shown)[every, every],
        camera=camera.matrix,
        middle=float(np.median(z)) if z.size else 1.0,
        far=far,
        deepest=deepest,
    )


def _surface(shown: Result, step: int) -> Mask:
    """Cells of the surface, see `PageScene.surface`."""
    rec, K = shown.reconstruction, np.asarray(shown.array("input/K_ref"), float)
    right, below = joined(rec, K, shown.components.of_pixel)
    height, width = rec.labels.shape
    found = triangles(right, below, np.isfinite(rec.depth_ref), step)
    # every cell has two triangles; the first begins at its upper left pixel
    v, u = np.divmod(found[: len(found) // 2, 0], width)
    out = np.zeros(((height - 1) // step, (width - 1) // step), bool)
    out[v // step, u // step] = True
    return out


def _sigma(shown: Result) -> Int:
    """(H, W) sigma as a byte, see `PageScene.sigma`."""
    sigma = shown.array("depth/sigma_ref")
    if sigma is None:
        return np.zeros(shown.labels.shape, np.int64)
    byte = np.rint(np.clip(sigma / 0.5, 0, 1) * 254)
    return np.where(np.isfinite(sigma), byte, 255).astype(np.int64)


def _far(z: Float) -> tuple[float, float]:
    """Depth at which the view ends at first, and largest depth."""
    if not z.size:
        return 1.0, 1.0
    deepest = float(z.max())
    # sky and horizon may be orders of magnitude behind the rest
    return min(float(np.percentile(z, 99.5)), 4.0 * float(np.percentile(z, 70))), deepest


def _pivots(shown: Result) -> Float:
    """(N, 3) centre of the component of every superpixel, or of the superpixel if it bends."""
    parts, rec = shown.components, shown.reconstruction
    known = np.isfinite(rec.depth_ref)
    at, count = rec.labels[known], len(parts.of_superpixel)
    sums = [np.bincount(at, x, count) for x in rec.points_ref[known].T]
    own = np.stack(sums, axis=1) / np.maximum(np.bincount(at, minlength=count), 1)[:, None]
    common = np.stack([part.centre for part in parts])[parts.of_superpixel]
    centre = np.where(shown.bends[:, None], own, common)
    return np.asarray(shown.scale * np.nan_to_num(centre))


def _motion(R: Float, T: Float, pivot: Float) -> Float:
    """(N, 9) rotation vectors, pivots and shifts of motions X' = R X + T."""
    shift = np.einsum("nij,nj->ni", R, pivot) + T - pivot
    return np.concatenate([log(R), pivot, shift], axis=1)
