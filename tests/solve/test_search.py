"""The search along a step of the presolve, at bounds that curve."""

from __future__ import annotations

import numpy as np
import pytest

from soup_nlp.solve import line_search as search_module
from soup_nlp.solve.descent import Descent
from soup_nlp.solve.line_search import LEAST_SLACK, Point, Search, along, evaluate, restored
from soup_nlp.solve.tangent_problem import TangentProblem

GRAZING = 1e-8
"""Slack of the bound along which the steps of these tests lead."""


def grazing(problem: TangentProblem, k: int) -> tuple[Point, np.ndarray]:
    """A point where superpixel k almost grazes one rim pixel, and a step of it along that bound."""
    problem.smoothing(0.1)
    inner = Descent(problem).x
    normal = problem.slacks(inner)[1][k, 0]

    def turned(t: float) -> np.ndarray:
        x = inner.copy()
        x.reshape(-1, 9)[k, 1:3] -= t * normal[1:]
        return x

    low, high = 0.0, 20.0
    for _ in range(200):
        middle = 0.5 * (low + high)
        inside = problem.slacks(turned(middle))[0][k, : problem.rims].min() > GRAZING
        low, high = (middle, high) if inside else (low, middle)
    at = evaluate(problem, turned(low), 1e-10)
    assert at is not None
    assert at.slack[k].min() == pytest.approx(GRAZING, rel=1e-3)
    row = at.jacobian[k, np.argmin(at.slack[k])]
    side = np.array([0.0, -row[2], row[1]])
    h = np.zeros_like(at.x)
    h.reshape(-1, 9)[k, :3] = 0.3 * side / np.linalg.norm(side)
    return at, h


def test_a_step_along_a_curved_bound_is_restored_to_it(problem):
    k = 7
    at, h = grazing(problem, k)
    assert evaluate(problem, problem.normalise(at.x + h), 1e-10) is None, "it leaves the bound"
    search = Search(problem, at, h, 1e-10, lambda gradient: np.zeros_like(gradient))
    point, length = search._feasible(np.ones(len(at.slack)))
    assert (length == 1).all()
    assert (point.slack > LEAST_SLACK * at.slack).all()
    went = (point.x - at.x).reshape(-1, 9)[k, :3]
    step = h.reshape(-1, 9)[k, :3]
    assert went @ step > 0.99 * step @ step, "the change is across the step"
    # every row keeps its linearised slack, 1e-8 for slopes that changed by 0.3, and one just does
    promised = (at.slack + along(at.jacobian, h))[k]
    assert (point.slack[k] / promised).min() == pytest.approx(1.0, rel=5e-2)


def test_without_it_the_step_would_be_refused_but_for_a_hundredth(problem, monkeypatch):
    at, h = grazing(problem, 7)
    monkeypatch.setattr(search_module, "BACK", 0)
    search = Search(problem, at, h, 1e-10, lambda gradient: np.zeros_like(gradient))
    _, length = search._feasible(np.ones(len(at.slack)))
    assert length[7] < 0.01


def test_a_point_inside_its_bounds_is_left_alone(problem):
    at, h = grazing(problem, 7)
    x = problem.normalise(at.x + h)
    floor = LEAST_SLACK * at.slack
    back, slack, _ = restored(problem, x, at.slack + along(at.jacobian, h), floor)
    np.testing.assert_array_equal(slack, problem.slacks(back)[0])
    # it stays on the simplex, by one factor for all
    np.testing.assert_allclose(back, problem.normalise(back), rtol=1e-14)
    ratio = (back / np.where(x == 0, 1.0, x)).reshape(-1, 9)
    assert np.ptp(np.delete(ratio, 7, axis=0)[:, 0]) < 1e-14
    np.testing.assert_array_equal(back.reshape(-1, 9)[:, 3:], x.reshape(-1, 9)[:, 3:])
    assert (ratio[7, :3] != ratio[0, 0]).any()
    assert restored(problem, at.x, at.slack, floor)[0] is at.x
