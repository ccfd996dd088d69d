"""Steps of a few superpixels: Newton's of their own block, the others held."""

from __future__ import annotations

import numpy as np
import pytest

from soup_nlp.solve.factor import numbered
from soup_nlp.solve.part import STEPS, Part

COUNT = 10


@pytest.fixture
def chain():
    """Part and matrix of superpixels in a row, each coupled to the next."""
    rng = np.random.default_rng(0)
    near = np.abs(np.subtract.outer(*2 * [np.arange(COUNT)])) < 2
    full = np.kron(near, np.ones((9, 9))) * rng.normal(size=(9 * COUNT, 9 * COUNT))
    full = full + full.T + 60 * np.eye(9 * COUNT)
    columns, rows = np.nonzero(np.tril(full))
    return Part(numbered(rows, columns, 9 * COUNT)), full, full[rows, columns]


def test_a_part_is_the_worst_and_their_neighbours(chain):
    one, full, nonzeros = chain
    residual = np.full(COUNT, 1e-3)
    residual[4] = 1.0
    one.choose(residual, slow=True)
    np.testing.assert_array_equal(np.flatnonzero(one.block.some), [3, 4, 5])
    moves = np.repeat(one.block.some, 9)
    b = np.random.default_rng(1).normal(size=9 * COUNT)
    got = one.factorise(nonzeros[one.block.nonzeros])(b)
    expected = np.linalg.solve(full[np.ix_(moves, moves)], b[moves])
    np.testing.assert_allclose(got[moves], expected, rtol=1e-10)
    assert not got[~moves].any()


def test_a_part_ends_where_it_no_longer_pays(chain):
    one, _, _ = chain
    residual = np.full(COUNT, 1e-3)
    residual[4] = 1.0
    for slow, after in ((True, residual), (False, np.ones(COUNT)), (False, np.roll(residual, 5))):
        one.choose(residual, slow=False)
        assert one.block is not None
        one.choose(after, slow)
        assert one.block is None
    for _ in range(STEPS):
        one.choose(residual, slow=False)
        assert one.block is not None
    one.choose(residual, slow=False)
    assert one.block is None


def test_many_bad_superpixels_move_with_all(chain):
    one, _, _ = chain
    one.choose(np.ones(COUNT), slow=False)
    assert one.block is None
