"""Shares of the image whose depth is determined, and the reasons of the rest."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from soup_nlp.evaluate.confidence import MOST_SIGMA, SIGMA_PRIOR, scale_by_contact
from soup_nlp.report.findings import GUESSES, certainty, certainty_lines, guess_reason
from soup_nlp.start.components import FIXED, TIES, displacement

REASONS = GUESSES


def unsure(run, component_variance=None):
    """The same run where every pixel is a guess, though the flow is evidence of depth."""
    sure = run.confidence
    far = np.full_like(sure.evidence.turn, 9.0)
    seen = replace(sure.evidence, turn=far, constant=far, solution=np.zeros_like(far))
    scale, start = sure.scale, run.start
    if component_variance is not None:
        own = replace(
            sure.marginals, component=np.full_like(sure.marginals.component, component_variance)
        )
        far = displacement(run.soup, run.data.anchor_ray, start.component)
        scale = scale_by_contact(own, start, run.segmentation.sizes, far)
    sigma = np.full_like(sure.sigma, SIGMA_PRIOR)
    return replace(run, confidence=replace(sure, sigma=sigma, scale=scale, evidence=seen))


def test_shares_add_up(small_run):
    found = certainty(small_run)
    assert found["determined"] + found["guess"] == pytest.approx(1.0)
    assert sum(found[k] for k in ("flow", "contact", "outline")) == pytest.approx(
        found["determined"]
    )
    assert sum(found[k] for k in REASONS) == pytest.approx(found["guess"])
    assert found["median_sigma"] < MOST_SIGMA


def test_every_guess_has_one_reason(small_run):
    found = certainty(unsure(small_run))
    assert found["determined"] == 0
    assert np.isnan(found["median_sigma"])
    assert sum(found[k] for k in REASONS) == pytest.approx(1.0)


def test_a_scale_that_contact_hardly_determines_is_named(small_run):
    start, labels = small_run.start, small_run.segmentation.labels
    loose = certainty(unsure(small_run, 1.0))
    firm = certainty(unsure(small_run, 1e-6))
    others = (start.tie != TIES.index("reference"))[labels].mean()
    # without evidence of depth the scale is not the reason
    assert 0 <= firm["scale"] < loose["scale"] <= others
    assert loose["scale"] + loose["weak"] == pytest.approx(firm["scale"] + firm["weak"])
    (line,) = certainty_lines(loose)
    assert "with a scale that contact hardly determines" in line


def test_a_camera_at_rest_is_the_reason_of_every_guess(small_run):
    rest = replace(small_run, start=replace(small_run.start, at_rest=True))
    found = certainty(unsure(rest))
    assert found["rest"] == 1.0
    assert "turns or stands still" in guess_reason(found)


def test_what_is_fixed_in_the_image_is_named(small_run):
    start = small_run.start
    tie = np.where(start.component == start.component[0], FIXED, start.tie)
    found = certainty(unsure(replace(small_run, start=replace(start, tie=tie))))
    own = (tie == FIXED)[small_run.segmentation.labels]
    assert found["fixed"] == pytest.approx(own.mean())
    assert "stands still in the image while the camera moves" in certainty_lines(found)[0]
