"""Seeing through a layer that stands still before a moving scene: other flow, other images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from soup_nlp.data.flow.layers import corrected, still, without_still_layer
from soup_nlp.data.pair import Pair
from soup_nlp.geometry.camera import rays
from soup_nlp.start.epipolar import repeated

LEAST_SHARE = 0.003
"""Share of the pixels that must stand still for a layer to be looked for."""
LEAST_FLOW = 2.0
"""Median displacement, pixels, below which the camera may be at rest."""
PIXELS = 6000
"""The motion of what moves is fitted to so many."""


def see_through(pair: Pair, seed: int = 0) -> Pair | None:
    """The pair without a still layer, and with the flow of what moves behind it.

    Args:
        pair: A pair whose flow was computed from its images.
        seed: Of the sample that the motion is fitted to.

    Returns:
        Grey images (as RGB) without the layer, and the corrected flow; None where nothing stands
        still, where all may, or where the images do not contradict what stands still.
    """
    flow = pair.flow
    assert flow is not None
    at_rest, sure = still(flow), flow.confidence > 0.5
    if pair.size != pair.image_next.shape[:2] or at_rest.mean() < LEAST_SHARE:
        return None
    if np.median(np.linalg.norm(flow.uv[sure], axis=1)) < LEAST_FLOW:
        return None
    v, u = np.nonzero(sure & ~at_rest)
    pick = np.random.default_rng(seed).permutation(len(v))[:PIXELS]
    place = np.stack([u, v], axis=-1)[pick].astype(float)
    move = flow.uv[v, u][pick].astype(float)
    motions = repeated(
        rays(pair.K_ref, place),
        rays(pair.K_next, place + move),
        flow.confidence[v, u][pick].astype(float),
        float(pair.K_next[0, 0]),
        count=1,
        seed=seed,
    )
    if not motions:
        return None
    ref, nxt = without_still_layer(pair.image_ref, pair.image_next)
    R, t = motions[0].R, motions[0].t
    new = corrected(ref, nxt, flow, R, t, pair.K_ref, pair.K_next)
    if new is None:
        return None
    first, second = (np.repeat(image[..., None], 3, axis=2) for image in (ref, nxt))
    return replace(pair, image_ref=first, image_next=second, flow=new)
