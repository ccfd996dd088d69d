"""Evidence for depth: residuals of a turn, of a constant depth, and of the answer."""

from dataclasses import replace

import numpy as np
import pytest

from soup_nlp.evaluate.evidence import LEAST_GAP_PX, evidence
from soup_nlp.geometry import rotation
from soup_nlp.geometry.camera import project, rays
from soup_nlp.geometry.soup import Soup
from soup_nlp.start.bending import ANY_TURN, PLAIN_TURN, fit_robustly, turned

NOISE = 0.05


def scene(case, depth: float, t: tuple[float, float, float], turn: float = 0.02, far: float = 1):
    """A soup of planes that face the camera, and the data with exactly its flow.

    `depth` is the standard deviation of log depth; every other plane is `far` times as far.
    """
    n = len(case.data)
    lam = np.exp(depth * np.random.default_rng(0).standard_normal(n))
    lam[::2] *= far
    R = rotation.exp(np.array([0.3 * turn, turn, 0.1 * turn]))
    soup = Soup(
        lam,
        np.tile([0.0, 0.0, -1.0], (n, 1)),
        np.ones(n),
        np.tile(R, (n, 1, 1)),
        np.array(t) / lam[:, None],
    )
    target = project(case.data.K_next, soup.moved(soup.points(case.data.pixel_ray)))
    weight = np.full_like(case.data.pixel_weight, 1 / case.data.pixel_weight.shape[1])
    return soup, replace(case.data, pixel_target=target, pixel_weight=weight)


def evidence_of(case, *args, **options):
    soup, data = scene(case, *args, **options)
    return evidence(soup, data, np.zeros(len(soup), np.int64), NOISE)


def test_parallax_of_a_scene_with_relief_is_evidence(small_room):
    result = evidence_of(small_room, 0.4, (0.3, 0.0, 0.1))
    assert result.solution[0] < 1e-9
    assert result.gap[0] > LEAST_GAP_PX
    assert not result.guess[0]
    assert np.median(result.sigma) < 0.1


@pytest.mark.parametrize(("depth", "t"), [(0.4, (0.0, 0.0, 0.0)), (0.0, (0.3, 0.0, 0.1))])
def test_a_turn_and_a_constant_depth_are_no_evidence(small_room, depth, t):
    result = evidence_of(small_room, depth, t)
    assert result.gap[0] < 0.02
    assert result.guess[0]


def test_a_turn_is_no_evidence_with_a_wrong_focal_length(small_room):
    soup, data = scene(small_room, 0.4, (0.0, 0.0, 0.0), turn=0.05)
    K = data.K_next.copy()
    K[:2, :2] *= 1.3
    ray = data.pixel_ray / np.array([1.3, 1.3, 1.0])
    result = evidence(
        soup, replace(data, K_next=K, pixel_ray=ray), np.zeros(len(soup), np.int64), NOISE
    )
    assert result.turn[0] < 0.02
    assert result.guess[0]


def test_a_turn_explains_a_stabilised_flow_with_all_parameters_only(small_room):
    _, data = scene(small_room, 0.4, (0.0, 0.0, 0.0), turn=0.1)
    # stabilisation moves the next image back, and crops it
    target = 1.03 * data.pixel_target - 0.08 * data.K_next[0, 0]
    ray, seen = (v.reshape(-1, 3) for v in (data.pixel_ray, rays(data.K_next, target)))
    scale = np.tile(np.diag(data.K_next)[:2], (len(ray), 1))

    def error(size: int) -> float:
        miss = fit_robustly(turned, size, ray, seen[:, :2], scale)[1]
        return float(np.mean(np.abs(miss)))

    assert error(PLAIN_TURN) > 0.3
    assert error(ANY_TURN) < 0.02


def test_less_parallax_leaves_more_open(small_room):
    near, far = (np.median(evidence_of(small_room, 0.3, (x, 0.0, 0.0)).sigma) for x in (0.3, 0.06))
    assert far > 3 * near


def test_a_far_background_leaves_no_more_open_before_it(small_room):
    """The depth of the sky relative to the foreground is open, the foreground's relief is not."""
    before, after = (
        evidence_of(small_room, 0.3, (0.3, 0.0, 0.1), far=far).sigma for far in (1, 1e4)
    )
    assert np.median(before[1::2]) < np.median(after[1::2]) < 0.02
    assert after[::2].min() > 0.4


def test_what_motion_leaves_open_is_that_of_refitted_motions(small_room):
    """The linear prediction agrees with depths that follow a changed motion."""
    soup, data = scene(small_room, 0.3, (0.3, 0.0, 0.1))
    result = evidence(soup, data, np.zeros(len(soup), np.int64), NOISE)
    # a turn about y that changes the flow by at most the systematic error
    error = 0.5 * NOISE
    w = np.array([0.0, error / data.K_next[0, 0], 0.0])
    X = np.einsum("nij,nj->ni", rotation.exp(w) @ soup.R, data.anchor_ray)
    q = project(data.K_next, soup.moved(soup.points(data.anchor_ray)))
    r = (q - data.K_next[:2, 2]) / np.diag(data.K_next)[:2]
    t = soup.translation
    a = X[:, :2] - r * X[:, 2:]
    b = t[:, :2] - r * t[:, 2:]
    z = -np.sum(a * b, axis=1) / np.sum(a * a, axis=1)
    change = np.log(z / soup.depth_at(data.anchor_ray))
    change -= change.mean()
    # the systematic error does not exclude this change
    assert np.sqrt(np.mean(change**2)) < 3 * np.sqrt(np.mean(result.sigma**2))


def test_the_uncertain_focal_length_counts_in_squares(small_room):
    soup, data = scene(small_room, 0.3, (0.3, 0.0, 0.1))
    component = np.zeros(len(soup), np.int64)
    exact, uncertain, doubled = (
        evidence(soup, data, component, NOISE, x).sigma for x in (0.0, 0.2, 0.4)
    )
    np.testing.assert_array_equal(exact, evidence(soup, data, component, NOISE).sigma)
    assert np.median(uncertain) > 1.5 * np.median(exact)
    np.testing.assert_allclose(doubled**2 - exact**2, 4 * (uncertain**2 - exact**2), rtol=1e-9)


def test_a_component_without_flow_is_a_guess(small_room):
    soup, data = scene(small_room, 0.4, (0.3, 0.0, 0.1))
    component = (np.arange(len(soup)) >= len(soup) - 5).astype(np.int64)
    weight = np.where(component[:, None] == 1, 0.0, data.pixel_weight)
    result = evidence(soup, replace(data, pixel_weight=weight), component, NOISE)
    assert result.guess.tolist() == [False, True]
    assert result.rows()[1]["turn_px"] is None
    assert np.isinf(result.sigma[component == 1]).all()
