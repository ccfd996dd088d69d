"""Sparsification and coverage, by hand-made examples."""

from __future__ import annotations

import numpy as np
import pytest

from soup_nlp.evaluate.scoring import LAST, STEPS, coverage, sparsification

ERROR = np.linspace(0.0, 1.0, 1001)


def test_the_errors_themselves_are_a_perfect_uncertainty():
    found = sparsification(ERROR[::-1], 3 * ERROR[::-1])
    assert found.ause == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(found.error, found.oracle)
    assert found.kept[0] == 1.0
    assert found.kept[-1] == LAST
    assert len(found.kept) == STEPS


def test_the_area_of_a_linear_error():
    """The mean of what the oracle keeps is kept / 2; sorted the wrong way it is 1 - kept / 2."""
    kept = np.linspace(1.0, LAST, STEPS)
    worst = sparsification(ERROR, -ERROR)
    np.testing.assert_allclose(worst.oracle, kept / 2, atol=2e-3)
    np.testing.assert_allclose(worst.error, 1 - kept / 2, atol=2e-3)
    assert worst.ause == pytest.approx(np.mean(1 - kept) / 0.5, abs=5e-3)


def test_an_uncertainty_by_chance_keeps_the_mean():
    rng = np.random.default_rng(0)
    found = sparsification(rng.permutation(np.repeat(ERROR, 20)), rng.uniform(size=20020))
    kept = np.linspace(1.0, LAST, STEPS)
    assert found.ause == pytest.approx(np.mean(0.5 - kept / 2) / 0.5, abs=0.03)


def test_equal_uncertainties_are_chance_in_whatever_order_they_come():
    one = sparsification(ERROR, np.ones(len(ERROR)))
    np.testing.assert_allclose(one.error, ERROR.mean())
    half = ERROR > 0.5
    there, back = (sparsification(ERROR[::k], half[::k]) for k in (1, -1))
    np.testing.assert_allclose(there.error, back.error)
    assert 0 < there.ause < one.ause


def test_no_error_has_no_area():
    assert sparsification(np.zeros(5), np.arange(5.0)).ause == 0.0


def test_coverage_counts_what_lies_within():
    assert coverage([0.5, -1.5, 2.5, 1.0], [1.0, 1.0, 1.0, 1.0]) == [0.5, 0.75]
