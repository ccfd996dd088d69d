"""Proposals around a soup: random walks, states of neighbours, re-fits, shared motions.

A particle is written about the anchor of its superpixel: depth Z there, slope g of the relative
inverse depth (`1 / Z(r) = (1 + g . (r - r_a)) / Z`, a chart of the sphere of normals), rotation
R and translation T. Whatever is added to (log Z, g, rotation vector, T), the result is a plane
with a unit normal and a positive distance, and a motion in SE(3). Spreads are in pixels of
re-projection, so that one number fits every scene and every superpixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from soup_nlp.arrays import Float, Int
from soup_nlp.geometry import rotation
from soup_nlp.geometry.plane import inverse_depth
from soup_nlp.geometry.plane_fit import PlaneFit, fit_planes
from soup_nlp.geometry.soup import Soup
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.refine.anchored import Local, Particles, fit_motion
from soup_nlp.refine.population import COMMON, KINDS, WALKS, Spread


@dataclass(frozen=True)
class Proposals:
    """New particles of a round.

    Attributes:
        particles: (N, C).
        kind: (C,) number into KINDS.
        step: (N, C) drawn step in pixels; nan where a kind has none.
    """

    particles: Particles
    kind: Int
    step: Float


class Proposer:
    """Makes proposals for one pair.

    Args:
        data: Rays, targets and graphs.
        near: (N, K) neighbours of every superpixel, nearest first.
        seed: Of every draw.
    """

    def __init__(self, data: EnergyData, near: Int, seed: int) -> None:
        self.data, self.near = data, near
        self.rng = np.random.default_rng(seed)
        self.focal = float(data.K_next[0, 0])
        self.spread = Spread()
        K = data.K_next
        y = (data.pixel_target[..., 1] - K[1, 2]) / K[1, 1]
        x = (data.pixel_target[..., 0] - K[0, 2] - K[0, 1] * y) / K[0, 0]
        self.target = np.stack([x, y, np.ones_like(x)], axis=-1)

    def propose(self, soup: Soup, counts: dict[str, int]) -> Proposals:
        """A given number of particles of every kind around a soup.

        Args:
            soup: Current belief.
            counts: Number by kind, for kinds of KINDS but current and kept.
        """
        now = Local.of(soup, self.data.anchor_ray)
        parts, kinds, steps = [], [], []
        for kind, count in counts.items():
            if count < 1:
                continue
            step: Float | None = None
            if kind in WALKS:
                made, step = self._walk(now, kind, count)
            elif kind in COMMON:
                made, step = self._common_motion(soup, now, count)
            else:
                made = self._borrowed(soup, now, kind, count)
            parts.append(made.particles(self.data.anchor_ray))
            number = made.Z.shape[1]
            kinds.append(np.full(number, KINDS.index(kind)))
            steps.append(np.full((len(soup), number), np.nan) if step is None else step)
        return Proposals(parts[0].joined(*parts[1:]), np.concatenate(kinds), np.hstack(steps))

    # --- walks: what one pixel of re-projection error means for each coordinate ---------------

    def _units(self, now: Local) -> tuple[Float, Float, Float]:
        """Changes of log Z (motion fixed), g x radius and T that move the image by one pixel.

        The parallax of a superpixel is the image motion by its translation, at least half a pixel,
        because without parallax only the other terms limit its depth.
        """
        Y = np.einsum("ncij,nj->nci", now.R, self.data.anchor_ray) * now.Z[..., None] + now.T
        z = np.maximum(Y[..., 2], 1e-9)
        side = now.T[..., :2] - Y[..., :2] / z[..., None] * now.T[..., 2:]
        parallax = self.focal * np.linalg.norm(side, axis=-1) / z
        per = 1.0 / np.maximum(parallax, 0.5)
        return per, per, z / self.focal

    def _walk(self, now: Local, kind: str, count: int) -> tuple[Local, Float]:
        n, rng = len(now.Z), self.rng
        step = self.spread.draw(kind, (n, count), rng)
        depth, slope, shift = self._units(now)
        w, dT = np.zeros((2, n, count, 3))
        dz, dg = np.zeros((n, count)), np.zeros((n, count, 2))
        base = now.repeated(count)
        plane = kind in ("walk_plane", "walk_all")
        if plane:
            dz = depth * step * rng.standard_normal((n, count))
        if plane or kind == "walk_scale":
            dg = (slope * step)[..., None] * rng.standard_normal((n, count, 2))
            dg /= self.data.radius[:, None, None]
        if kind in ("walk_motion", "walk_all"):
            w = step[..., None] / self.focal * rng.standard_normal((n, count, 3))
            dT = (shift * step)[..., None] * rng.standard_normal((n, count, 3))
        if kind == "walk_pivot":
            # about the anchor's next-frame point, which a turn of this size keeps in place
            w = step[..., None] / self.focal * rng.standard_normal((n, count, 3))
        R = rotation.exp(w) @ base.R
        T = base.T + dT
        if kind == "walk_pivot":
            X = base.Z[..., None] * self.data.anchor_ray[:, None]
            T = T + np.einsum("ncij,ncj->nci", base.R - R, X)
        scale = np.ones((n, count))
        if kind == "walk_scale":
            # plane and translation together: the re-projection stays as it is
            scale = np.exp(0.02 * step * rng.standard_normal((n, count)))
        # a step changes depth by a factor of 4 at most
        Z = base.Z * np.exp(np.clip(dz, -1.4, 1.4)) * scale
        g = base.g + dg
        return Local(Z, g, R, T * scale[..., None]), step

    # --- motions that are proposed to all superpixels, so that a component can move as one ------
    # (no common scale: E hardly depends on the scale of a component, and is lower at wrong depths)

    def _common_motion(self, soup: Soup, now: Local, count: int) -> tuple[Local, Float]:
        """Motions that many superpixels share, fitted again to the flow of their present planes.

        A superpixel alone pays for a motion that differs from the one it shares with others;
        together they do not. Every third candidate is the fit itself, the others are steps around
        it.
        """
        step = self.spread.draw("common_motion", (count,), self.rng)
        step[::3] = 0.0
        R, T = self._shared(soup, now, (count + 2) // 3)
        R, T = (np.repeat(v, 3, axis=0)[:count] for v in (R, T))
        count = len(R)
        w = step[:count, None] / self.focal * self.rng.standard_normal((count, 3))
        shift = np.median(now.Z) * step[:count] / self.focal
        R = rotation.exp(w) @ R
        T = T + shift[:, None] * self.rng.standard_normal((count, 3))
        R, T = (np.broadcast_to(v, (len(soup), *v.shape)) for v in (R, T))
        base = now.repeated(count)
        step = np.where(step > 0, step, np.nan)[:count]
        return Local(base.Z, base.g, R, T), np.broadcast_to(step, base.Z.shape)

    def _shared(self, soup: Soup, now: Local, count: int) -> tuple[Float, Float]:
        """At most `count` motions (C, 3, 3), (C, 3), each fitted to its superpixels."""
        R, T, error = self._explaining(soup, now, count)
        member = error.argmin(axis=1)
        X = soup.points(self.data.pixel_ray)
        out_R, out_T = [], []
        for c in range(len(R)):
            inliers = np.flatnonzero((member == c) & (error[:, c] < 1.0))
            points, target = X[inliers].reshape(-1, 3), self.target[inliers].reshape(-1, 3)
            weight = self.data.pixel_weight[inliers].ravel()
            if (weight > 0).sum() >= 8:
                pick = self.rng.permutation(np.flatnonzero(weight > 0))[:3000]
                a, b = fit_motion(R[c], T[c], points[pick], target[pick], weight[pick], self.focal)
            else:
                a, b = R[c], T[c]
            out_R.append(a)
            out_T.append(b)
        return np.stack(out_R), np.stack(out_T)

    # --- what neighbours and the flow suggest ---------------------------------------------------

    def _some(self, count: int) -> Int:
        """(N, count) different neighbours, the nearer ones preferred."""
        n, k = self.near.shape
        rank = np.arange(k) + 1.0
        key = self.rng.exponential(size=(n, k)) * rank
        order = np.argsort(key, axis=1)[:, : min(count, k)]
        return np.take_along_axis(self.near, order, axis=1)

    def _extrapolated(self, soup: Soup, who: Int, local: Local) -> tuple[Float, Float]:
        """Depth and slope, at each anchor, of the planes of other superpixels (N, C)."""
        m = inverse_depth(soup.n, soup.distance)[who]
        inverse = np.einsum("ncj,nj->nc", m, self.data.anchor_ray)
        # a plane that does not meet the anchor's ray in front: its depth is borrowed instead
        bad = inverse * local.Z < 0.1
        Z = np.where(bad, local.Z[who, 0], 1.0 / np.where(bad, 1.0, inverse))
        g = np.where(bad[..., None], 0.0, m[..., :2] * Z[..., None])
        return Z, g

    def _borrowed(self, soup: Soup, now: Local, kind: str, count: int) -> Local:
        """States that take plane, motion or both from neighbours, or fit the plane again.

        "own_refit" fits the plane to the flow under the own motion, "neighbour_refit" under the
        motions of neighbours; "neighbour_motion" and "dominant" fit its depth alone, under motions
        of neighbours and under those that explain most superpixels with their present planes.
        """
        if kind == "mean":
            return self._mean(soup, now, count)
        if kind == "own_refit":
            return self._with_motion(now, now.R, now.T, slopes=True)
        if kind == "dominant":
            R, T, _ = self._explaining(soup, now, count)
            R, T = (np.broadcast_to(v, (len(soup), *v.shape)) for v in (R, T))
            return self._with_motion(now, R, T, slopes=False)
        who = self._some(count)
        R, T = soup.R[who], soup.translation[who]
        if kind in ("neighbour_motion", "neighbour_refit"):
            return self._with_motion(now, R, T, slopes=kind == "neighbour_refit")
        Z, g = self._extrapolated(soup, who, now)
        if kind == "neighbour_plane":
            # every other one keeps its motion, the rest take the scale along with the depth
            scale = np.where(np.arange(who.shape[1]) % 2, 1.0, Z / now.Z)
            current = now.repeated(who.shape[1])
            R, T = current.R, current.T * scale[..., None]
        return Local(Z, g, R, T)

    def commonest(self, soup: Soup, count: int) -> tuple[Float, Float]:
        """(C, 3, 3), (C, 3) the present motions that explain most superpixels, C <= count."""
        R, T, _ = self._explaining(soup, Local.of(soup, self.data.anchor_ray), count)
        return R, T

    def _explaining(self, soup: Soup, now: Local, count: int) -> tuple[Float, Float, Float]:
        """At most `count` present motions under which most anchors move as under their own.

        Returns:
            (C, 3, 3), (C, 3), and (N, C) by how many pixels each misses.
        """
        n = len(soup)
        pick = self.rng.choice(n, min(64, n), replace=False)
        R, T = soup.R[pick], soup.translation[pick]
        X = now.Z[:, 0, None] * self.data.anchor_ray
        Y = np.einsum("mij,nj->nmi", R, X) + T
        moved = np.einsum("nij,nj->ni", soup.R, X) + soup.translation
        z = np.maximum(np.stack([Y[..., 2], np.broadcast_to(moved[:, None, 2], Y.shape[:2])]), 1e-9)
        gap = Y[..., :2] / z[0][..., None] - (moved[:, None] / z[1][..., None])[..., :2]
        error = np.minimum(self.focal * np.linalg.norm(gap, axis=-1), 3.0)
        best = np.full(n, 3.0)
        kept: list[int] = []
        for _ in range(min(count, len(pick))):
            c = int(np.minimum(best[:, None], error).sum(axis=0).argmin())
            kept.append(c)
            best = np.minimum(best, error[:, c])
        return R[kept], T[kept], error[:, kept]

    def _mean(self, soup: Soup, now: Local, count: int) -> Local:
        """Means of a superpixel's state and a few neighbours', which smoothness favours."""
        parts = []
        for c in range(count):
            who = self._some(3 + 2 * (c % 3))
            Z, g = self._extrapolated(soup, who, now)
            inverse = np.concatenate([1 / Z, 1 / now.Z], axis=1).mean(axis=1, keepdims=True)
            slope = np.concatenate([g, now.g], axis=1).mean(axis=1, keepdims=True)
            R = np.concatenate([soup.R[who], now.R], axis=1).mean(axis=1, keepdims=True)
            T = np.concatenate([soup.translation[who], now.T], axis=1).mean(axis=1, keepdims=True)
            R = rotation.nearest(R)
            if c % 2:
                # the plane alone, the motion scaled with it
                R, T = now.R, now.T / (inverse * now.Z)[..., None]
            parts.append(Local(1 / inverse, slope, R, T))
        return Local(*(np.concatenate([getattr(p, k) for p in parts], axis=1) for k in "ZgRT"))

    def _with_motion(self, now: Local, R: Float, T: Float, slopes: bool) -> Local:
        """The present planes with the depth (and slope) that fit the flow under given motions.

        Where the flow does not determine a depth under a motion, the own plane stays.
        """
        count = R.shape[1]
        length = np.linalg.norm(T, axis=-1)
        unit = T / np.maximum(length, 1e-12)[..., None]
        d = self.data
        focal = (float(d.K_next[0, 0]), float(d.K_next[1, 1]))
        fit: PlaneFit = fit_planes(
            R,
            unit,
            d.pixel_ray,
            self.target,
            # fits weigh their prior against confidences
            d.pixel_weight * d.pixel_weight.shape[1],
            d.anchor_ray,
            d.radius,
            focal,
            rounds=3,
        )
        mu = fit.inverse_depth
        # depth is known to about a pixel of parallax; half a pixel is required
        known = (mu > 1e-9) & (fit.parallax * mu > 0.5) & (length > 1e-12)
        current = now.repeated(count)
        Z = np.where(known, length / np.where(known, mu, 1.0), current.Z)
        # depths beyond 20 times the present one, or below a twentieth, are not proposed
        sane = known & (Z < 20 * current.Z) & (Z > current.Z / 20)
        Z = np.where(sane, Z, current.Z)
        g = current.g
        if slopes:
            g = np.where(sane[..., None], fit.slope / d.radius[:, None, None], g)
        return Local(Z, g, R, T)
