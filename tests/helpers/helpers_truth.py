"""Superpixels and truth of test pairs: partitions, components, pairs without margins."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import ndimage

from soup_nlp.data.pair import Pair, Truth
from soup_nlp.geometry.graph import Segmentation

IMAGES = ("depth_ref", "depth_next", "flow", "occluded", "components", "scene_flow")


def assert_partition(labels: np.ndarray) -> int:
    """Labels are 0..N-1 and each is one 4-connected piece; returns N."""
    assert labels.dtype == np.int32
    n = int(labels.max()) + 1
    np.testing.assert_array_equal(np.unique(labels), np.arange(n))
    for k in range(n):
        assert ndimage.label(labels == k)[1] == 1, f"superpixel {k} is not connected"
    return n


def majority(truth: Truth, seg: Segmentation) -> tuple[np.ndarray, np.ndarray]:
    """(N,) component of most pixels of every superpixel, and their share of its pixels."""
    top = int(truth.components.max()) + 2
    flat = seg.labels.ravel().astype(np.int64) * top + truth.components.ravel() + 1
    votes = np.bincount(flat, minlength=len(seg) * top).reshape(len(seg), top)[:, 1:]
    return votes.argmax(axis=1), votes.max(axis=1) / np.maximum(votes.sum(axis=1), 1)


def cropped(pair: Pair, left: int, top: int, right: int, bottom: int) -> Pair:
    """The pair without margins (pixels); depths and motions do not change."""

    def cut(array: np.ndarray) -> np.ndarray:
        return array[top : len(array) - bottom, left : array.shape[1] - right].copy()

    flow, truth = pair.flow, pair.truth
    if flow is not None:
        flow = replace(flow, uv=cut(flow.uv), confidence=cut(flow.confidence))
    maps = {name: getattr(truth, name) for name in IMAGES}
    truth = replace(truth, **{k: cut(v) for k, v in maps.items() if v is not None})
    cameras = {"K_ref": pair.K_ref.copy(), "K_next": pair.K_next.copy()}
    for K in cameras.values():
        K[:2, 2] -= [left, top]
    images = {"image_ref": cut(pair.image_ref), "image_next": cut(pair.image_next)}
    return replace(pair, **images, **cameras, flow=flow, truth=truth)
