"""A term of one's own, added as docs/adding.md says: everything finds it by its one object."""

import casadi as ca
import numpy as np
import pytest
from helpers_model import PAPER, Tiny
from helpers_nl import ReadBack

from soup_nlp.export.nl import write_nl
from soup_nlp.model import oracle
from soup_nlp.model.elements import TERMS, Element, Term, _rays
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.norms import Norm
from soup_nlp.model.programs import build_matrix_nlp
from soup_nlp.refine.particles import PairCosts, Particles
from soup_nlp.schema.section import NonNegative


class WiderWeights(Weights):
    """Step 1: the options."""

    level: NonNegative = 0.7
    """Factor of E_level."""


def symbols(a, b, row):
    """Step 3: the ratio of the depths of two neighbours, in symbols."""
    ratio = a.anchor(row["ray_i"])[2] / b.anchor(row["ray_k"])[2]
    return [Norm(row["weight"], ca.log(ratio), row["eps"])]


def numbers(e, weights):
    """Step 4: the same in numpy."""
    log = np.log(e.states.inverse)
    return np.abs(log[e.k][:, None, :] - log[e.i][:, :, None])


def table(data, w):
    """Step 5: its elements."""
    columns = {"weight": w.level * data.pair_weight, **_rays(data, data.pairs)}
    return Element(data.pairs, columns, symbols)


def test_a_new_term_is_one_object(monkeypatch, tmp_path):
    tiny, weights = Tiny(), WiderWeights(**dict(PAPER))
    form = Formulation(eps=1e-9, eps_pixel=1e-9)
    without, _ = build_matrix_nlp(tiny.soup, tiny.data, weights, form)
    before = oracle.energy(tiny.soup, tiny.data, weights)
    monkeypatch.setitem(TERMS, "level", Term("level", table, "pair_weight", "pairs", numbers))
    energy = oracle.energy(tiny.soup, tiny.data, weights)
    i, k = tiny.data.pairs.T
    Z = tiny.soup.depth_at(tiny.data.anchor_ray)
    expected = 0.7 * np.sum(tiny.data.pair_weight * np.abs(np.log(Z[i] / Z[k])))
    assert energy["level"] == pytest.approx(expected, rel=1e-12)
    assert energy["total"] == pytest.approx(before["total"] + expected, rel=1e-12)
    nlp, _ = build_matrix_nlp(tiny.soup, tiny.data, weights, form)
    assert nlp.value(nlp.x0) - without.value(nlp.x0) == pytest.approx(expected, rel=1e-6)
    file = write_nl(tmp_path / "soup.nl", nlp)
    f = ReadBack(file.path).values(nlp.x0[file.variables])[0]
    assert float(f) == pytest.approx(nlp.value(nlp.x0), rel=1e-9)
    # the refinement's tables have it too
    p = Particles.of(tiny.soup)
    tables = PairCosts(tiny.data, weights).tables(p)
    monkeypatch.delitem(TERMS, "level")
    added = tables - PairCosts(tiny.data, weights).tables(p)
    assert added[:, 0, 0].sum() == pytest.approx(expected, rel=1e-9)
