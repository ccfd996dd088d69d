"""Planes as inverse depth: conversions, tilts until they face the camera, fits to a flow.

The plane `n . X + D = 0` with unit normal n and D > 0 is the inverse-depth vector `m = -n / D`:
a ray r meets it at depth `Z(r) = 1 / (m . r)`. About an anchor ray a it is
`m = (g, 1 - g . a) / Z`, with the depth Z at the anchor and the slope g of the relative inverse
depth: `1 / Z(r) = (1 + g . (r - a)) / Z`. Leading axes are free.
"""

from dataclasses import dataclass

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
    """Depth (...) at the anchor rays (..., 3), negative where the plane passes them behind the
    camera, and slopes (..., 2), per ray unit."""
    Z = 1.0 / np.einsum("...c,...c->...", m, anchor_ray)
    return Z, m[..., :2] * Z[..., None]


def about_anchor(Z: Float, g: Float, anchor_ray: Float) -> Float:
    """Inverse-depth vectors (..., 3) of depths (...) and slopes (..., 2) at anchors (..., 3)."""
    last = 1.0 - np.sum(g * anchor_ray[..., :2], axis=-1)
    return np.concatenate([g, last[..., None]], axis=-1) / Z[..., None]


def tilt_to_camera(soup: Soup, anchor_ray: Float, visibility_ray: Float, min_facing: float) -> Soup:
    """The soup with planes that break visibility, `-n . v >= min_facing` at rays v (N, V, 3),
    tilted about their anchors until they satisfy it, as a plane parallel to the image does.

    The depth at the anchor rays (N, 3), which is positive, is kept.
    """
    Z, g = at_anchor(inverse_depth(soup.n, soup.distance), anchor_ray)
    share = np.ones(len(soup))
    n, D = soup.n.copy(), soup.distance.copy()
    for _ in range(60):
        facing = -np.einsum("nc,nvc->nv", n, visibility_ray).max(axis=1)
        bad = facing < min_facing - TOLERANCE
        if not bad.any():
            break
        share = np.where(bad, 0.8 * share, share)
        plane = about_anchor(Z[bad], (g * share[:, None])[bad], anchor_ray[bad])
        n[bad], D[bad] = normal_and_distance(plane)
    return Soup(np.ones(len(soup)), n, D, soup.R, soup.translation)


# --- the plane of every superpixel under given motions: linear in n / d, robust, batched ----------

ROUNDING_PX = 1e-3
"""Parallax, in pixels, that counts as none, because the flow is not more accurate."""
SLOPES, MOST_SLOPE = 0.4, 0.75
"""Standard deviation of a slope without flow, and its limit, as in `PlaneFit.slope`."""
NOISE_PX, CLIP_PX = 0.5, 5.0
"""Flow noise that slopes are weighed against, and limit of an error, pixels."""
ROUNDS = 4
"""Re-weighting rounds of a fit."""


@dataclass(frozen=True)
class PlaneFit:
    """Planes of N superpixels under C candidate motions each (unit translation).

    Attributes:
        inverse_depth: (N, C) 1 / Z at the anchor, in units of |t|; may be negative (bad).
        slope: (N, C, 2) relative change of inverse depth at the superpixel's radius.
        cost: (N, C) robust mean re-projection error, pixels; inf where a fit is impossible.
        parallax: (N, C) pixels that the anchor moves per unit of relative inverse depth.
    """

    inverse_depth: Float
    slope: Float
    cost: Float
    parallax: Float

    def penalised(self) -> Float:
        """(N, C) cost in pixels, increased where the plane lies behind the camera."""
        # a point without parallax is at infinity, and rounding decides its sign
        shift = self.parallax * self.inverse_depth
        return self.cost + np.where(shift < -ROUNDING_PX, 1.0 - 0.5 * shift, 0.0)


def fit_planes(
    R: Float,
    t: Float,
    ray: Float,
    target: Float,
    weight: Float,
    anchor: Float,
    radius: Float,
    focal: Float,
) -> PlaneFit:
    """Fit `mu(r) = mu_a + g . (r - r_a) / h` with `q ~ R r + mu t` to the flow.

    Args:
        R, t: (N, C, 3, 3) rotations and (N, C, 3) translations.
        ray: (N, S, 3) rays of sampled pixels.
        target, weight: (N, S, 3) rays of their flow targets (next camera), (N, S) confidence.
        anchor, radius: (N, 3) anchor rays, (N,) reach in ray units (h).
        focal: (2,) focal lengths of the next camera: errors are in pixels.
    """
    # one array (N, C, S) per coordinate, the pixels contiguous
    y = R @ np.ascontiguousarray(ray.transpose(0, 2, 1))[:, None]
    front, shift = y[:, :, 2], t[:, :, None, 2]
    q = target[:, None]
    ax, ay = ((y[:, :, i] - q[..., i] * front) * focal[i] for i in (0, 1))
    bx, by = ((t[:, :, None, i] - q[..., i] * shift) * focal[i] for i in (0, 1))
    off = (ray - anchor[:, None])[..., :2] / radius[:, None, None]
    basis = np.concatenate([np.ones((*off.shape[:2], 1)), off], axis=2)
    outer = (basis[..., :, None] * basis[..., None, :]).reshape(*basis.shape[:2], 9)
    w = np.broadcast_to(weight[:, None], front.shape).copy()
    confident = w
    depth_like = np.maximum(np.abs(front), 1e-6)
    b2 = bx * bx + by * by
    ab = ax * bx + ay * by
    mu = np.zeros((*front.shape[:2], 3))
    for step in range(ROUNDS):
        s = w / depth_like**2
        if step == 0:
            mu[..., 0] = -np.sum(s * ab, axis=2) / np.maximum(np.sum(s * b2, axis=2), 1e-12)
        else:
            A = ((s * b2) @ outer).reshape(*mu.shape, 3)
            rhs = -(s * ab) @ basis
            # slopes are known a priori to SLOPES, the flow to NOISE_PX pixels
            prior = (NOISE_PX / (SLOPES * np.maximum(np.abs(mu[..., 0]), 1e-9))) ** 2
            A[..., 1, 1] += prior
            A[..., 2, 2] += prior
            size = np.trace(A, axis1=-2, axis2=-1)[..., None, None]
            A += (1e-12 * size + 1e-18) * np.eye(3)
            mu = np.linalg.solve(A, rhs[..., None])[..., 0]
            limit = MOST_SLOPE * np.abs(mu[..., :1])
            mu[..., 1:] = np.clip(mu[..., 1:], -limit, limit)
        value = mu @ basis.transpose(0, 2, 1)
        depth_like = np.maximum(front + value * shift, 1e-3)
        ex, ey = ax + bx * value, ay + by * value
        error = np.sqrt(ex * ex + ey * ey) / depth_like
        w = confident / np.sqrt(error**2 + NOISE_PX**2)
    total = np.maximum(confident.sum(axis=2), 1e-9)
    cost = np.sum(confident * np.minimum(error, CLIP_PX), axis=2) / total
    parallax = np.sqrt(np.sum(confident * b2 / depth_like**2, axis=2) / total)
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = np.where(mu[..., :1] != 0, mu[..., 1:] / mu[..., :1], 0.0)
    return PlaneFit(mu[..., 0], np.clip(slope, -MOST_SLOPE, MOST_SLOPE), cost, parallax)
