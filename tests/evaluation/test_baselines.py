from dataclasses import replace

import numpy as np
import pytest

from soup_nlp.data.flow.sources import flow_from_truth
from soup_nlp.data.pair import Flow, Pair
from soup_nlp.data.scenes.catalogue import render_scene
from soup_nlp.evaluation.metrics import depth_metrics
from soup_nlp.evaluation.scoring import FAR, rigid_depth
from soup_nlp.geometry import rotation

K = np.array([[90.0, 0, 41.0], [0, 92.0, 28.0], [0, 0, 1]])


@pytest.fixture(scope="module")
def orbit() -> Pair:
    pair = render_scene("orbit", width=256, height=109)
    return pair.with_flow(flow_from_truth(pair))


def made(K_next, turn=(0.01, -0.04, 0.02), shift=(0.3, 0.05, 0.1)):
    """A wavy surface in front of two cameras, with its exact flow; (pair, depth, R, t)."""
    v, u = np.mgrid[:60, :80].astype(float)
    z = 4 + np.sin(u / 9) + 0.5 * np.cos(v / 7)
    X = z[..., None] * (np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T)
    R, t = rotation.exp(np.array(turn)), np.array(shift)
    x = (X @ R.T + t) @ K_next.T
    image = np.zeros((60, 80, 3), np.uint8)
    return (
        Pair(image, image, K, K_next, Flow(x[..., :2] / x[..., 2:] - np.stack([u, v], -1))),
        z,
        R,
        t,
    )


@pytest.mark.parametrize("camera", [(90, 110, 0, 72, 28), (140, 120, 1.5, 30, 35)])
def test_exact_flow_gives_exact_depth_whatever_the_second_camera(camera):
    fx, fy, skew, cx, cy = camera
    K_next = np.array([[fx, skew, cx], [0, fy, cy], [0, 0, 1.0]])
    pair, z, _, t = made(K_next)
    np.testing.assert_allclose(rigid_depth(pair) * np.linalg.norm(t), z, rtol=1e-6)


def test_depth_without_parallax_is_unknown():
    """Pixels with the flow of a point at infinity have no depth."""
    pair, z, R, t = made(K)
    v, u = np.mgrid[:60, :80]
    far = np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(pair.K_ref).T * 10 * FAR * 4
    x = (far @ R.T + t) @ pair.K_next.T
    uv = pair.flow.uv.copy()
    uv[:10] = (x[..., :2] / x[..., 2:] - np.stack([u, v], -1))[:10]
    depth = rigid_depth(pair.with_flow(Flow(uv, pair.flow.confidence)))
    assert np.isnan(depth[:10]).all()
    np.testing.assert_allclose(depth[10:] * np.linalg.norm(t), z[10:], rtol=1e-6)
    assert np.isfinite(depth).mean() == pytest.approx(50 / 60)


def test_flow_without_confidence_is_ignored(orbit):
    rng = np.random.default_rng(0)
    uv, confidence = orbit.flow.uv.copy(), orbit.flow.confidence.copy()
    bad = rng.random(confidence.shape) < 0.6
    uv[bad] = rng.uniform(-30, 30, (int(bad.sum()), 2))
    confidence[bad] = 0.0
    uv[0, 0], confidence[0, 0] = np.nan, 0.0
    bad[0, 0] = True
    depth = rigid_depth(orbit.with_flow(Flow(uv, confidence)))
    np.testing.assert_array_equal(np.isnan(depth), bad)
    assert np.isfinite(depth).mean() == pytest.approx(1 - bad.mean())
    assert depth_metrics(depth, orbit.truth.depth_ref).mre < 1e-4


def test_points_behind_a_camera_are_unknown():
    pair, *_ = made(K, turn=(0.0, 0.0, 0.0), shift=(0.3, 0.0, 0.0))
    uv = pair.flow.uv.copy()
    uv[20:40, 20:40] *= -1
    behind = np.zeros(pair.size, bool)
    behind[20:40, 20:40] = True
    depth = rigid_depth(pair.with_flow(Flow(uv, pair.flow.confidence)))
    np.testing.assert_array_equal(np.isnan(depth), behind)
    assert np.isfinite(depth).mean() == pytest.approx(1 - behind.mean())


def test_without_flow_or_motion_there_is_no_baseline(orbit, monkeypatch):
    assert rigid_depth(replace(orbit, flow=None)) is None
    unsure = Flow(orbit.flow.uv, np.zeros_like(orbit.flow.confidence))
    assert rigid_depth(orbit.with_flow(unsure)) is None
    still = Flow(np.zeros_like(orbit.flow.uv), np.ones_like(orbit.flow.confidence))
    depth = rigid_depth(orbit.with_flow(still))
    assert depth is None or depth.shape == orbit.size
    monkeypatch.setattr("soup_nlp.start.epipolar.estimate", lambda *_: None)
    assert rigid_depth(orbit) is None


def test_confidence_weighs_the_motion(orbit):
    """A moving half of low confidence does not determine the motion."""
    uv, confidence = orbit.flow.uv.copy(), orbit.flow.confidence.copy()
    uv[:, :150] += np.linspace(3, 9, 150)[None, :, None]
    confidence[:, :150] = 0.02
    depth = rigid_depth(orbit.with_flow(Flow(uv, confidence)))
    right = depth_metrics(depth[:, 150:], orbit.truth.depth_ref[:, 150:])
    assert right.mre < 0.01


@pytest.mark.slow
def test_dynamic_scene_is_not_rigid():
    pair = render_scene("street", width=256, height=109)
    depth = rigid_depth(pair.with_flow(flow_from_truth(pair)))
    m = depth_metrics(depth, pair.truth.depth_ref)
    at_rest = np.where(pair.truth.components == 0, pair.truth.depth_ref, np.nan)
    static = depth_metrics(depth, at_rest)
    assert static.mre < m.mre < 0.05
