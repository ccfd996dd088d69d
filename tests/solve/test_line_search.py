"""Lengths of steps: shortened for one superpixel or for all, and never prolonged by rounding."""

from __future__ import annotations

import numpy as np
import pytest

from soup_nlp.solve.line_search import Search, evaluate


class Chain:
    """Superpixels that stiff norms hold together; past 0.3 each pays more than it gained."""

    def __init__(self, n: int) -> None:
        self.n = n

    def normalise(self, x):
        return x

    def slacks(self, x):
        return np.ones((self.n, 1)), np.zeros((self.n, 1, 3))

    def parts(self, x):
        a = x[6::9]
        # the first one's wall is the steepest, so that it is found alone
        wall = np.where(np.arange(self.n) == 0, 100.0, 2.0)
        return a, np.diff(a), wall

    def value(self, x):
        a, apart, wall = self.parts(x)
        return float(np.sum(np.maximum(a - 0.3, 0) * wall - a) + 1e4 * np.sum(apart**2))

    def gradient(self, x):
        a, apart, wall = self.parts(x)
        out = np.zeros_like(x)
        out[6::9] = np.where(a > 0.3, wall, 0.0) - 1.0
        out[6::9] += 2e4 * (np.append(0, apart) - np.append(apart, 0))
        return out


@pytest.mark.parametrize("n", [3, 10])
def test_a_step_too_long_for_one_is_shortened_for_all_where_that_one_alone_does_not_do(n):
    chain = Chain(n)
    x, h = np.zeros(9 * n), np.zeros(9 * n)
    h[6::9] = 1.0
    at = evaluate(chain, x, 1e-8)
    gradient = chain.gradient(x)
    # a Hessian for which h is Newton's step
    move = Search(chain, at, h, 1e-8, np.zeros_like).run(gradient, -gradient)
    assert move.point is not None
    assert move.point.f < at.f
    np.testing.assert_array_equal(move.length, 0.25)


def test_a_bound_that_cuts_one_short_cuts_all_where_norms_hold_them_together():
    class Bounded(Chain):
        """One component by its scales; the first superpixel may go a tenth of the step."""

        def slacks(self, x):
            slack, jacobian = np.ones((self.n, 1)), np.zeros((self.n, 1, 3))
            slack[0], jacobian[0, 0, 0] = 0.1 - x[0], -1.0
            return slack, jacobian

        def parts(self, x):
            return super().parts(np.roll(x, 6))

        def gradient(self, x):
            return np.roll(super().gradient(x), -6)

    class Aside(Bounded):
        """The first superpixel has nothing to do with the component."""

        def parts(self, x):
            a, apart, wall = super().parts(x)
            return a, np.where(np.arange(self.n - 1) == 0, 0.0, apart), wall

    component = Bounded(5)
    x, h = np.zeros(45), np.zeros(45)
    h[::9] = 1.0
    at, gradient = evaluate(component, x, 1e-8), component.gradient(x)
    move = Search(component, at, h, 1e-8, np.zeros_like).run(gradient, -gradient)
    assert move.point is not None
    np.testing.assert_allclose(move.length, 0.099)
    assert move.point.f < at.f - 0.4
    aside = Aside(5)
    at, gradient = evaluate(aside, x, 1e-8), aside.gradient(x)
    move = Search(aside, at, h, 1e-8, np.zeros_like).run(gradient, -gradient)
    np.testing.assert_allclose(move.length, [0.25 * 0.099, 0.25, 0.25, 0.25, 0.25])


def test_a_step_to_the_minimum_is_not_doubled_for_a_fall_by_rounding():
    class Noisy(Chain):
        """A minimum at 1, and rounding by which the value falls beyond it."""

        def value(self, x):
            return 1e6 - 1e-9 * float(np.sum(x[6::9]))

        def gradient(self, x):
            out = np.zeros_like(x)
            out[6::9] = 1e-8 * (x[6::9] - 1.0)
            return out

    flat = Noisy(2)
    x, h = np.zeros(18), np.zeros(18)
    h[6::9] = 1.0
    gradient = flat.gradient(x)
    at = evaluate(flat, x, 1e-12)
    move = Search(flat, at, h, 1e-12, np.zeros_like).run(gradient, -gradient)
    assert move.point is not None
    np.testing.assert_array_equal(move.point.x, h)
