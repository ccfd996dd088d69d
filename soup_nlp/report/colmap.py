"""COLMAP's text model: two cameras, two images and the points of the static scene."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float, Image, Int, Mask
from soup_nlp.errors import DataError
from soup_nlp.geometry.motion import RigidMotion
from soup_nlp.report.figures import write_png
from soup_nlp.report.result import Result
from soup_nlp.storage.files import write_text

POINTS = 50_000
"""Largest number of points of a model."""
IMAGES = ("ref.png", "next.png")
"""Names of the images in a model."""


def write_colmap(folder: Path, result: Result) -> int:
    """Write `images/`, `masks/` and `sparse/0/` into a folder; returns the number of points.

    The world is the reference camera (x right, y down, z ahead); both images have poses
    cam_from_world. COLMAP models are static: the points are background points visible in both
    images, and the masks are black where something moves by itself.

    Raises:
        DataError: a camera has skew, which none of COLMAP's models has.
    """
    moving = result.components.of_pixel > 0
    uv, points, colours = _points(result, ~moving)
    every = np.arange(len(points))
    write_model(
        folder,
        IMAGES,
        result.images,
        result.K,
        [RigidMotion(np.eye(3), np.zeros(3)), result.components.camera],
        [moving, _moved(result, moving)],
        (points, colours),
        [(every, uv[0]), (every, uv[1])],
        f"{result.name}; unit: {result.unit}",
    )
    return len(points)


def write_model(
    folder: Path,
    names: Sequence[str],
    images: Sequence[Image],
    cameras: Sequence[Float],
    poses: Sequence[RigidMotion],
    moving: Sequence[Mask],
    cloud: tuple[Float, NDArray[np.uint8]],
    seen: Sequence[tuple[Int, Float]],
    title: str,
) -> None:
    """Write a model of any number of images.

    Args:
        folder: Gets `images/`, `masks/` and `sparse/0/`.
        names: Names of the images.
        images: (H, W, 3) uint8 RGB.
        cameras: (3, 3) intrinsics by image; the centre of the first pixel is (0, 0).
        poses: cam_from_world by image.
        moving: (H, W) what moves by itself, by image.
        cloud: (P, 3) points and their colours.
        seen: Indices of the points that an image sees, and their pixels (u, v).
        title: Comment of the points' file.

    Raises:
        DataError: a camera has skew, which none of COLMAP's models has.
    """
    for K in cameras:
        if K[0, 1] != 0:
            raise DataError("COLMAP has no camera with skew", found=K.tolist(), expected="s = 0")
    model = folder / "sparse" / "0"
    for place in (model, folder / "images", folder / "masks"):
        place.mkdir(parents=True, exist_ok=True)
    for name, image, mask in zip(names, images, moving, strict=True):
        write_png(folder / "images" / name, image)
        black = np.where(mask, 0, 255)[..., None]
        write_png(folder / "masks" / f"{name}.png", np.repeat(black, 3, 2).astype("u1"))
    write_text(model / "cameras.txt", _cameras(cameras, images))
    write_text(model / "images.txt", _images(names, poses, seen))
    tracks: list[list[str]] = [[] for _ in cloud[0]]
    for i, (points, _) in enumerate(seen, 1):
        for k, point in enumerate(points):
            tracks[point].append(f"{i} {k}")
    rows = [
        f"{i} {x:.9g} {y:.9g} {z:.9g} {r} {g} {b} 0 {' '.join(track)}"
        for i, ((x, y, z), (r, g, b), track) in enumerate(zip(*cloud, tracks), 1)
    ]
    head = [
        f"# {title}",
        "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)",
    ]
    write_text(model / "points3D.txt", "\n".join([*head, *rows]) + "\n")


def _cameras(cameras: Sequence[Float], images: Sequence[Image]) -> str:
    """PINHOLE cameras; the first pixel's centre is (0.5, 0.5) in COLMAP, (0, 0) here."""
    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[] as fx, fy, cx, cy"]
    for i, (K, image) in enumerate(zip(cameras, images), 1):
        fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2] + 0.5, K[1, 2] + 0.5
        size = f"{image.shape[1]} {image.shape[0]}"
        lines.append(f"{i} PINHOLE {size} {fx:.17g} {fy:.17g} {cx:.17g} {cy:.17g}")
    return "\n".join(lines) + "\n"


def _images(
    names: Sequence[str], poses: Sequence[RigidMotion], seen: Sequence[tuple[Int, Float]]
) -> str:
    lines = [
        "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME (cam_from_world)",
        "# POINTS2D[] as (X, Y, POINT3D_ID)",
    ]
    for i, (pose, name, (points, uv)) in enumerate(zip(poses, names, seen), 1):
        x, y, z, w = pose.quaternion
        numbers = " ".join(f"{a:.17g}" for a in (w, x, y, z, *pose.t))
        lines.append(f"{i} {numbers} {i} {name}")
        lines.append(" ".join(f"{u:.6g} {v:.6g} {k + 1}" for k, (u, v) in zip(points, uv + 0.5)))
    return "\n".join(lines) + "\n"


def _points(result: Result, still: Mask) -> tuple[tuple[Float, Float], Float, NDArray[np.uint8]]:
    """Pixels (P, 2) in both images, points (P, 3) and colours (P, 3) on an even grid."""
    keep = still & result.sure
    step = max(1, int(np.ceil(np.sqrt(keep.sum() / POINTS))))
    grid = np.zeros_like(keep)
    grid[step // 2 :: step, step // 2 :: step] = True
    v, u = np.nonzero(keep & grid)
    rec = result.reconstruction
    uv = np.stack([u, v], axis=1).astype(float)
    return (uv, uv + rec.flow[v, u]), rec.points_ref[v, u], result.images[0][v, u]


def _moved(result: Result, moving: Mask) -> Mask:
    """(H', W') pixels of the next image that show independently moving parts, gaps closed."""
    rec = result.reconstruction
    height, width = rec.depth_next.shape
    v, u = np.nonzero(moving & np.isfinite(rec.flow).all(axis=2))
    at = np.floor(np.stack([u, v], 1) + rec.flow[v, u] + 0.5)
    # only points that are not hidden by the static scene
    inside = (at >= 0).all(1) & (at < [width, height]).all(1)
    u2, v2 = at[inside].astype(np.int64).T
    z = rec.points_next[v[inside], u[inside], 2]
    seen = z <= 1.05 * rec.depth_next[v2, u2]
    out = np.zeros((height, width), np.uint8)
    out[v2[seen], u2[seen]] = 1
    return np.asarray(cv2.morphologyEx(out, cv2.MORPH_CLOSE, np.ones((3, 3), np.uint8)) > 0)
