"""Newton steps with the factor of an earlier matrix: the same step, the same end."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from soup_nlp.solve import newton, part
from soup_nlp.solve.descent import Descent
from soup_nlp.solve.part import Part
from soup_nlp.solve.phase import Phase
from soup_nlp.solve.reuse import LIMIT, held, preconditioned

N = 30


@pytest.fixture
def matrices():
    """A matrix, one that is near, a gradient and the normal of the plane."""
    rng = np.random.default_rng(0)
    M = rng.normal(size=(N, N))
    old = M @ M.T + np.eye(N)
    change = rng.normal(size=(N, 3))
    return old, old + change @ change.T, rng.normal(size=N), rng.uniform(0.5, 1, N)


def test_it_solves_within_the_plane(matrices):
    old, new, gradient, a = matrices
    newton = held(partial(np.linalg.solve, old), a)
    got = preconditioned(new.__matmul__, newton, gradient, 1e-6)
    system = np.block([[new, a[:, None]], [a[None], np.zeros((1, 1))]])
    expected = np.linalg.solve(system, np.append(-gradient, 0))[:N]
    # a change of rank 3 leaves four different eigenvalues
    assert got.solved
    assert got.iterations <= 4
    np.testing.assert_allclose(got.h, expected, atol=1e-6 * np.abs(expected).max())
    np.testing.assert_allclose(got.product, new @ got.h, atol=1e-10)
    # with its own factor one iteration does
    own = held(partial(np.linalg.solve, new), a)
    assert preconditioned(new.__matmul__, own, gradient, 1e-6).iterations == 1


def test_negative_curvature_and_a_poor_factor_are_told(matrices):
    old, new, gradient, a = matrices
    newton = held(partial(np.linalg.solve, old), a)
    bent = preconditioned((new - 50 * np.eye(N)).__matmul__, newton, gradient, 1e-8)
    assert not bent.solved
    assert bent.indefinite
    assert bent.iterations < LIMIT
    spread = np.diag(np.geomspace(1, 1e8, N))
    poor = preconditioned(spread.__matmul__, newton, gradient, 1e-8)
    assert poor.iterations == LIMIT // 2
    assert not poor.solved
    assert not poor.indefinite
    even = np.diag(np.geomspace(1, 10, N))
    fair = preconditioned(even.__matmul__, held(lambda b: b, a), gradient, 1e-3)
    assert fair.solved
    assert fair.worn


@pytest.mark.slow
def test_a_descent_with_fewer_factors_ends_at_a_minimum(problem, monkeypatch):
    phases = (
        Phase("first", "gauss-newton", 0.3, 1e-3, 60, 1e-4, 1e-6),
        Phase("last", "exact", 0.3, 1e-8, 60, 0.0, 1e-6),
    )
    ends, counts, parts = [], [], []
    # twelve superpixels have few that are nobody's neighbour, or much better than others
    monkeypatch.setattr(part, "WORST", 0.3)
    monkeypatch.setattr(Part, "_with_neighbours", lambda self, some: some)
    within = part._within
    monkeypatch.setattr(part, "_within", lambda block: parts.append(1) or within(block))
    for least in (10**9, 0):
        monkeypatch.setattr(newton, "REUSE", least)
        runner, made = Descent(problem), []
        factorise = runner.newton._factorise
        runner.newton._factorise = lambda values, f=factorise, m=made: m.append(1) or f(values)
        ends.append([runner.run(phase) for phase in phases][-1])
        counts.append(len(made))
    assert all(end.converged for end in ends)
    # both gradients are below 1e-6 in a strictly convex neighbourhood, or in two minima
    assert ends[1].objective == pytest.approx(ends[0].objective, rel=1e-3)
    assert counts[1] < 0.7 * counts[0]
    assert parts
