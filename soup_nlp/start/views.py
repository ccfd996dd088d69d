"""What planes are fitted to: sampled rays and flow targets of every superpixel."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.geometry.plane_fit import PlaneFit, fit_planes
from soup_nlp.start.epipolar import Motion


@dataclass(frozen=True)
class Views:
    """Sampled rays, flow targets and extent of every superpixel.

    Attributes:
        ray: (N, S, 3) rays of sampled pixels.
        target: (N, S, 3) rays of their flow targets (next camera).
        weight: (N, S) confidence.
        anchor: (N, 3) anchor rays.
        radius: (N,) reach in ray units.
        focal: (fx, fy) of the next camera, pixels.
    """

    ray: Float
    target: Float
    weight: Float
    anchor: Float
    radius: Float
    focal: tuple[float, float]

    def fit(self, motions: list[Motion]) -> PlaneFit:
        """Planes of every superpixel under each of M motions."""
        shape = (len(self.ray), len(motions))
        R = np.broadcast_to(np.stack([m.R for m in motions]), (*shape, 3, 3))
        t = np.broadcast_to(np.stack([m.t for m in motions]), (*shape, 3))
        return self.fit_own(R, t)

    def fit_own(self, R: Float, t: Float) -> PlaneFit:
        """Planes under own motions R (N, C, 3, 3), t (N, C, 3)."""
        return fit_planes(
            R, t, self.ray, self.target, self.weight, self.anchor, self.radius, self.focal
        )

    def distance(self, moved: Float) -> Float:
        """(N,) mean distance of points (N, S, 3) of the next camera from the targets, pixels."""
        off = (moved[..., :2] / moved[..., 2:] - self.target[..., :2]) * np.asarray(self.focal)
        return self.mean(np.linalg.norm(off, axis=2))

    def mean(self, value: Float) -> Float:
        """(N,) mean of the samples' values (N, S), weighted by confidence; 0 without any."""
        total = np.maximum(self.weight.sum(axis=1), 1e-9)
        return np.asarray(np.sum(self.weight * value, axis=1) / total)

    def without(self, mask: Mask) -> Views:
        """The same with confidence 0 in the superpixels of a mask (N,)."""
        return replace(self, weight=np.where(mask[:, None], 0.0, self.weight))

    def some(self, at: Int) -> Views:
        """The entries of superpixels `at`."""
        ray, target, weight = self.ray[at], self.target[at], self.weight[at]
        return Views(ray, target, weight, self.anchor[at], self.radius[at], self.focal)
