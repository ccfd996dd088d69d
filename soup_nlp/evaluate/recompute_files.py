"""Independent computation of what the files of a result show, and of E_photo from the images.

As in `evaluate.recompute`, nothing that made the result is used.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from scipy import ndimage

from soup_nlp.arrays import Float, Int
from soup_nlp.evaluate.recompute import State, next_depth_map

SAMPLES, TAU, UNSEEN, BEHIND = 24, 0.35, 0.25, 1.1
"""Constants of E_photo, see docs/formulation.md."""
BESIDE = [(v, u) for v in (-2, 0, 2) for u in (-2, 0, 2) if (v, u) != (0, 0)]
"""(dv, du) of the census."""


def png_scale(depth: Float) -> float:
    """Values per unit of a 16-bit depth map: a power of two at which the 99.9th percentile fits."""
    known = depth[np.isfinite(depth) & (depth > 0)]
    far = float(np.percentile(known, 99.9)) if len(known) else 1.0
    return float(2.0 ** np.floor(np.log2(65535.0 / far)))


def png_values(depth: Float, scale: float) -> Int:
    """Values of a 16-bit depth map; 0 where unknown."""
    known = np.isfinite(depth) & (depth > 0)
    value = np.minimum(np.maximum(np.rint(np.where(known, depth, 1.0) * scale), 1), 65535)
    return np.where(known, value, 0).astype(np.int64)


def clouds(s: State, depth: Float, labels: Int, K: Float) -> tuple[Float, Float, Float]:
    """Points and normals of both clouds, and the size of what each is the sum of.

    Args:
        s: Soup.
        depth: (H, W) z of the reference frame.
        labels: (H, W) superpixel of every pixel.
        K: (3, 3) intrinsics of the reference frame.

    Returns:
        (M, 6) of the reference frame, (M, 6) of the next frame, (M,); NaN where z is unknown.
    """
    v, u = (x.ravel() for x in np.mgrid[0 : labels.shape[0], 0 : labels.shape[1]])
    who = labels.ravel()
    X = depth.ravel()[:, None] * (np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T)
    T = (s["lam"][:, None] * s["t"])[who]
    Y = np.matmul(s["R"][who], X[..., None])[..., 0] + T
    turned = np.matmul(s["R"], s["n"][..., None])[..., 0]
    size = np.linalg.norm(X, axis=1) + np.linalg.norm(T, axis=1)
    return np.hstack([X, s["n"][who]]), np.hstack([Y, turned[who]]), np.asarray(size)


class Photo(NamedTuple):
    """E_photo with its factor, and by how much rounding may change it."""

    energy: float
    within: float


def photo(
    s: State, tree: Mapping[str, Any], factor: float, image_ref: Any, image_next: Any
) -> Photo:
    """E_photo of a soup (equation 27 of docs/formulation.md) from the two images.

    Args:
        s: Soup.
        tree: Arrays of result.h5; the NLP's soup says what hides what.
        factor: Of E_photo.
        image_ref: (H, W, 3) or (H, W) uint8.
        image_next: The same of the next frame.
    """
    labels, K_ref, K_next = (
        tree["segmentation"]["labels"],
        tree["input"]["K_ref"],
        tree["input"]["K_next"],
    )
    row, column = _samples(labels, len(s["lam"]))
    ray = np.stack([column, row, np.ones_like(row)], -1) @ np.linalg.inv(K_ref).T
    D = s["lam"] * s["d"]
    z = D[:, None] / np.maximum(-(ray @ s["n"][..., None])[..., 0], 1e-9)
    X = z[..., None] * ray
    Y = X @ np.swapaxes(s["R"], 1, 2) + (s["lam"][:, None] * s["t"])[:, None]
    image = Y @ K_next.T
    ahead = image[..., 2] / z
    u, v = (image[..., k] / np.where(ahead > 1e-6, image[..., 2], 1.0) for k in (0, 1))
    height, width = image_next.shape[:2]
    # distance from leaving the picture, pixels
    margin = np.minimum(np.minimum(u, width - 1 - u), np.minimum(v, height - 1 - v))
    seen = (ahead > 1e-6) & (margin >= 0)
    u, v = np.where(seen, u, 0.0), np.where(seen, v, 0.0)
    nlp = tree["nlp"]
    front, doubt = next_depth_map(nlp, labels, K_ref, K_next, (height, width))
    unit = float(np.median(D / (nlp["lam"] * nlp["d"])))
    front = np.where(np.isnan(front), np.inf, front)
    place = np.floor(v + 0.5).astype(int), np.floor(u + 0.5).astype(int)
    depth = Y[..., 2] / (BEHIND * unit)
    # half way between two pixels, either may be looked at
    either = doubt[place] | (np.abs([u % 1 - 0.5, v % 1 - 0.5]) < 1e-3).any(0)
    low = np.where(either, ndimage.minimum_filter(front, 3)[place], front[place])
    high = np.where(either, ndimage.maximum_filter(front, 3)[place], front[place])
    near = (depth > low * (1 - 1e-4)) & (depth < high * (1 + 1e-4)) & seen
    near |= np.abs(margin) < 1e-3
    seen &= depth < front[place]

    own, there = _census(image_ref)[row, column], _census(image_next)
    sums = []
    # OpenCV looks pixels up at multiples of 1/32
    for x, y in ((u, v), (np.rint(u * 32) / 32, np.rint(v * 32) / 32)):
        miss = np.abs(_between(there, x, y) - own).sum(-1) / (2 * len(BESIDE))
        sums.append(np.where(seen, np.minimum(miss, TAU), UNSEEN).mean(1).sum())
    undecided = float(near.mean(1).sum()) * TAU
    within = 2 * abs(sums[0] - sums[1]) + undecided + 1e-5 * sums[1]
    return Photo(factor * float(sums[0]), factor * float(within))


def _samples(labels: Int, n: int) -> tuple[Int, Int]:
    """(N, SAMPLES) rows and columns, evenly spread over each superpixel in the order of rows."""
    order = np.argsort(labels, axis=None, kind="stable")
    count = np.bincount(labels.ravel(), minlength=n)
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    step = ((2 * np.arange(SAMPLES) + 1) * count[:, None]) // (2 * SAMPLES)
    row, column = np.divmod(order[first[:, None] + step], labels.shape[1])
    return row, column


def _census(image: Any) -> Float:
    """(H, W, 8) tanh of the grey-level differences of a smoothed image over 10."""
    grey = np.asarray(image, np.float64)
    if grey.ndim == 3:
        grey = np.floor(grey @ [9798, 19235, 3735] / 32768 + 0.5)
    smooth = ndimage.gaussian_filter(grey, 0.7, mode="mirror", radius=3)
    wide = np.pad(smooth, 2, mode="edge")
    height, width = smooth.shape
    return np.stack(
        [
            np.tanh((wide[2 + v : 2 + v + height, 2 + u : 2 + u + width] - smooth) / 10)
            for v, u in BESIDE
        ],
        -1,
    )


def _between(values: Float, u: Float, v: Float) -> Float:
    """Bilinear interpolation of (H, W, C) at pixels inside."""
    height, width = values.shape[:2]
    u0, v0 = (np.floor(x).astype(int) for x in (u, v))
    u1, v1 = np.minimum(u0 + 1, width - 1), np.minimum(v0 + 1, height - 1)
    a, b = (u - u0)[..., None], (v - v0)[..., None]
    above = (1 - a) * values[v0, u0] + a * values[v0, u1]
    below = (1 - a) * values[v1, u0] + a * values[v1, u1]
    return np.asarray((1 - b) * above + b * below)
