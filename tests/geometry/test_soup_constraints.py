"""Residuals of the constraints: by hand, on arrays of others, and just beside every limit."""

from dataclasses import replace

import numpy as np
import pytest

import soup_nlp
from soup_nlp.errors import DataError
from soup_nlp.geometry.constraints import constraints
from soup_nlp.geometry.soup import Soup

RAYS = np.array([[[0.0, 0, 1], [1, 0, 1]]] * 2)
GOOD = Soup(
    lam=np.full(2, 0.5),
    n=np.array([[0.6, 0, -0.8], [0.0, 0, -1.0]]),
    d=np.ones(2),
    R=np.stack([np.eye(3), np.eye(3)]),
    t=np.zeros((2, 3)),
)


def changed(name, index, change, soup=GOOD):
    """A soup with another number at one place."""
    values = getattr(soup, name).copy()
    values[index] += change
    return replace(soup, **{name: values})


def test_residuals_by_hand():
    found = constraints(GOOD, RAYS, 0.3)
    off = {"so3": 0, "det": 0, "normal": 0, "simplex": 0, "positive": 0, "visible": 0.1}
    assert found.largest == pytest.approx(off, abs=1e-12)
    assert found["visible"].worst[0][0] == 0
    one = {
        "lam": np.array([0.4]),
        "n": 1.1 * GOOD.n[:1],
        "d": np.array([-0.2]),
        "R": 1.1 * GOOD.R[:1],
        "t": GOOD.t[:1],
    }
    off = {"so3": 0.21, "normal": 0.21, "simplex": 0.6, "positive": 0.2, "det": 1.1**3 - 1}
    assert soup_nlp.constraints(one).largest == pytest.approx(off)
    # a reflection passes R^T R = I and fails here
    mirror = constraints(replace(GOOD, R=np.stack([np.eye(3), np.diag([1.0, 1.0, -1.0])])))
    assert mirror["so3"].largest == 0
    assert mirror["det"].worst == ((1, 2.0),)
    assert not mirror.within(1.0)


# a kind, its limit, and a soup whose residual is `r`
BESIDE = {
    "so3": (1e-8, lambda r: changed("R", (1, 0, 0), r / 2)),
    # entries of R'R stay within their limit
    "det": (1e-8, lambda r: replace(GOOD, R=np.stack([np.eye(3) * (1 + r / 3), np.eye(3)]))),
    "normal": (1e-8, lambda r: changed("n", (1, 2), -r / 2)),
    "simplex": (1e-10, lambda r: changed("lam", 0, r)),
    "positive": (0.0, lambda r: changed("d", 1, -1.0 + (1e-9 if r < 0 else 0.0))),
    "visible": (1e-6, lambda r: GOOD),
}


@pytest.mark.parametrize("kind", BESIDE)
def test_every_limit_holds_just_inside_and_fails_just_outside(kind):
    limit, soup = BESIDE[kind]
    for factor, good in ((0.98, True), (1.02, False)):
        r = factor * limit if limit else (-1.0 if good else 1.0)
        # the plane of superpixel 0 has -n . r = 0.2 at its second ray
        found = constraints(soup(r), RAYS, 0.2 + r if kind == "visible" else 0.1)
        assert found.within() == found[kind].ok == good
        assert found[kind].beyond == (not good)
        if limit:
            assert found[kind].largest == pytest.approx(r, rel=1e-4)
            assert found.within(1.01 * limit) == good


def test_numbers_that_are_not_finite_violate_every_kind():
    found = constraints(changed("t", (1, 0), np.nan), RAYS)
    assert all(kind.worst[0] == (1, np.inf) for kind in found.values() if kind.superpixels)
    assert not found.within(np.finfo(float).max)
    assert constraints(changed("lam", 0, np.inf)).largest["simplex"] == np.inf


@pytest.mark.parametrize(
    ("soup", "message"),
    [
        ({}, "lam"),
        (vars(GOOD) | {"R": np.eye(3)}, r"where: R\n  found: \(3, 3\)"),
        (vars(GOOD) | {"n": "n"}, "where: n"),
        (3, "of another kind"),
    ],
)
def test_arrays_that_are_no_soup_are_refused(soup, message):
    with pytest.raises(DataError, match=message):
        soup_nlp.constraints(soup)
    with pytest.raises(DataError, match="where: rays"):
        soup_nlp.constraints(GOOD, RAYS[:1])
