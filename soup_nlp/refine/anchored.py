"""States of superpixels: particles, the same about their anchors, and motions fitted to points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from soup_nlp.arrays import Float, Int
from soup_nlp.geometry import rotation
from soup_nlp.geometry.plane import about_anchor, at_anchor, inverse_depth, normal_and_distance
from soup_nlp.geometry.soup import Soup


@dataclass(frozen=True)
class Particles:
    """L possible states of each of N superpixels: plane `n . X + D = 0`, motion `X' = R X + T`.

    Attributes:
        n: (N, L, 3) unit normals that face the camera.
        D: (N, L) distances of the planes, positive.
        R: (N, L, 3, 3) rotations.
        T: (N, L, 3) translations.
    """

    n: Float
    D: Float
    R: Float
    T: Float

    @property
    def shape(self) -> tuple[int, int]:
        """(N, L)."""
        return self.D.shape[0], self.D.shape[1]

    @classmethod
    def of(cls, soup: Soup) -> Particles:
        """A soup as one particle per superpixel."""
        T = soup.translation[:, None]
        return cls(soup.n[:, None], soup.distance[:, None], soup.R[:, None], T)

    def joined(self, *others: Particles) -> Particles:
        """The particles of several sets, concatenated."""
        every = (self, *others)
        return Particles(
            *(np.concatenate([getattr(p, k) for p in every], axis=1) for k in ("n", "D", "R", "T"))
        )

    def take(self, which: Int) -> Particles:
        """The particles that have the numbers `which` (N, C)."""
        rows = np.arange(len(self.D))[:, None]
        return Particles(*(a[rows, which] for a in (self.n, self.D, self.R, self.T)))

    def of_some(self, who: Int) -> Particles:
        """The particles of some superpixels (M,)."""
        return Particles(self.n[who], self.D[who], self.R[who], self.T[who])

    def soup(self, labels: Int, share: Float) -> Soup:
        """The soup of labels (N,), with sum(lam) = 1 exactly restored (`Soup.normalised`)."""
        own = self.take(labels[:, None])
        one = np.ones(len(labels))
        return Soup(one, own.n[:, 0], own.D[:, 0], own.R[:, 0], own.T[:, 0]).normalised(share)


def anchor_depth(p: Particles, anchor_ray: Float) -> Float:
    """(N, L) depth of every particle's plane at the anchor."""
    return -p.D / np.einsum("nlc,nc->nl", p.n, anchor_ray)


@dataclass(frozen=True)
class Local:
    """C states of each of N superpixels, written about its anchor.

    Attributes:
        Z: (N, C) depth at the anchor.
        g: (N, C, 2) slope of the relative inverse depth, per ray unit.
        R: (N, C, 3, 3) rotations.
        T: (N, C, 3) translations.
    """

    Z: Float
    g: Float
    R: Float
    T: Float

    def particles(self, anchor_ray: Float) -> Particles:
        """These states as particles: planes with unit normals, and motions."""
        n, D = normal_and_distance(about_anchor(self.Z, self.g, anchor_ray[:, None]))
        return Particles(n, D, self.R, self.T)

    @classmethod
    def of(cls, soup: Soup, anchor_ray: Float) -> Local:
        """A soup as one state per superpixel, C = 1."""
        Z, g = at_anchor(inverse_depth(soup.n, soup.distance), anchor_ray)
        return cls(Z[:, None], g[:, None], soup.R[:, None], soup.translation[:, None])

    def repeated(self, count: int) -> Local:
        """The one state of every superpixel, `count` times."""
        return Local(*(np.repeat(v, count, axis=1) for v in (self.Z, self.g, self.R, self.T)))


def neighbours(edges: Int, anchor_ray: Float) -> Int:
    """(N, K) neighbours of every superpixel on a graph, nearest first. K is the smallest degree.

    Args:
        edges: (E, 2) undirected edges.
        anchor_ray: (N, 3).
    """
    n = len(anchor_ray)
    if not len(edges):
        return np.zeros((n, 0), np.int64)
    own = np.concatenate([edges[:, 0], edges[:, 1]])
    other = np.concatenate([edges[:, 1], edges[:, 0]])
    gap = np.linalg.norm(anchor_ray[own] - anchor_ray[other], axis=1)
    order = np.lexsort((gap, own))
    degree = np.bincount(own, minlength=n)
    start = np.concatenate([[0], np.cumsum(degree)[:-1]])
    k = int(degree.min())
    return other[order][start[:, None] + np.arange(k)].astype(np.int64)


def fit_motion(
    R: Float, T: Float, X: Float, target: Float, weight: Float, focal: float, rounds: int = 5
) -> tuple[Float, Float]:
    """Motion near a given one that maps points to their targets, by re-weighted Gauss-Newton.

    Args:
        R: (3, 3) rotation to start from.
        T: (3,) translation to start from.
        X: (M, 3) reference-frame points.
        target: (M, 3) rays of their targets in the next camera.
        weight: (M,) weights of the un-squared distances.
        focal: Pixels per ray unit.
        rounds: Steps.

    Returns:
        Rotation and translation; the given ones where a step fails.
    """
    best, found = np.inf, (R, T)
    for _ in range(rounds + 1):
        Y = X @ R.T + T
        z = np.maximum(Y[:, 2:], 1e-9)
        e = focal * (Y[:, :2] / z - target[:, :2])
        size = np.linalg.norm(e, axis=1)
        cost = float(np.sum(weight * size))
        if not cost < best:
            break
        best, found = cost, (R, T)
        P = np.zeros((len(X), 2, 3))
        P[:, 0, 0] = P[:, 1, 1] = focal / z[:, 0]
        P[:, :, 2] = -focal * Y[:, :2] / z**2
        # Y + w x (R X) + dT
        J = np.concatenate([-P @ rotation.hat(X @ R.T), P], axis=2)
        w = weight / np.sqrt(size**2 + 0.05**2)
        A = np.einsum("m,mci,mcj->ij", w, J, J, optimize=True)
        A += 1e-9 * np.diag(np.diag(A)) + 1e-15 * np.trace(A) * np.eye(6)
        step = -np.linalg.solve(A, np.einsum("m,mci,mc->i", w, J, e, optimize=True))
        R, T = rotation.exp(step[:3]) @ R, T + step[3:]
    return found
