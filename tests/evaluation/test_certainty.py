"""By what the depth of every pixel is known: measured, inferred or drawn."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from soup_nlp.evaluation.confidence import FACTORS, KINDS, MOST_SIGMA, confidence, kinds
from soup_nlp.geometry.surface import hidden
from soup_nlp.report.findings import ORIGIN_WORDS
from soup_nlp.report.verdict import certainty
from soup_nlp.start.regions import ORIGINS, SCENE


def sure_of(run, start, given=None):
    """The uncertainty of a run with another start."""
    energy = run.data, run.weights, run.problem.formulation
    return confidence(run.reconstruction, run.pair, start, *energy, given)


def test_every_pixel_is_of_one_kind(small_run):
    found, sure = certainty(small_run), small_run.confidence
    assert sum(found[kind] for kind in KINDS) == pytest.approx(1.0)
    assert found["measured"] > 0.5
    assert np.mean(sure.sigma > MOST_SIGMA) < 0.2
    measured = sure.kind == KINDS.index("measured")
    assert found["median_sigma"] == pytest.approx(np.median(sure.sigma[measured]))
    seen = (small_run.pair.flow.confidence > 0) & ~hidden(small_run.reconstruction)
    static = (small_run.start.component == SCENE)[small_run.segmentation.labels]
    assert (seen & static)[measured].all()
    # what moves by itself has the scale of a contact
    assert (sure.kind[~static] > 0).all()


@pytest.mark.parametrize("name", ["bends", "interpolated", "given"])
def test_what_parallax_does_not_tell_is_inferred(name, small_run):
    start, rec = small_run.start, small_run.reconstruction
    half = np.arange(len(start.soup)) % 2 == 0
    none, given = np.zeros(rec.labels.shape, bool), np.zeros_like(half)
    if name == "given":
        given = half
    else:
        start = replace(start, **{name: half})
    kind = kinds(rec, small_run.pair.flow, start, none, given)
    assert (kind[half[rec.labels]] == KINDS.index("inferred")).all()
    assert (kind == KINDS.index("measured")).any()
    assert (kinds(rec, small_run.pair.flow, start, ~none, given) == KINDS.index("drawn")).all()


@pytest.mark.slow
def test_before_a_camera_at_rest_all_is_drawn_but_what_is_given(small_run):
    at_rest = replace(small_run.start, at_rest=True)
    drawn = sure_of(small_run, at_rest)
    assert drawn.share("drawn") == 1.0
    assert (drawn.sigma == FACTORS["drawn"]).all()
    one = np.arange(len(at_rest.soup)) == 3
    sigma = np.where(one, 0.3, np.inf)
    given = SimpleNamespace(sigma=sigma, from_prior=one)
    kind = sure_of(small_run, at_rest, given).kind
    inside = one[small_run.segmentation.labels]
    assert (kind[inside] == KINDS.index("inferred")).all()
    assert (kind[~inside] == KINDS.index("drawn")).all()


def test_what_is_as_uncertain_as_a_drawing_is_one(small_run):
    """An energy that sees no plane leaves everything to the prior."""
    sure = small_run.confidence
    assert (sure.kind[sure.sigma >= FACTORS["drawn"]] == KINDS.index("drawn")).all()
    alone = dict.fromkeys(("proj", "cont", "orient", "prior"), 0.0)
    blind = replace(small_run, weights=small_run.weights.replace(**alone))
    nothing = sure_of(blind, blind.start)
    assert np.isfinite(nothing.sigma).all()
    assert np.median(nothing.sigma) == pytest.approx(FACTORS["prior"], rel=0.05)
    assert nothing.share("drawn") > 0.95


def test_the_page_has_words_for_what_gives_a_component_its_scale():
    assert ORIGIN_WORDS.keys() == set(ORIGINS)
    assert not set(ORIGIN_WORDS.values()) & set(ORIGINS)
