"""Superpixel borders move to flow discontinuities, and nothing else changes."""

import numpy as np
import pytest
from helpers_truth import assert_partition, majority

from soup_nlp.config.problem import make_problem
from soup_nlp.data.flow.borders import AffineFlow, follow_depth, follow_flow
from soup_nlp.data.flow.sources import flow_from_truth
from soup_nlp.data.pair import Flow
from soup_nlp.data.scenes.catalogue import render_scene
from soup_nlp.geometry.graph import build_segmentation
from soup_nlp.geometry.superpixels import segment
from soup_nlp.pipeline.case import superpixels

HEIGHT, WIDTH, EDGE = 48, 64, 26
"""EDGE is inside a column of cells of 8 pixels."""


def two_motions(jump: float = 3.0, noise: float = 0.0) -> Flow:
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(float)
    uv = np.stack([0.02 * u - 1, 0.01 * v + 0.5], axis=-1)
    uv[:, EDGE:, 0] += jump
    uv += np.random.default_rng(2).normal(0, noise, uv.shape)
    return Flow(uv.astype(np.float32), np.ones((HEIGHT, WIDTH), np.float32), "two motions")


def grid() -> np.ndarray:
    return segment(np.zeros((HEIGHT, WIDTH, 3), np.uint8), 48, "grid")


def mixed(labels: np.ndarray) -> int:
    """Superpixels with pixels on both sides."""
    return len(np.intersect1d(labels[:, :EDGE], labels[:, EDGE:]))


@pytest.mark.parametrize("noise", [0.0, 0.2])
def test_only_borders_at_the_discontinuity_move(noise):
    before = grid()
    assert mixed(before) == 6
    after = follow_flow(before, two_motions(noise=noise))
    assert mixed(after) == 0
    assert assert_partition(after) == 48
    for side in (np.s_[:, :16], np.s_[:, 40:]):
        pairs = np.unique([before[side].ravel(), after[side].ravel()], axis=1)
        # the same pieces, whatever their numbers
        assert pairs.shape[1] == len(np.unique(before[side])) == len(np.unique(after[side]))


@pytest.mark.parametrize(("step", "split"), [(0.2, 0), (0.03, 6)])
def test_borders_move_to_a_known_step_of_depth(step, split):
    before = grid()
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    depth = 0.002 * u + 0.001 * v + step * (u >= EDGE)
    after = follow_depth(before, depth)
    assert mixed(after) == split
    assert assert_partition(after) == 48
    depth[: HEIGHT // 2] = np.nan
    below = follow_depth(before, depth)
    np.testing.assert_array_equal(below[: HEIGHT // 2], before[: HEIGHT // 2])
    assert mixed(below[HEIGHT // 2 :]) == split // 2


@pytest.mark.parametrize(("jump", "margin"), [(0.0, 1.0), (0.9, 1.0), (3.0, 3.1)])
def test_borders_stay_where_the_residual_hardly_falls(jump, margin):
    np.testing.assert_array_equal(follow_flow(grid(), two_motions(jump), margin), grid())


def test_pixels_without_confidence_stay():
    flow = two_motions()
    flow.confidence[:24] = 0
    after = follow_flow(grid(), flow)
    np.testing.assert_array_equal(after[:24], grid()[:24])
    assert mixed(after[24:]) == 0


def test_a_superpixel_without_flow_attracts_nothing():
    before, flow = grid(), two_motions(0.0)
    # the coefficients of a superpixel without flow are 0, like the flow of the pixels around it
    flow.uv[:] = 0
    hole = before == before[20, 20]
    flow.confidence[hole] = 0
    flow.uv[hole] = 50
    np.testing.assert_array_equal(follow_flow(before, flow), before)
    fit = AffineFlow(flow, before)
    assert not fit.fitted[before[20, 20]]
    assert fit.fitted.sum() == 47
    assert len(fit.weight) == (~hole).sum()


def test_scattered_pixels_are_no_outliers():
    """The spread of a superpixel is the scale of its weights if it exceeds `SCALE_PX`."""
    v, u = np.mgrid[0:40, 0:80].astype(float)
    labels = (u >= 40).astype(np.int32)
    uv = np.stack([0.1 * u, 0.05 * v], axis=-1)
    rng = np.random.default_rng(0)
    rough = (labels == 0)[..., None] * rng.normal(0, 2.0, uv.shape)
    lone = (labels == 1) & (rng.random(labels.shape) < 0.02)
    uv = uv + rough + np.where(lone, 2.0, 0.0)[..., None]
    flow = Flow(uv.astype(np.float32), np.ones(labels.shape, np.float32), "test")
    weight = AffineFlow(flow, labels).weight.reshape(labels.shape)
    assert np.median(weight[labels == 0]) > 0.4
    assert weight[lone].max() < 0.1
    assert weight[(labels == 1) & ~lone].min() > 0.9


MEMORY = {"input": {"kind": "memory", "hash": "0"}}


@pytest.mark.slow
def test_following_the_flow_leaves_fewer_mixed_superpixels():
    """Superpixels of two components; the ratio is 0.35, as SLIC mixes few at the wanted number."""
    pair = render_scene("orbit", 3, 384, 164)
    pair = pair.with_flow(flow_from_truth(pair))
    share = {}
    for margin in (1.0, None):
        cut = {"superpixels": 300, "follow_flow_px": margin}
        labels = superpixels(make_problem({**MEMORY, "segmentation": cut}), pair)
        purity = majority(pair.truth, build_segmentation(labels, pair.image_ref))[1]
        share[margin] = float((purity < 0.95).mean())
    np.testing.assert_array_equal(labels, segment(pair.image_ref, 300))
    assert share[1.0] < 0.5 * share[None]
