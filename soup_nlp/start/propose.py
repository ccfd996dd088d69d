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
from soup_nlp.start.epipolar import Motion, estimate, repeated
from soup_nlp.start.local import fit_translation, neighbourhood, refine_motion
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
        rounds: Rounds of proposals from unexplained pieces, and from neighbours.
        unexplained_px: A superpixel whose error is below this has no need of another motion.
        pieces: At most this many unexplained pieces are looked at in a round.
        piece_size: A piece has at least this many superpixels.
        seed: Of sampling and RANSAC.
    """

    samples: int = 40
    dominant: int = 5
    threshold_px: float = 1.0
    smoothness: float = 0.5
    min_parallax_px: float = 0.25
    rounds: int = 3
    unexplained_px: float = 0.1
    pieces: int = 6
    piece_size: int = 4
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
        body: (N,) group that seems to move as one and shares one scale: a dominant motion, or a
            connected piece of superpixels with motions of their own.
        motions: The dominant motions.
    """

    soup: Soup
    error: Float
    parallax: Float
    borrowed: NDArray[np.bool_]
    motion: Int
    body: Int
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
    width = seg.labels.shape[1]
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

    views = _Views(ray, target, weight, anchor, radius, focal)
    motions = _dominant(views, o)
    fit = views.fit(motions)
    cost = _penalised(fit)
    noise = _noise(cost)
    # what no motion explains yet, piece by piece
    for _ in range(o.rounds):
        extra = _of_pieces(views, seg, motions, cost, noise, o)
        if not extra:
            break
        motions = motions + extra
        fit = views.fit(motions)
        cost = _penalised(fit)
        kept = _select(cost, noise, o)
        motions, fit, cost = [motions[c] for c in kept], _columns(fit, kept), cost[:, kept]
        noise = _noise(cost)
    # the dominant motion is preferred where another is not clearly better
    prefer = np.where(np.arange(len(motions)) == 0, 0.0, max(noise, 0.5 * o.unexplained_px))
    label = _smooth_choice(cost + prefer, seg, o.smoothness)
    R = np.stack([m.R for m in motions])[label]
    t = np.stack([m.t for m in motions])[label]
    take = np.arange(len(seg)), label
    own = _pick(fit, take)
    best = cost[take]
    R, t, own, best, label = _local(views, seg, R, t, own, best, label, noise, o)
    mu, slope, parallax = own.inverse_depth[:, 0], own.slope[:, 0], own.parallax[:, 0]
    parallax = parallax * np.abs(mu)
    weak = (mu <= 0) | (parallax < o.min_parallax_px) | (own.cost[:, 0] > 3.0) | poor
    weak |= weight.sum(axis=1) < 2.0
    if weak.all():
        # little parallax everywhere is still some, until it is the rounding of the flow
        weak = ~np.isfinite(mu) | (mu <= 0) | (parallax < 0.02)
    if weak.all():
        n = len(seg)
        mu, slope, weak = np.ones(n), np.zeros((n, 2)), np.ones(n, bool)
    mu, slope = _borrow(mu, slope, label, weak, seg)
    soup = _soup(mu, slope, R, t, anchor, radius)
    body = _pieces(label, seg)
    scale = _contact_scales(soup, body, seg, K_ref)
    soup = Soup(soup.lam * scale, soup.n, soup.d, soup.R, soup.t).normalised()
    return Start(soup, own.cost[:, 0], parallax, weak, label, body, motions)


@dataclass(frozen=True)
class _Views:
    """What the fits need of every superpixel: rays, targets, confidence, anchor, reach."""

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


def _noise(cost: Float) -> float:
    """Flow noise in pixels: the median error of the best motions, within sensible limits."""
    return float(np.clip(np.median(cost.min(axis=1)), 0.05, 0.6))


def _pick(fit: PlaneFit, take: tuple[Int, Int]) -> PlaneFit:
    return PlaneFit(*(v[take][:, None] for v in fit.__dict__.values()))


def _columns(fit: PlaneFit, kept: list[int]) -> PlaneFit:
    return PlaneFit(*(v[:, kept] for v in fit.__dict__.values()))


def _select(cost: Float, noise: float, o: StartOptions) -> list[int]:
    """Fewest motions that explain the flow: greedy, each must gain on enough superpixels."""
    clipped = np.minimum(cost, 3.0)
    gain = max(2 * noise, o.unexplained_px)
    kept = [int(np.argmin(clipped.sum(axis=0)))]
    while len(kept) < clipped.shape[1]:
        best = clipped[:, kept].min(axis=1)
        better = np.maximum(best[:, None] - clipped - gain, 0.0)
        total = better.sum(axis=0)
        c = int(np.argmax(total))
        if np.sum(better[:, c] > 0) < o.piece_size:
            break
        kept.append(c)
    return kept


def _components(mask: NDArray[np.bool_], seg: Segmentation) -> Int:
    """(N,) component of every superpixel of a mask over the neighbour pairs, -1 outside."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    i, k = seg.pairs.T
    both = mask[i] & mask[k]
    n = len(mask)
    graph = coo_matrix((np.ones(int(both.sum())), (i[both], k[both])), shape=(n, n))
    _, piece = connected_components(graph, directed=False)
    return np.where(mask, piece, -1)


def _of_pieces(
    views: _Views,
    seg: Segmentation,
    motions: list[Motion],
    cost: Float,
    noise: float,
    o: StartOptions,
) -> list[Motion]:
    """Motions of the connected pieces that the motions so far do not explain.

    A piece gets the motion of its own essential matrix and the one that shares the main
    rotation: a small patch determines a translation better than both.
    """
    bad = cost.min(axis=1) > max(3 * noise, o.unexplained_px)
    bad &= views.weight.mean(axis=1) > 0.3
    piece = _components(bad, seg)
    out: list[Motion] = []
    sizes = np.bincount(piece[piece >= 0], minlength=1)
    for c in np.argsort(-sizes)[: o.pieces]:
        if sizes[c] < o.piece_size:
            break
        own = piece == c
        r, q = views.ray[own].reshape(-1, 3), views.target[own].reshape(-1, 3)
        w = views.weight[own].ravel()
        found = estimate(r, q, w, views.focal[0], max(3 * noise, 0.3), o.seed)
        if found is not None:
            out.append(found)
        R = motions[0].R[None]
        t = fit_translation(R, r[None], q[None], w[None], views.focal[0], max(noise, 0.1))
        out.append(Motion(motions[0].R, t[0]))
    return out


def _local(
    views: _Views,
    seg: Segmentation,
    R: Float,
    t: Float,
    own: PlaneFit,
    best: Float,
    label: Int,
    noise: float,
    o: StartOptions,
) -> tuple[Float, Float, PlaneFit, Float, Int]:
    """Motions of every superpixel's own neighbourhood and of its neighbours', where they pay."""
    n, k = seg.knn.shape
    if k == 0:
        return R, t, own, best, label
    gain = max(2 * noise, o.unexplained_px)
    for size in (8, 24):
        if not (best > gain).any():
            break
        near = np.column_stack([np.arange(n), seg.knn[:, : min(size, k)]])
        step = max(1, near.shape[1] * views.ray.shape[1] // 200)
        r, q, w = (
            neighbourhood(v[:, ::step], near) for v in (views.ray, views.target, views.weight)
        )
        t1 = fit_translation(R, r, q, w, views.focal[0], max(noise, 0.1))
        R2, t2 = refine_motion(R, t, r, q, w, views.focal[0], max(noise, 0.1))
        R3, t3 = refine_motion(R, t1, r, q, w, views.focal[0], max(noise, 0.1))
        Rs = np.stack([R, R2, R3], axis=1)
        ts = np.stack([t1, t2, t3], axis=1)
        R, t, own, best, label = _adopt(views, Rs, ts, R, t, own, best, label, gain)
    for _ in range(o.rounds):
        if not (best > gain).any():
            break
        near = seg.knn[:, : min(6, k)]
        R, t, own, best, label = _adopt(
            views, R[near], t[near], R, t, own, best, label, gain, label[near]
        )
    return R, t, own, best, label


def _adopt(
    views: _Views,
    Rs: Float,
    ts: Float,
    R: Float,
    t: Float,
    own: PlaneFit,
    best: Float,
    label: Int,
    gain: float,
    labels: Int | None = None,
) -> tuple[Float, Float, PlaneFit, Float, Int]:
    """Take the best candidate (N, C) where it lowers the error by more than `gain` pixels."""
    fit = views.fit_own(Rs, ts)
    cost = _penalised(fit)
    c = np.argmin(cost, axis=1)
    every = np.arange(len(R))
    better = cost[every, c] + gain < best
    new = _pick(fit, (every, c))
    own = PlaneFit(
        *(
            np.where(better.reshape(-1, *[1] * (a.ndim - 1)), b, a)
            for a, b in zip(own.__dict__.values(), new.__dict__.values())
        )
    )
    R = np.where(better[:, None, None], Rs[every, c], R)
    t = np.where(better[:, None], ts[every, c], t)
    best = np.where(better, cost[every, c], best)
    taken = labels[every, c] if labels is not None else np.full(len(R), -1)
    return R, t, own, best, np.where(better, taken, label)


def _pieces(label: Int, seg: Segmentation) -> Int:
    """Groups that share one scale: a dominant motion, or a piece of superpixels of their own."""
    own = label < 0
    if not own.any():
        return label
    piece = _components(own, seg)
    _, piece = np.unique(np.where(own, piece, -1), return_inverse=True)
    return np.where(own, label.max() + piece, label)


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


def _dominant(views: _Views, o: StartOptions) -> list[Motion]:
    rng = np.random.default_rng(o.seed)
    r, q = views.ray.reshape(-1, 3), views.target.reshape(-1, 3)
    w = views.weight.ravel()
    good = np.flatnonzero(w > 0.3 * w.max())
    pick = good if len(good) <= 6000 else rng.choice(good, 6000, replace=False)
    found = repeated(
        r[pick],
        q[pick],
        w[pick],
        views.focal[0],
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
    m = cost.shape[1]
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
