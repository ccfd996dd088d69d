"""Nested dissection of the image: a permutation, separators that separate, the same solution."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import sparse
from scipy.spatial import cKDTree

from soup_nlp.solve import dissection
from soup_nlp.solve.dissection import dissected
from soup_nlp.solve.factor import cholmod, numbered

SIDE = 24


@pytest.fixture(scope="module")
def image():
    """Places of superpixels, a matrix that couples near ones, its triangle and the pattern."""
    rng = np.random.default_rng(0)
    grid = np.stack(np.meshgrid(*2 * [np.arange(SIDE)]), axis=-1).reshape(-1, 2)
    place = grid + rng.uniform(-0.3, 0.3, (SIDE**2, 2))
    far, near = (cKDTree(place).query_pairs(r, output_type="ndarray") for r in (2.5, 1.4))
    slope = dissection.KIND == 1
    all_, rest = np.ones((9, 9)), np.outer(~slope, ~slope)
    full = sparse.kron(sparse.identity(len(place)), all_)
    for pairs, block in ((far, rest), (near, all_)):
        own = sparse.coo_matrix((np.ones(len(pairs)), pairs.T), 2 * [len(place)])
        full = full + sparse.kron(own + own.T, block)
    full = full.tocsc()
    full.data = rng.uniform(-1, 1, full.nnz)
    full = full + full.T + 1000 * sparse.identity(9 * len(place))
    triangle = sparse.triu(full).tocsc()
    triangle.sort_indices()
    columns = np.repeat(np.arange(triangle.shape[1]), np.diff(triangle.indptr))
    return place, full, triangle.data, numbered(triangle.indices, columns, len(place) * 9)


def fill(full, order) -> int:
    """Nonzeros of the factor by rows of the elimination tree."""
    upper = sparse.triu(full[order][:, order]).tocsc()
    n = len(order)
    parent, mark, count = np.full(n, -1), np.full(n, -1), 0
    for k in range(n):
        mark[k] = k
        for i in upper.indices[upper.indptr[k] : upper.indptr[k + 1]]:
            while mark[i] != k:
                parent[i] = k if parent[i] < 0 else parent[i]
                mark[i], i, count = k, parent[i], count + 1
    return count + n


def test_it_is_a_permutation_with_less_fill(image):
    place, full, _, upper = image
    order = dissected(upper, place)
    np.testing.assert_array_equal(np.sort(order), np.arange(9 * len(place)))
    assert fill(full, order) < 0.9 * fill(full, np.arange(9 * len(place)))


def test_what_is_last_separates(image):
    place, full, _, _ = image
    graph = (abs(full[::9, ::9]) > 0).astype(np.int32).tocsr()
    weight = np.ones(len(place), np.int64)
    side = dissection._separated(graph, weight, dissection._halves(weight, place))
    left, right = (np.flatnonzero(side == s) for s in (-1, 1))
    assert graph[left][:, right].nnz == 0
    # superpixels reach over 2.5 columns
    assert SIDE < (side == 0).sum() <= 2.5 * SIDE
    assert min(len(left), len(right)) > 0.2 * len(place)


def test_the_solution_is_the_same(image):
    pytest.importorskip("cvxopt")
    place, full, nonzeros, upper = image
    b = np.random.default_rng(1).normal(size=9 * len(place))
    one, two = (
        cholmod(upper, order)(nonzeros)(b) for order in (None, lambda: dissected(upper, place))
    )
    np.testing.assert_allclose(one, two, rtol=0, atol=1e-12 * np.abs(one).max())
    np.testing.assert_allclose(full @ two, b, rtol=0, atol=1e-12)


def test_superpixels_at_one_place_that_all_touch_are_ordered_too():
    columns, rows = np.nonzero(np.tri(180, dtype=bool))
    order = dissected(numbered(rows, columns, 180), np.zeros((20, 2)))
    np.testing.assert_array_equal(np.sort(order), np.arange(180))
