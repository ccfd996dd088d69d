"""Rotations, and the rigid motions of the camera and of independently moving components."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from soup_nlp.arrays import Float
from soup_nlp.errors import DataError, printable, repr_of


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
    h = 0.5 * np.asarray(w, float)
    n2 = np.sum(h * h, axis=-1)[..., None, None]
    W = hat(h)
    return np.eye(3) + (2.0 / (1.0 + n2)) * (W + W @ W)


def nearest(M: ArrayLike) -> Float:
    """Rotation (..., 3, 3) nearest to M in the Frobenius norm (orthogonal Procrustes)."""
    U, _, Vt = np.linalg.svd(np.asarray(M, float))
    sign = np.sign(np.linalg.det(U @ Vt))
    U[..., :, 2] *= sign[..., None]
    return U @ Vt


# --- rigid motions --------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class RigidMotion:
    """The motion `X' = R X + t` of points from one frame of reference to another.

    Attributes:
        R: (3, 3) rotation.
        t: (3,) translation, in the length unit of the points.
    """

    R: Float
    t: Float

    def __repr__(self) -> str:
        x, y, z = self.t
        return f"RigidMotion(turn {self.angle:.3g} deg, t ({x:.3g}, {y:.3g}, {z:.3g}))"

    def __call__(self, points: Float) -> Float:
        """The points (..., 3), moved; DataError for what is no array of points."""
        try:
            x = np.asarray(points, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            x = np.empty(0)
        if x.shape[-1:] != (3,):
            raise DataError(
                "points are no array of points",
                found=f"{type(points).__name__} {printable(repr_of(points), 60)}",
                expected="numbers (..., 3)",
            )
        return np.asarray(x @ self.R.T + self.t)

    def __matmul__(self, first: RigidMotion) -> RigidMotion:
        """The composition: the other motion first, then this one."""
        return RigidMotion(self.R @ first.R, self.R @ first.t + self.t)

    @property
    def matrix(self) -> Float:
        """The (4, 4) matrix of homogeneous coordinates."""
        out = np.eye(4)
        out[:3, :3], out[:3, 3] = self.R, self.t
        return out

    @property
    def inverse(self) -> RigidMotion:
        """The inverse motion."""
        return RigidMotion(self.R.T, -self.R.T @ self.t)

    @property
    def centre(self) -> Float:
        """(3,) the point that this motion maps to the origin: for next_from_ref, the centre of the
        next camera in the reference frame."""
        return np.asarray(-self.R.T @ self.t)

    @property
    def angle(self) -> float:
        """Angle of the rotation, degrees."""
        return float(np.degrees(np.linalg.norm(log(self.R))))

    @property
    def quaternion(self) -> Float:
        """(4,) rotation as x, y, z, w with w >= 0."""
        from scipy.spatial.transform import Rotation

        return np.asarray(Rotation.from_matrix(self.R).as_quat(canonical=True))


def fit_motion(before: Float, after: Float, weight: Float) -> RigidMotion:
    """The rigid motion of least squares between points (M, 3) and the same, moved (Procrustes).

    Weights (M,) are not negative, and not all 0.
    """
    share = weight / weight.sum()
    a, b = share @ before, share @ after
    R = nearest((share[:, None] * (after - b)).T @ (before - a))
    return RigidMotion(R, b - R @ a)
