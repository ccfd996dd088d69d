"""Thresholds and factors that decide how far a method goes: each is held from both sides."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from soup_nlp.solve import line_search
from soup_nlp.solve.descent import Descent
from soup_nlp.solve.line_search import Move, Search
from soup_nlp.solve.phase import Reached


def test_damping_falls_where_steps_are_good_and_rises_where_they_are_too_long():
    flags = np.eye(4, dtype=bool)
    move = Move(object(), np.ones(4), far=flags[0], calm=flags[1], eager=flags[2])
    state = SimpleNamespace(damping=np.full(4, 0.016))
    Descent._adapt(state, move)
    np.testing.assert_allclose(state.damping, [0.064, 0.004, 0.001, 0.016], rtol=1e-14)
    # a step that leads nowhere raises all of them
    stuck = Move(None, np.ones(4), *np.zeros((3, 4), bool))
    Descent._adapt(state, stuck)
    np.testing.assert_allclose(state.damping, [0.512, 0.032, 0.008, 0.128], rtol=1e-14)


@pytest.mark.parametrize(
    ("falls", "taken"),
    [
        # the second correction gains 6 per cent of the first, the third 4 per cent
        ((5.0, 0.3, 0.21, 0.2, 0.2, 0.2), 3),
        # a correction that raises the merit is not taken
        ((5.0, -0.1), 1),
    ],
)
def test_corrections_end_with_the_first_that_is_not_worth_it(falls, taken, monkeypatch):
    one, made = np.ones((2, 1)), []

    def point(*_: object) -> SimpleNamespace:
        merit = (made[-1].merit if made else 10.0) - falls[len(made)]
        made.append(SimpleNamespace(x=np.zeros(18), slack=one, jacobian=None, merit=merit))
        return made[-1]

    monkeypatch.setattr(line_search, "_point", point)
    monkeypatch.setattr(line_search, "merit_gradient", lambda *_: np.zeros(18))
    monkeypatch.setattr(line_search, "reach", lambda *_: np.ones(2))
    monkeypatch.setattr(line_search, "along", lambda *_: np.zeros((2, 1)))
    monkeypatch.setattr(line_search, "restored", lambda p, x, *_: (x, one, None))
    problem = SimpleNamespace(normalise=lambda x: x, gradient=lambda x: x)
    start = SimpleNamespace(x=np.zeros(18), slack=one, jacobian=None, merit=10.0)
    search = Search(problem, start, np.zeros(18), 1e-10, lambda gradient: gradient)
    best = search._corrected(start)
    assert best is made[taken - 1]
    assert len(made) == max(taken, 2)


def test_steps_beyond_the_tolerance_must_make_either_residual_three_tenths():
    reached = Reached(None, None, (0.0, 1e-7, 1e-9))
    assert reached.less(0.29e-7, 1e-9)
    assert reached.less(1e-7, 0.29e-9)
    assert not reached.less(0.31e-7, 0.31e-9)
