"""Sparsification, coverage and their table, by hand-made examples."""

from __future__ import annotations

import numpy as np
import pytest

from soup_nlp.bench.confidence import confidence_page, plot_confidence
from soup_nlp.bench.confidence import left_out_factors as factors_of
from soup_nlp.bench.studies import STUDIES
from soup_nlp.bench.study import frame_of
from soup_nlp.evaluate.confidence import POWER
from soup_nlp.evaluate.sparsification import LAST, STEPS, coverage, sparsification

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


def row(family: str, pair: str, scale: float, bending: bool = False) -> dict:
    rng = np.random.default_rng(3)
    unit = rng.uniform(0.5, 2.0, 2000) ** POWER
    return {
        "sequence": family,
        "pair": pair,
        "suite": "rendered",
        "flow": "dis",
        "variant": "",
        "presets": ["paper"],
        **{"ok": True, "error": None, "code": "c", "cpu_seconds": 1.0, "key": pair},
        "confidence": {
            "mre": 0.05,
            "solution_90": 0.04,
            "solution_70": 0.03,
            "ause": {"sigma": 0.2},
            "within": [0.7, 0.9],
            "guess": 0.1,
            "noise": 0.1,
            "seconds": 0.5,
            "curve": [[1.0, 0.5], [0.05, 0.02], [0.05, 0.01]],
            "sample": [
                (scale * unit * np.abs(rng.normal(size=2000)) * 1e-3).tolist(),
                unit.tolist(),
                [0.0] * 2000,
                [float(bending)] * 2000,
            ],
        },
    }


def left_out_factors(rows: list[dict]) -> dict:
    return factors_of(frame_of(rows))


def test_the_factor_of_a_family_is_chosen_on_the_others():
    """Errors of 1 and of 2 thousandths: each family is judged by the other's factor."""
    told = left_out_factors([row("one", "a", 1.0), row("two", "b", 2.0)])
    # 76 % of a Gaussian lie within 1.175 standard deviations
    assert told["one"][0][0] == pytest.approx(2.35e-3, rel=0.05)
    assert told["two"][0][0] == pytest.approx(1.175e-3, rel=0.05)
    assert told["one"][1] == pytest.approx(0.98, abs=0.02)
    assert told["two"][1] == pytest.approx(0.44, abs=0.03)


def test_pairs_that_bend_are_judged_by_others_that_bend():
    rows = [row("one", "a", 1.0), row("two", "b", 9.0, bending=True)]
    assert left_out_factors(rows) == {}
    told = left_out_factors([*rows, row("three", "c", 2.0, bending=True)])
    assert set(told) == {"two", "three"}
    assert told["three"][0][0] == pytest.approx(9 * 1.175e-3, rel=0.05)


def test_what_is_added_in_squares_needs_no_factor():
    """Errors of a thousandth of the unit, with 0.04 added in squares, as sigma has it."""
    rows = [row("one", "a", 1.0), row("two", "b", 1.0)]
    for own in rows:
        log = own["confidence"]["sample"][0]
        own["confidence"]["sample"][0] = np.hypot(np.array(log), 0.04).tolist()
        own["confidence"]["sample"][2] = [0.04] * len(log)
    told = left_out_factors(rows)
    assert told["one"][0][0] == pytest.approx(1.175e-3, rel=0.05)


def test_a_pair_of_both_kinds_has_a_factor_for_each():
    both = row("both", "c", 1.0)
    both["confidence"]["sample"][3] = [float(k % 2) for k in range(2000)]
    rows = [row("one", "a", 1.0), row("two", "b", 9.0, bending=True), both]
    factors, one, _ = left_out_factors(rows)["both"]
    assert factors == pytest.approx((1.175e-3, 9 * 1.175e-3), rel=0.05)
    # rigid pixels lie within as many as they should, bending ones nearly all
    assert one == pytest.approx((0.76 + 1.0) / 2, abs=0.03)


def test_the_page_has_pairs_and_families(tmp_path):
    frame = frame_of([row("one", "a", 1.0), row("two", "b", 2.0)])
    text = confidence_page(STUDIES["confidence"], frame)
    assert "| a, dis | 0.0500 | 0.0400 | 0.0300 | 0.20 | 0.70 | 0.90 | 0.10 | 0.50 |" in text
    assert "| two | 0.0500" in text
    assert "mean of 2 families" in text
    plot_confidence(tmp_path / "c.png", frame)
    assert (tmp_path / "c.png").stat().st_size > 5000
    failed = {**row("one", "a", 1.0), "ok": False, "error": "out of luck"}
    del failed["confidence"]
    assert "out of luck" in confidence_page(STUDIES["confidence"], frame_of([failed]))
