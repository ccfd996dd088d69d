"""Planes as inverse depth: conversions, and planes tilted until they face the camera.

The plane `n . X + D = 0` with unit normal n and D > 0 is the inverse-depth vector `m = -n / D`:
a ray r meets it at depth `Z(r) = 1 / (m . r)`. About an anchor ray a it is
`m = (g, 1 - g . a) / Z`, with the depth Z at the anchor and the slope g of the relative inverse
depth: `1 / Z(r) = (1 + g . (r - a)) / Z`. Leading axes are free.
"""

from __future__ import annotations

import numpy as np

from soup_nlp.arrays import Float
from soup_nlp.geometry.soup import Soup

TOLERANCE = 1e-7
"""Violation of visibility that `tilt_to_camera` accepts: the tolerance of an NLP's answer."""


def inverse_depth(n: Float, D: Float) -> Float:
    """Inverse-depth vectors (..., 3) of planes with normals (..., 3) and distances (...)."""
    return np.asarray(-n / D[..., None])


def normal_and_distance(m: Float) -> tuple[Float, Float]:
    """Unit normals (..., 3) that face the camera and distances (...) of inverse-depth vectors."""
    length = np.linalg.norm(m, axis=-1)
    return -m / length[..., None], 1.0 / length


def at_anchor(m: Float, anchor_ray: Float) -> tuple[Float, Float]:
    """Depth (...) at the anchor rays (..., 3) and slopes (..., 2), per ray unit.

    A depth is negative where the plane passes the anchor behind the camera.
    """
    Z = 1.0 / np.einsum("...c,...c->...", m, anchor_ray)
    return Z, m[..., :2] * Z[..., None]


def about_anchor(Z: Float, g: Float, anchor_ray: Float) -> Float:
    """Inverse-depth vectors (..., 3) of depths (...) and slopes (..., 2) at anchors (..., 3)."""
    last = 1.0 - np.sum(g * anchor_ray[..., :2], axis=-1)
    return np.concatenate([g, last[..., None]], axis=-1) / Z[..., None]


def tilt_to_camera(soup: Soup, anchor_ray: Float, visibility_ray: Float, min_facing: float) -> Soup:
    """The soup with planes that break visibility tilted about their anchors until they satisfy it.

    The depth at the anchor is kept; a negative one becomes the median of the others. A plane
    parallel to the image satisfies every row.

    Args:
        soup: State.
        anchor_ray: (N, 3).
        visibility_ray: (N, V, 3) rays v of `-n . v >= min_facing`.
        min_facing: Least cosine, times the length of v.
    """
    Z, g = at_anchor(inverse_depth(soup.n, soup.distance), anchor_ray)
    behind = Z <= 0
    if behind.any():
        Z = np.where(behind, np.median(Z[~behind]) if (~behind).any() else 1.0, Z)
        g = np.where(behind[:, None], 0.0, g)
    share = np.ones(len(soup))
    n, D = soup.n.copy(), soup.distance.copy()
    for _ in range(60):
        facing = -np.einsum("nc,nvc->nv", n, visibility_ray).max(axis=1)
        bad = (facing < min_facing - TOLERANCE) | behind
        behind = np.zeros(len(soup), bool)
        if not bad.any():
            break
        share = np.where(bad, 0.8 * share, share)
        plane = about_anchor(Z[bad], (g * share[:, None])[bad], anchor_ray[bad])
        n[bad], D[bad] = normal_and_distance(plane)
    return Soup(np.ones(len(soup)), n, D, soup.R, soup.translation)
