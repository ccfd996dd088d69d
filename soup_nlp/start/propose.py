"""Initial proposal of every superpixel: candidates, choice, planes, scales (paper, Sec. 4.4.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from soup_nlp.data.pair import Flow
from soup_nlp.errors import DataError
from soup_nlp.geometry.camera import rays
from soup_nlp.geometry.graph import Segmentation
from soup_nlp.geometry.soup import Soup
from soup_nlp.model.energy import sample_pixels
from soup_nlp.start.epipolar import Motion, repeated
from soup_nlp.start.planes import PlaneFit, fit_planes

Float = NDArray[np.float64]
Int = NDArray[np.int64]


@dataclass(frozen=True)
class StartOptions:
    """How the start is made.

    Attributes:
        samples: Pixels per superpixel.
        dominant: Dominant motions looked for.
        threshold_px: Inlier distance of a dominant motion.
        smoothness: Pixels of error that a motion unlike all neighbours' must gain.
        min_parallax_px: Below this the depth of a superpixel is borrowed.
        rounds: Rounds of proposals from neighbours.
        seed: Of sampling and RANSAC.
    """

    samples: int = 40
    dominant: int = 5
    threshold_px: float = 1.0
    smoothness: float = 0.5
    min_parallax_px: float = 0.25
    rounds: int = 3
    seed: int = 0


@dataclass(frozen=True)
class Start:
    """The unorganised soup with what is known about its making.

    Attributes:
        soup: Start of the optimisation, mean plane distance 1.
        error: (N,) mean re-projection error of every superpixel, pixels.
        parallax: (N,) pixels that its translation moves the anchor.
        borrowed: (N,) True where plane or motion come from neighbours.
        motion: (N,) index of its motion among `motions`, -1 for one of its own.
        motions: The dominant motions.
    """

    soup: Soup
    error: Float
    parallax: Float
    borrowed: NDArray[np.bool_]
    motion: Int
    motions: list[Motion]

    def __str__(self) -> str:
        return (
            f"Start({len(self.soup)} superpixels, {len(self.motions)} dominant motions, median"
            f" error {np.median(self.error):.2f} px, {int(self.borrowed.sum())} borrowed)"
        )


def propose(
    seg: Segmentation, flow: Flow, K_ref: Float, K_next: Float, options: StartOptions | None = None
) -> Start:
    """Rotation, translation, plane and scale of every superpixel from its flow.

    Args:
        seg: Superpixels and graphs.
        flow: Flow with confidence.
        K_ref: (3, 3) intrinsics of the reference frame.
        K_next: (3, 3) intrinsics of the next frame.
        options: See StartOptions.

    Raises:
        DataError: fewer than 8 pixels have a usable flow.
    """
    o = options or StartOptions()
    height, width = seg.labels.shape
    index, there = sample_pixels(seg.labels, flow, o.samples, o.seed)
    if there.sum() < 8:
        raise DataError(
            "too few pixels have a usable flow",
            where=f"flow {flow.source}",
            found=int(there.sum()),
            expected="at least 8",
            hint="check the flow file, or lower the confidence threshold",
        )
    index, there, poor = _fill_poor(seg, index, there)
    uv = np.stack([index % width, index // width], axis=-1).astype(float)
    displacement = flow.uv.reshape(-1, 2)[index].astype(float)
    weight = np.where(there, flow.confidence.ravel()[index].astype(float), 0.0)
    ray, target = rays(K_ref, uv), rays(K_next, uv + np.where(there[..., None], displacement, 0.0))
    anchor = rays(K_ref, seg.anchors)
    rim = rays(K_ref, seg.rim)
    radius = np.linalg.norm((rim - anchor[:, None])[..., :2], axis=-1).max(axis=1)
    radius = np.maximum(radius, 1.0 / K_ref[0, 0])
    focal = (float(K_next[0, 0]), float(K_next[1, 1]))

    motions = _dominant(ray, target, weight, focal[0], o)
    R = np.stack([m.R for m in motions])
    t = np.stack([m.t for m in motions])
    n = len(seg)
    shape = (n, len(motions))
    fit = fit_planes(
        np.broadcast_to(R, (*shape, 3, 3)),
        np.broadcast_to(t, (*shape, 3)),
        ray,
        target,
        weight,
        anchor,
        radius,
        focal,
    )
    cost = _penalised(fit)
    label = _smooth_choice(cost, seg, o.smoothness)
    take = np.arange(n), label
    mu, slope = fit.inverse_depth[take], fit.slope[take]
    parallax = fit.parallax[take] * np.abs(mu)
    weak = (mu <= 0) | (parallax < o.min_parallax_px) | (fit.cost[take] > 3.0) | poor
    weak |= weight.sum(axis=1) < 2.0
    if weak.all():
        weak = ~np.isfinite(mu) | (mu <= 0)
    if weak.all():
        mu, slope, weak = np.ones(n), np.zeros((n, 2)), np.ones(n, bool)
    mu, slope = _borrow(mu, slope, label, weak, seg)
    soup = _soup(mu, slope, R[label], t[label], anchor, radius)
    scale = _contact_scales(soup, label, seg, K_ref)
    soup = Soup(soup.lam * scale, soup.n, soup.d, soup.R, soup.t).normalised()
    return Start(soup, fit.cost[take], parallax, weak, label, motions)


def _fill_poor(
    seg: Segmentation, index: Int, there: NDArray[np.bool_], least: int = 8
) -> tuple[Int, NDArray[np.bool_], NDArray[np.bool_]]:
    """Superpixels with few usable pixels take those of their nearest rich neighbour."""
    count = there.sum(axis=1)
    poor = count < least
    if not poor.any() or poor.all():
        return index, there, poor
    from scipy.spatial import cKDTree

    rich = np.flatnonzero(~poor)
    _, nearest = cKDTree(seg.anchors[rich]).query(seg.anchors[poor])
    index, there = index.copy(), there.copy()
    index[poor], there[poor] = index[rich[nearest]], there[rich[nearest]]
    return index, there, poor


def _dominant(ray: Float, target: Float, weight: Float, focal: float, o: StartOptions) -> list[Motion]:
    rng = np.random.default_rng(o.seed)
    r, q, w = ray.reshape(-1, 3), target.reshape(-1, 3), weight.ravel()
    good = np.flatnonzero(w > 0.3 * w.max())
    pick = good if len(good) <= 6000 else rng.choice(good, 6000, replace=False)
    found = repeated(
        r[pick],
        q[pick],
        w[pick],
        focal,
        count=o.dominant,
        threshold=o.threshold_px,
        seed=o.seed,
    )
    if not found:
        # nothing determines a motion (no flow at all): a sideways camera keeps depth defined
        found = [Motion(np.eye(3), np.array([1.0, 0.0, 0.0]))]
    return found


def _penalised(fit: PlaneFit) -> Float:
    behind = fit.inverse_depth <= 0
    return fit.cost + np.where(behind, 1.0 + 0.5 * fit.parallax * np.abs(fit.inverse_depth), 0.0)


def _smooth_choice(cost: Float, seg: Segmentation, gain: float, rounds: int = 10) -> Int:
    """Labels by iterated conditional modes: cost plus `gain` x share of unlike neighbours."""
    n, m = cost.shape
    label = np.argmin(cost, axis=1)
    if m == 1:
        return label
    near = seg.knn[:, : min(8, seg.knn.shape[1])]
    for _ in range(rounds):
        alike = np.stack([(label[near] == c).mean(axis=1) for c in range(m)], axis=1)
        new = np.argmin(cost + gain * (1 - alike), axis=1)
        if np.array_equal(new, label):
            break
        label = new
    return label


def _borrow(
    mu: Float, slope: Float, label: Int, weak: NDArray[np.bool_], seg: Segmentation
) -> tuple[Float, Float]:
    """Weak superpixels take the median inverse depth of strong neighbours of their motion."""
    from scipy.spatial import cKDTree

    mu, slope = mu.copy(), slope.copy()
    for c in np.unique(label[weak]) if weak.any() else []:
        own = np.flatnonzero(weak & (label == c))
        strong = np.flatnonzero(~weak & (label == c))
        if not len(strong):
            strong = np.flatnonzero(~weak)
        if not len(strong):
            continue
        k = min(5, len(strong))
        _, near = cKDTree(seg.anchors[strong]).query(seg.anchors[own], k=k)
        mu[own] = np.median(mu[strong][near.reshape(len(own), k)], axis=1)
        slope[own] = 0.0
    return mu, slope


def _soup(mu: Float, slope: Float, R: Float, t: Float, anchor: Float, radius: Float) -> Soup:
    g = slope / radius[:, None]
    m = mu[:, None] * np.column_stack([g, 1 - np.sum(g * anchor[:, :2], axis=1)])
    length = np.linalg.norm(m, axis=1)
    D = 1 / length
    return Soup(D, -m / length[:, None], np.ones(len(D)), R.copy(), t / D[:, None])


def _contact_scales(
    soup: Soup, label: Int, seg: Segmentation, K_ref: Float, quantile: float = 0.25
) -> Float:
    """(N,) relative scale of every motion, such that bodies touch what is around them.

    A body hides what is behind it: along its outline its depth is at most its neighbours', with
    equality where it touches. So its scale is a low quantile of the depth ratios there. Bodies
    are joined to the placed ones in the order of their contact length.
    """
    count = int(label.max()) + 1
    log_scale = np.zeros(count)
    if count == 1 or not len(seg.pairs):
        return np.ones(len(soup))
    i, k = seg.pairs.T
    ray = rays(K_ref, seg.boundary.mean(axis=1))
    zi = soup.distance[i] / np.maximum(-np.sum(soup.n[i] * ray, axis=1), 1e-3)
    zk = soup.distance[k] / np.maximum(-np.sum(soup.n[k] * ray, axis=1), 1e-3)
    across = label[i] != label[k]
    a = np.concatenate([label[i][across], label[k][across]])
    b = np.concatenate([label[k][across], label[i][across]])
    ratio = np.log(np.concatenate([(zk / zi)[across], (zi / zk)[across]]))
    contact = np.tile(seg.boundary_length[across], 2).astype(float)
    placed = np.zeros(count, bool)
    placed[np.argmax(np.bincount(label, minlength=count))] = True
    while not placed.all():
        touch = ~placed[a] & placed[b]
        if not touch.any():
            break
        length = np.bincount(a[touch], contact[touch], minlength=count)
        c = int(np.argmax(length))
        mine = touch & (a == c)
        value = ratio[mine] + log_scale[b[mine]]
        order = np.argsort(value)
        share = np.cumsum(contact[mine][order]) / contact[mine].sum()
        log_scale[c] = value[order][np.searchsorted(share, quantile)]
        placed[c] = True
    return np.exp(log_scale)[label]
