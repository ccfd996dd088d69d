"""The numbers of the energy: sampled pixels, graphs, weights. No symbolic expressions."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.data.pair import Flow
from soup_nlp.geometry.camera import rays
from soup_nlp.geometry.graph import Segmentation

HINGE = 0.01
"""Width of the corner of the hinge of E_order, relative inverse depth."""


@dataclass(frozen=True, eq=False)
class EnergyData:
    """Everything numeric that E and its constraints need (N superpixels, E edges, P pairs).

    Attributes:
        K_next: (3, 3) intrinsics of the next frame.
        anchor_ray: (N, 3).
        radius: (N,) largest distance of a rim pixel from the anchor, ray units.
        pixel_ray: (N, S, 3) sampled pixels of every superpixel.
        pixel_target: (N, S, 2) their flow targets, pixels.
        pixel_weight: (N, S) confidence / S: E_proj is the confidence-weighted mean of the sample.
        edges: (E, 2) edges i < k: the K-NN graph, and those that join the scene.
        edge_weight: (E,) w1 = w2, both directions folded.
        edge_unit: (E,) length unit of the edge (1: the mean plane distance).
        prior_weight: (E,) weight of E_prior: 1 / K for each direction of the edge, so that it is
            the mean over the neighbours of a superpixel, times the flow's noise in pixels where
            that is known.
        prior_relief: (E,) relative difference of inverse depth along each edge that costs nothing
            in E_prior: that of the start where the flow determines the depth of neither end.
        depth_weight: (E,) weight of E_depth; 0 without a depth prior, and where it is not reliable.
        depth_change: (E,) difference of log depth along each edge by the depth prior.
        order_weight: (P,) weight of E_order: positive where the second superpixel of a pair covers
            the first, negative where the first covers the second, 0 where neither is known.
        order_step: (P,) difference of inverse depth, relative to that of the covered superpixel, by
            which the other is at least in front.
        rotation_scale: (E,) factor of |R_i - R_k| (1 in the paper's units, focal in pixel units).
        pairs: (P, 2) neighbours i < k.
        boundary_ray: (P, B, 3) sampled shared boundary points.
        pair_weight: (P,) w4, both directions folded.
        pair_factor: (P,) sqrt(boundary length / B): the sampled Frobenius norm times this stands
            for the norm over the whole boundary.
        pair_unit: (P,) length unit of the pair.
        orient_weight: (P,) weight of E_orient: 2, directed pairs folded into one, less at flow
            discontinuities of bending surfaces.
        orient_turn: (P, 3) difference of the normals that costs nothing in E_orient: that of a
            depth prior where it decides both.
        rim_ray: (N, V, 3) rays where visibility is imposed, the anchor first.
        local_units: edge_unit and pair_unit are shares of the depth of the two anchors, mostly the
            nearer one (E is then independent of scale, term by term), instead of lengths.
        share: (N,) weights c of the length unit: lengths are measured with sum_i c_i D_i = 1, D the
            plane distances; lam_i = c_i D_i is then on the simplex.
        arap_at_anchors: motion difference taken at the anchors rather than at the camera.
    """

    K_next: Float
    anchor_ray: Float
    radius: Float
    pixel_ray: Float
    pixel_target: Float
    pixel_weight: Float
    edges: Int
    edge_weight: Float
    edge_unit: Float
    prior_weight: Float
    prior_relief: Float
    depth_weight: Float
    depth_change: Float
    order_weight: Float
    order_step: Float
    rotation_scale: Float
    pairs: Int
    boundary_ray: Float
    pair_weight: Float
    pair_factor: Float
    pair_unit: Float
    orient_weight: Float
    orient_turn: Float
    rim_ray: Float
    share: Float
    local_units: bool = False
    arap_at_anchors: bool = False

    def __len__(self) -> int:
        return len(self.anchor_ray)

    def __str__(self) -> str:
        return (
            f"EnergyData({len(self)} superpixels x {self.pixel_ray.shape[1]} pixels,"
            f" {len(self.edges)} edges, {len(self.pairs)} pairs x {self.boundary_ray.shape[1]})"
        )

    __repr__ = __str__

    def visibility_ray(self, depth_ratio: float) -> Float:
        """(N, V, 3) rays v with `-n . v >= c` for visibility: the anchor, then r_rim - r_a / ratio.

        The latter bounds the depth at a rim pixel by `ratio` times the anchor's and implies
        `-n . r_rim >= c`.
        """
        rim = self.rim_ray[:, 1:] - self.rim_ray[:, :1] / depth_ratio
        return np.concatenate([self.rim_ray[:, :1], rim], axis=1)

    def arrays(self) -> dict[str, Float]:
        """Every array by name, for storing."""
        return {k: np.asarray(v) for k, v in vars(self).items()}


def sample_pixels(
    labels: NDArray[np.int32], flow: Flow, samples: int | None, seed: int
) -> tuple[Int, Mask]:
    """(N, S) flat indices of a random sample of every superpixel's pixels of nonzero confidence,
    None for all of them, and (N, S) bool, False where a superpixel has fewer."""
    n = int(labels.max()) + 1
    rng = np.random.default_rng(seed)
    flat = labels.ravel()
    usable = np.flatnonzero(flow.confidence.ravel() > 0)
    # a random order within each superpixel, then its first S: a sample without replacement
    order = usable[np.argsort(flat[usable] + rng.random(len(usable)))]
    count = np.bincount(flat[order], minlength=n)
    s = int(count.max(initial=1)) if samples is None else samples
    start = np.cumsum(count) - count
    slot = np.arange(s)[None, :]
    filled = slot < count[:, None]
    if not len(order):
        return np.zeros((n, s), np.int64), filled
    take = np.minimum(start[:, None] + np.where(filled, slot, 0), len(order) - 1)
    return order[take], filled


def build_energy_data(
    seg: Segmentation,
    flow: Flow,
    K_ref: Float,
    K_next: Float,
    samples: int | None = 16,
    seed: int = 0,
    arap_at_anchors: bool = False,
) -> EnergyData:
    """Rays, targets and weights of a segmented pair, in the paper's units.

    E_proj has `samples` pixels per superpixel, drawn by the seed, or all (None).
    """
    width = seg.labels.shape[1]
    index, filled = sample_pixels(seg.labels, flow, samples, seed)
    uv = np.stack([index % width, index // width], axis=-1).astype(float)
    confidence = np.where(filled, flow.confidence.ravel()[index].astype(float), 0.0)
    target = uv + np.where(filled[..., None], flow.uv.reshape(-1, 2)[index], 0.0)
    anchor = rays(K_ref, seg.anchors)
    rim = rays(K_ref, seg.rim)
    reach = np.linalg.norm((rim - anchor[:, None])[..., :2], axis=-1).max(axis=1)
    return EnergyData(
        K_next=np.asarray(K_next, float),
        anchor_ray=anchor,
        radius=np.maximum(reach, 1.0 / K_ref[0, 0]),
        pixel_ray=rays(K_ref, uv),
        pixel_target=target,
        pixel_weight=confidence / index.shape[1],
        edges=seg.edges,
        edge_weight=seg.edge_weight,
        edge_unit=np.ones(len(seg.edges)),
        prior_weight=seg.edge_multiplicity / max(1, seg.knn.shape[1]),
        prior_relief=np.zeros(len(seg.edges)),
        depth_weight=np.zeros(len(seg.edges)),
        depth_change=np.zeros(len(seg.edges)),
        order_weight=np.zeros(len(seg.pairs)),
        order_step=np.zeros(len(seg.pairs)),
        rotation_scale=np.ones(len(seg.edges)),
        pairs=seg.pairs,
        boundary_ray=rays(K_ref, seg.boundary),
        pair_weight=seg.pair_weight,
        pair_factor=np.sqrt(seg.boundary_length / max(1, seg.boundary.shape[1])),
        pair_unit=np.ones(len(seg.pairs)),
        orient_weight=np.full(len(seg.pairs), 2.0),
        orient_turn=np.zeros((len(seg.pairs), 3)),
        rim_ray=np.concatenate([anchor[:, None], rim], axis=1),
        share=np.full(len(seg), 1.0 / len(seg)),
        arap_at_anchors=arap_at_anchors,
    )
