"""Thresholds and factors that decide how far a method goes: each is held from both sides."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from helpers_formulation import form, tiny
from helpers_model import PAPER, Tiny, weights_for

from soup_nlp.bench.solvers import runner
from soup_nlp.bench.solvers.page import conclusion, frame_of_runs
from soup_nlp.export.verify import ENERGY_SLACK, Limits, Residuals
from soup_nlp.model import oracle
from soup_nlp.model.matrix import build_matrix_nlp
from soup_nlp.refine.costs import PairCosts, Particles
from soup_nlp.solve import line_search
from soup_nlp.solve.descent import Descent
from soup_nlp.solve.line_search import Move, Search
from soup_nlp.solve.phase import Reached


@pytest.mark.parametrize("kind", ["primal", "dual", "complementarity"])
def test_a_foreign_answer_is_verified_to_ten_times_the_tolerance(kind):
    limits = Limits(tol=1e-4)
    tolerance = 1e-6 if kind == "primal" else 1e-4
    zero = Residuals(0.0, 0.0, 0.0, "solver")
    assert replace(zero, **{kind: 9.9 * tolerance}).within(limits)
    assert not replace(zero, **{kind: 10.1 * tolerance}).within(limits)


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


def test_turns_between_neighbours_count_in_both_directions():
    problem = Tiny("pixels", samples=None)
    names = ("arap", "proj", "cont", "prior")
    weights = weights_for("pixels", False).replace(**dict.fromkeys(names, 0.0), orient=1.0)
    costs = PairCosts(problem.data, weights)
    found = costs.tables(Particles.of(problem.soup))[:, 0, 0].sum()
    i, k = problem.data.pairs.T
    n = problem.soup.n
    turn = np.minimum(1 - np.sum(n[i] * n[k], axis=1), weights.sigma_orient)
    assert turn.sum() > 0.01
    assert found == pytest.approx(float(2 * turn.sum()), rel=1e-12)
    exact = oracle.energy(problem.soup, problem.data, weights)["orient"]
    assert found == pytest.approx(exact, rel=1e-12)


@pytest.mark.parametrize("gauge", ["free", "unit-translation"])
def test_the_length_unit_of_a_free_gauge_weighs_distances_by_their_share(gauge):
    problem = tiny()
    share = np.linspace(1.0, 4.0, len(problem.soup))
    share /= share.sum()
    data = replace(problem.data, share=share)
    nlp, layout = build_matrix_nlp(problem.soup, data, PAPER, form(gauge=gauge))
    row = nlp.g_names().index(next(name for name in nlp.g_names() if name.startswith("unit")))
    g = np.asarray(nlp.oracle(nlp.x0, nlp.p)[1]).ravel()
    assert g[row] == pytest.approx(1.0, rel=1e-12)
    # with equal shares the unit would be the mean distance, which is another one
    soup = layout.unpack(nlp.x0[: layout.size])
    assert abs(float(np.mean(soup.distance)) - 1) > 0.01


def test_the_energy_of_an_answer_may_be_a_thousandth_above_the_start():
    assert pytest.approx(1.001, rel=1e-12) == 1 + ENERGY_SLACK


def test_a_problem_s_lowest_energy_is_that_of_its_own_runs():
    def row(problem: str, energy: float) -> dict[str, object]:
        label = {"problem": problem, "superpixels": 9, "formulation": "f", "solver": "s"}
        point = {"energy": energy, "primal": 0.0, "seconds": 1.0, "verified": True}
        return {**label, **point, "claimed": True, "problem_hash": problem, "start": "presolve"}

    text = "\n".join(conclusion(frame_of_runs([row("a", 1.0), row("b", 2.0)])))
    assert text.count("lowest exact energy of any run 1 by s") == 1
    assert text.count("lowest exact energy of any run 2 by s") == 1


def test_a_curve_has_the_first_and_the_last_iterate(monkeypatch):
    monkeypatch.setattr(runner, "_energy", lambda _, x: float(x[0]))
    for count in (1, 2, 500):
        at = np.arange(float(count))
        curve = runner._curve(None, at, at[:, None])
        assert curve[0] == [0, 0]
        assert curve[-1] == [count - 1, count - 1]
        assert len(curve) == min(count, runner.CURVE_POINTS)
    assert runner._curve(None, np.zeros(0), np.zeros((0, 1))) == []
