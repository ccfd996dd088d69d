"""Superpixels and graphs: connected, complete, and equal to brute force on small images."""

import itertools

import numpy as np
import pytest
from helpers_truth import assert_partition
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import ndimage

from soup_nlp.data.scenes.catalogue import render_scene
from soup_nlp.errors import DataError
from soup_nlp.geometry.graph import Segmentation, build_segmentation
from soup_nlp.geometry.superpixels import segment, split_components

FOUR = ((0, 1), (0, -1), (1, 0), (-1, 0))


@pytest.fixture(scope="module")
def image() -> np.ndarray:
    return render_scene("street", 0, 160, 120).image_ref


def noise(height: int, width: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


# --- superpixels -------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["slic", "grid"])
@pytest.mark.parametrize("count", [1, 2, 12, 60, 300])
def test_superpixels_are_connected_and_numbered(image, method, count):
    n = assert_partition(segment(image, count, method))
    # a grid has a whole number of rows and columns
    near = max(1, 0.03 * count) if method == "slic" else 0.15 * count
    assert abs(n - count) <= near


def test_an_image_of_one_colour_has_equal_cells():
    grey = np.full((48, 64, 3), 90, np.uint8)
    labels = segment(grey, 12, "grid")
    np.testing.assert_array_equal(segment(grey, 12, "slic"), labels)
    assert assert_partition(labels) == 12
    np.testing.assert_array_equal(np.bincount(labels.ravel()), np.full(12, 48 * 64 // 12))
    assert (labels[0, 0], labels[-1, -1]) == (0, 11)


@pytest.mark.parametrize("count", [0, -3, 10**6])
def test_a_count_that_does_not_fit_is_an_error(count):
    with pytest.raises(DataError, match=r"segmentation\.superpixels"):
        segment(noise(48, 64), count)


@given(hnp.arrays(np.int32, (8, 9), elements=st.integers(0, 3)), st.integers(1, 12))
def test_split_components_leaves_connected_pieces(labels, min_size):
    out = split_components(labels, min_size)
    assert_partition(out)
    if min_size == 1:
        # nothing is merged: exactly the components of the input
        for k in np.unique(out):
            assert len(np.unique(labels[out == k])) == 1
        expected = sum(ndimage.label(labels == k)[1] for k in np.unique(labels))
        assert out.max() + 1 == expected


@pytest.mark.parametrize("seed", [11, 923, 2041])
def test_filled_pieces_that_end_up_cut_off_become_their_own(seed):
    """In these images the nearest remaining piece does not touch all pixels that join it."""
    rng = np.random.default_rng(seed)
    labels = rng.integers(0, 2, (10, 12)).astype(np.int32)
    assert_partition(split_components(labels, int(rng.integers(2, 20))))


# --- graphs ------------------------------------------------------------------------------------


def test_anchors_and_sizes_by_hand():
    labels = np.zeros((2, 6), np.int32)
    labels[:, 4:] = 1
    seg = build_segmentation(labels, noise(2, 6), neighbours=1)
    np.testing.assert_allclose(seg.anchors, [[1.5, 0.5], [4.5, 0.5]])
    np.testing.assert_array_equal(seg.sizes, [8, 4])
    assert len(seg) == 2


@pytest.fixture(scope="module", params=["slic", "grid"])
def seg(request, image) -> Segmentation:
    return build_segmentation(segment(image, 60, request.param), image, neighbours=7)


def test_knn_is_brute_force_nearest_first_and_of_equal_distances_by_index(seg):
    far = ((seg.anchors[:, None] - seg.anchors) ** 2).sum(axis=2).round(6)
    np.fill_diagonal(far, np.inf)
    # a grid has ties
    np.testing.assert_array_equal(seg.knn, np.argsort(far, axis=1, kind="stable")[:, :7])


@pytest.mark.parametrize("beta", [0.02, 0.0, 0.3])
def test_edge_weight_is_equation_2(seg, image, beta, monkeypatch):
    if beta != 0.02:  # the paper's
        monkeypatch.setattr("soup_nlp.geometry.graph.BETA", beta)
    seg = build_segmentation(seg.labels, image, neighbours=7)
    i, k = seg.edges.T
    distance = np.linalg.norm(seg.anchors[i] - seg.anchors[k], axis=1)
    np.testing.assert_allclose(seg.edge_weight, seg.edge_multiplicity * np.exp(-beta * distance))


def brute_pairs(labels):
    """{(i, k): list of (pixel of i, pixel of k)} over 4-neighbours, i < k."""
    out = {}
    height, width = labels.shape
    for v, u in itertools.product(range(height), range(width)):
        for dv, du in ((0, 1), (1, 0)):
            b = v + dv, u + du
            if b[0] >= height or b[1] >= width or labels[v, u] == labels[b]:
                continue
            p, q = sorted([(v, u), b], key=lambda x: labels[x])
            out.setdefault((int(labels[p]), int(labels[q])), []).append((p, q))
    return out


def brute_w4(image, pixels, beta):
    """Eq. 5: over four neighbours, exp(-beta |I(X_b) - I(zeta_j)|_F), boundary pixels stacked."""
    colour = image / 255.0
    height, width = image.shape[:2]
    total = 0.0
    for dv, du in FOUR:
        gap = []
        for v, u in sorted(set(pixels)):
            w = min(max(v + dv, 0), height - 1), min(max(u + du, 0), width - 1)
            gap.append(colour[v, u] - colour[w])
        total += np.exp(-beta * np.linalg.norm(np.stack(gap)))
    return total


def small_labels(seed):
    rng = np.random.default_rng(seed)
    raw = np.repeat(np.repeat(rng.integers(0, 4, (4, 5)), 3, 0), 2, 1)
    return split_components(raw.astype(np.int32), 4)


@pytest.mark.parametrize("seed", range(4))
def test_shared_boundaries_and_w4_are_brute_force(seed, monkeypatch):
    monkeypatch.setattr("soup_nlp.geometry.graph.BETA_COLOUR", 0.7)
    labels, image = small_labels(seed), noise(12, 10, seed)
    expected = brute_pairs(labels)
    seg = build_segmentation(labels, image, neighbours=1, boundary_samples=None)
    pairs = [tuple(p) for p in seg.pairs.tolist()]
    assert sorted(pairs) == sorted(expected)
    for p, key in enumerate(pairs):
        contact = expected[key]
        assert seg.boundary_length[p] == len(contact)
        middles = {tuple((np.array(a) + b)[::-1] / 2) for a, b in contact}
        assert {tuple(x) for x in seg.boundary[p]} == middles
        w4 = brute_w4(image, [a for a, _ in contact], 0.7)
        w4 += brute_w4(image, [b for _, b in contact], 0.7)
        assert seg.pair_weight[p] == pytest.approx(w4, rel=1e-12)


@pytest.mark.parametrize("samples", [1, 3])
def test_boundary_samples_are_spread_over_the_shared_boundary(samples):
    labels = np.zeros((9, 10), np.int32)
    labels[:, 5:] = 1
    seg = build_segmentation(labels, noise(9, 10), neighbours=1, boundary_samples=samples)
    assert seg.boundary.shape == (1, samples, 2)
    np.testing.assert_allclose(seg.boundary[0, :, 0], 4.5)
    rows = {1: [4.0], 3: [1.0, 4.0, 7.0]}[samples]
    np.testing.assert_allclose(np.sort(seg.boundary[0, :, 1]), rows)


def test_rim_points_are_extreme_pixels_of_their_superpixel(seg):
    height, width = seg.labels.shape
    v, u = np.mgrid[0:height, 0:width]
    directions = seg.rim.shape[1]
    for i in range(len(seg)):
        inside = seg.labels == i
        for k in range(directions):
            angle = 2 * np.pi * k / directions
            ru, rv = seg.rim[i, k].astype(int)
            assert inside[rv, ru]
            reach = np.cos(angle) * u[inside] + np.sin(angle) * v[inside]
            assert np.cos(angle) * ru + np.sin(angle) * rv == pytest.approx(reach.max())


def test_k_must_be_below_the_number_of_superpixels():
    image = noise(48, 64)
    labels = segment(image, 12, "grid")
    for k in (0, 12, 40):
        with pytest.raises(DataError, match=r"segmentation\.neighbours"):
            build_segmentation(labels, image, neighbours=k)
    seg = build_segmentation(labels, image, neighbours=11)
    assert len(seg.edges) == 12 * 11 // 2
    np.testing.assert_array_equal(seg.edge_multiplicity, 2)


def test_one_superpixel_has_no_edges_and_no_pairs():
    seg = build_segmentation(np.zeros((8, 9), np.int32), noise(8, 9))
    assert len(seg) == 1
    assert len(seg.edges) == len(seg.pairs) == len(seg.boundary) == 0
    assert seg.knn.shape == (1, 0)
    np.testing.assert_allclose(seg.anchors, [[4.0, 3.5]])
    assert "1 superpixels" in str(seg)
