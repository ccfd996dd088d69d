"""Rotations: exponential and logarithm, Cayley map, nearest rotation."""

import numpy as np
from numpy.typing import ArrayLike

from soup_nlp.arrays import Float


def hat(w: ArrayLike) -> Float:
    """Skew matrices (..., 3, 3) with `hat(w) x = w x x` (cross product)."""
    w = np.asarray(w, float)
    out = np.zeros((*w.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -w[..., 2], w[..., 1], -w[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = w[..., 2], -w[..., 1], w[..., 0]
    return out


def exp(w: ArrayLike) -> Float:
    """Rotations (..., 3, 3) of rotation vectors (..., 3), radians (Rodrigues)."""
    w = np.asarray(w, float)
    angle2 = np.sum(w * w, axis=-1)[..., None, None]
    angle = np.sqrt(angle2)
    W = hat(w)
    # np.sinc(x) = sin(pi x) / (pi x) is exact at 0
    a = np.sinc(angle / np.pi)
    b = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    return np.eye(3) + a * W + b * (W @ W)


def right_jacobian(w: ArrayLike) -> Float:
    """J (3, 3) with `exp(w + d) = exp(w) exp(J d)` to first order in d, for w (3,)."""
    w = np.asarray(w, float)
    angle2, W = w @ w, hat(w)
    angle = np.sqrt(angle2)
    a = 0.5 * np.sinc(angle / (2 * np.pi)) ** 2
    b = (1 - np.sinc(angle / np.pi)) / max(angle2, 1e-30)
    return np.eye(3) - a * W + b * (W @ W)


def log(R: ArrayLike) -> Float:
    """Rotation vectors (..., 3) of rotations (..., 3, 3); angles in [0, pi]."""
    from scipy.spatial.transform import Rotation

    R = np.asarray(R, float)
    return Rotation.from_matrix(R.reshape(-1, 3, 3)).as_rotvec().reshape(R.shape[:-1])


def cayley(w: ArrayLike) -> Float:
    """Cayley map (..., 3, 3) of (..., 3): equals `exp(w)` to third order, rational in w."""
    w = np.asarray(w, float)
    h = 0.5 * w
    n2 = np.sum(h * h, axis=-1)[..., None, None]
    W = hat(h)
    return np.eye(3) + (2.0 / (1.0 + n2)) * (W + W @ W)


def nearest(M: ArrayLike) -> Float:
    """Rotation (..., 3, 3) nearest to M in the Frobenius norm (orthogonal Procrustes)."""
    U, _, Vt = np.linalg.svd(np.asarray(M, float))
    sign = np.sign(np.linalg.det(U @ Vt))
    U = U.copy()
    U[..., :, 2] *= sign[..., None]
    return U @ Vt
