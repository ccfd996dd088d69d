"""The true soup: planes fitted to the true depth, with true motions, for a comparison of energies.

If E(truth) is above E(solution), the minimum of the model differs from the truth. If it is below,
the solver has not found the minimum.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from soup_nlp.arrays import Float, Int, Mask
from soup_nlp.bench.depth_maps import least_error_planes
from soup_nlp.data.pair import Pair, Truth
from soup_nlp.errors import DataError
from soup_nlp.geometry.camera import pixel_grid, rays
from soup_nlp.geometry.graph import Segmentation
from soup_nlp.geometry.motion import fit_motion
from soup_nlp.geometry.soup import Soup

MIN_PIXELS = 6
"""True pixels that the fit of plane and motion of a superpixel needs."""
SCALES = np.geomspace(1 / 3, 3, 41)
"""Factors of the scale that `rescaled` tries."""


@dataclass(frozen=True)
class TrueSoup:
    """A soup of true planes and motions.

    Attributes:
        soup: The soup, mean plane distance 1.
        component: (N,) component of most pixels of every superpixel; 0 where unknown.
        known: (N,) False where plane and motion are those of a neighbour for lack of truth.
        purity: (N,) share of the true pixels that belong to the component.
    """

    soup: Soup
    component: Int
    known: Mask
    purity: Float


def true_soup(pair: Pair, seg: Segmentation) -> TrueSoup:
    """Plane and rigid motion of every superpixel from the truth.

    The plane has the least mean relative error over the pixels of the superpixel's component. The
    motion is that of the component if it is known, else the rigid motion that fits the true scene
    flow of the pixels best (least squares).

    Args:
        pair: A pair with dense true depth, and motions of components or scene flow.
        seg: Its superpixels.

    Raises:
        DataError: the truth lacks one of these, or is known for too few superpixels.
    """
    truth = pair.truth
    if truth is None or truth.depth_ref is None:
        raise DataError("true soup needs a dense true depth", where=pair.name, found=truth)
    if truth.scene_flow is None and (truth.motions is None or truth.components is None):
        raise DataError("true soup needs motions or scene flow", where=pair.name, found=truth)
    n = len(seg)
    component, purity = _majority(truth, seg)
    mine = np.isfinite(truth.depth_ref) & (truth.depth_ref > 0)
    if truth.components is not None:
        mine &= truth.components == component[seg.labels]
    if truth.scene_flow is not None:
        mine &= np.isfinite(truth.scene_flow).all(axis=2)
    known = np.bincount(seg.labels[mine], minlength=n) >= MIN_PIXELS
    if known.sum() < max(1, n // 2):
        raise DataError(
            "too few superpixels have a truth", where=pair.name, found=int(known.sum()), expected=n
        )
    depth = np.where(mine, truth.depth_ref, np.nan)
    m = least_error_planes(seg.labels, depth, pair.K_ref)
    m = _facing(m, seg, pair.K_ref, depth)
    R, T, moved = _motions(truth, seg, component, mine, depth, pair.K_ref)
    known &= moved
    given = np.flatnonzero(known)
    fill = given[cKDTree(seg.anchors[given]).query(seg.anchors)[1]]
    length = np.linalg.norm(m[fill], axis=1)
    D = 1 / length
    soup = Soup(D, -m[fill] / length[:, None], np.ones(n), R[fill], T[fill] / D[:, None])
    return TrueSoup(soup.normalised(), component, known, purity)


def moves_by_itself(truth: Truth) -> Mask:
    """(B,) bool, True for components that move differently from component 0, the static scene.

    Without known motions it is True for all components but 0.
    """
    assert truth.components is not None
    own = np.arange(int(truth.components.max()) + 1) > 0
    if truth.motions is not None:
        near = np.isclose(truth.motions, truth.motions[0], rtol=0, atol=1e-9).all(axis=(1, 2))
        own[: len(near)] &= ~near[: len(own)]
    return own


def rescaled(true: TrueSoup, energy: Callable[[Soup], float]) -> Soup:
    """The true soup with the scale of each component but the largest set to that of lowest energy.

    The flow does not determine the scale of an independently moving component. The difference to
    E(truth) is the energy that the model gains by wrong scales.
    """
    soup, size = true.soup, np.bincount(true.component)
    for b in np.argsort(-size, kind="stable")[1 : np.count_nonzero(size)]:
        own = true.component == b
        tried = [replace(soup, lam=np.where(own, f, 1.0) * soup.lam).normalised() for f in SCALES]
        soup = min([soup, *tried], key=energy)
    return soup


def _majority(truth: Truth, seg: Segmentation) -> tuple[Int, Float]:
    n = len(seg)
    if truth.components is None:
        return np.zeros(n, np.int64), np.ones(n)
    top = int(truth.components.max()) + 2
    flat = seg.labels.ravel().astype(np.int64) * top + truth.components.ravel() + 1
    votes = np.bincount(flat, minlength=n * top).reshape(n, top)[:, 1:]
    share = votes.max(axis=1) / np.maximum(votes.sum(axis=1), 1)
    return votes.argmax(axis=1).astype(np.int64), share


def _facing(m: Float, seg: Segmentation, K: Float, depth: Float) -> Float:
    """The planes; those seen from behind at a pixel of their superpixel become fronto-parallel."""
    inverse = np.einsum("hwc,hwc->hw", m[seg.labels], rays(K, pixel_grid(*depth.shape)))
    bad = np.bincount(seg.labels.ravel(), ~(inverse.ravel() > 0), len(m)) > 0
    for i in np.flatnonzero(bad & np.isfinite(m).all(axis=1)):
        m[i] = [0.0, 0.0, np.nanmedian(1 / depth[seg.labels == i])]
    return m


def _motions(
    truth: Truth, seg: Segmentation, component: Int, mine: Mask, depth: Float, K: Float
) -> tuple[Float, Float, Mask]:
    """(N, 3, 3) rotations, (N, 3) translations, (N,) whether they are known."""
    n = len(seg)
    R, T, known = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), np.zeros(n, bool)
    if truth.motions is not None and truth.components is not None:
        own = truth.motions[np.minimum(component, len(truth.motions) - 1)]
        known = np.asarray(np.isfinite(own).all(axis=(1, 2)))
        R[known], T[known] = own[known, :3, :3], own[known, :3, 3]
    if truth.scene_flow is None or known.all():
        return R, T, known
    use = np.flatnonzero(mine & ~known[seg.labels])
    X = (depth[..., None] * rays(K, pixel_grid(*depth.shape))).reshape(-1, 3)
    Y = X + truth.scene_flow.reshape(-1, 3)
    which = seg.labels.ravel()[use]
    order = np.argsort(which, kind="stable")
    labels, first = np.unique(which[order], return_index=True)
    for i, pixels in zip(labels, np.split(use[order], first[1:]), strict=True):
        if len(pixels) >= MIN_PIXELS:
            moved = fit_motion(X[pixels], Y[pixels], np.ones(len(pixels)))
            R[i], T[i], known[i] = moved.R, moved.t, True
    return R, T, known
