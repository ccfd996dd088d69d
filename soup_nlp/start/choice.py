"""Which motion each superpixel takes: candidates, fewest that explain the flow, smoothness."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from soup_nlp.geometry.graph import Segmentation
from soup_nlp.start.bodies import components
from soup_nlp.start.epipolar import Motion, estimate, repeated
from soup_nlp.start.local import fit_translation, neighbourhood, refine_motion
from soup_nlp.start.options import StartOptions
from soup_nlp.start.planes import PlaneFit, Views

Float = NDArray[np.float64]
Int = NDArray[np.int64]


def dominant(views: Views, o: StartOptions) -> list[Motion]:
    """Motions that many pixels share, the commonest first; at least one.

    Args:
        views: Rays, targets and confidence of every superpixel.
        o: Count, inlier distance and seed.
    """
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


def flow_noise(cost: Float) -> float:
    """Flow noise in pixels: the median error of the best motions, within sensible limits.

    Args:
        cost: (N, M) penalised error of each superpixel under each motion, pixels.
    """
    return float(np.clip(np.median(cost.min(axis=1)), 0.05, 0.6))


def of_pieces(
    views: Views,
    seg: Segmentation,
    motions: list[Motion],
    cost: Float,
    noise: float,
    o: StartOptions,
) -> list[Motion]:
    """Motions of the connected pieces that the motions so far do not explain.

    A piece gets the motion of its own essential matrix and the one that shares the main
    rotation: a small patch determines a translation better than both.

    Args:
        views: Rays, targets and confidence of every superpixel.
        seg: Superpixels and graphs.
        motions: M motions so far; the first has the main rotation.
        cost: (N, M) penalised error under them, pixels.
        noise: Flow noise, pixels.
        o: Which pieces are looked at.
    """
    bad = cost.min(axis=1) > max(3 * noise, o.unexplained_px)
    bad &= views.weight.mean(axis=1) > 0.3
    piece = components(bad, seg)
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


def select(cost: Float, noise: float, o: StartOptions) -> list[int]:
    """Fewest motions that explain the flow: greedy, each must gain on enough superpixels.

    Args:
        cost: (N, M) penalised error of each superpixel under each motion, pixels.
        noise: Flow noise, pixels.
        o: Least gain and least number of superpixels.

    Returns:
        Columns that are kept, the best motion first.
    """
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


def smooth_choice(cost: Float, seg: Segmentation, gain: float, rounds: int = 10) -> Int:
    """Labels by iterated conditional modes: cost plus `gain` x share of unlike neighbours.

    Args:
        cost: (N, M) error of each superpixel under each motion, pixels.
        seg: Superpixels and graphs.
        gain: Pixels that a label unlike all neighbours' must gain.
        rounds: At most this many sweeps.

    Returns:
        (N,) motion of every superpixel.
    """
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


def of_neighbourhoods(
    views: Views,
    seg: Segmentation,
    R: Float,
    t: Float,
    own: PlaneFit,
    best: Float,
    label: Int,
    noise: float,
    o: StartOptions,
) -> tuple[Float, Float, PlaneFit, Float, Int]:
    """Motions of every superpixel's own neighbourhood and of its neighbours', where they pay.

    Args:
        views: Rays, targets and confidence of every superpixel.
        seg: Superpixels and graphs.
        R: (N, 3, 3) rotations so far.
        t: (N, 3) unit translations so far.
        own: Planes (N, 1) under them.
        best: (N,) their penalised error, pixels.
        label: (N,) index of each motion, -1 for one of the superpixel's own.
        noise: Flow noise, pixels.
        o: Least gain and rounds.

    Returns:
        R, t, own, best and label with what was adopted.
    """
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
    views: Views,
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
    cost = fit.penalised()
    c = np.argmin(cost, axis=1)
    every = np.arange(len(R))
    better = cost[every, c] + gain < best
    new = fit.pick((every, c))
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
