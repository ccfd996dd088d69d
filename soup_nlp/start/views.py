"""Options of the initialisation, and the flow of every superpixel at sampled pixels."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.data.pair import Flow
from soup_nlp.errors import DataError
from soup_nlp.geometry.camera import rays
from soup_nlp.geometry.graph import Segmentation
from soup_nlp.geometry.plane import PlaneFit, about_anchor, fit_planes, normal_and_distance
from soup_nlp.geometry.soup import Soup
from soup_nlp.model.energy_data import sample_pixels
from soup_nlp.schema.section import Section
from soup_nlp.start.epipolar import FITS, LEAST_MATCHES, Matches, Motion, stacked


class StartOptions(Section):
    """How the initialisation is made."""

    method: Literal["shared", "homography"] = "shared"
    """shared (every superpixel takes one of the motions of the whole image) or homography (the
    paper's: epipolar geometry and homography of every superpixel, equal scales)."""
    bending: bool = True
    """Whether surfaces may bend; if false, everything is rigid."""
    upright: bool = True
    """Whether the image is upright, so that components stand on what is below them. If false, a
    component is scaled by its whole outline."""
    ground: bool = True
    """Use the ground of an upright image, a level plane on which much of the scene lies: unreliable
    depths and components below it are lifted."""


SAMPLES = {"shared": 40, "homography": 100}
"""Sampled pixels per superpixel, by the method."""
USABLE = 0.5
"""Mean confidence above which the flow of a superpixel counts."""
LEAST_PARALLAX_PX = 0.25
"""Parallax from which the flow of a superpixel determines its depth, pixels."""
LEAST_SEEN = 0.1
"""Mean confidence of all pixels of a superpixel from which its flow determines its depth: fewer
pixels match by chance as well."""
JUMP_PX = 1.0
"""Least jump of the flow between two neighbours at which a surface ends, pixels: what moves
less relative to something stands still before it."""
CACHED = 1 << 16
"""Pixels times motions that are fitted at once: 0.5 MB per array, so that the cache holds them."""


@dataclass(frozen=True)
class Views:
    """Sampled rays, flow targets and extent of every superpixel.

    Attributes:
        ray: (N, S, 3) rays of sampled pixels.
        target: (N, S, 3) rays of their flow targets (next camera).
        weight: (N, S) confidence.
        anchor: (N, 3) anchor rays.
        radius: (N,) reach in ray units.
        focal: (2,) focal lengths of the next camera, pixels.
    """

    ray: Float
    target: Float
    weight: Float
    anchor: Float
    radius: Float
    focal: Float

    @property
    def usable(self) -> Mask:
        """(N,) True where the flow counts: its mean confidence is above `USABLE`."""
        return np.asarray(self.weight.mean(axis=1) > USABLE)

    def fit(self, motions: list[Motion], label: Int | None = None) -> PlaneFit:
        """Planes (N, M) under each of M motions, or (N, 1) under that of index `label` (N,)."""
        each = np.arange(len(motions))[None] if label is None else label[:, None]
        each = np.broadcast_to(each, (len(self.ray), each.shape[1]))
        R, t = stacked(motions)
        size = max(1, CACHED // max(1, each.shape[1] * self.weight.shape[1]))
        fits = []
        for k in range(0, max(1, len(each)), size):
            m, v = each[k : k + size], self.subset(slice(k, k + size))
            samples = v.ray, v.target, v.weight
            fits.append(fit_planes(R[m], t[m], *samples, v.anchor, v.radius, v.focal))
        return PlaneFit(*map(np.concatenate, zip(*(vars(fit).values() for fit in fits))))

    def distance(self, moved: Float) -> Float:
        """(N,) mean distance of points (N, S, 3) of the next camera from the targets, pixels."""
        off = (moved[..., :2] / moved[..., 2:] - self.target[..., :2]) * self.focal
        return self.mean(np.linalg.norm(off, axis=2))

    def mean(self, value: Float) -> Float:
        """(N,) mean of the samples' values (N, S), weighted by confidence; 0 without any."""
        total = np.maximum(self.weight.sum(axis=1), 1e-9)
        return np.asarray(np.sum(self.weight * value, axis=1) / total)

    def soup(self, mu: Float, slope: Float, R: Float, T: Float) -> Soup:
        """Planes with motions `X' = R X + T` of each or of all, all scales such that `d` is 1.

        mu (N,) is the inverse depth at the anchors, slope (N, 2) its relative change over the
        radius.
        """
        n, D = normal_and_distance(about_anchor(1 / mu, slope / self.radius[:, None], self.anchor))
        R = np.broadcast_to(R, (len(D), 3, 3)).copy()
        return Soup(D, n, np.ones(len(D)), R, T / D[:, None])

    def parallax(self, soup: Soup) -> Float:
        """(N,) distance in pixels between the moved and the merely rotated anchor."""
        return np.linalg.norm(soup.parallax(self.anchor) * self.focal, axis=1)

    def matches(self, most: int | None = None) -> Matches:
        """The sampled pixels; evenly about `most` of them if there are more."""
        step = max(1, self.weight.size // most) if most else 1
        r, q = (v.reshape(-1, 3)[::step] for v in (self.ray, self.target))
        return Matches(r, q, self.weight.ravel()[::step], self.focal[0])

    def subset(self, at: Int | Mask | slice) -> Views:
        """The views of superpixels `at`."""
        ray, target, weight = self.ray[at], self.target[at], self.weight[at]
        return Views(ray, target, weight, self.anchor[at], self.radius[at], self.focal)


class FlowFit(NamedTuple):
    """The flow of every superpixel at sampled pixels, and an affine map fitted to it.

    Attributes:
        seg: Superpixels and graphs.
        K_ref: (3, 3) intrinsics of the reference frame.
        K_next: (3, 3) intrinsics of the next frame.
        options: Options of the start.
        seed: Seed of sampling.
        views: Rays, targets and confidence of every superpixel.
        poor: (N,) True where the views are a neighbour's, or do not count.
        fit: (N, 3, 2) affine flow, see `affine_flow`.
        residual: (N,) its mean error, pixels.
        seen: (N,) mean confidence of all pixels, not only of the sampled ones.
        jump: (P,) mean difference of the affine flows of two neighbours on their boundary, pixels.
    """

    seg: Segmentation
    K_ref: Float
    K_next: Float
    options: StartOptions
    seed: int
    views: Views
    poor: Mask
    fit: Float
    residual: Float
    seen: Float
    jump: Float

    @classmethod
    def of(
        cls,
        seg: Segmentation,
        flow: Flow,
        K_ref: Float,
        K_next: Float,
        options: StartOptions,
        seed: int = 0,
    ) -> FlowFit:
        """Sample and fit a flow with confidence.

        Raises:
            DataError: fewer than `LEAST_MATCHES` pixels have a usable flow.
        """
        index, filled = sample_pixels(seg.labels, flow, SAMPLES[options.method], seed)
        if filled.sum() < LEAST_MATCHES:
            raise DataError(
                "too few pixels have a usable flow",
                where=f"flow {flow.source}",
                found=int(filled.sum()),
                expected=f"at least {LEAST_MATCHES}",
                hint="two frames of one scene, with texture and closer in time; "
                "of a flow from a file, look at its values and confidence",
            )
        poor = filled.sum(axis=1) < LEAST_MATCHES
        if not poor.all():
            source = seg.nearest(~poor)
            index, filled = index[source], filled[source]
        uv = np.stack(np.divmod(index, seg.labels.shape[1])[::-1], axis=-1).astype(float)
        shift = np.where(filled[..., None], flow.uv.reshape(-1, 2)[index].astype(float), 0.0)
        weight = np.where(filled, flow.confidence.ravel()[index].astype(float), 0.0)
        anchor = rays(K_ref, seg.anchors)
        reach = (rays(K_ref, seg.rim) - anchor[:, None])[..., :2]
        radius = np.maximum(np.linalg.norm(reach, axis=-1).max(axis=1), 1.0 / K_ref[0, 0])
        targets, focal = rays(K_next, uv + shift), np.diag(K_next)[:2]
        views = Views(rays(K_ref, uv), targets, weight, anchor, radius, focal)
        seen = np.bincount(seg.labels.ravel(), flow.confidence.ravel()) / seg.sizes
        given = seg, K_ref, K_next, options, seed, views, poor
        fitted = cls(*given, *affine_flow(views), seen, np.zeros(0))
        edge = rays(K_ref, seg.boundary)
        first, second = (fitted.followed(which, edge) for which in seg.pairs.T)
        return fitted._replace(jump=np.linalg.norm(first - second, axis=-1).mean(axis=1))

    def without(self, mask: Mask) -> FlowFit:
        """The flow without that of the superpixels of a mask (N,)."""
        weight = np.where(mask[:, None], 0.0, self.views.weight)
        return self._replace(views=replace(self.views, weight=weight), poor=self.poor | mask)

    def followed(self, which: Int, ray: Float) -> Float:
        """(M, ..., 2) targets of rays (M, ..., 3) by the affine flows of superpixels `which` (M,).

        Targets are in pixels from the next frame's principal point.
        """
        v, wide = self.views, (slice(None), *(None,) * (ray.ndim - 2))
        off = (ray - v.anchor[which][wide])[..., :2] / v.radius[which][(*wide, None)]
        moved = self.fit[which, 0][wide] + np.einsum("m...c,mcd->m...d", off, self.fit[which, 1:])
        return np.asarray(moved)

    @property
    def trusted(self) -> Mask:
        """(N,) True where the flow counts, and is that of the superpixel itself."""
        return self.views.usable & ~self.poor

    @property
    def middle(self) -> Float:
        """(P, 3) rays of the middles of the boundaries between neighbours."""
        return rays(self.K_ref, self.seg.boundary.mean(axis=1))

    @property
    def centre(self) -> Float:
        """(N, 3) rays of the next frame to which the anchors move."""
        moved = self.fit[:, 0] / self.views.focal
        return np.concatenate([moved, np.ones((len(moved), 1))], axis=1)

    def anchor_matches(self, at: Int) -> Matches:
        """Correspondences of the anchors of superpixels `at`, all with the same weight."""
        v = self.views
        return Matches(v.anchor[at], self.centre[at], np.ones(len(at)), v.focal[0])


def determined(fit: PlaneFit) -> Mask:
    """(N, M) True where planes are ahead, and parallax determines their depth."""
    near = fit.parallax * fit.inverse_depth >= LEAST_PARALLAX_PX
    return (fit.inverse_depth > 0) & near


QUADRATIC_PX = 0.1
"""Error of an affine flow below which its loss is quadratic, pixels."""


def affine_flow(views: Views) -> tuple[Float, Float]:
    """Affine flow of every superpixel, fitted robustly: (N, 3, 2) maps from offsets in radii to
    targets in pixels, and (N,) their mean error, pixels: noise, whether surfaces bend or not."""
    off = (views.ray - views.anchor[:, None])[..., :2] / views.radius[:, None, None]
    basis = np.concatenate([np.ones((*off.shape[:2], 1)), off], axis=2)
    target = views.target[..., :2] * views.focal
    # without confident pixels any affine map will do; the ridge keeps the system regular
    w = confidence = views.weight + 1e-6
    fit = np.zeros((len(basis), 3, 2))
    for _ in range(FITS):
        right = (basis * w[..., None]).transpose(0, 2, 1)
        fit = np.linalg.solve(right @ basis + 1e-9 * np.eye(3), right @ target)
        error = np.linalg.norm(basis @ fit - target, axis=2)
        w = confidence / np.sqrt(error**2 + QUADRATIC_PX**2)
    return fit, views.mean(error)
