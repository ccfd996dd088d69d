"""What stands still in the image while the camera moves: found, apart from the scene, a guess."""

import numpy as np
import pytest
from helpers_start import squares

from soup_nlp.data.pair import Flow
from soup_nlp.geometry import camera, rotation
from soup_nlp.start.propose import propose
from soup_nlp.start.regions import FIXED
from soup_nlp.start.views import FlowFit, StartOptions

pytestmark = pytest.mark.slow

K = camera.intrinsics(150.0, 150.0, 80.0, 60.0)
H, W, TILE = 120, 160, 10
AHEAD, TURN = np.array([0.0, 0.0, 0.4]), np.array([0.0, 0.02, 0.0])


@pytest.fixture(scope="module")
def seg():
    return squares(H // TILE, W // TILE, TILE, neighbours=6)


def scene_flow(turn=TURN):
    """Flow of a camera above the ground, before blocks at 4 to 9 and a sky at 1000."""
    uv = camera.pixel_grid(H, W)
    ray = camera.rays(K, uv)
    block = np.kron(np.random.default_rng(1).random((H // 20, W // 20)), np.ones((20, 20)))
    depth = np.minimum(4.0 + 5.0 * block, 1.0 / np.maximum(ray[..., 1], 0.1))
    depth[:20] = 1000.0
    X = depth[..., None] * ray @ rotation.exp(turn).T + AHEAD
    return (camera.project(K, X) - uv).astype(np.float32)


def start_of(seg, flow):
    return propose(FlowFit.of(seg, Flow(flow), K, K, StartOptions()))


@pytest.fixture(scope="module")
def clean(seg):
    """The start of the scene alone."""
    return start_of(seg, scene_flow())


@pytest.mark.parametrize("where", [np.s_[40:70, 60:100], np.s_[90:, :], np.s_[:30, 120:]])
def test_a_still_region_before_a_moving_camera_is_fixed(seg, clean, where):
    flow, mask = scene_flow(), np.zeros((H, W), bool)
    mask[where] = True
    flow[mask] = 0.0
    start = start_of(seg, flow)
    at = start.origin == FIXED
    assert at[seg.labels][mask].mean() > 0.9
    assert at[seg.labels][~mask].mean() < 0.02
    np.testing.assert_array_equal(start.soup.t[at], 0.0)
    assert not set(start.component[at]) & set(start.component[~at])
    # other superpixels are as without the region
    ray = camera.rays(K, seg.anchors)
    log = np.log(start.soup.depth_at(ray) / clean.soup.depth_at(ray))[~at & ~clean.interpolated]
    assert np.median(np.abs(log - np.median(log))) < 0.02


@pytest.mark.parametrize("what", ["far region", "resting camera", "mover"])
def test_what_moves_or_is_far_is_not_fixed(seg, what):
    flow = scene_flow(np.zeros(3)) if what == "far region" else scene_flow()
    if what == "far region":
        assert np.linalg.norm(flow[:20], axis=2).max() < 0.1
    elif what == "resting camera":
        moving, flow = flow, np.zeros_like(flow)
        flow[30:90, 30:110] = moving[30:90, 30:110]
    else:
        flow[50:80, 50:100] = [3.0, -2.0]
    assert not (start_of(seg, flow).origin == FIXED).any()
