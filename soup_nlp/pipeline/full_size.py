"""Depth of both frames at the size of the images, where a pair was solved at a smaller one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from soup_nlp.arrays import FloatMap
from soup_nlp.config.problem import Expected
from soup_nlp.data.pair import Pair
from soup_nlp.evaluate.metrics import DepthMetrics
from soup_nlp.evaluate.scoring import score_depths
from soup_nlp.geometry.full_size import Labels, grown_labels, plane_depth
from soup_nlp.geometry.soup import Reconstruction


@dataclass(frozen=True, eq=False)
class FullSize:
    """Depth at the size of the images, in the soup's length unit.

    Attributes:
        depth_ref: (H, W) z of the reference frame, NaN where unknown.
        depth_next: (H', W') z of the next frame, NaN where nothing lands.
        labels: (H, W) superpixel of every pixel of the reference frame.
        metrics: Score of `depth_ref`; None without truth.
    """

    depth_ref: FloatMap
    depth_next: FloatMap
    labels: Labels
    metrics: DepthMetrics | None = None

    def __repr__(self) -> str:
        (h, w), (h2, w2) = self.depth_ref.shape, self.depth_next.shape
        return f"FullSize(reference {w}x{h}, next {w2}x{h2})"


def full_size(full: Pair, small: Pair, result: Reconstruction, expected: Expected) -> FullSize:
    """Bring a reconstruction of a smaller pair to the pair's own size.

    Superpixels grow along the edges of the images; planes are evaluated at every pixel, in the next
    frame after their motions.
    """
    soup = result.soup
    labels = grown_labels(result.labels, small.image_ref, full.image_ref)
    depth_ref = plane_depth(labels, soup.n, soup.distance, full.K_ref)
    # X' = R X + t carries n . X + D = 0 to (R n) . X' + D - (R n) . t = 0
    turned = np.einsum("nij,nj->ni", soup.R, soup.n)
    moved = soup.distance - np.einsum("ni,ni->n", turned, soup.translation)
    source = result.source_next
    shown = np.where(source >= 0, result.labels.ravel()[source], -1).astype(np.int32)
    there = grown_labels(shown, small.image_next, full.image_next)
    depth_next = plane_depth(there, turned, moved, full.K_next)
    own = {"own": depth_ref.astype(np.float64)}
    scores = score_depths(full.truth, own, expected.scale, expected.cap)
    return FullSize(depth_ref, depth_next, labels, scores.get("own"))
