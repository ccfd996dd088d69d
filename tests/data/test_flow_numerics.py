"""Choice between flows and reweighting of a flow on constructed examples."""

from __future__ import annotations

import numpy as np
import pytest

from soup_nlp.data.flow import guided as flow_guided
from soup_nlp.data.flow.guided import guided_flow
from soup_nlp.data.flow.robust import fit_affine
from soup_nlp.data.pair import Flow


@pytest.mark.parametrize(("error", "taken"), [(0.2, False), (0.8, True)])
def test_a_guided_flow_must_be_better_by_a_margin(monkeypatch, error, taken):
    """Images without contrast: only the round trip counts, and that of the new flow is exact."""
    shape = (60, 80)
    grey = np.full(shape, 128, np.uint8)

    def constant(u: float) -> np.ndarray:
        return np.full((*shape, 2), (u, 0.0), np.float32)

    def match(a, b):
        return constant(0.1), constant(-0.1)

    monkeypatch.setattr(flow_guided, "dominant_homographies", lambda *a: [np.eye(3)])
    monkeypatch.setattr(flow_guided, "_MARGIN", 0.5)
    first, back = constant(0.0), constant(error)
    flow, gap = guided_flow(grey, grey, match, first, back, 1)
    inside = (slice(20, 40), slice(20, 60))
    np.testing.assert_allclose(flow[inside][..., 0], 0.1 if taken else 0.0, atol=1e-6)
    np.testing.assert_allclose(gap[inside], 0.0 if taken else error, atol=1e-4)


def test_where_all_pixels_scatter_none_of_them_is_suspected():
    """The spread of a superpixel is the scale if it exceeds the given one."""
    v, u = np.mgrid[0:40, 0:80].astype(float)
    labels = (u >= 40).astype(np.int32)
    uv = np.stack([0.1 * u, 0.05 * v], axis=-1)
    rng = np.random.default_rng(0)
    rough = (labels == 0)[..., None] * rng.normal(0, 2.0, uv.shape)
    lone = (labels == 1) & (rng.random(labels.shape) < 0.02)
    uv = uv + rough + np.where(lone, 2.0, 0.0)[..., None]
    flow = Flow(uv.astype(np.float32), np.ones(labels.shape, np.float32), "test")
    _, weight = fit_affine(flow, labels, 0.25)
    weight = weight.reshape(labels.shape)
    assert np.median(weight[labels == 0]) > 0.4
    assert weight[lone].max() < 0.1
    assert weight[(labels == 1) & ~lone].min() > 0.9
