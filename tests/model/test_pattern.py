"""Patterns of sparse matrices: the union of many elements' nonzeros, and where each stands."""

import numpy as np
import pytest

from soup_nlp.model.pattern import Entries, Pattern


@pytest.mark.parametrize("size", [40, 100_000])
def test_a_pattern_is_the_union_of_its_sets(size):
    """Also where keys need more than four bytes, and elements stand where another does."""
    rng = np.random.default_rng(2)
    whole = rng.integers(0, size, (2, 7, 5))[:, [0, 0, 1, 2, 2, 2, 3, 4, 5, 6]]
    other = rng.integers(0, size, (2, 4, 3))
    other[:, 1] = whole[:, 6, :3]
    pattern = Pattern((size, size), lambda: [Entries(*whole), Entries(*other)])
    keys = pattern.columns * size + pattern.rows
    assert (np.diff(keys) > 0).all()
    for (rows, columns), place in zip((whole, other), pattern.places):
        np.testing.assert_array_equal(pattern.rows[place], rows)
        np.testing.assert_array_equal(pattern.columns[place], columns)
    assert len(keys) == len(set(np.concatenate([p.ravel() for p in pattern.places]).tolist()))
