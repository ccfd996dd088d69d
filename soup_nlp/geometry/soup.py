"""The soup: scale, plane and rigid motion of every superpixel, and derived quantities."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.geometry.camera import pixel_grid, project, rays
from soup_nlp.geometry.rotation import nearest

LEAST_FACING = 1e-6
"""A pixel with `-n . ray` below this has no depth."""


@dataclass(frozen=True, eq=False)
class Soup:
    """State of N superpixels, the input and output of every stage.

    Plane i is `n_i . X + D_i = 0` with `D_i = lam_i d_i` and n facing the camera; motion i is
    `X' = R_i X + lam_i t_i` (next_from_ref). Lengths are free up to one global scale.

    Attributes:
        lam: (N,) scales, positive.
        n: (N, 3) unit normals.
        d: (N,) plane offsets before scaling, positive.
        R: (N, 3, 3) rotations.
        t: (N, 3) translations before scaling.
    """

    lam: Float
    n: Float
    d: Float
    R: Float
    t: Float

    def __len__(self) -> int:
        return len(self.lam)

    def __repr__(self) -> str:
        D, T = self.distance, np.linalg.norm(self.translation, axis=1)
        return (
            f"Soup({len(self)} superpixels, plane distance {D.min():.3g}..{D.max():.3g},"
            f" translation {T.min():.3g}..{T.max():.3g})"
        )

    @property
    def distance(self) -> Float:
        """(N,) distance of the plane from the reference camera, `lam d`."""
        return self.lam * self.d

    @property
    def translation(self) -> Float:
        """(N, 3) scaled translation, `lam t`."""
        return self.lam[:, None] * self.t

    def taking(self, other: Soup, which: Mask) -> Soup:
        """This soup with the superpixels `which` (N,) of another soup."""
        out = Soup(*(values.copy() for values in vars(self).values()))
        for values, replacements in zip(vars(out).values(), vars(other).values()):
            values[which] = replacements[which]
        return out

    def depth_at(self, ray: Float) -> Float:
        """z (N, ...) of rays (N, ..., 3), each on its superpixel's plane, docs/formulation.md 3."""
        facing = -np.einsum("nc,n...c->n...", self.n, ray)
        return self.distance.reshape(-1, *[1] * (ray.ndim - 2)) / facing

    def depth_across(self, superpixels: Int, ray: Float) -> Float:
        """(S, P) z of every ray (P, 3) on the planes of S superpixels each, `superpixels` (P, S);
        `-n . ray` is at least 1e-3."""
        facing = np.maximum(-np.einsum("psc,pc->sp", self.n[superpixels], ray), 1e-3)
        return np.asarray(self.distance[superpixels.T] / facing)

    def points(self, ray: Float) -> Float:
        """Reference-frame points (N, ..., 3) of rays (N, ..., 3)."""
        return self.depth_at(ray)[..., None] * ray

    def moved(self, points: Float) -> Float:
        """Next-frame points of reference points, both (N, ..., 3)."""
        T = self.translation.reshape(-1, *[1] * (points.ndim - 2), 3)
        return np.einsum("nij,n...j->n...i", self.R, points) + T

    def normalised(self, share: Float | None = None) -> Soup:
        """Same geometry with sum(lam) = 1, where lam_i = share_i x plane distance; by default the
        shares (N,) are 1/N, and the mean plane distance becomes 1."""
        n = len(self)
        c = np.full(n, 1.0 / n) if share is None else share
        unit = float(np.sum(c * self.distance))
        D, T = self.distance / unit, self.translation / unit
        lam = c * D
        return Soup(lam, self.n, 1.0 / c, self.R, T / lam[:, None])

    def retracted(self) -> Soup:
        """Nearest soup that satisfies SO(3), unit normals and the simplex to rounding."""
        length = np.linalg.norm(self.n, axis=1)
        n = self.n / length[:, None]
        # the plane does not move: d belongs to a normal of unit length
        return Soup(self.lam / self.lam.sum(), n, self.d / length, nearest(self.R), self.t)

    def parallax(self, ray: Float) -> Float:
        """(N, 2) displacement in the next image, in ray units, of points along rays (N, 3) from
        where the rotation alone moves them."""
        far = np.einsum("nij,nj->ni", self.R, self.points(ray))
        near = far + self.translation
        return near[:, :2] / near[:, 2:] - far[:, :2] / far[:, 2:]


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """Dense 3D of both frames, in the soup's length unit.

    Attributes:
        depth_ref: (H, W) z of the reference frame, NaN where a plane does not face the pixel.
        points_ref: (H, W, 3) reference-frame points.
        points_next: (H, W, 3) the same material points in the next frame.
        flow: (H, W, 2) flow that the soup induces, pixels.
        depth_next: (H', W') z of the next frame (nearest surface wins), NaN where nothing lands.
        soup: State of the reconstruction.
        labels: (H, W) superpixel of every pixel.
        source_next: (H', W') reference pixel that the next frame shows there, in row order; -1
            where nothing lands.
        sigma_ref: (H, W) standard deviation of log z of the reference frame, scale left out
            (`evaluation.confidence`); None where it was not computed.
        detail: (H, W) log z relative to the planes (`refine.detail`); None for the planes alone.
    """

    depth_ref: Float
    points_ref: Float
    points_next: Float
    flow: Float
    depth_next: Float
    soup: Soup
    labels: NDArray[np.int32]
    source_next: Int
    sigma_ref: Float | None = None
    detail: Float | None = None

    @property
    def normals(self) -> Float:
        """(H, W, 3) unit normals of `points_ref`, towards the reference camera."""
        return np.asarray(self.soup.n[self.labels])

    @property
    def sigma_next(self) -> Float | None:
        """(H', W') standard deviation of log z of the next frame; NaN where nothing lands."""
        if self.sigma_ref is None:
            return None
        return np.where(self.source_next >= 0, self.sigma_ref.ravel()[self.source_next], np.nan)

    def __repr__(self) -> str:
        z = self.depth_ref[np.isfinite(self.depth_ref)]
        seen = np.isfinite(self.depth_next).mean()
        return f"Reconstruction(depth {z.min():.3g}..{z.max():.3g}, next frame {seen:.0%} covered)"


def plane_depth(soup: Soup, labels: NDArray[np.int32], K: Float) -> Float:
    """(H, W) z of the planes of superpixels `labels` (H, W); NaN where one faces away."""
    facing = -np.einsum("hwc,hwc->hw", soup.n[labels], rays(K, pixel_grid(*labels.shape)))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(facing > LEAST_FACING, soup.distance[labels] / facing, np.nan)


def reconstruct(
    soup: Soup,
    labels: NDArray[np.int32],
    K_ref: Float,
    K_next: Float,
    size_next: tuple[int, int] | None = None,
    detail: Float | None = None,
) -> Reconstruction:
    """Dense reconstruction of both frames, whose cameras are (3, 3).

    `labels` (H, W) are the superpixels of the pixels, `size_next` is the (height, width) of the
    next frame, by default that of the reference, `detail` that of a `Reconstruction`.
    """
    uv, z = pixel_grid(*labels.shape), plane_depth(soup, labels, K_ref)
    z = z if detail is None else z * np.exp(detail)
    with np.errstate(divide="ignore", invalid="ignore"):
        points = z[..., None] * rays(K_ref, uv)
        moved = np.einsum("hwij,hwj->hwi", soup.R[labels], points) + soup.translation[labels]
        target = project(K_next, moved)
    depth = moved[..., 2]
    source = nearest_on_top(target, depth, size_next or labels.shape)
    depth_next = np.where(source >= 0, depth.ravel()[source], np.nan)
    flow = target - uv
    return Reconstruction(z, points, moved, flow, depth_next, soup, labels, source, detail=detail)


def nearest_on_top(target: Float, z: Float, size: tuple[int, int]) -> Int:
    """(height, width) reference pixel that every pixel of the next frame shows, in row order: that
    of the nearest surface; -1 where nothing lands.

    From target (H, W, 2) and depth there (H, W) of the reference pixels. Cracks of one pixel in a
    stretched surface are closed.
    """
    height, width = size
    ok = np.flatnonzero((np.isfinite(target).all(-1) & (z > 0)).ravel())
    far_first = ok[np.argsort(-z.ravel()[ok], kind="stable")]
    at = target.reshape(-1, 2)[far_first]

    def cells(corners: Float) -> tuple[Int, Int]:
        """Pixels of the next frame on which corners (P, 2) lie, and numbers of these corners."""
        u, v = corners.astype(np.int64).T
        inside = np.flatnonzero((u >= 0) & (v >= 0) & (u < width) & (v < height))
        return (v * width + u)[inside], inside

    out = np.full(height * width, -1)
    # of values with the same index the last one, that of the nearest pixel, is kept
    cell, which = cells(np.floor(at + 0.5))
    out[cell] = far_first[which]
    # footprints of 2 x 2 pixels fill only the cracks of a stretched surface: everywhere, they would
    # make silhouettes larger and slanted surfaces nearer
    crack, low = out < 0, np.floor(at)
    covered = [cells(low + corner) for corner in ([0, 0], [0, 1], [1, 0], [1, 1])]
    cell, which = (
        np.concatenate(x) for x in zip(*((c[crack[c]], w[crack[c]]) for c, w in covered))
    )
    order = np.argsort(which, kind="stable")
    out[cell[order]] = far_first[which[order]]
    return out.reshape(height, width)
