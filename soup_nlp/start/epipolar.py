"""Rigid two-view motion from flow: robust estimation, refinement, and the choice of a motion.

A small turn and a small translation move an image almost alike (the bas-relief ambiguity). Motions
whose residuals differ by less than the systematic error of the flow explain it equally well, and
their depths range from a flat scene to one that recedes to infinity. Among them the one whose log
depths vary as scenes do is the most probable (`most_probable`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
from scipy.optimize import least_squares

from soup_nlp.arrays import Float, Mask
from soup_nlp.data.pair import Pair
from soup_nlp.geometry import rotation
from soup_nlp.geometry.camera import rays

LEAST_MATCHES = 8
"""Least number of correspondences that determine a motion, or tell anything of a depth."""
REFINEMENTS, EVALUATIONS, TRANSLATION_FITS, FITS = 5, 30, 6, 8
"""Largest number of robust fits of a motion, each with the noise estimated by the last, and of
evaluations of a fit; re-weighted fits of a translation, and of anything else."""
LEAST_WIDTH = 0.01
"""Smallest scale of the robust loss, pixels."""
MOTION_SIGMA = np.array([0.02] * 3 + [0.3] * 2)
"""Standard deviations of the change of a motion by `refine_near`: rotation in radians, direction of
the translation."""
RELIEF, MOST_RELIEF = 0.5, 3.0
"""Standard deviation of log depth within a scene, and limit of a log depth relative to the median:
points at infinity or behind the camera."""
MOTION_CHANGE, MOTION_STEP = np.array([0.01] * 3 + [0.1] * 2), 1e-5
"""Usual change of a motion by `most_probable`, and step by which motions are differentiated."""
EPIPOLAR_PX = 0.3
"""Scale of the Cauchy loss of epipolar distances, pixels."""


@dataclass(frozen=True)
class Motion:
    """Rigid motion next_from_ref with a translation of unit length.

    Attributes:
        R: (3, 3) rotation.
        t: (3,) direction of the translation.
    """

    R: Float
    t: Float

    def essential(self) -> Float:
        """(3, 3) E with `q^T E r = 0` for rays r (reference) and q (next)."""
        return rotation.hat(self.t) @ self.R


SIDEWAYS = Motion(np.eye(3), np.array([1.0, 0.0, 0.0]))
"""The motion where nothing determines one: it keeps depth defined."""


def stacked(motions: Sequence[Motion]) -> tuple[Float, Float]:
    """Rotations (M, 3, 3) and translations (M, 3) of motions."""
    return np.stack([m.R for m in motions]), np.stack([m.t for m in motions])


class Matches(NamedTuple):
    """Correspondences of two frames.

    Attributes:
        ray: (M, 3) reference rays, third component 1.
        target: (M, 3) rays of the next frame.
        weight: (M,) confidence.
        focal: Pixels per ray unit, so that errors are in pixels.
    """

    ray: Float
    target: Float
    weight: Float
    focal: float

    def confident(self, most: int) -> Matches:
        """Those with weight; evenly about `most` of them if there are more."""
        use = np.flatnonzero(self.weight > 0)
        use = use[:: max(1, len(use) // most)]
        return Matches(self.ray[use], self.target[use], self.weight[use], self.focal)

    def distance(self, motion: Motion) -> Float:
        """(M,) Sampson distance to a motion, pixels."""
        E, r, q = motion.essential(), self.ray.T, self.target.T
        by_q, by_r = E @ r, E.T @ q
        squared = np.sum(by_q[:2] ** 2 + by_r[:2] ** 2, axis=0)
        return self.focal * np.sum(q * by_q, axis=0) / np.sqrt(np.maximum(squared, 1e-24))

    def slope(self, motion: Motion) -> Float:
        """(9, M) derivative of `distance` by the essential matrix, row by row."""
        r, q = (np.ascontiguousarray(v.T) for v in (self.ray, self.target))
        E = motion.essential()
        by_q, by_r = E @ r, E.T @ q
        squared = np.maximum(np.sum(by_q[:2] ** 2 + by_r[:2] ** 2, axis=0), 1e-24)
        share = np.sum(q * by_q, axis=0) / squared
        by_q[2] = by_r[2] = 0.0
        # the numerator is q^T E r, and the root of `squared` is the denominator
        by_E = (q - share * by_q)[:, None] * r - (share * q)[:, None] * by_r
        return self.focal / np.sqrt(squared) * by_E.reshape(9, -1)


PIXELS = 6000
"""Largest number of pixels to which the motion of a whole image is fitted."""


def flow_matches(pair: Pair, which: Mask, seed: int) -> Matches:
    """Correspondences by the flow of at most `PIXELS` of the pixels `which` (H, W)."""
    assert pair.flow is not None
    v, u = np.nonzero(which)
    pick = np.random.default_rng(seed).permutation(len(v))[:PIXELS]
    pixel = np.stack([u, v], axis=-1)[pick].astype(float)
    move = pair.flow.uv[v, u][pick].astype(float)
    ends = rays(pair.K_ref, pixel), rays(pair.K_next, pixel + move)
    weight = pair.flow.confidence[v, u][pick].astype(float)
    return Matches(*ends, weight, float(pair.K_next[0, 0]))


def estimate(matches: Matches, threshold: float = 1.0) -> Motion | None:
    """Motion with the most inliers, up to a distance in pixels; None if nothing determines one."""
    motion = essential_motion(matches, threshold)
    return None if motion is None else refine(motion, matches, threshold)


def essential_motion(matches: Matches, threshold: float | None) -> Motion | None:
    """Motion by RANSAC on the essential matrix and cheirality, or None; see `estimate`.

    Without a threshold it is the motion with the least median error. OpenCV draws the same samples
    every time.
    """
    r, q, _, focal = matches
    if len(r) < LEAST_MATCHES:
        return None
    try:
        E, _ = cv2.findEssentialMat(
            *(np.ascontiguousarray(v[:, :2]) for v in (r, q)),
            np.eye(3),
            method=cv2.LMEDS if threshold is None else cv2.RANSAC,
            prob=0.999,
            threshold=(threshold or 1.0) / focal,
        )
    except cv2.error:
        return None
    if E is None or E.shape != (3, 3) or not np.isfinite(E).all():
        return None
    R1, R2, t = cv2.decomposeEssentialMat(E)

    def in_front(motion: Motion) -> int:
        z, z_next = triangulate(motion, r, q)
        return int(np.sum((z > 0) & (z_next > 0)))

    # of the four decompositions the one with the most points in front of both cameras
    motions = [Motion(R, s * t.ravel()) for R in (R1, R2) for s in (1.0, -1.0)]
    return max(motions, key=in_front)


def triangulate(motion: Motion, r: Float, q: Float) -> tuple[Float, Float]:
    """Depths (M,) in both frames of rays r, q under a motion, unit baseline.

    Minimises the algebraic error of `z R r + t ~ q` in the next image.
    """
    y = r @ motion.R.T
    # residual of (z y + t)_xy - q (z y + t)_z, linear in z
    a = y[:, :2] - q[:, :2] * y[:, 2:]
    b = motion.t[:2] - q[:, :2] * motion.t[2]
    z = -np.sum(a * b, axis=1) / np.maximum(np.sum(a * a, axis=1), 1e-18)
    return z, z * y[:, 2] + motion.t[2]


def refine(motion: Motion, matches: Matches, threshold: float = 1.0) -> Motion:
    """Motion that minimises the robust (Cauchy), weighted Sampson distance.

    The scale of the loss falls from the inlier distance to the noise, so that components that move
    otherwise drop out.
    """
    root, moved = np.sqrt(matches.weight), around(motion)
    x, scale = np.zeros(5), max(0.1, 0.5 * threshold)

    def residual(x: Float) -> Float:
        return root * matches.distance(moved(x))

    def jacobian(x: Float) -> Float:
        return (root * (essential_slope(motion, x) @ matches.slope(moved(x)))).T

    for _ in range(REFINEMENTS):
        fit = least_squares(
            residual, x, jacobian, loss="cauchy", f_scale=scale, max_nfev=EVALUATIONS
        )
        x = fit.x
        error = np.abs(residual(x))
        near = error[error < 3 * scale]
        noise = 1.5 * float(np.median(near)) if len(near) else scale
        if noise > 0.8 * scale:
            break
        scale = max(noise, LEAST_WIDTH)
    return moved(x)


def refine_near(motion: Motion, matches: Matches, noise: float, rounds: int = FITS) -> Motion:
    """Motion near a given one that lowers the robust Sampson distance; `noise` is in pixels.

    Re-weighted Gauss-Newton steps. A prior (`MOTION_SIGMA`) holds the directions that a small patch
    does not determine.
    """
    # one row per coordinate, the pixels contiguous
    r, q = (np.ascontiguousarray(v.T) for v in (matches.ray, matches.target))
    R, t, turn, stiff = motion.R, motion.t, np.zeros(3), MOTION_SIGMA**-2.0
    for _ in range(rounds):
        y, basis = R @ r, tangent(t)
        cross = np.cross(y, q, axis=0)
        E = rotation.hat(t) @ R
        sides = np.concatenate([E[:2] @ r, E.T[:2] @ q])
        scale = matches.focal / np.maximum(np.linalg.norm(sides, axis=0), 1e-9)
        by_turn = (t @ y) * q - np.sum(y * q, axis=0) * t[:, None]
        J = scale * np.concatenate([by_turn, basis @ cross])
        e = scale * (t @ cross)
        w = matches.weight / (1 + (e / noise) ** 2) / noise**2
        A = (w * J) @ J.T + np.diag(stiff)
        g = J @ (w * e) + stiff * np.append(turn, basis @ (t - motion.t))
        try:
            step = -np.linalg.solve(A, g)
        except np.linalg.LinAlgError:
            # the prior is below the rounding of A (focal lengths of 1e9)
            step = -np.linalg.pinv(A, hermitian=True) @ g
        step *= min(1.0, 0.1 / max(np.abs(step).max(), 1e-12))
        turn = turn + step[:3]
        R, t = rotation.exp(turn) @ motion.R, t + step[3:] @ basis
        t = t / np.linalg.norm(t)
    return _facing(Motion(R, t), matches)


def tangent(t: Float) -> Float:
    """(2, 3) unit vectors perpendicular to a translation (3,) and to each other."""
    return np.asarray(np.linalg.svd(t[None])[2][1:])


def around(motion: Motion) -> Callable[[Float], Motion]:
    """Motions near a given one by (5,) parameters: rotation vector, and shifts along `tangent`."""
    basis = tangent(motion.t)

    def moved(x: Float) -> Motion:
        t = motion.t + x[3:] @ basis
        return Motion(motion.R @ rotation.exp(x[:3]), t / np.linalg.norm(t))

    return moved


def essential_slope(motion: Motion, x: Float) -> Float:
    """(5, 9) derivative of the essential matrix of `around(motion)(x)`, row by row, by x."""
    basis, moved = tangent(motion.t), around(motion)(x)
    by_turn = moved.essential() @ rotation.hat(rotation.right_jacobian(x[:3]).T)
    # the translation is scaled to unit length
    along = basis - np.outer(basis @ moved.t, moved.t)
    by_shift = rotation.hat(along / np.linalg.norm(motion.t + x[3:] @ basis)) @ moved.R
    return np.concatenate([by_turn, by_shift]).reshape(5, 9)


def fit_translation(R: Float, matches: Matches, noise: float) -> Motion:
    """Motion with a given rotation (3, 3) whose translation explains correspondences best.

    The epipolar constraint `t . (R r x q) = 0` is linear in t, which is the eigenvector of the
    re-weighted scatter matrix with the smallest eigenvalue. Errors beyond the noise, pixels, are
    down-weighted.
    """
    r, q, weight, focal = matches
    normal, w, t = np.cross(r @ R.T, q), weight, np.zeros(3)
    for _ in range(TRANSLATION_FITS):
        t = np.linalg.eigh((normal * w[:, None]).T @ normal)[1][:, 0]
        spread = np.maximum(np.linalg.norm(np.cross(t, q)[:, :2], axis=1), 1e-6)
        # Sampson's weight: error in pixels, not the algebraic one
        w = weight / (1 + (focal * (normal @ t) / spread / noise) ** 2) / spread**2
    return _facing(Motion(R, t), matches)


def _facing(motion: Motion, matches: Matches) -> Motion:
    """The motion with the sign of its translation that puts most points in front of the camera."""
    vote = matches.weight @ np.sign(triangulate(motion, matches.ray, matches.target)[0])
    return motion if vote >= 0 else Motion(motion.R, -motion.t)


def most_probable(
    motions: Sequence[Motion],
    matches: Matches,
    error: float,
    expected: Float | float = 0.0,
    spread: float = RELIEF,
) -> tuple[Motion, Float]:
    """The motion that minimises the mean squared epipolar distance and the relief, and the (5, 5)
    covariance of the parameters of `around` it.

    `mean rho(e, EPIPOLAR_PX) / error^2 + mean rho(log(z / median z), spread) / spread^2`, with e
    the Sampson distance and rho(x, c) = c^2 log(1 + x^2 / c^2) the Cauchy loss. It begins at each
    of the motions; `error` is the systematic one of the flow, pixels. Relief, whose standard
    deviation is `spread`, is counted from the `expected` log depth (M,) of a depth prior.
    """
    root = np.sqrt(matches.weight / matches.weight.sum())

    def residual(motion: Motion) -> Float:
        distance = cauchy(matches.distance(motion), EPIPOLAR_PX)
        depth = cauchy(relief(motion, matches.ray, matches.target, expected), spread)
        return np.concatenate([root * distance / error, root * depth / spread])

    def fitted(motion: Motion, evaluations: int) -> tuple[float, Motion, Float]:
        moved = around(motion)
        end = least_squares(
            lambda x: residual(moved(x)), np.zeros(5), x_scale=MOTION_CHANGE, max_nfev=evaluations
        )
        return float(end.cost), moved(end.x), end.jac

    _, best, _ = min((fitted(m, EVALUATIONS) for m in motions), key=lambda fit: fit[0])
    # derivatives at the result, in its own coordinates
    slope = fitted(best, 1)[2]
    return best, np.asarray(np.linalg.pinv(slope.T @ slope))


def relief_spread(motion: Motion, covariance: Float, ray: Float, target: Float) -> Float:
    """(M,) standard deviation of log depth by the error of a motion, a common scale left out.

    The error has the `covariance` (5, 5) of the parameters of `around`. Rays (M, 3) move to the
    points `target` (M, 3) of the next frame.
    """
    moved, steps = around(motion), MOTION_STEP * np.eye(5)
    target = target / target[:, 2:]
    ends = [[relief(moved(x), ray, target) for x in (step, -step)] for step in steps]
    slope = np.array([more - less for more, less in ends]) / (2 * MOTION_STEP)
    slope -= np.median(slope, axis=1, keepdims=True)
    return np.sqrt(np.einsum("kn,kl,ln->n", slope, covariance, slope))


def cauchy(x: Float, scale: float) -> Float:
    """x (M,) whose squares are its Cauchy losses."""
    return scale * np.sqrt(np.log1p((x / scale) ** 2))


def relief(motion: Motion, r: Float, q: Float, expected: Float | float = 0.0) -> Float:
    """(M,) log depth of correspondences under a motion, relative to the expected log depth.

    The median is 0, and values are limited to `MOST_RELIEF`.
    """
    z, _ = triangulate(motion, r, q)
    inverse = np.exp(expected) / np.where(np.abs(z) < 1e-12, 1e-12, z)
    middle = np.median(inverse)
    if middle <= 0:
        return np.full(len(r), MOST_RELIEF)
    return -np.log(np.clip(inverse / middle, np.exp(-MOST_RELIEF), np.exp(MOST_RELIEF)))
