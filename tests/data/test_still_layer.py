"""The flow of a moving scene is found behind a static layer."""

from dataclasses import replace

import numpy as np
import pytest
from test_flow import texture

from soup_nlp.config.problem import make_problem
from soup_nlp.data.flow.layers import without_still_layer
from soup_nlp.data.pair import Flow, Pair
from soup_nlp.data.scenes.catalogue import render_scene
from soup_nlp.pipeline.case import see_through, with_flow

WIDTH, HEIGHT = 512, 218
BEHIND = np.s_[130:205, 150:400]
"""Part of the image, mostly road, that the static layer covers."""


def given(pair: Pair, still: bool, source: str = "dis") -> Pair:
    """The true flow, but zero with full confidence behind the layer."""
    uv = np.nan_to_num(pair.truth.flow).astype(np.float32)
    sure = np.isfinite(pair.truth.flow).all(axis=2).astype(np.float32)
    if still:
        uv[BEHIND], sure[BEHIND] = 0.0, 1.0
    return pair.with_flow(Flow(uv, sure, source))


def covered(image: np.ndarray) -> np.ndarray:
    """The image with a reflection of more contrast than the road."""
    out = image.astype(float)
    layer = texture(HEIGHT, WIDTH, seed=5)[..., None]
    out[BEHIND] = 0.5 * out[BEHIND] + 0.5 * layer[BEHIND]
    return np.rint(out).astype(np.uint8)


@pytest.fixture(scope="module")
def street() -> Pair:
    return render_scene("street", 0, WIDTH, HEIGHT)


@pytest.fixture(scope="module")
def reflecting(street: Pair) -> Pair:
    images = covered(street.image_ref), covered(street.image_next)
    return replace(street, image_ref=images[0], image_next=images[1])


def test_a_static_layer_is_removed_from_the_images():
    layer, other = (np.dstack([texture(60, 80, seed)] * 3) for seed in (0, 1))
    for image in without_still_layer(layer, layer):
        assert image.std() == 0
    for image, original in zip(without_still_layer(layer, other), (layer, other)):
        # a random derivative shares its sign with another half of the time
        assert 0.5 * original.std() < image.std() < original.std()


@pytest.mark.slow
def test_the_road_moves_behind_a_reflection(reflecting: Pair):
    reflected = given(reflecting, still=True)
    seen = see_through(reflected)
    assert seen.source == "dis"
    true = reflecting.truth.flow[BEHIND]
    error = np.linalg.norm(seen.uv[BEHIND] - true, axis=2)
    moved = np.linalg.norm(true, axis=2) > 4
    sure = seen.confidence[BEHIND] > 0.3
    assert np.mean(moved) > 0.5
    # without the correction, all of these pixels are wrong by more than 4 at full confidence
    assert np.mean(error[moved & sure] < 2.0) > 0.8
    assert np.mean(sure[moved]) > 0.25
    # moving pixels outside the static layer keep their flow
    above = np.s_[20:90, 100:400]
    assert np.mean((seen.uv == reflected.flow.uv)[above]) > 0.95


@pytest.mark.slow
def test_images_without_a_layer_are_left_alone(street: Pair):
    assert see_through(given(street, still=False)) is None


@pytest.mark.slow
def test_true_flow_is_believed(reflecting: Pair):
    """The correction applies to computed flow only, and an option disables it."""
    memory = {"input": {"kind": "memory", "hash": "0"}}
    for source, options in (("truth", {}), ("dis", {"consistency": False})):
        reflected = given(reflecting, still=True, source=source)
        problem = make_problem({**memory, "flow": options})
        believed = with_flow(problem, reflected, reflected, None)
        assert (believed.flow.uv[BEHIND] == 0).all()
