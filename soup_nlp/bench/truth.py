"""The true soup: planes fitted to true depth and true motions, to compare its energy with.

If E(truth) is above E(solution) the model prefers something else to the truth; if it is below, the
solver has missed it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from soup_nlp.bench.piecewise_planar import fit_planes
from soup_nlp.data.pair import Pair, Truth
from soup_nlp.errors import DataError
from soup_nlp.geometry.camera import pixel_grid, rays
from soup_nlp.geometry.graph import Segmentation
from soup_nlp.geometry.rotation import nearest
from soup_nlp.geometry.soup import Soup

Float = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class TrueSoup:
    """A soup of true planes and motions.

    Attributes:
        soup: The soup, mean plane distance 1.
        component: (N,) component of every superpixel (that of most of its pixels); 0 where unknown.
        known: (N,) False where a superpixel has too little truth and borrows its neighbour's.
        purity: (N,) share of its true pixels that belong to its component.
    """

    soup: Soup
    component: NDArray[np.int64]
    known: Bools
    purity: Float

    def __str__(self) -> str:
        mixed = int((self.purity < 0.95).sum())
        return (
            f"TrueSoup({len(self.soup)} superpixels, {self.known.mean():.0%} known, {mixed} mixed)"
        )


def true_soup(pair: Pair, seg: Segmentation) -> TrueSoup:
    """Plane and rigid motion of every superpixel from the truth.

    The plane is the one of least mean relative error over the pixels of the superpixel's
    component. The motion is the component's own where it is known; else the rigid motion that fits
    the true scene flow of the pixels best (least squares).

    Args:
        pair: A pair with dense true depth, and motions of components or scene flow.
        seg: Its superpixels.

    Raises:
        DataError: that truth is not known, or too little of it.
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
    known = np.bincount(seg.labels[mine], minlength=n) >= 6
    if known.sum() < max(1, n // 2):
        raise DataError(
            "too few superpixels have a truth", where=pair.name, found=int(known.sum()), expected=n
        )
    depth = np.where(mine, truth.depth_ref, np.nan)
    m = fit_planes(seg.labels, depth, pair.K_ref)
    m = _facing(m, seg, pair.K_ref, depth)
    R, T, moved = _motions(truth, seg, component, mine, depth, pair.K_ref)
    known &= moved
    fill = _nearest_known(known, seg)
    length = np.linalg.norm(m[fill], axis=1)
    D = 1 / length
    soup = Soup(D, -m[fill] / length[:, None], np.ones(n), R[fill], T[fill] / D[:, None])
    return TrueSoup(soup.normalised(), component, known, purity)


def moves_by_itself(truth: Truth) -> Bools:
    """(B,) which components move otherwise than component 0, the static scene.

    Without known motions every component but 0 does.

    Args:
        truth: With components.
    """
    assert truth.components is not None
    own = np.arange(int(truth.components.max()) + 1) > 0
    if truth.motions is not None:
        near = np.isclose(truth.motions, truth.motions[0], rtol=0, atol=1e-9).all(axis=(1, 2))
        own[: len(near)] &= ~near[: len(own)]
    return own


SCALES = np.geomspace(1 / 3, 3, 41)
"""Factors that `rescaled` tries."""


def rescaled(true: TrueSoup, energy: Callable[[Soup], float]) -> Soup:
    """The true soup with every component but the largest at its scale of lowest energy, in turn.

    Flow leaves every component that moves by itself a scale of its own: E(truth) less this is what
    the model would have instead of true distances.

    Args:
        true: Soup and components.
        energy: Of a soup.
    """
    soup, size = true.soup, np.bincount(true.component)
    for b in np.argsort(-size, kind="stable")[1 : np.count_nonzero(size)]:
        own = true.component == b
        tried = [replace(soup, lam=np.where(own, f, 1.0) * soup.lam).normalised() for f in SCALES]
        soup = min([soup, *tried], key=energy)
    return soup


def _majority(truth: Truth, seg: Segmentation) -> tuple[NDArray[np.int64], Float]:
    n = len(seg)
    if truth.components is None:
        return np.zeros(n, np.int64), np.ones(n)
    top = int(truth.components.max()) + 2
    flat = seg.labels.ravel().astype(np.int64) * top + truth.components.ravel() + 1
    votes = np.bincount(flat, minlength=n * top).reshape(n, top)[:, 1:]
    share = votes.max(axis=1) / np.maximum(votes.sum(axis=1), 1)
    return votes.argmax(axis=1).astype(np.int64), share


def _facing(m: Float, seg: Segmentation, K: Float, depth: Float) -> Float:
    """Planes that are seen from behind at a pixel of their superpixel become fronto-parallel."""
    inverse = np.einsum("hwc,hwc->hw", m[seg.labels], rays(K, pixel_grid(*depth.shape)))
    bad = np.bincount(seg.labels.ravel(), ~(inverse.ravel() > 0), len(m)) > 0
    for i in np.flatnonzero(bad & np.isfinite(m).all(axis=1)):
        m[i] = [0.0, 0.0, np.nanmedian(1 / depth[seg.labels == i])]
    return m


def _motions(
    truth: Truth,
    seg: Segmentation,
    component: NDArray[np.int64],
    mine: Bools,
    depth: Float,
    K: Float,
) -> tuple[Float, Float, Bools]:
    """(N, 3, 3) rotations, (N, 3) translations, (N,) whether they are known."""
    n = len(seg)
    R, T, known = np.tile(np.eye(3), (n, 1, 1)), np.zeros((n, 3)), np.zeros(n, bool)
    if truth.motions is not None and truth.components is not None:
        own = truth.motions[np.minimum(component, len(truth.motions) - 1)]
        known = np.asarray(np.isfinite(own).all(axis=(1, 2)))
        R[known], T[known] = own[known, :3, :3], own[known, :3, 3]
    if truth.scene_flow is None or known.all():
        return R, T, known
    use = mine & ~known[seg.labels]
    which = seg.labels[use]
    X = depth[use][:, None] * rays(K, pixel_grid(*depth.shape))[use]
    Y = X + truth.scene_flow[use]
    count = np.bincount(which, minlength=n)
    rich = ~known & (count >= 6)
    total = np.maximum(count, 1)[:, None]
    a = np.stack([np.bincount(which, X[:, c], n) for c in range(3)], axis=1) / total
    b = np.stack([np.bincount(which, Y[:, c], n) for c in range(3)], axis=1) / total
    dx, dy = X - a[which], Y - b[which]
    cross = np.stack(
        [np.bincount(which, dy[:, r] * dx[:, c], n) for r in range(3) for c in range(3)], axis=1
    ).reshape(n, 3, 3)
    # a flat patch leaves the third direction to the determinant
    R[rich] = nearest(cross[rich])
    T[rich] = b[rich] - np.einsum("nij,nj->ni", R[rich], a[rich])
    return R, T, known | rich


def _nearest_known(known: Bools, seg: Segmentation) -> NDArray[np.int64]:
    from scipy.spatial import cKDTree

    rich = np.flatnonzero(known)
    _, near = cKDTree(seg.anchors[rich]).query(seg.anchors)
    return np.asarray(rich[near], np.int64)
