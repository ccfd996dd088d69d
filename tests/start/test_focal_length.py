"""A guessed focal length is corrected by the flow where the flow determines it."""

from dataclasses import replace

import numpy as np
import pytest

from soup_nlp.config.problem import make_problem
from soup_nlp.data.formats.cameras import GUESS_SIGMA
from soup_nlp.data.pair import Pair
from soup_nlp.geometry import rotation
from soup_nlp.pipeline import case
from soup_nlp.start.epipolar import Matches
from soup_nlp.start.focal_length import focal_length

FOCAL = 500.0


def correspondences(turn, shift, wrong, noise=0.05):
    """Rays of both frames with a focal length that is `wrong` times too long."""
    rng = np.random.default_rng(0)
    r = np.column_stack([rng.uniform(-0.6, 0.6, (800, 2)), np.ones(800)])
    X = rng.uniform(2, 6, 800)[:, None] * r @ rotation.exp(np.array(turn)).T + np.array(shift)
    q = X / X[:, 2:]
    q[:, :2] += noise / FOCAL * rng.standard_normal((800, 2))
    r, q = (v / [wrong, wrong, 1.0] for v in (r, q))
    return Matches(r, q, np.ones(800), FOCAL * wrong)


@pytest.mark.parametrize("wrong", [0.7, 1.25])
def test_a_turn_with_parallax_determines_the_focal_length(wrong):
    matched = correspondences((0.05, 0.1, 0.02), (0.4, 0.1, 0.2), wrong)
    factor, sigma = focal_length(matched, GUESS_SIGMA)
    assert abs(np.log(factor * wrong)) < 0.08
    assert sigma < 0.15


def test_a_shift_without_a_turn_keeps_the_focal_length():
    """A longer lens and as much deeper a scene have the same flow."""
    factor, sigma = focal_length(correspondences((0, 0, 0), (0.4, 0, 0), 1.25), GUESS_SIGMA)
    assert factor == pytest.approx(1.0, abs=0.05)
    assert sigma > 0.85 * GUESS_SIGMA


@pytest.mark.slow
def test_only_a_guess_is_corrected():
    scene = {"kind": "scene", "scene": "orbit", "width": 480, "height": 204}
    raw = {"input": scene, "flow": {"source": "truth"}, "segmentation": {"superpixels": 60}}
    problem = make_problem(raw)
    right = problem.load_pair()
    wrong = right.with_focal(1.3, 0.0)

    def observed(pair: Pair) -> Pair:
        return case._observed(problem, pair, None, lambda *_: None)[1]

    kept = observed(wrong)
    np.testing.assert_array_equal(kept.K_ref, wrong.K_ref)
    assert kept.focal_sigma == 0
    corrected = observed(replace(wrong, focal_sigma=GUESS_SIGMA))
    np.testing.assert_allclose(corrected.K_ref, right.K_ref, rtol=0.08)
    np.testing.assert_array_equal(corrected.K_ref[:2, 2], right.K_ref[:2, 2])
    assert corrected.focal_sigma < 0.15
