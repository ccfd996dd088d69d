"""Patterns of sparse matrices: the union of many elements' nonzeros, and where each stands."""

from __future__ import annotations

import numpy as np
import pytest

from soup_nlp.arrays import Int
from soup_nlp.model.pattern import Elements, Entries, Pattern, pattern_of


@pytest.mark.parametrize("size", [40, 100_000])
def test_a_pattern_is_the_union_of_its_sets(size):
    """Also where keys need more than four bytes, and elements stand where another does."""
    rng = np.random.default_rng(2)
    whole = rng.integers(0, size, (2, 7, 5))[:, [0, 0, 1, 2, 2, 2, 3, 4, 5, 6]]
    other = rng.integers(0, size, (2, 4, 3))
    other[:, 1] = whole[:, 6, :3]
    pattern = Pattern.of((size, size), [Entries(*whole), Entries(*other)])
    keys = pattern.columns * size + pattern.rows
    assert (np.diff(keys) > 0).all()
    for (rows, columns), place in zip((whole, other), pattern.places):
        np.testing.assert_array_equal(pattern.rows[place], rows.ravel())
        np.testing.assert_array_equal(pattern.columns[place], columns.ravel())
    assert len(keys) == len(set(np.concatenate(pattern.places).tolist()))


def runs(rng: np.random.Generator) -> list[Int]:
    """Indices of pairs of four variables each with a slack, also of one pair with itself."""
    pairs = np.vstack([rng.integers(0, 12, (30, 2)), [[5, 5], [7, 3], [3, 7]]])
    own = 4 * pairs[:, :, None] + np.arange(4)
    return [
        np.column_stack([own[:, 0], own[:, 1], 48 + np.arange(len(pairs))]),
        np.repeat(own[:, 0], 3, axis=0),
        # single variables, whose offsets in a block differ
        rng.integers(0, 48, (20, 1)),
    ]


def anyhow(rng: np.random.Generator) -> list[Int]:
    """Indices that follow no rule, some of them twice in an element."""
    return [rng.integers(0, 81, (9, 5)), rng.integers(20, 30, (9, 3)), np.zeros((0, 4), int)]


@pytest.mark.parametrize("indices", [runs, anyhow])
def test_a_pattern_by_blocks_is_that_of_every_nonzero(indices):
    rng = np.random.default_rng(4)
    sets: list[Elements] = []
    for index in indices(rng):
        local = rng.integers(0, index.shape[1], (2, 7))
        sets.append(Elements(index, *local))
    sets.append(Elements(sets[0].variables, *np.zeros((2, 0), int)))
    pairs = [np.sort([s.variables[:, s.rows], s.variables[:, s.columns]], axis=0) for s in sets]
    expected = Pattern.of((90, 90), [Entries(*own) for own in pairs])
    found = pattern_of(90, sets)
    for a, b in zip(found, expected):
        for one, two in zip(a, b) if isinstance(a, list) else [(a, b)]:
            np.testing.assert_array_equal(one, two)
    alone = pattern_of(90, sets, placed=False)
    np.testing.assert_array_equal(alone.rows, expected.rows)
    np.testing.assert_array_equal(alone.columns, expected.columns)
