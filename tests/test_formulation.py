"""One problem in every gauge: packing, names, sizes, feasibility, constraints, visibility."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest
from helpers_formulation import FORMS, TERMS, UNITS, assert_same_soup, form, tiny
from helpers_model import GAUGES, PAPER, random_soup, value, weights_for
from hypothesis import given, settings
from hypothesis import strategies as st

from soup_nlp.errors import ConfigError, ModelError
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.kernel import Group, Kernel, Table
from soup_nlp.model.layout import MatrixLayout, TangentLayout
from soup_nlp.model.nlp import NLP
from soup_nlp.model.tangent_nlp import build_tangent_nlp

# --- layouts -------------------------------------------------------------------------------------


@pytest.mark.parametrize("gauge", GAUGES)
@settings(max_examples=20)
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
@settings(max_examples=20)
@given(seed=st.integers(0, 10_000))
def test_tangent_pack_and_unpack_are_inverse_of_each_other(chart, seed):
    problem = tiny()
    layout = TangentLayout.about(problem.soup, problem.data, chart)
    soup = random_soup(seed, len(problem.seg))
    assert_same_soup(layout.unpack(layout.pack(soup)), soup.normalised(), 1e-11)


def test_the_base_of_the_presolve_is_where_it_says():
    problem = tiny()
    x = TangentLayout.about(problem.soup, problem.data).pack(problem.soup).reshape(-1, 9)
    np.testing.assert_allclose(x[:, 0], 1, rtol=1e-14)
    np.testing.assert_allclose(x[:, 3:6], 0, atol=1e-14)


def test_a_superpixel_at_rest_gets_a_tiny_translation_in_its_gauge():
    soup = random_soup(0, 6)
    t = soup.t.copy()
    t[2] = 0
    soup = replace(soup, t=t)
    back = MatrixLayout(np.full(6, 1 / 6), "unit-translation")
    back = back.unpack(back.pack(soup))
    truth = soup.normalised()
    length = np.linalg.norm(truth.translation, axis=1)
    moved = np.linalg.norm(back.translation - truth.translation, axis=1)
    assert 0 < moved[2] < 2e-3 * np.median(length)
    np.testing.assert_allclose(np.delete(moved, 2), 0, atol=1e-12)
    for gauge in ("unit-offset", "free"):
        layout = MatrixLayout(np.full(6, 1 / 6), gauge)
        np.testing.assert_array_equal(layout.unpack(layout.pack(soup)).translation[2], 0)


# --- names, sizes, print -------------------------------------------------------------------------


@pytest.mark.parametrize(("norm", "truncation"), FORMS)
@pytest.mark.parametrize("gauge", GAUGES)
def test_names_are_unique_and_as_many_as_there_are_numbers(gauge, norm, truncation):
    problem = tiny()
    nlp, layout = problem.nlp(
        weights_for("paper"), form(gauge=gauge, norm=norm, truncation=truncation)
    )
    x, g = nlp.x_names(), nlp.g_names()
    assert len(x) == len(set(x)) == nlp.nx
    assert len(g) == len(set(g)) == nlp.ng
    k = 3 * layout.stride
    assert x[k : k + 4] == ["lam[3]", "n[3,1]", "n[3,2]", "n[3,3]"]
    # a name says where the number is
    soup = layout.unpack(nlp.x0)
    assert nlp.x0[x.index("R[5,2,1]")] == soup.R[5, 1, 0]
    assert nlp.x0[x.index("t[7,3]")] * len(problem.seg) == soup.t[7, 2]
    kinds = {re.sub(r"\[.*", "", name) for name in g}
    assert {"so3", "normal", "visible", "simplex"} <= kinds


def test_names_of_the_presolve():
    problem = tiny()
    nlp, _ = build_tangent_nlp(problem.soup, problem.data, PAPER, form())
    assert len(set(nlp.x_names())) == nlp.nx == 9 * 12
    names = nlp.g_names()
    assert len(set(names)) == nlp.ng
    assert {re.sub(r"\[.*", "", name) for name in names} == {"simplex", "visible"}
    assert nlp.x_names()[9:12] == ["lam[1]", "s1[1]", "s2[1]"]


def test_sizes_are_those_of_the_formulation():
    problem, n = tiny(), 12
    nlp, _ = problem.nlp(PAPER, form())
    sizes = nlp.sizes()
    assert sizes["variables"] == 16 * n
    assert sizes["equalities"] == 6 * n + n + 1
    assert sizes["inequalities"] == 9 * n
    free, _ = problem.nlp(PAPER, form(gauge="free"))
    assert free.sizes()["variables"] == 17 * n
    assert free.sizes()["equalities"] == 7 * n + 2
    other, _ = problem.nlp(PAPER, form(gauge="unit-translation"))
    assert other.sizes()["variables"] == 17 * n + 1
    assert other.sizes()["equalities"] == 8 * n + 2
    slack, _ = problem.nlp(weights_for("paper"), form(norm="epigraph", truncation="lifted"))
    e, p, pixels = len(problem.seg.edges), len(problem.seg.pairs), problem.data.pixel_weight
    norms = 4 * e + 2 * p + int((pixels > 0).sum())
    # orientation has no epigraph (a square is smooth) but a switch
    # and the prior is not truncated
    assert slack.sizes()["variables"] == 16 * n + 2 * norms - e + p
    assert slack.sizes()["inequalities"] == 9 * n + norms
    assert sizes["jacobian_nonzeros"] == nlp.nnzj == nlp.jac_g.nnz_out(1)


def test_the_print_shows_sizes_bound_kinds_and_sparsity():
    nlp, _ = tiny().nlp(PAPER, form(norm="epigraph", truncation="lifted"))
    text = str(nlp)
    assert text.startswith(f"NLP soup: {nlp.nx} variables, {nlp.ng} constraints")
    rows = {}
    for label, kind, count in re.findall(
        r"^  (variables|constraints) +(\w+) +#+ +(\d+)$", text, re.M
    ):
        rows[label, kind] = int(count)
    assert sum(v for (label, _), v in rows.items() if label == "variables") == nlp.nx
    assert sum(v for (label, _), v in rows.items() if label == "constraints") == nlp.ng
    switches = sum(name.startswith("z_") for name in nlp.x_names())
    assert rows["variables", "range"] == switches > 0
    assert rows["constraints", "fixed"] == nlp.sizes()["equalities"]
    assert f"{nlp.nnzj} nonzeros" in text
    assert f"{nlp.nnzh} nonzeros" in text
    assert "Hessian kind: exact" in text
    for name in (*TERMS, "so3", "normal", "visible", "simplex"):
        assert re.search(rf"^  {name} +\d+ x ", text, re.M), name


@pytest.mark.parametrize("wrong", [{"gauge": "sideways"}, {"hessian": "guess"}])
def test_unknown_kinds_of_formulation_are_refused(wrong):
    with pytest.raises(ConfigError, match=next(iter(wrong.values()))):
        Formulation.make(wrong)


def test_unknown_parameters_are_refused():
    nlp, _ = tiny().nlp(PAPER, form())
    with pytest.raises(ModelError, match="unknown parameter"):
        nlp.with_theta(epsilon=1.0)


def test_a_table_must_fit_its_kernel_and_be_finite():
    nlp, _ = tiny().nlp(PAPER, form())
    group = next(g for g in nlp.groups if g.kernel.name == "normal")
    kernel: Kernel = group.kernel
    with pytest.raises(ModelError, match="does not fit"):
        Group(kernel, replace(group.table, index=group.table.index[:, 1:]))
    with pytest.raises(ModelError, match="does not fit"):
        Group(kernel, replace(group.table, rows=group.table.rows[1:]))
    arap = next(g for g in nlp.groups if g.kernel.name == "arap")
    data = arap.table.data.copy()
    data[1, 2] = np.nan
    with pytest.raises(ModelError, match="NaN"):
        Group(arap.kernel, Table(arap.table.index, data, arap.table.rows))


# --- one problem in every gauge ------------------------------------------------------------------


@pytest.mark.parametrize("units", UNITS)
@pytest.mark.parametrize(("norm", "truncation"), FORMS)
def test_the_same_soup_has_the_same_objective_in_every_gauge(norm, truncation, units):
    problem, found = tiny(units), []
    for gauge in GAUGES:
        nlp, _ = problem.nlp(
            weights_for(units), form(gauge=gauge, norm=norm, truncation=truncation)
        )
        found.append(value(nlp, nlp.x0)[0])
    assert found[0] > 0
    np.testing.assert_allclose(found, found[0], rtol=1e-12)


@pytest.mark.parametrize("units", UNITS)
def test_the_presolve_has_the_same_objective_as_the_constrained_nlp(units):
    problem = tiny(units)
    one, _ = problem.nlp(weights_for(units), form())
    two, _ = build_tangent_nlp(problem.soup, problem.data, weights_for(units), form())
    assert value(two, two.x0)[0] == pytest.approx(value(one, one.x0)[0], rel=1e-11)


@pytest.mark.parametrize(("norm", "truncation"), FORMS)
@pytest.mark.parametrize("gauge", GAUGES)
def test_the_start_is_feasible(gauge, norm, truncation):
    problem = tiny("pixels")
    nlp, _ = problem.nlp(weights_for("pixels"), form(gauge=gauge, norm=norm, truncation=truncation))
    g = value(nlp, nlp.x0)[1]
    assert np.maximum(nlp.lbg - g, g - nlp.ubg).max() <= 1e-9
    assert (nlp.lbx <= nlp.x0).all()
    assert (nlp.x0 <= nlp.ubx).all()
    assert np.isfinite(nlp.x0).all()


def test_the_start_of_the_presolve_is_feasible():
    problem = tiny("pixels")
    nlp, _ = build_tangent_nlp(problem.soup, problem.data, weights_for("pixels"), form())
    g = value(nlp, nlp.x0)[1]
    assert g[nlp.g_names().index("simplex[0]")] == pytest.approx(1.0, abs=1e-12)
    assert np.maximum(nlp.lbg - g, g - nlp.ubg).max() <= 1e-9
    assert ((nlp.lbx <= nlp.x0) & (nlp.x0 <= nlp.ubx)).all()


@pytest.mark.parametrize("gauge", GAUGES)
def test_constraints_say_what_is_wrong_with_a_point(gauge):
    """Each kind of constraint reacts to its own violation, by the amount of the formula."""
    problem = tiny()
    nlp, layout = problem.nlp(PAPER, form(gauge=gauge, depth_ratio=4.0))
    names, x_names = nlp.g_names(), nlp.x_names()

    def rows(kind: str, x: np.ndarray) -> np.ndarray:
        g = value(nlp, x)[1]
        return np.array([v for v, name in zip(g, names) if name.startswith(kind)])

    x = nlp.x0.copy()
    x[x_names.index("lam[4]")] += 0.12
    assert rows("simplex", x)[0] == pytest.approx(1 + 0.12 / 12)
    x = nlp.x0.copy()
    x[[x_names.index(f"n[4,{c}]") for c in (1, 2, 3)]] *= 1.1
    np.testing.assert_allclose(rows("normal", x)[4], 1.1**2 - 1)
    x = nlp.x0.copy()
    R = [x_names.index(f"R[4,{r},{c}]") for r in (1, 2, 3) for c in (1, 2, 3)]
    x[R] *= 1.1
    so3 = rows("so3", x).reshape(-1, 6)
    np.testing.assert_allclose(so3[4], 0.21 * np.array([1, 0, 1, 0, 0, 1]), atol=1e-12)
    np.testing.assert_allclose(np.delete(so3, 4, axis=0), 0, atol=1e-12)
    # a shear breaks orthogonality alone
    x = nlp.x0.copy()
    x[R] = (x[R].reshape(3, 3) @ [[1, 0.1, 0], [0, 1, 0], [0, 0, 1]]).ravel()
    np.testing.assert_allclose(
        rows("so3", x).reshape(-1, 6)[4], [0, 0.1, 0.01, 0, 0, 0], atol=1e-12
    )
    x = nlp.x0.copy()
    if gauge != "unit-offset":
        # the length unit: the mean plane distance, N lam x d / N, is one
        x[x_names.index("d[4]")] += 0.12
        assert rows("unit", x)[0] == pytest.approx(1 + 0.12 * x[x_names.index("lam[4]")] / 12)
    if gauge == "unit-translation":
        t = [x_names.index(f"t[4,{c}]") for c in (1, 2, 3)]
        x[t] *= 1.1
        length = rows("translation", x)
        np.testing.assert_allclose(length[4], 0.21 * x[layout.tau] ** 2)
        np.testing.assert_allclose(np.delete(length, 4), 0, atol=1e-14)
    # the anchor faces the camera, and no rim pixel is more than four times as deep
    soup = layout.unpack(nlp.x0)
    facing = -np.einsum("nc,nvc->nv", soup.n, problem.data.rim_ray)
    facing[:, 1:] -= facing[:, :1] / 4.0
    np.testing.assert_allclose(rows("visible", nlp.x0), facing.ravel(), atol=1e-14)
    assert (nlp.lbg[[name.startswith("visible") for name in names]] > 0).all()


@pytest.mark.parametrize("ratio", [2.0, 5.0])
def test_visibility_bounds_the_depth_over_a_superpixel(ratio):
    """A plane that the constrained NLP or the presolve admits is nowhere too steep."""
    problem, rng = tiny(), np.random.default_rng(0)
    f = form(depth_ratio=ratio)
    nlp, layout = problem.nlp(PAPER, f)
    pre, tangent = build_tangent_nlp(problem.soup, problem.data, PAPER, f)
    rim = problem.data.rim_ray
    admitted = 0
    for _ in range(200):
        n = rng.normal(0, 1, (12, 3)) * [4, 4, 1]
        n /= -np.sign(n[:, 2:]) * np.linalg.norm(n, axis=1, keepdims=True)
        soup = replace(problem.soup, n=n)
        facing = -np.einsum("nc,nvc->nv", n, rim)
        steep = (facing[:, 1:] <= facing[:, :1] / ratio).any(axis=1) | (facing <= 0).any(axis=1)
        g = value(nlp, layout.pack(soup))[1]
        bad = _violated(nlp, g)
        assert (bad[facing[:, 0] > 0] >= steep[facing[:, 0] > 0]).all()
        assert bad[facing[:, 0] <= 0].all()
        admitted += int((~bad).sum())
        # the presolve admits no more than the constrained NLP
        sees = (facing > 0).all(axis=1)
        other = _violated(pre, value(pre, tangent.pack(replace(soup, n=_facing(n, sees))))[1])
        assert (other[sees] >= bad[sees]).all()
    assert admitted > 100


def _facing(n: np.ndarray, keep: np.ndarray) -> np.ndarray:
    """Normals, those not kept replaced by the optical axis."""
    return np.where(keep[:, None], n, [0.0, 0.0, -1.0])


def _violated(nlp: NLP, g: np.ndarray) -> np.ndarray:
    """(N,) whether any visibility row of a superpixel is violated."""
    rows = np.array([name.startswith("visible") for name in nlp.g_names()])
    return (g[rows] < nlp.lbg[rows]).reshape(12, -1).any(axis=1)
