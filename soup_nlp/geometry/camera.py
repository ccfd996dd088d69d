"""Pinhole cameras: pixels, rays and points (integer pixel = pixel centre, depth is z)."""

import numpy as np
from numpy.typing import ArrayLike

from soup_nlp.arrays import Float


def intrinsics(fx: float, fy: float, cx: float, cy: float) -> Float:
    """The (3, 3) matrix K of focal lengths and principal point in pixels."""
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def rays(K: Float, uv: ArrayLike) -> Float:
    """Rays (..., 3), `K^-1 (u, v, 1)`, of pixels (..., 2)."""
    uv = np.asarray(uv, float)
    y = (uv[..., 1] - K[1, 2]) / K[1, 1]
    x = (uv[..., 0] - K[0, 2] - K[0, 1] * y) / K[0, 0]
    return np.stack([x, y, np.ones_like(x)], axis=-1)


def project(K: Float, points: ArrayLike) -> Float:
    """Pixels (..., 2) of camera-frame points (..., 3)."""
    X = np.asarray(points, float)
    x, y = X[..., 0] / X[..., 2], X[..., 1] / X[..., 2]
    return np.stack([K[0, 0] * x + K[0, 1] * y + K[0, 2], K[1, 1] * y + K[1, 2]], axis=-1)


def pixel_grid(height: int, width: int) -> Float:
    """(H, W, 2) array of pixel coordinates (u, v)."""
    v, u = np.mgrid[0:height, 0:width]
    return np.stack([u, v], axis=-1).astype(float)
