"""Superpixel floor, true soup and unorganised baseline on constructed examples."""

from __future__ import annotations

import numpy as np
import pytest

from soup_nlp.bench.depth_maps import least_error_planes, plane_depth, points_as_map, unorganised
from soup_nlp.bench.truth import rescaled, true_soup
from soup_nlp.data.flow.sources import flow_from_truth
from soup_nlp.data.pair import Pair, Truth
from soup_nlp.data.scenes.catalogue import render_scene
from soup_nlp.errors import DataError
from soup_nlp.geometry.graph import build_segmentation
from soup_nlp.geometry.soup import reconstruct
from soup_nlp.geometry.superpixels import segment
from soup_nlp.model import oracle
from soup_nlp.model.energy_data import build_energy_data
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.reweighting import in_pixels

K = np.array([[100.0, 0, 32], [0, 100.0, 24], [0, 0, 1]])


def labelled_planes():
    """(48, 64) labels of two halves and the depth of a plane in each."""
    labels = np.zeros((48, 64), np.int32)
    labels[:, 32:] = 1
    m = np.array([[0.1, -0.05, 0.5], [-0.2, 0.1, 0.25]])
    return labels, m, plane_depth(m, labels, K)


def test_planes_come_back_and_outliers_do_not_pull_them():
    labels, m, depth = labelled_planes()
    np.testing.assert_allclose(least_error_planes(labels, depth, K), m, atol=1e-6)
    holes = depth.copy()
    holes[::2] = np.nan
    holes[1, :20] *= 7.0
    np.testing.assert_allclose(least_error_planes(labels, holes, K), m, atol=1e-3)
    # no plane is worse than the constant it may always choose
    rough = depth * np.exp(np.random.default_rng(0).normal(0, 0.5, depth.shape))
    fit = plane_depth(least_error_planes(labels, rough, K), labels, K)
    for i in (0, 1):
        z = rough[labels == i]
        constant = min(np.mean(np.abs(z - c) / z) for c in z)
        assert np.mean(np.abs(z - fit[labels == i]) / z) <= constant + 1e-12


def test_a_few_rows_of_sky_do_not_cost_the_plane():
    labels, _, depth = labelled_planes()
    sky = depth.copy()
    sky[:5] = 1e3
    fit = plane_depth(least_error_planes(labels, sky, K), labels, K)
    for i in (0, 1):
        own = labels == i
        true = np.mean(np.abs(sky - depth)[own] / sky[own])
        assert np.mean(np.abs(sky - fit)[own] / sky[own]) <= true + 1e-3


def test_planes_of_little_truth():
    labels, _, depth = labelled_planes()
    few = np.full(depth.shape, np.nan)
    few[3, 3] = 2.0
    m = least_error_planes(labels, few, K)
    assert m[0].tolist() == [0, 0, 0.5]
    assert np.isnan(m[1]).all()
    with pytest.raises(DataError, match="no true depth"):
        least_error_planes(labels, np.full(depth.shape, np.nan), K)
    with pytest.raises(DataError, match="differ in size"):
        least_error_planes(labels[1:], depth, K)
    sparse = points_as_map(np.array([[1.4, 2.6, 5.0], [99.0, 0.0, 1.0]]), (4, 4))
    assert sparse[3, 1] == 5.0
    assert np.isfinite(sparse).sum() == 1


@pytest.fixture(scope="module")
def street():
    pair = render_scene("street", 0, 256, 112)
    labels = segment(pair.image_ref, 150)
    return pair, build_segmentation(labels, pair.image_ref, 8)


def test_true_soup_is_the_truth_but_for_mixed_superpixels(street):
    pair, seg = street
    true = true_soup(pair, seg)
    rec = reconstruct(true.soup, seg.labels, pair.K_ref, pair.K_next)
    z, gt = rec.depth_ref, pair.truth.depth_ref
    z = z * np.median(gt / z)
    assert np.median(np.abs(z - gt) / gt) < 0.01
    pure = (true.purity == 1.0)[seg.labels]
    gap = np.linalg.norm(rec.flow - pair.truth.flow, axis=2)
    assert np.median(gap[pure]) < 0.1
    assert true.known.all()
    # its motions come out of the scene flow as well as from the components
    other = pair.truth.__class__(
        depth_ref=gt, components=pair.truth.components, scene_flow=pair.truth.scene_flow
    )
    again = true_soup(pair.__class__(**{**vars(pair), "truth": other}), seg)
    np.testing.assert_allclose(again.soup.R, true.soup.R, atol=1e-6)
    with pytest.raises(DataError, match="motions or scene flow"):
        true_soup(pair.__class__(**{**vars(pair), "truth": other.__class__(depth_ref=gt)}), seg)


def test_a_true_plane_seen_from_behind_somewhere_faces_the_camera():
    """The depth is known on the left only; further right the plane is behind the camera."""
    height, width = 24, 48
    u = np.arange(width) * np.ones((height, 1))
    labels = (u >= 24).astype(np.int32)
    inverse = np.where(u < 8, 0.5 - 0.05 * u, np.nan)
    depth = np.where(labels == 1, 2.0, 1 / inverse)
    black = np.zeros((height, width, 3), np.uint8)
    truth = Truth(
        depth_ref=depth, components=np.zeros((height, width), np.int32), motions=np.eye(4)[None]
    )
    pair = Pair(black, black, K, K, truth=truth)
    true = true_soup(pair, build_segmentation(labels, black, neighbours=1))
    assert true.known.all()
    np.testing.assert_allclose(np.abs(true.soup.n), np.tile([0, 0, 1.0], (2, 1)), atol=1e-9)
    ratio = true.soup.distance / true.soup.distance[1]
    assert ratio[0] == pytest.approx(1 / np.median(inverse[:, :8]) / 2.0, rel=1e-9)
    z = true.soup.depth_at(np.tile([(47 - 32) / 100, 0, 1.0], (2, 1)))
    assert (z > 0).all()


def test_the_truth_has_less_energy_than_a_shaken_truth(street):
    pair, seg = street
    data = build_energy_data(seg, flow_from_truth(pair), pair.K_ref, pair.K_next)
    soup = true_soup(pair, seg).soup
    data = in_pixels(data, soup, seg)
    own = oracle.energy(soup, data, Weights())["total"]
    rng = np.random.default_rng(0)
    shaken = soup.__class__(
        soup.lam * np.exp(rng.normal(0, 0.1, len(soup))), soup.n, soup.d, soup.R, soup.t
    )
    assert oracle.energy(shaken, data, Weights())["total"] > 1.5 * own


def test_unorganised_superpixels_have_translations_of_length_one(street):
    pair, seg = street
    soup = true_soup(pair, seg).soup
    alone = unorganised(soup)
    length = np.linalg.norm(alone.translation, axis=1)
    np.testing.assert_allclose(length, 1.0, atol=1e-9)
    # the flow of every superpixel stays
    H = soup.homographies(pair.K_ref, pair.K_next)
    np.testing.assert_allclose(alone.homographies(pair.K_ref, pair.K_next), H, atol=1e-9)


def test_components_are_rescaled_to_where_the_energy_likes_them(street):
    true = true_soup(*street)
    size = np.bincount(true.component)
    order = np.argsort(-size)
    assert (size[order[:3]] > 0).all()
    wanted = np.ones(len(size))
    wanted[order[1]], wanted[order[2]] = 2.0, 0.6
    target = np.log(wanted)[true.component]

    def energy(soup):
        """Deviation of log distances from the expected ones after one scale."""
        gap = np.log(soup.lam / true.soup.lam) - target
        return float(np.abs(gap - np.median(gap)).sum())

    gap = np.log(rescaled(true, energy).lam / true.soup.lam)
    gap -= gap[true.component == order[0]][0]
    # to half a step of the factors that are tried
    np.testing.assert_allclose(gap, target, atol=np.log(9) / 40 / 2 + 1e-12)
    # of what costs nothing the truth is left as it is
    assert rescaled(true, lambda soup: 0.0) is true.soup
