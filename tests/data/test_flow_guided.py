"""Flow under dominant homographies: large displacements with a change of scale are found."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from test_flow import texture

from soup_nlp.data.flow import dis
from soup_nlp.data.flow.consistency import confidence_of
from soup_nlp.data.flow.dis import dominant_homographies, guided_flow

HEIGHT, WIDTH = 200, 360
# the road of a driving camera: what is far down comes nearer fast
ROAD = np.array([[1.0, 0.12, -20.0], [0.0, 1.28, -10.0], [0.0, 1.4e-3, 1.0]])


def truth(H: np.ndarray) -> np.ndarray:
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH].astype(float)
    p = np.stack([u, v, np.ones_like(u)], axis=-1) @ H.T
    return p[..., :2] / p[..., 2:] - np.stack([u, v], axis=-1)


def images(H: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    first = np.ascontiguousarray(np.dstack([texture(HEIGHT, WIDTH, seed=2)] * 3))
    return first, cv2.warpPerspective(first, H, (WIDTH, HEIGHT), borderMode=cv2.BORDER_REFLECT)


def test_homographies_are_recovered_one_after_the_other():
    left = np.arange(WIDTH) < WIDTH // 3
    shift = np.array([[1.0, 0, 3], [0, 1, -2], [0, 0, 1]])
    flow = np.where(left[None, :, None], truth(shift), truth(ROAD)).astype(np.float32)
    found = dominant_homographies(flow, np.ones((HEIGHT, WIDTH), np.float32), 4)
    assert len(found) == 2
    for H, true in zip(found, (ROAD, shift)):
        np.testing.assert_allclose(H / H[2, 2], true, atol=1e-3, rtol=1e-3)
    assert dominant_homographies(flow, np.zeros((HEIGHT, WIDTH), np.float32), 4) == []
    assert len(dominant_homographies(flow, np.ones((HEIGHT, WIDTH), np.float32), 1)) == 1


def test_a_first_flow_that_is_half_wrong_is_completed():
    """The first flow is right on the left only; under its homography it is right everywhere."""
    first, second = images(ROAD)
    true = truth(ROAD)
    ref, nxt = first[..., 0], second[..., 0]
    known = np.arange(WIDTH)[None, :] < WIDTH // 2
    forward = np.where(known[..., None], true, 0.0).astype(np.float32)
    backward = np.full((HEIGHT, WIDTH, 2), 50.0, np.float32)
    back = truth(np.linalg.inv(ROAD))
    backward[:, : WIDTH // 2] = back[:, : WIDTH // 2]

    def match(a, b):
        dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
        dis.setFinestScale(0)
        return dis.calc(a, b, None), dis.calc(b, a, None)

    flow, gap = guided_flow(ref, nxt, match, forward, backward, 2)
    at = np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), axis=-1) + true
    inside = ((at > 8) & (at < [WIDTH - 9, HEIGHT - 9])).all(axis=-1)
    right = inside & ~known
    right[:, : WIDTH // 2 + 20] = False
    assert right.sum() > 3000
    error = np.linalg.norm(flow - true, axis=-1)
    assert np.median(error[right]) < 0.2
    assert np.median(confidence_of(gap)[right]) > 0.8
    # pixels whose target is outside the next image are never certain
    outside = ((at < -0.5) | (at > [WIDTH - 0.5, HEIGHT - 0.5])).any(axis=-1)
    assert outside.any()
    assert confidence_of(gap)[outside & ~known].max(initial=0.0) < 0.5
    # no homography: the first flow as it is
    same, _ = guided_flow(ref, nxt, match, forward, backward, 0)
    np.testing.assert_array_equal(same, forward)


@pytest.mark.parametrize("planes", [0, 4])
def test_flow_with_and_without_homographies(planes, monkeypatch):
    monkeypatch.setattr(dis, "PLANES", planes)
    first, second = images(ROAD)
    flow = dis.dis_flow(first, second)
    assert np.isfinite(flow.uv).all()
    sure = flow.confidence > 0.5
    assert sure.mean() > 0.3
    assert np.median(np.linalg.norm(flow.uv - truth(ROAD), axis=-1)[sure]) < 0.3


@pytest.mark.parametrize(("error", "taken"), [(0.2, False), (0.8, True)])
def test_a_guided_flow_must_be_better_by_a_margin(monkeypatch, error, taken):
    """Images without contrast: only the round trip counts, and that of the new flow is exact."""
    shape = (60, 80)
    grey = np.full(shape, 128, np.uint8)

    def constant(u: float) -> np.ndarray:
        return np.full((*shape, 2), (u, 0.0), np.float32)

    def match(a, b):
        return constant(0.1), constant(-0.1)

    monkeypatch.setattr(dis, "dominant_homographies", lambda *a: [np.eye(3)])
    monkeypatch.setattr(dis, "_MARGIN", 0.5)
    first, back = constant(0.0), constant(error)
    flow, gap = guided_flow(grey, grey, match, first, back, 1)
    inside = (slice(20, 40), slice(20, 60))
    np.testing.assert_allclose(flow[inside][..., 0], 0.1 if taken else 0.0, atol=1e-6)
    np.testing.assert_allclose(gap[inside], 0.0 if taken else error, atol=1e-4)
