"""The segmentation record: anchors, shared boundaries, K-NN and adjacency graphs, weights."""

from dataclasses import dataclass

import numpy as np
import scipy  # its modules are loaded on use: commands that need none start sooner
from numpy.typing import NDArray

from soup_nlp.arrays import Float, Image, Int, Mask
from soup_nlp.errors import DataError

BETA = 0.02
"""Fall-off of w1 and w2 with the distance of anchors, 1/pixel; the paper does not print its own."""
BETA_COLOUR = 1.0
"""Fall-off of w4 with the difference of colours in [0, 1]; the paper does not print its own."""
RIM = 8
"""Directions in which a superpixel has an extreme pixel."""
TIED = 12
"""Neighbours beyond K that may be as near as the last one."""


@dataclass(frozen=True, eq=False)
class Segmentation:
    """Superpixels and the two graphs over them (N superpixels, E edges, P neighbour pairs).

    Attributes:
        labels: (H, W) int32 superpixel of every pixel.
        anchors: (N, 2) centroid (u, v) of every superpixel, pixels.
        sizes: (N,) pixels of every superpixel.
        knn: (N, K) the K nearest anchors of every anchor, nearest first (directed).
        edges: (E, 2) undirected edges i < k of the K-NN graph.
        edge_multiplicity: (E,) 1 or 2: directions in which the edge occurs.
        edge_weight: (E,) w1 = w2 of paper Eq. 2, summed over the directions that occur.
        pairs: (P, 2) 4-connected neighbours i < k that share boundary.
        boundary: (P, B, 2) sampled shared boundary points (u, v), midway between two pixels.
        boundary_length: (P,) number of shared boundary pixels before sampling.
        pair_weight: (P,) w4 of paper Eq. 5, summed over both directions.
        rim: (N, V, 2) extreme pixels of every superpixel in V directions (visibility, report).
    """

    labels: NDArray[np.int32]
    anchors: Float
    sizes: Int
    knn: Int
    edges: Int
    edge_multiplicity: Int
    edge_weight: Float
    pairs: Int
    boundary: Float
    boundary_length: Int
    pair_weight: Float
    rim: Float

    def __len__(self) -> int:
        return len(self.anchors)

    def __repr__(self) -> str:
        height, width = self.labels.shape
        return (
            f"Segmentation({len(self)} superpixels of {width}x{height}, K = {self.knn.shape[1]},"
            f" {len(self.edges)} K-NN edges, {len(self.pairs)} neighbour pairs)"
        )

    def across(self, label: Int | Mask) -> Mask:
        """(P,) True where two neighbours have different labels (N,)."""
        first, second = label[self.pairs].T
        return np.asarray(first != second)

    def nearest(self, mask: Mask) -> Int:
        """(N,) the nearest superpixel of a mask (N,), which is not empty; in the mask itself."""
        members = np.flatnonzero(mask)
        nearest = members[scipy.spatial.cKDTree(self.anchors[members]).query(self.anchors)[1]]
        return np.where(mask, np.arange(len(mask)), nearest)


def build_segmentation(
    labels: NDArray[np.int32], image: Image, neighbours: int = 15, boundary_samples: int | None = 3
) -> Segmentation:
    """Graphs and weights of superpixels 0..N-1, labels (H, W), of an RGB image.

    K = `neighbours` is at most N - 1, else DataError. `boundary_samples` points, evenly spaced, are
    kept of every shared boundary; None takes as many as the longest boundary has (shorter ones
    repeat their points, nearly evenly).
    """
    n = int(labels.max()) + 1
    if n > 1 and not 1 <= neighbours < n:
        raise DataError(
            "K-NN graph needs 1 <= K < number of superpixels",
            where="segmentation.neighbours",
            found=f"K = {neighbours}, {n} superpixels",
            hint="lower segmentation.neighbours or raise segmentation.superpixels",
        )
    height, width = labels.shape
    flat = labels.ravel()
    sizes = np.bincount(flat, minlength=n)
    v, u = (x.ravel().astype(float) for x in np.mgrid[0:height, 0:width])
    anchors = np.stack([np.bincount(flat, w, n) / sizes for w in (u, v)], axis=1)
    knn = _nearest(anchors, neighbours)
    directed = np.stack([np.repeat(np.arange(n), knn.shape[1]), knn.ravel()], axis=1)
    edges, multiplicity = np.unique(np.sort(directed, axis=1), axis=0, return_counts=True)
    distance = np.linalg.norm(anchors[edges[:, 0]] - anchors[edges[:, 1]], axis=1)
    pairs, boundary, length, weight = _shared_boundaries(labels, image, boundary_samples)
    return Segmentation(
        labels=labels,
        anchors=anchors,
        sizes=sizes,
        knn=knn,
        edges=edges,
        edge_multiplicity=multiplicity,
        edge_weight=multiplicity * np.exp(-BETA * distance),
        pairs=pairs,
        boundary=boundary,
        boundary_length=length,
        pair_weight=weight,
        rim=_rim(labels, u, v, n),
    )


def _nearest(anchors: Float, k: int) -> Int:
    """(N, k) nearest other anchors, nearest first, of equal distances the lower index first."""
    n = len(anchors)
    most = min(n, k + 1 + TIED)
    _, index = scipy.spatial.cKDTree(anchors).query(anchors, k=most)
    index = np.sort(index.reshape(n, most), axis=1)
    far = np.round(((anchors[index] - anchors[:, None]) ** 2).sum(axis=2), 6)
    far[index == np.arange(n)[:, None]] = np.inf
    order = np.argsort(far, axis=1, kind="stable")[:, : min(k, n - 1)]
    return np.take_along_axis(index, order, axis=1).astype(np.int64)


def _shared_boundaries(
    labels: NDArray[np.int32], image: Image, samples: int | None
) -> tuple[Int, Float, Int, Float]:
    width, n = labels.shape[1], int(labels.max()) + 1
    of, index = labels.ravel().astype(np.int64), np.arange(labels.size).reshape(labels.shape)
    beside = (index[:, :-1], index[:, 1:]), (index[:-1], index[1:])
    ends = np.concatenate([np.stack([a.ravel(), b.ravel()]) for a, b in beside], axis=1)
    ends = ends[:, of[ends[0]] != of[ends[1]]]
    # the pixel of the lower superpixel first
    p, q = np.where(of[ends[0]] < of[ends[1]], ends, ends[::-1])
    i, k = of[p], of[q]
    key, which = np.unique(i * n + k, return_inverse=True)
    pairs = np.stack([key // n, key % n], axis=1)
    count = np.bincount(which)
    weight = _colour_weight(image, p, which, len(key)) + _colour_weight(image, q, which, len(key))
    middle = np.stack([(p % width + q % width) / 2, (p // width + q // width) / 2], axis=1)
    return pairs, _sample_along(middle, which, count, samples), count, weight


def _colour_weight(image: Image, pixel: Int, which: Int, n_pairs: int) -> Float:
    """Sum over the four neighbours of `exp(-beta |I(X_b) - I(zeta_j)|_F)`, paper Eq. 5."""
    height, width = image.shape[:2]
    # a pixel that touches the other superpixel twice counts once
    unique = np.unique(which * (height * width) + pixel)
    which, pixel = unique // (height * width), unique % (height * width)
    colour = image.astype(float) / 255.0
    v, u = pixel // width, pixel % width
    total = np.zeros(n_pairs)
    for dv, du in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        neighbour = colour[np.clip(v + dv, 0, height - 1), np.clip(u + du, 0, width - 1)]
        gap2 = np.sum((colour[v, u] - neighbour) ** 2, axis=1)
        total += np.exp(-BETA_COLOUR * np.sqrt(np.bincount(which, gap2, n_pairs)))
    return total


def _sample_along(points: Float, which: Int, count: Int, samples: int | None) -> Float:
    """Evenly spaced points (P, B, 2) along each shared boundary, ordered along its main axis."""
    n_pairs = len(count)
    mean = np.stack([np.bincount(which, points[:, c]) / count for c in (0, 1)], axis=1)
    off = points - mean[which]
    sxx, syy, sxy = (np.bincount(which, off[:, a] * off[:, b]) for a, b in ((0, 0), (1, 1), (0, 1)))
    angle = 0.5 * np.arctan2(2 * sxy, sxx - syy)
    along = off[:, 0] * np.cos(angle)[which] + off[:, 1] * np.sin(angle)[which]
    order = np.lexsort((along, which))
    start = np.cumsum(count) - count
    b = int(count.max(initial=1)) if samples is None else samples
    # midpoints of b equal parts: b = 1 is the middle, large b tends to the whole boundary
    fraction = (np.arange(b) + 0.5) / b
    inside = np.minimum((fraction[None] * count[:, None]).astype(np.int64), count[:, None] - 1)
    return points[order[start[:, None] + inside]].reshape(n_pairs, b, 2)


def connected(links: Int, count: int) -> Int:
    """(count,) component of every node of a graph with these links (L, 2)."""
    sparse = scipy.sparse
    graph = sparse.coo_matrix((np.ones(len(links)), tuple(links.T)), shape=(count, count))
    return np.asarray(sparse.csgraph.connected_components(graph, directed=False)[1], np.int64)


def _rim(labels: NDArray[np.int32], u: Float, v: Float, n: int) -> Float:
    """(N, RIM, 2) extreme pixels of every superpixel by direction."""
    order = np.argsort(labels.ravel(), kind="stable")
    owner, u, v = labels.ravel()[order], u[order], v[order]
    start, last = np.searchsorted(owner, np.arange(n)), np.empty(n, np.int64)
    out = np.empty((n, RIM, 2))
    for k in range(RIM):
        angle = 2 * np.pi * k / RIM
        reach = u * np.cos(angle) + v * np.sin(angle)
        top = np.flatnonzero(reach == np.maximum.reduceat(reach, start)[owner])
        # of pixels at the same extreme the last one is kept
        last[owner[top]] = top
        out[:, k] = np.stack([u[last], v[last]], axis=1)
    return out
