"""The flow of a problem, also behind a layer that stands still before the scene."""

from collections.abc import Callable

import numpy as np

from soup_nlp.config.problem import Problem
from soup_nlp.data.flow.layers import corrected, still, without_still_layer
from soup_nlp.data.flow.sources import is_named
from soup_nlp.data.pair import Flow, Pair
from soup_nlp.data.working_size import resized_flow
from soup_nlp.geometry.camera import rays
from soup_nlp.start.epipolar import Matches, estimate

LEAST_SHARE = 0.003
"""Least share of pixels that stand still for the search for a layer."""
LEAST_FLOW = 2.0
"""Median displacement, pixels, below which the camera may be at rest."""
PIXELS = 6000
"""Largest number of moving pixels to which their motion is fitted."""


def with_flow(problem: Problem, full: Pair, pair: Pair, log: Callable[[str], None] | None) -> Pair:
    """A pair with its flow, searched for behind a layer that stands still if there is one.

    `full` is the pair at its own size; `log` is called with a line if there is such a layer.
    """
    flow = pair.flow
    if flow is None and pair is not full and problem.flow.is_file():
        # a flow file has the size of the original images
        flow = resized_flow(problem.flow.load(full, problem.path), full, pair)
    flow = flow or problem.flow.load(pair, problem.path)
    pair = pair.with_flow(flow)
    computed = is_named(flow.source) and not flow.source.startswith("truth")
    behind = see_through(pair, problem.seed) if problem.flow.see_through and computed else None
    if behind is None:
        return pair
    if log:
        log("a layer stands still before the scene: flow searched for behind it")
    return pair.with_flow(behind)


def see_through(pair: Pair, seed: int = 0) -> Flow | None:
    """The flow of the moving scene behind a still layer.

    Args:
        pair: A pair whose flow was computed from its images.
        seed: Seed of the sample to which the motion is fitted.

    Returns:
        The corrected flow; None if no pixel stands still, if all may, or if the images do not
        contradict the flow of those that do.
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
    pixel = np.stack([u, v], axis=-1)[pick].astype(float)
    move = flow.uv[v, u][pick].astype(float)
    matches = Matches(
        rays(pair.K_ref, pixel),
        rays(pair.K_next, pixel + move),
        flow.confidence[v, u][pick].astype(float),
        float(pair.K_next[0, 0]),
    )
    motion = estimate(matches, seed=seed)
    if motion is None:
        return None
    ref, nxt = without_still_layer(pair.image_ref, pair.image_next)
    return corrected(ref, nxt, flow, motion.R, motion.t, pair.K_ref, pair.K_next)
