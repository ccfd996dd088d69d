"""Rigid motions: of the camera and of independently moving components."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from soup_nlp.arrays import Float
from soup_nlp.errors import DataError, printable, repr_of
from soup_nlp.geometry import rotation


@dataclass(frozen=True, eq=False)
class RigidMotion:
    """The motion `X' = R X + t` of points from one frame of reference to another.

    Attributes:
        R: (3, 3) rotation.
        t: (3,) translation, in the length unit of the points.
    """

    R: Float
    t: Float

    def __str__(self) -> str:
        x, y, z = self.t
        return f"RigidMotion(turn {self.angle:.3g} deg, t ({x:.3g}, {y:.3g}, {z:.3g}))"

    __repr__ = __str__

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
        return float(np.degrees(np.linalg.norm(rotation.log(self.R))))

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
    R = rotation.nearest((share[:, None] * (after - b)).T @ (before - a))
    return RigidMotion(R, b - R @ a)
