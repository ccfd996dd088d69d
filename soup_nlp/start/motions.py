"""Motions fitted to groups of pixels: translation alone, then rotation as well."""

from __future__ import annotations

import numpy as np

from soup_nlp.arrays import Float
from soup_nlp.geometry import rotation


def fit_translation(
    R: Float, r: Float, q: Float, weight: Float, focal: float, noise: float, rounds: int = 6
) -> Float:
    """Translation direction of every group for a given rotation.

    The epipolar constraint `t . (R r x q) = 0` is linear in t, which is the eigenvector of the
    re-weighted scatter matrix with the smallest eigenvalue.

    Args:
        R: (N, 3, 3) rotations.
        r: (N, M, 3) reference rays.
        q: (N, M, 3) next rays.
        weight: (N, M) confidence.
        focal: Pixels per ray unit.
        noise: Flow noise, pixels: errors beyond it are down-weighted.
        rounds: Reweighting rounds.

    Returns:
        (N, 3) unit translations with most points in front of the camera.
    """
    y, q_ = R @ _rows(r), _rows(q)
    normal = _cross(y, q_)
    w = weight.copy()
    t = np.zeros((len(R), 3))
    for _ in range(rounds):
        A = (normal * w[:, None]) @ normal.transpose(0, 2, 1)
        t = np.linalg.eigh(A)[1][:, :, 0]
        algebraic = (t[:, None] @ normal)[:, 0]
        spread = np.sqrt(_square(*_cross_xy(t[..., None], q_)))
        error = focal * np.abs(algebraic) / np.maximum(spread, 1e-9)
        w = weight / (1 + (error / noise) ** 2)
        # Sampson's weight: error in pixels, not the algebraic one
        w = w / np.maximum(spread, 1e-6) ** 2
    return _facing(t, y, q_, weight)


def _rows(v: Float) -> Float:
    """(N, 3, M) from (N, M, 3): contiguous coordinates, which is faster."""
    return np.ascontiguousarray(v.transpose(0, 2, 1))


def _cross_xy(a: Float, b: Float) -> tuple[Float, Float]:
    """First two coordinates (N, M) of the cross product of (N, 3, M)."""
    x = a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1]
    return x, a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2]


def _cross(a: Float, b: Float) -> Float:
    """Cross product of (N, 3, M)."""
    return np.stack([*_cross_xy(a, b), a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]], axis=1)


def _square(x: Float, y: Float) -> Float:
    return x * x + y * y


def _facing(t: Float, y: Float, q: Float, weight: Float) -> Float:
    """t (N, 3) with the sign that makes most depths positive, of rays y (turned), q (N, 3, M)."""
    s = t[..., None]
    dot = (y[:, 0] - q[:, 0] * y[:, 2]) * (s[:, 0] - q[:, 0] * s[:, 2])
    dot += (y[:, 1] - q[:, 1] * y[:, 2]) * (s[:, 1] - q[:, 1] * s[:, 2])
    vote = np.sum(weight * np.sign(-dot), axis=1)
    return t * np.where(vote >= 0, 1.0, -1.0)[:, None]


def refine_motion(
    R: Float,
    t: Float,
    r: Float,
    q: Float,
    weight: Float,
    focal: float,
    noise: float,
    rotation_prior: float = 0.02,
    translation_prior: float = 0.3,
    rounds: int = 8,
) -> tuple[Float, Float]:
    """Rotation and translation direction of every group near a given motion.

    Re-weighted Gauss-Newton steps on the Sampson distance. Priors hold the directions that a small
    patch does not determine.

    Args:
        R: (N, 3, 3) rotations to start from.
        t: (N, 3) unit translations to start from.
        r: (N, M, 3) reference rays.
        q: (N, M, 3) next rays.
        weight: (N, M) confidence.
        focal: Pixels per ray unit.
        noise: Flow noise, pixels.
        rotation_prior: Standard deviation of the change of R, radians.
        translation_prior: Standard deviation of the change of t, radians.
        rounds: Gauss-Newton steps.
    """
    R0, t0 = R, t
    turn = np.zeros((len(R), 3))
    r_, q_ = _rows(r), _rows(q)
    J = np.empty((len(R), 5, r.shape[1]))
    for _ in range(rounds):
        y, s = R @ r_, t[..., None]
        cross = _cross(y, q_)
        value = (t[:, None] @ cross)[:, 0]
        back = R[:, :, :2].transpose(0, 2, 1) @ _cross(q_, s)
        spread = np.sqrt(_square(*_cross_xy(s, y)) + _square(back[:, 0], back[:, 1]))
        spread = np.maximum(spread, 1e-9)
        ty = (t[:, None] @ y)[:, 0]
        yq = np.sum(y * q_, axis=1)
        # t moves in its tangent plane
        basis = np.linalg.svd(t[:, None, :])[2][:, 1:]
        J[:, :3] = ty[:, None] * q_ - yq[:, None] * s
        J[:, 3:] = basis @ cross
        J *= (focal / spread)[:, None]
        e = focal * value / spread
        w = weight / (1 + (e / noise) ** 2) / noise**2
        Jw = J * w[:, None]
        A = Jw @ J.transpose(0, 2, 1)
        g = (Jw @ e[..., None])[..., 0]
        prior = np.array([rotation_prior] * 3 + [translation_prior] * 2) ** -2.0
        A += np.diag(prior)
        g[:, :3] += prior[:3] * turn
        g[:, 3:] += prior[3:] * np.einsum("nbi,ni->nb", basis, t - t0)
        try:
            step = -np.linalg.solve(A, g[..., None])[..., 0]
        except np.linalg.LinAlgError:
            # the prior is below the rounding of A (focal lengths of 1e9)
            step = -(np.linalg.pinv(A, hermitian=True) @ g[..., None])[..., 0]
        limit = np.minimum(1.0, 0.1 / np.maximum(np.abs(step).max(axis=1), 1e-12))[:, None]
        step = step * limit
        turn = turn + step[:, :3]
        R = rotation.exp(turn) @ R0
        t = t + np.einsum("nb,nbi->ni", step[:, 3:], basis)
        t = t / np.linalg.norm(t, axis=1, keepdims=True)
    return R, _facing(t, R @ r_, q_, weight)
