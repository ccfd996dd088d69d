"""E_photo, the difference between the images and superpixels' homographies.

    E_photo = sum_i mean_s min(c_is, tau)

c_is, 0 to 1, is the difference of soft census (`data.census`) between sampled pixel s of
superpixel i and the pixel of the next frame to which the superpixel's homography maps it. A sample
that leaves the next frame, or is hidden there by a nearer surface, costs tau, as much as the worst
contradiction: if it cost less, superpixels whose pixels contradict would recede until they are
hidden. Nearer surfaces are read off a depth map of the next frame which is the same for all soups
that are compared, so that E_photo is one function of a soup.

Where the images contradict the flow, E_proj is weaker and truncated; everywhere else it is that of
E. They contradict the flow of a superpixel if, in the soup that followed this flow, the visible
samples disagree by more than `CONTRADICTION`, or most samples are not visible.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float, FloatMap, Mask
from soup_nlp.data.census import census, census_at
from soup_nlp.data.pair import Pair
from soup_nlp.geometry.camera import rays
from soup_nlp.geometry.soup import Soup, reconstruct
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.model.energy_options import Weights
from soup_nlp.refine.particles import Particles, unary_costs
from soup_nlp.refine.records import RefineOptions

TAU = 0.25
"""Most that a sample costs, and what it costs where the next frame does not show it."""
BEHIND = 1.1
"""A sample is hidden if the nearest surface is nearer by this factor."""
SAMPLES = 24
"""Pixels per superpixel."""
PROJ, SIGMA_PROJ = 0.3, 2.0
"""Factor of alpha1, and truncation of a re-projection error (pixels), where images contradict."""
CONTRADICTION = 0.1
"""Mean difference of a superpixel's visible samples above which the images contradict the flow:
twice that of most superpixels of real pairs, four times that of rendered ones."""
USABLE = 0.1
"""Least mean confidence of a flow that can be contradicted."""
BLOCK = 1 << 19
"""Samples that are looked up at once."""


@dataclass(frozen=True)
class Photometric:
    """Census of both frames, sampled where superpixels are.

    Attributes:
        ray: (N, S, 3) rays of the sampled pixels.
        census_ref: (2, N, S, 4) census of the reference frame at the sampled pixels.
        census_next: (2, H', W', 4) census of the next frame.
        nearest: (H', W') depth of the nearest surface in the next frame; inf where unknown.
        distance: (N,) distances of the planes of the soup behind `nearest`, the length unit.
        K_next: (3, 3) intrinsics of the next frame.
        weight: Factor of E_photo.
        contradicted: (N,) superpixels whose flow the images contradict.
    """

    ray: FloatMap
    census_ref: FloatMap
    census_next: FloatMap
    nearest: FloatMap
    distance: Float
    K_next: Float
    weight: float
    contradicted: Mask

    def costs_of_flow(self, p: Particles, data: EnergyData, weights: Weights) -> tuple[Float, Mask]:
        """`unary_costs`, with a weaker, truncated E_proj where the images contradict the flow."""
        out, ahead = unary_costs(p, data, weights)
        superpixels = np.flatnonzero(self.contradicted)
        sigma = min(weights.sigma_proj, SIGMA_PROJ)
        weak = weights.replace(proj=PROJ * weights.proj, sigma_proj=sigma)
        out[superpixels] = unary_costs(p.subset(superpixels), data, weak, superpixels)[0]
        return out, ahead

    def unit(self, soup: Soup) -> float:
        """Length unit of a soup, relative to that of `nearest`."""
        return float(np.median(soup.distance / self.distance))

    def energy(self, soup: Soup) -> float:
        """Factor times E_photo; it does not depend on the soup's scale."""
        return float(self.costs(Particles.of(soup), self.unit(soup)).sum())

    def costs(self, p: Particles, unit: float) -> Float:
        """(N, L) factor times the contribution of every particle to E_photo, in a length unit."""
        out = np.empty(p.shape)
        step = max(1, BLOCK // (p.shape[1] * self.ray.shape[1]))
        for a in range(0, len(out), step):
            b = slice(a, a + step)
            c, seen = self._differences(p, b, unit)
            out[b] = self.weight * np.where(seen, c, TAU).mean(axis=2)
        return out

    def disagreeing(self, soup: Soup, data: EnergyData) -> Mask:
        """(N,) superpixels with flow whose samples disagree, or are mostly not visible."""
        c, seen = self._differences(Particles.of(soup), slice(None), self.unit(soup))
        visible = seen.mean(axis=2)[:, 0]
        mean = np.where(seen, c, 0).mean(axis=2)[:, 0] / np.maximum(visible, 1e-9)
        usable = data.pixel_weight.sum(axis=1) > USABLE
        return np.asarray(usable & ((mean > CONTRADICTION) | (visible <= 0.5)))

    def _differences(self, p: Particles, b: slice, unit: float) -> tuple[FloatMap, Mask]:
        """Truncated differences of census, and whether the next frame shows a sample: (n, L, S)."""
        u, v, seen = self._seen(p, b, unit)
        flat = u.shape[0] * u.shape[1], u.shape[2]
        difference = census_at(self.census_next, u.reshape(flat), v.reshape(flat))
        difference = difference.reshape(2, *u.shape, 4)
        difference -= self.census_ref[:, b, None]
        np.abs(difference, out=difference)
        return np.minimum(difference.sum(axis=(0, 4)) / 16.0, TAU), seen

    def _seen(self, p: Particles, b: slice, unit: float) -> tuple[FloatMap, FloatMap, Mask]:
        """Pixels (u, v) of the next frame, and whether it shows them: (n, L, S) each."""
        n, labels = p.D[b].shape
        ray = self.ray[b].transpose(0, 2, 1)
        H = (self.K_next @ p.subset(b).homographies).reshape(n, labels * 3, 3).astype(np.float32)
        x, y, z = np.moveaxis(np.matmul(H, ray).reshape(n, labels, 3, -1), 2, 0)
        seen = z > 1e-6
        ahead = np.where(seen, z, 1.0)
        u, v = x / ahead, y / ahead
        height, width = self.nearest.shape
        seen &= (u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1)
        u, v = np.where(seen, u, 0.0), np.where(seen, v, 0.0)
        facing = -np.matmul(p.n[b].astype(np.float32), ray)
        # z is the next depth over that in the reference frame
        depth = p.D[b][..., None].astype(np.float32) / np.maximum(facing, 1e-9) * z
        front = self.nearest[(v + 0.5).astype(np.intp), (u + 0.5).astype(np.intp)]
        seen &= depth < BEHIND * unit * front
        return u, v, seen


def photometric_term(
    pair: Pair, labels: NDArray[np.int32], soup: Soup, data: EnergyData, o: RefineOptions
) -> Photometric | None:
    """The photometric term of a pair; None where its factor is 0.

    The samples are spread evenly over every superpixel, in the order of rows. `soup` is where the
    refinement starts: it followed the flow.
    """
    if not o.photo:
        return None
    size = pair.image_next.shape[0], pair.image_next.shape[1]
    depth_next = reconstruct(soup, labels, pair.K_ref, pair.K_next, size).depth_next
    flat = labels.ravel()
    count = np.bincount(flat)
    order = np.argsort(flat, kind="stable")
    offset = ((np.arange(SAMPLES) + 0.5) / SAMPLES * count[:, None]).astype(np.int64)
    v, u = np.divmod(order[(np.cumsum(count) - count)[:, None] + offset], labels.shape[1])
    photo = Photometric(
        ray=rays(pair.K_ref, np.stack([u, v], axis=-1).astype(float)).astype(np.float32),
        census_ref=census(pair.image_ref)[:, v, u],
        census_next=census(pair.image_next),
        nearest=np.nan_to_num(depth_next, nan=np.inf).astype(np.float32),
        distance=soup.distance,
        K_next=pair.K_next,
        weight=o.photo,
        contradicted=np.zeros(len(soup), bool),
    )
    return replace(photo, contradicted=photo.disagreeing(soup, data))
