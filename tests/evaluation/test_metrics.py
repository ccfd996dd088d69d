"""Errors of depth and components, all by hand."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from soup_nlp.errors import DataError
from soup_nlp.evaluation import recompute
from soup_nlp.evaluation.metrics import UNSCALED, Convention, depth_metrics, sample_at_points, skill

depths = arrays(np.float64, 12, elements=st.floats(0.1, 100.0))
quick = settings(max_examples=20)


def test_hand_values():
    m = depth_metrics([1.0, 3.0], [2.0, 2.0], UNSCALED)
    assert m.mre == pytest.approx(0.5)
    assert m.median_relative == pytest.approx(0.5)
    assert m.sq_rel == pytest.approx(0.5)
    assert m.rmse == pytest.approx(1.0)
    assert m.log_rmse == pytest.approx(np.sqrt((np.log(2) ** 2 + np.log(1.5) ** 2) / 2))
    assert (m.delta1, m.delta2, m.delta3) == (0.0, 0.5, 0.5)  # ratios 2 and 1.5
    assert (m.scale, m.scale_rule, m.cap, m.coverage, m.n_pixels) == (1.0, "none", None, 1.0, 2)


@pytest.mark.parametrize(
    ("rule", "scale"),
    [
        ("none", 1.0),
        ("median", 2.0),  # ratios 4, 2, 1
        ("mre", 1.0),  # weights 1/4, 1/2, 1
        ("lsq", (4 + 32 + 256) / (1 + 16 + 256)),
    ],
)
def test_scale_rules(rule, scale):
    z, gt = np.array([1.0, 4.0, 16.0]), np.array([4.0, 8.0, 16.0])
    assert depth_metrics(z, gt, Convention(scale=rule)).scale == pytest.approx(scale)
    # the check has the rules once more
    assert recompute.scores(z, gt, rule, None)["scale"] == pytest.approx(scale, rel=1e-12)


def test_coverage_and_cap():
    truth = np.array([[1.0, 2.0, np.nan], [4.0, 100.0, 0.0]])
    estimate = np.array([[1.0, np.nan, 5.0], [4.0, 100.0, 1.0]])
    m = depth_metrics(estimate, truth)
    assert (m.n_pixels, m.coverage) == (3, 0.75)
    m = depth_metrics(estimate, truth, Convention(cap=4.0))
    assert (m.n_pixels, m.coverage, m.cap) == (2, pytest.approx(2 / 3), 4.0)
    m = depth_metrics(estimate, np.where(truth == 2.0, truth, np.nan))
    assert (m.n_pixels, m.coverage) == (0, 0.0)
    assert np.isnan(m.mre)
    capped = Convention(cap=70.0)
    assert capped.mask([70.0, np.nextafter(70.0, 71.0), 0.0]).tolist() == [1, 0, 0]
    assert not capped.counts(np.full((2, 2), 71.0))


def test_negative_and_infinite_estimates_cost_coverage_not_error():
    m = depth_metrics([1.0, -1.0, 0.0, np.inf], [1.0, 1.0, 1.0, 1.0])
    assert (m.mre, m.coverage) == (0.0, 0.25)


def test_metrics_and_check_agree_at_the_delta_thresholds():
    """The check of a result folder recounts the shares: both must agree at the thresholds."""
    truth = np.arange(1.0, 200.0)
    for k in (1, 2, 3):
        for z in (truth * 1.25**k, truth / 1.25**k):
            m, recomputed = (
                depth_metrics(z, truth, UNSCALED),
                recompute.scores(z, truth, "none", None),
            )
            assert [m.delta1, m.delta2, m.delta3] == [recomputed[f"delta{j}"] for j in (1, 2, 3)]
    exact = [1.25, 1.25**2, 1.25**3]
    m = depth_metrics(exact, np.ones(3), UNSCALED)
    assert [m.delta1, m.delta2, m.delta3] == [0.0, 1 / 3, 2 / 3]


@quick
@given(depths, depths, st.floats(1e-2, 1e2), st.floats(-1, 1))
def test_scale_and_shift_have_the_least_squares(z, gt, factor, shift):
    m = depth_metrics(z, gt, Convention(scale="affine"))
    assert m.rmse <= depth_metrics(z, gt, Convention(scale="lsq")).rmse * (1 + 1e-6) + 1e-9
    moved = factor * (z + (shift - 0.1) * z.min() / 2)
    if np.ptp(z) > 0.01 * z.max() and (moved > 0).all():
        assert depth_metrics(moved, gt, Convention(scale="affine")).mre == pytest.approx(m.mre)
    exact = depth_metrics(2 * gt + 3, gt, Convention(scale="affine"))
    if np.ptp(gt) > 0.01 * gt.max():
        assert (exact.scale, exact.shift) == (pytest.approx(0.5), pytest.approx(-1.5))


def test_constant_depth_and_skill():
    truth = np.array([[1.0, 2.0], [4.0, np.nan]])
    m = depth_metrics(np.ones(truth.shape), truth)
    assert m.scale == 2.0
    assert m.mre == pytest.approx((1 + 0 + 0.5) / 3)
    assert skill(0.25, 0.5) == 0.5
    assert skill(0.0, 0.5) == 1.0
    assert skill(1.0, 0.5) == -1.0
    assert np.isnan(skill(0.1, 0.0))
    assert np.isnan(skill(float("nan"), 0.5))


def test_sampling_takes_the_nearest_pixel():
    depth = np.arange(6.0).reshape(2, 3)
    points = [[0.4, 0.0, 9.0], [0.6, 0.6, 8.0], [2.49, 1.0, 7.0], [2.5, 0, 6.0], [-0.6, 0, 5.0]]
    estimate, truth = sample_at_points(depth, [*points, [np.nan, 0, 4.0]])
    np.testing.assert_array_equal(estimate, [0, 4, 5, np.nan, np.nan, np.nan])
    np.testing.assert_array_equal(truth, [9, 8, 7, 6, 5, 4])


@pytest.mark.parametrize(
    ("score", "words"),
    [
        (lambda: depth_metrics([1.0], [1.0, 2.0]), "differ in shape"),
        (lambda: depth_metrics([1.0], [np.nan]), "no pixel"),
        (lambda: depth_metrics([1.0], [1.0], Convention(cap=0.5)), "no pixel"),
        (lambda: Convention(scale="mean"), "unknown scale rule"),
        (lambda: Convention(cap=0.0), "must be positive"),
        (lambda: Convention(cap=float("nan")), "must be positive"),
    ],
)
def test_bad_input(score, words):
    with pytest.raises(DataError, match=words):
        score()
