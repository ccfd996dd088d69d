"""Motions of small neighbourhoods, all superpixels at once: translation alone, then both."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from soup_nlp.geometry import rotation

Float = NDArray[np.float64]
Int = NDArray[np.int64]


def neighbourhood(values: Float, members: Int) -> Float:
    """(N, M S, ...) values of every superpixel's members, from (N, S, ...) of each.

    Args:
        values: (N, S, ...) per superpixel and pixel.
        members: (N, M) superpixels that make up each neighbourhood.
    """
    picked = values[members]
    return picked.reshape(len(members), -1, *values.shape[2:])


def fit_translation(
    R: Float, r: Float, q: Float, weight: Float, focal: float, noise: float, rounds: int = 6
) -> Float:
    """Translation direction of every neighbourhood with its rotation given.

    The epipolar constraint `t . (R r x q) = 0` is linear in t: smallest eigenvector of the
    reweighted scatter matrix.

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
    y = np.einsum("nij,nmj->nmi", R, r)
    normal = np.cross(y, q)
    w = weight.copy()
    t = np.zeros((len(R), 3))
    for _ in range(rounds):
        A = np.einsum("nm,nmi,nmj->nij", w, normal, normal, optimize=True)
        t = np.linalg.eigh(A)[1][:, :, 0]
        algebraic = np.einsum("nmi,ni->nm", normal, t)
        spread = np.linalg.norm(np.cross(t[:, None], q)[..., :2], axis=2)
        error = focal * np.abs(algebraic) / np.maximum(spread, 1e-9)
        w = weight / (1 + (error / noise) ** 2)
        # Sampson's weight: error in pixels, not the algebraic one
        w = w / np.maximum(spread, 1e-6) ** 2
    return face_forward(R, t, r, q, weight)


def face_forward(R: Float, t: Float, r: Float, q: Float, weight: Float) -> Float:
    """The sign of t (N, 3) under which most depths are positive."""
    y = np.einsum("nij,nmj->nmi", R, r)
    a = y[..., :2] - q[..., :2] * y[..., 2:]
    b = t[:, None, :2] - q[..., :2] * t[:, None, 2:]
    vote = np.sum(weight * np.sign(-np.sum(a * b, axis=2)), axis=1)
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
    """Rotation and translation direction of every neighbourhood near a given motion.

    Reweighted Gauss-Newton on the Sampson distance; priors keep what a small patch does not
    determine.

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
    for _ in range(rounds):
        y = np.einsum("nij,nmj->nmi", R, r)
        cross = np.cross(y, q)
        value = np.einsum("nmi,ni->nm", cross, t)
        Eq = np.linalg.norm(np.cross(t[:, None], y)[..., :2], axis=2)
        Er = np.linalg.norm(np.einsum("nji,nmj->nmi", R, np.cross(q, t[:, None]))[..., :2], axis=2)
        spread = np.maximum(np.sqrt(Eq**2 + Er**2), 1e-9)
        ty = np.einsum("nmi,ni->nm", y, t)
        yq = np.sum(y * q, axis=2)
        d_turn = ty[..., None] * q - yq[..., None] * t[:, None]
        # t moves in its tangent plane
        basis = np.linalg.svd(t[:, None, :])[2][:, 1:]
        d_t = np.einsum("nmi,nbi->nmb", cross, basis)
        J = np.concatenate([d_turn, d_t], axis=2) * (focal / spread)[..., None]
        e = focal * value / spread
        w = weight / (1 + (e / noise) ** 2) / noise**2
        A = np.einsum("nm,nmi,nmj->nij", w, J, J, optimize=True)
        g = np.einsum("nm,nmi,nm->ni", w, J, e, optimize=True)
        prior = np.array([rotation_prior] * 3 + [translation_prior] * 2) ** -2.0
        A += np.diag(prior)
        g[:, :3] += prior[:3] * turn
        g[:, 3:] += prior[3:] * np.einsum("nbi,ni->nb", basis, t - t0)
        step = -np.linalg.solve(A, g[..., None])[..., 0]
        limit = np.minimum(1.0, 0.1 / np.maximum(np.abs(step).max(axis=1), 1e-12))[:, None]
        step = step * limit
        turn = turn + step[:, :3]
        R = rotation.exp(turn) @ R0
        t = t + np.einsum("nb,nbi->ni", step[:, 3:], basis)
        t = t / np.linalg.norm(t, axis=1, keepdims=True)
    return R, face_forward(R, t, r, q, weight)
