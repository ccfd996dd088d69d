"""Shares of the image whose depth is determined, and the reasons for guesses."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from soup_nlp.evaluation.confidence import MOST_SIGMA, PRIOR
from soup_nlp.geometry.surface import hidden
from soup_nlp.report.findings import (
    DETERMINED,
    GUESSES,
    ORIGINS,
    SHARES,
    certainty_lines,
    guess_line,
)
from soup_nlp.report.summary import certainty
from soup_nlp.start.components import FIXED, SCENE, TIES


def unsure(run, scale=None):
    """The same run where every pixel is a guess, though the flow is evidence of depth."""
    sure = run.confidence
    far = np.full(int(run.start.component.max()) + 1, 9.0)
    evidence = replace(sure.evidence, turn=far, constant=far, solution=np.zeros_like(far))
    terms = dict(sure.terms)
    if scale is not None:
        other = (run.start.component != SCENE)[run.segmentation.labels]
        terms["scale"] = np.where(other, scale, 0.0)
        terms["pace"] = np.zeros_like(terms["pace"])
    sigma = np.full_like(sure.sigma, PRIOR)
    return replace(run, confidence=replace(sure, sigma=sigma, terms=terms, evidence=evidence))


def test_shares_add_up(small_run):
    shares = certainty(small_run)
    assert shares["determined"] + shares["guess"] == pytest.approx(1.0)
    parts = [shares[k] for k in DETERMINED if k in shares]
    assert sum(parts) == pytest.approx(shares["determined"])
    assert sum(shares[k] for k in GUESSES) == pytest.approx(shares["guess"])
    assert shares["median_sigma"] < MOST_SIGMA


def test_every_guess_has_one_reason(small_run):
    shares = certainty(unsure(small_run))
    assert shares["determined"] == 0
    assert np.isnan(shares["median_sigma"])
    assert sum(shares[k] for k in GUESSES) == pytest.approx(1.0)


def test_a_scale_that_contact_hardly_determines_is_named(small_run):
    start, labels = small_run.start, small_run.segmentation.labels
    two = (np.arange(len(start.soup)) < 9).astype(int)
    tie = np.where(two, TIES.index("contact below"), TIES.index("reference"))
    start = replace(start, component=two, tie=tie)
    small_run = replace(small_run, start=start)
    loose = certainty(unsure(small_run, 1.0))
    firm = certainty(unsure(small_run, 1e-6))
    tied_share = (start.component != SCENE)[labels].mean()
    # without evidence of depth the scale is not the reason
    assert 0 <= firm["scale"] < loose["scale"] <= tied_share
    assert loose["scale"] + loose["weak"] == pytest.approx(firm["scale"] + firm["weak"])
    (line,) = certainty_lines(loose)
    assert "with a scale that contact hardly determines" in line


SAID = {
    "reference": "by flow and parallax",
    "contact below": "with the scale of a contact",
    "outline": "with the scale of an outline",
    "nothing": "without contact to anything that has a scale",
    "ground": "with the scale of a contact",
    "fixed in the image": "with the scale of an outline",
    "given depth": "by the given depth",
    "occlusion": "in front of what it covers",
    "too fast": "nearer than its contact, at which it would move too far",
}


@pytest.mark.parametrize("name", TIES)
def test_what_gives_a_component_its_scale_is_said(name, small_run):
    start, sure = small_run.start, small_run.confidence
    certain = replace(sure, sigma=np.full_like(sure.sigma, 0.1))
    tied = replace(start, tie=np.full_like(start.tie, TIES.index(name)))
    given = None
    if name == "given depth":
        given = SimpleNamespace(from_prior=np.ones(len(tied.soup), bool))
    (line,) = certainty_lines(
        certainty(replace(small_run, start=tied, confidence=certain, given=given))
    )
    assert line.startswith("100% of the image is determined, half of it to 10.0% (1 sigma): 100% ")
    assert SAID[name] in line
    # the page has words for every component, too
    assert ORIGINS.keys() == set(TIES)
    assert ORIGINS[name][1] != name


def test_a_camera_at_rest_is_the_reason_of_every_guess(small_run):
    at_rest = replace(small_run, start=replace(small_run.start, at_rest=True))
    shares = certainty(unsure(at_rest))
    assert shares["rest"] == 1.0
    assert guess_line(shares) == f"100% of the image is a guess: {SHARES['rest']}"


def test_what_no_motion_explains_is_named(small_run):
    half = np.arange(len(small_run.start.soup)) % 2 == 0
    doubtful = replace(small_run, start=replace(small_run.start, unexplained=half))
    shares = certainty(unsure(doubtful))
    # but for what has no flow, or is hidden in the next frame
    known = (small_run.pair.flow.confidence > 0) & ~hidden(small_run.reconstruction)
    expected = np.mean(half[small_run.segmentation.labels] & known)
    assert shares["unexplained"] == pytest.approx(expected)
    assert "no motion that was found explains its flow" in certainty_lines(shares)[0]


def test_what_is_fixed_in_the_image_is_named(small_run):
    start = small_run.start
    tie = np.where(start.component == start.component[0], FIXED, start.tie)
    shares = certainty(unsure(replace(small_run, start=replace(start, tie=tie))))
    fixed = (tie == FIXED)[small_run.segmentation.labels]
    assert shares["fixed"] == pytest.approx(fixed.mean())
    assert "stands still in the image while the camera moves" in certainty_lines(shares)[0]
