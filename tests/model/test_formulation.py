"""One problem in every gauge: packing, names, sizes, patterns."""

from dataclasses import replace

import numpy as np
import pytest
from helpers_model import (
    GAUGES,
    PAPER,
    UNITS,
    assert_same_soup,
    form,
    random_soup,
    tiny,
    weights_for,
    world,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from soup_nlp.errors import ModelError
from soup_nlp.model import oracle
from soup_nlp.model.kernel import Pattern
from soup_nlp.model.layout import MatrixLayout, TangentLayout
from soup_nlp.model.programs import build_tangent_nlp, exact_chart

# --- layouts -------------------------------------------------------------------------------------


@pytest.mark.parametrize("gauge", GAUGES)
@settings(max_examples=8)
@given(seed=st.integers(0, 10_000))
def test_pack_and_unpack_are_inverse_of_each_other(gauge, seed):
    soup = random_soup(seed, 6)
    share = np.random.default_rng(seed).dirichlet(np.ones(6)) if seed % 2 else np.full(6, 1 / 6)
    layout = MatrixLayout(share, gauge)
    x = layout.pack(soup)
    assert x.shape == (layout.size,)
    back = layout.unpack(x)
    assert_same_soup(back, soup.normalised(share))
    np.testing.assert_allclose(layout.pack(back), x, atol=1e-12)
    if gauge == "unit-translation":
        # |t| is one and the same number for every superpixel
        np.testing.assert_allclose(np.linalg.norm(back.t, axis=1) / 6, x[-1], rtol=1e-12)


@pytest.mark.parametrize("chart", ["depth", "inverse-depth"])
@settings(max_examples=8)
@given(seed=st.integers(0, 10_000))
def test_tangent_pack_and_unpack_are_inverse_of_each_other(chart, seed):
    problem = tiny()
    layout = TangentLayout.about(problem.soup, problem.data, chart)
    soup = random_soup(seed, len(problem.seg))
    assert_same_soup(layout.unpack(layout.pack(soup)), soup.normalised(), 1e-11)


def test_superpixels_of_one_plane_stay_on_one_while_it_turns():
    """On the straight line between two planes, in the chart that the exact Hessian has."""
    soup, data = world("slanted", "pixels", False)
    other = replace(soup, n=np.tile(np.array([0.6, 0.0, -0.8]), (12, 1)))
    gap = {}
    for chart in ("depth", "inverse-depth"):
        layout = TangentLayout.about(soup, data, chart)
        half = layout.unpack((layout.pack(soup) + layout.pack(other)) / 2)
        gap[chart] = oracle.energy(half, data, PAPER)["cont"]
    assert gap.pop(exact_chart(data)) < 1e-9 < 1.0 < min(gap.values())
    # in the paper's units the length unit has to be linear in the scales
    assert exact_chart(tiny("paper").data) == "depth"


# --- names, sizes, print -------------------------------------------------------------------------


@pytest.mark.parametrize("gauge", GAUGES)
def test_names_are_unique_and_point_to_their_numbers(gauge):
    problem = tiny()
    nlp, layout = problem.nlp(weights_for("paper"), form(gauge=gauge))
    x, g = nlp.x_names(), nlp.g_names()
    assert len(x) == len(set(x)) == nlp.nx
    assert len(g) == len(set(g)) == nlp.ng
    k = 3 * layout.stride
    assert x[k : k + 4] == ["lam[3]", "n[3,1]", "n[3,2]", "n[3,3]"]
    # a name says where the number is
    soup = layout.unpack(nlp.x0)
    assert nlp.x0[x.index("R[5,2,1]")] == soup.R[5, 1, 0]
    assert nlp.x0[x.index("t[7,3]")] * len(problem.seg) == soup.t[7, 2]
    assert {"simplex", "so3[0,1]", "so3[11,6]", "normal[3]", "visible[5,1]"} <= set(g)
    assert ("translation[4]" in g) == (gauge == "unit-translation")
    # moving R[7] changes rows of superpixel 7 alone, but for edges
    hit = np.flatnonzero(nlp.jacobian(nlp.x0).toarray()[:, x.index("R[7,2,1]")])
    touched = [g[k] for k in hit]
    assert {"so3[7,1]", "so3[7,2]", "so3[7,4]"} <= set(touched)
    for name in touched:
        assert "7" in name.partition("[")[2].rstrip("]").split(",")[:2], name


def test_a_table_must_fit_its_kernel_and_be_finite():
    nlp, _ = tiny().nlp(PAPER, form())
    group = next(g for g in nlp.groups if g.kernel.name == "normal")
    with pytest.raises(ModelError, match="does not fit"):
        replace(group, index=group.index[:, 1:])
    with pytest.raises(ModelError, match="does not fit"):
        replace(group, rows=group.rows[1:])
    arap = next(g for g in nlp.groups if g.kernel.name == "arap")
    data = arap.data.copy()
    data[1, 2] = np.nan
    with pytest.raises(ModelError, match="NaN"):
        replace(arap, data=data)


@pytest.mark.parametrize("size", [40, 100_000])
def test_a_pattern_is_the_union_of_its_sets(size):
    """Also where keys need more than four bytes, and elements stand where another does."""
    rng = np.random.default_rng(2)
    whole = rng.integers(0, size, (2, 7, 5))[:, [0, 0, 1, 2, 2, 2, 3, 4, 5, 6]]
    other = rng.integers(0, size, (2, 4, 3))
    other[:, 1] = whole[:, 6, :3]
    pattern = Pattern((size, size), lambda: [whole, other])
    keys = pattern.columns * size + pattern.rows
    assert (np.diff(keys) > 0).all()
    for (rows, columns), place in zip((whole, other), pattern.places):
        np.testing.assert_array_equal(pattern.rows[place], rows)
        np.testing.assert_array_equal(pattern.columns[place], columns)
    assert len(keys) == len(set(np.concatenate([p.ravel() for p in pattern.places]).tolist()))


# --- one problem in every gauge ------------------------------------------------------------------


@pytest.mark.parametrize("units", UNITS)
def test_the_same_soup_has_the_same_objective_in_all_variables(units):
    problem, weights = tiny(units), weights_for(units)
    nlps = [problem.nlp(weights, form(gauge=gauge))[0] for gauge in GAUGES]
    nlps.append(build_tangent_nlp(problem.soup, problem.data, weights, form())[0])
    found = [nlp.value(nlp.x0) for nlp in nlps]
    assert found[0] > 0
    np.testing.assert_allclose(found[:-1], found[0], rtol=1e-12)
    assert found[-1] == pytest.approx(found[0], rel=1e-11)
