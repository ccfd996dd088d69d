"""Depth, error, flow, normals and superpixels in colour: (H, W, 3) uint8 RGB, unknown is black."""

from __future__ import annotations

import matplotlib
import numpy as np
from numpy.typing import NDArray

from soup_nlp.errors import DataError

Float = NDArray[np.floating]
Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]

_WHEEL = (15, 6, 4, 11, 13, 6)  # steps red-yellow-green-cyan-blue-magenta-red


def depth_range(depth: Float) -> tuple[float, float]:
    """(near, far) of a depth map, its 2nd and 98th percentile: a colour scale for several maps.

    Args:
        depth: (H, W) z; values that are not finite or not positive are left out.

    Returns:
        near < far, in the unit of the depth; (1, 2) where nothing is known.
    """
    z = np.asarray(depth, np.float64)
    z = z[np.isfinite(z) & (z > 0)]
    if z.size == 0:
        return 1.0, 2.0
    near, far = (float(x) for x in np.percentile(z, (2.0, 98.0)))
    if not far > near * (1 + 1e-9):  # a constant depth still needs a scale
        near, far = near / 1.1, far * 1.1
    return near, far


def colourise_depth(depth: Float, near: float | None = None, far: float | None = None) -> Image:
    """Depth in colour by even steps of 1/z: near is red, far is blue.

    Args:
        depth: (H, W) z; black where not finite or not positive.
        near: Depth of the near end; None takes `depth_range`.
        far: Depth of the far end; None takes `depth_range`.

    Raises:
        DataError: not a map, or not 0 < near < far.
    """
    z = as_map(depth, "depth")
    own = depth_range(z)
    near, far = own[0] if near is None else near, own[1] if far is None else far
    if not 0 < near < far < np.inf:
        raise DataError("depth range is wrong", found=(near, far), expected="0 < near < far")
    known = np.isfinite(z) & (z > 0)
    safe = np.clip(np.where(known, z, near), near, far)
    return _paint((1 / safe - 1 / far) / (1 / near - 1 / far), known, "turbo")


def colourise_error(relative_error: Float, limit: float = 0.2) -> Image:
    """Relative depth error in colour, from 0 (dark) to `limit` and above (bright).

    The lowest tenth of the colour map is left out, so that a small error differs from black, the
    colour of the unknown.

    Args:
        relative_error: (H, W) |z_gt - z| / z_gt; black where not finite.
        limit: Error at the upper end.

    Raises:
        DataError: not a map, or a limit that is not positive.
    """
    error = np.abs(as_map(relative_error, "relative_error"))
    if not 0 < limit < np.inf:
        raise DataError("error limit must be positive", where="limit", found=limit, expected="> 0")
    known = np.isfinite(error)
    level = np.minimum(np.where(known, error, 0.0) / limit, 1.0)
    return _paint(0.1 + 0.9 * level, known, "inferno")


def _paint(level: NDArray[np.float64], known: Mask, name: str) -> Image:
    """(H, W, 3) colours of levels (H, W) in [0, 1] by a matplotlib map, black where not known."""
    table = (matplotlib.colormaps[name](np.arange(256))[:, :3] * 255).round().astype(np.uint8)
    out = table[(level * 255).round().astype(np.intp)]
    out[~known] = 0
    return np.asarray(out)


def colour_wheel() -> NDArray[np.float64]:
    """(55, 3) colours, 0 to 255, of the Middlebury flow wheel (Baker et al., IJCV 2011)."""
    pure = np.array([[1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 1, 1], [0, 0, 1], [1, 0, 1], [1, 0, 0]])
    parts = []
    for k, steps in enumerate(_WHEEL):
        ramp = np.floor(255 * np.arange(steps) / steps)[:, None]
        parts.append(255.0 * pure[k] + ramp * (pure[k + 1] - pure[k]))
    return np.concatenate(parts)


def colourise_flow(uv: Float, limit: float | None = None) -> Image:
    """Flow in the colours of the Middlebury wheel: hue is direction, white is no motion.

    Args:
        uv: (H, W, 2) displacement, pixels; black where not finite.
        limit: Length, pixels, of full saturation; longer is darker. None takes the 99th
            percentile.

    Raises:
        DataError: wrong shape, or a limit that is not positive.
    """
    flow = as_map(uv, "uv", 2)
    known: Mask = np.asarray(np.isfinite(flow).all(axis=2))
    flow = np.where(known[:, :, None], flow, 0.0)
    length = np.hypot(flow[:, :, 0], flow[:, :, 1])
    if limit is None:
        limit = max(float(np.percentile(length[known], 99)), 1e-6) if known.any() else 1.0
    if not 0 < limit < np.inf:
        raise DataError("flow limit must be positive", where="limit", found=limit, expected="> 0")
    radius = (length / limit)[:, :, None]
    wheel = colour_wheel() / 255
    turn = np.arctan2(-flow[:, :, 1], -flow[:, :, 0]) / np.pi
    place = (turn + 1) / 2 * (len(wheel) - 1)
    low = np.floor(place).astype(np.intp)
    part = (place - low)[:, :, None]
    hue = (1 - part) * wheel[low] + part * wheel[(low + 1) % len(wheel)]
    colour = np.where(radius <= 1, 1 - radius * (1 - hue), 0.75 * hue)
    out = np.floor(255 * colour).astype(np.uint8)
    out[~known] = 0
    return np.asarray(out)


def colourise_normals(n_map: Float) -> Image:
    """Normals in colour: (x, -y, -z) from [-1, 1] to RGB, so one that faces the camera is blue.

    Args:
        n_map: (H, W, 3) unit normals in the camera frame (x right, y down, z forward); black where
            not finite.

    Raises:
        DataError: wrong shape.
    """
    n = as_map(n_map, "n_map", 3)
    known: Mask = np.asarray(np.isfinite(n).all(axis=2))
    signed = np.where(known[:, :, None], n, 0.0) * np.array([1.0, -1.0, -1.0])
    out = ((np.clip(signed, -1, 1) + 1) * 127.5).round().astype(np.uint8)
    out[~known] = 0
    return np.asarray(out)


def draw_superpixels(
    image: Image, labels: NDArray[np.integer], colour: tuple[int, int, int] = (255, 255, 0)
) -> Image:
    """The (H, W, 3) image with the boundaries of the labels (H, W) drawn one pixel wide.

    Raises:
        DataError: the image is not RGB, or the labels do not fit it.
    """
    check_rgb(image, "image")
    if labels.shape != image.shape[:2]:
        raise DataError("labels do not fit the image", found=labels.shape, expected=image.shape[:2])
    edge = np.zeros(labels.shape, bool)
    edge[:, :-1] |= labels[:, :-1] != labels[:, 1:]
    edge[:-1] |= labels[:-1] != labels[1:]
    out = image.copy()
    out[edge] = np.asarray(colour, np.uint8)
    return out


def as_map(value: Float, where: str, channels: int = 0) -> NDArray[np.float64]:
    """An (H, W) map, or an (H, W, channels) one, as doubles.

    Raises:
        DataError: another shape, or empty.
    """
    array = np.asarray(value, np.float64)
    fits = array.ndim == 2 if not channels else array.ndim == 3 and array.shape[2] == channels
    if not fits or array.size == 0:
        raise DataError(
            "cannot draw an array of this shape",
            where=where,
            found=array.shape,
            expected=f"(H, W, {channels})" if channels else "(H, W)",
        )
    return array


def check_rgb(image: Image, where: str) -> None:
    """Check that an image is (H, W, 3) uint8 and not empty.

    Raises:
        DataError: it is not.
    """
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise DataError(
            "image must be 8-bit RGB",
            where=where,
            found=f"{image.dtype} {image.shape}",
            expected="uint8 (H, W, 3)",
        )
