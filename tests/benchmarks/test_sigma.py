"""The fit of the factors of sigma."""

import numpy as np
import pytest

from benchmarks.sigma import FACTORS, HEAVY, fitted, loss, sigma_of
from soup_nlp.evaluation.confidence import SHARES


def test_sigma_by_terms_is_that_of_a_run(small_run):
    sure = small_run.confidence
    terms = {name: term / SHARES[name] for name, term in sure.terms.items()}
    terms["drawn"] = np.zeros(sure.sigma.shape)
    np.testing.assert_allclose(sigma_of(terms, FACTORS), sure.sigma)


def test_large_errors_count_linearly():
    one = np.array([1.0])
    slope = loss(np.array([HEAVY + 2]), one) - loss(np.array([HEAVY + 1]), one)
    assert slope == pytest.approx(HEAVY)
    assert loss(np.array([2.0]), one) == pytest.approx(2.0)


def test_the_fit_finds_the_factor_of_normal_errors():
    rng = np.random.default_rng(0)
    terms = {name: np.zeros(4000) for name in (*SHARES, "drawn")}
    terms["flow"] = np.exp(rng.normal(-4, 0.5, 4000))
    factor = fitted({"family": [(rng.normal(0, 1.0 * terms["flow"]), terms)]})
    assert factor["flow"] == pytest.approx(1.0, rel=0.05)
    assert factor["pace"] == pytest.approx(FACTORS["pace"], rel=0.05)
