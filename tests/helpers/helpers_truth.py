"""Superpixels and truth of test pairs: partitions, components."""

import numpy as np
from scipy import ndimage

from soup_nlp.data.pair import Truth
from soup_nlp.geometry.graph import Segmentation


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
