"""Numbers of the page's 3D view: planes, motions and cameras, for the browser to rebuild."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from soup_nlp.geometry.camera import pixel_grid, project, rays
from soup_nlp.geometry.motion import RigidMotion
from soup_nlp.geometry.plane import inverse_depth
from soup_nlp.geometry.rotation import log, nearest
from soup_nlp.report.shown import Shown

Float = NDArray[np.float64]
Int = NDArray[np.integer]
Mask = NDArray[np.bool_]

MOST_PIXELS = 600_000
"""Pixels above which the view takes every second (third, ...) pixel only."""
JUMP = 0.08
"""Gap between two neighbouring planes, relative to their depth, at which the surface is cut."""


@dataclass(frozen=True)
class Scene:
    """The 3D view of a result, lengths in the shown unit, camera frame (x right, y down, z ahead).

    Attributes:
        step: Every step-th pixel in either direction is shown.
        labels: (h, w) superpixel of the shown pixels.
        planes: (N, 3) m with depth 1 / (m . ray).
        motion: (N, 9) motion of every superpixel beside that of the background: rotation vector,
            pivot p and shift s; at time t a point X is at exp(t w) (X - p) + p + t s.
        motion_camera: (N, 9) the same in the frame of the camera, which then does not move.
        component: (N,) rigid component.
        guess: (N,) depth comes from neighbours.
        seen: (h, w) pixels that the next frame shows: inside it, and nothing in front of them.
        surface: (h - 1, w - 1, 2) triangles (a, c, b) and (b, c, d) of every four pixels
            a b / c d that are no curtain across a depth jump.
        camera: (4, 4) pose of the next camera, reference_from_next; the identity where surfaces
            bend.
        middle: Median depth.
        far: Depth beyond which the view starts without points.
        deepest: Largest depth.
    """

    step: int
    labels: Int
    planes: Float
    motion: Float
    motion_camera: Float
    component: Int
    guess: Mask
    surface: Mask
    seen: Mask
    camera: Float
    middle: float
    far: float
    deepest: float


def make_scene(shown: Shown) -> Scene:
    """The 3D view of a result."""
    labels, component = shown.labels, shown.components.of_superpixel
    step = int(np.ceil(np.sqrt(max(labels.size / MOST_PIXELS, 1.0))))
    labels = labels[::step, ::step]
    n, lam, scale = shown.soup("n"), shown.soup("lam"), shown.scale
    planes = inverse_depth(n, scale * lam * shown.soup("d"))
    R, T = nearest(shown.soup("R")), scale * lam[:, None] * shown.soup("t")
    K_ref, K_next = (np.asarray(shown.array(f"input/K_{k}"), float) for k in ("ref", "next"))
    ray = rays(K_ref, pixel_grid(*shown.labels.shape)[::step, ::step])
    points, known = _points(planes, labels, ray)
    pivot = _pivots(shown, points, known, labels)
    camera = RigidMotion(np.eye(3), np.zeros(3))
    if not shown.bending:
        own = shown.components.camera.inverse
        camera = RigidMotion(own.R, scale * own.t)
    z = points[..., 2][known]
    far, deepest = _far(z)
    moved = np.einsum("hwij,hwj->hwi", R[labels], points) + T[labels]
    return Scene(
        step=step,
        labels=labels,
        planes=planes,
        motion=_motion(camera.R @ R, camera(T), pivot),
        motion_camera=_motion(R, T, pivot),
        component=component,
        guess=np.asarray(shown.tree["start"]["borrowed"], bool) & (not shown.bending),
        surface=_surface(planes, labels, component, ray, known),
        seen=_seen(moved, known, K_next, scale * np.asarray(shown.array("depth/next"))),
        camera=camera.matrix,
        middle=float(np.median(z)) if z.size else 1.0,
        far=far,
        deepest=deepest,
    )


def _points(planes: Float, labels: Int, ray: Float) -> tuple[Float, Mask]:
    """(h, w, 3) points on the planes, and where there is one."""
    facing = np.einsum("hwc,hwc->hw", planes[labels], ray)
    known = facing > 1e-9 * np.abs(planes).max()
    z = np.where(known, 1 / np.where(known, facing, 1.0), 1.0)
    return z[..., None] * ray, known


def _far(z: Float) -> tuple[float, float]:
    """Depth where the view ends at first, and the largest one."""
    if not z.size:
        return 1.0, 1.0
    deepest = float(z.max())
    # sky and horizon are orders of magnitude behind what they are seen with
    return min(float(np.percentile(z, 99.5)), 4.0 * float(np.percentile(z, 70))), deepest


def _pivots(shown: Shown, points: Float, known: Mask, labels: Int) -> Float:
    """(N, 3) the centre of every superpixel's component, its own where surfaces bend."""
    parts = shown.components
    if not shown.bending:
        centre = shown.scale * np.stack([part.centre for part in parts])
        return np.nan_to_num(centre[parts.of_superpixel])
    at, count = labels[known], len(parts.of_superpixel)
    total = np.maximum(np.bincount(at, minlength=count), 1)
    sums = [np.bincount(at, x, count) for x in points[known].T]
    return np.asarray(np.stack(sums, axis=1) / total[:, None])


def _motion(R: Float, T: Float, pivot: Float) -> Float:
    """(N, 9) rotation vectors, pivots and shifts of motions X' = R X + T."""
    shift = np.einsum("nij,nj->ni", R, pivot) + T - pivot
    return np.concatenate([log(R), pivot, shift], axis=1)


def _seen(moved: Float, known: Mask, K_next: Float, depth_next: Float) -> Mask:
    """(h, w) pixels whose moved points (h, w, 3) are what the next frame's depth map holds."""
    z = moved[..., 2]
    front = known & (z > 0)
    uv = np.floor(project(K_next, np.where(front[..., None], moved, 1.0)) + 0.5)
    height, width = depth_next.shape
    front &= (uv >= 0).all(-1) & (uv[..., 0] < width) & (uv[..., 1] < height)
    u, v = np.where(front[..., None], uv, 0).astype(np.intp).transpose(2, 0, 1)
    # what is covered lies behind by more than neighbouring pixels differ
    return np.asarray(front & ~(z > (1 + JUMP) * depth_next[v, u]))


def _surface(planes: Float, labels: Int, component: Int, ray: Float, known: Mask) -> Mask:
    """(h - 1, w - 1, 2) triangles whose three sides lie on one surface."""

    def joined(p: tuple[slice, slice], q: tuple[slice, slice]) -> Mask:
        """Whether two pixels are on one surface: their planes meet between them."""
        i, k = labels[p], labels[q]
        out = known[p] & known[q]
        for pixel in (p, q):
            own = np.einsum("hwc,hwc->hw", planes[i], ray[pixel])
            other = np.einsum("hwc,hwc->hw", planes[k], ray[pixel])
            with np.errstate(divide="ignore", invalid="ignore"):
                gap = np.maximum(own, other) / np.minimum(own, other) - 1
            out &= (i == k) | ((np.minimum(own, other) > 0) & (gap < JUMP))
        return np.asarray(out & (component[i] == component[k]))

    near, far, every = slice(None, -1), slice(1, None), slice(None)
    right = joined((every, near), (every, far))
    down = joined((near, every), (far, every))
    across = joined((near, far), (far, near))
    first = down[:, :-1] & across & right[:-1]
    second = across & right[1:] & down[:, 1:]
    return np.stack([first, second], axis=2)
