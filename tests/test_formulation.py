"""One problem in every gauge and form: packing, feasibility, exactness, zeros, invariances."""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cache

import casadi as ca
import numpy as np
import pytest
from helpers_model import (
    GAUGES,
    HEIGHT,
    K_NEXT,
    K_REF,
    PAPER,
    WIDTH,
    Tiny,
    gradient,
    motion,
    plane_pose,
    plane_soup,
    plane_world,
    random_soup,
    value,
    weights_for,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from soup_nlp.data.pair import Flow
from soup_nlp.errors import ModelError
from soup_nlp.geometry import camera, rotation
from soup_nlp.geometry.graph import build_segmentation
from soup_nlp.geometry.soup import Soup
from soup_nlp.geometry.superpixels import segment
from soup_nlp.model import plain
from soup_nlp.model.energy import EnergyData, Weights, build_energy_data, in_pixels, sample_pixels
from soup_nlp.model.formulation import Formulation, build_matrix_nlp, build_tangent_nlp
from soup_nlp.model.kernel import Group, Kernel, Table
from soup_nlp.model.layout import MatrixLayout, TangentLayout
from soup_nlp.model.nlp import NLP

UNITS = ("paper", "pixels")
FORMS = [(n, t) for n in ("smooth", "epigraph") for t in ("smooth", "lifted")]
TERMS = ("arap", "proj", "cont", "orient")


@cache
def tiny(units: str = "paper", at_anchors: bool = False) -> Tiny:
    return Tiny(units, at_anchors)


def form(**options) -> Formulation:
    return Formulation(**{"compiled": False, **options})


def assert_same_soup(a: Soup, b: Soup, tolerance: float = 1e-12) -> None:
    np.testing.assert_allclose(a.lam.sum(), 1.0, rtol=tolerance)
    for name in ("n", "R", "distance", "translation"):
        np.testing.assert_allclose(getattr(a, name), getattr(b, name), rtol=0, atol=tolerance)


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


@settings(max_examples=20)
@given(seed=st.integers(0, 10_000))
def test_tangent_pack_and_unpack_are_inverse_of_each_other(seed):
    problem = tiny()
    layout = TangentLayout.about(problem.soup, problem.data)
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
    norms = 3 * e + 2 * p + int((pixels > 0).sum())
    # orientation has no epigraph (a square is smooth) but a switch
    assert slack.sizes()["variables"] == 16 * n + 2 * norms + p
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


def test_wrong_words_are_model_errors():
    problem = tiny()
    with pytest.raises(ModelError, match=r"gauge.*\n.*sideways"):
        problem.nlp(PAPER, form(gauge="sideways"))
    with pytest.raises(ModelError, match="Hessian"):
        problem.nlp(PAPER, form(hessian="guess"))
    nlp, _ = problem.nlp(PAPER, form())
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


# --- solver forms and the exact energy -----------------------------------------------------------


def by_term(nlp: NLP, x: np.ndarray, p: np.ndarray) -> dict[str, float]:
    """Objective by kernel."""
    out = {}
    for group in nlp.groups:
        k, t = group.kernel, group.table
        if k.name not in TERMS:
            continue
        f = ca.Function("f", [k.x, k.row, k.theta], [k.objective]).map(len(t))
        theta = np.repeat(p[: len(nlp.theta), None], len(t), axis=1)
        out[k.name] = float(np.asarray(f(x[t.index].T, t.data.T, theta)).sum())
    return out


@pytest.mark.parametrize("units", UNITS)
def test_the_smooth_norm_tends_to_the_exact_energy(units):
    problem = tiny(units)
    weights = replace(weights_for(units, truncated=False), sigma_cont=np.inf)
    nlp, _ = problem.nlp(weights, form(truncation="smooth"))
    exact = plain.energy(problem.soup, problem.data, weights)
    gap = []
    for eps in (1e-2, 1e-3, 1e-4, 1e-7):
        made = by_term(nlp, nlp.x0, nlp.with_theta(eps=eps, eps_pixel=eps))
        gap.append([(exact[k] - made[k]) / exact[k] for k in ("arap", "proj", "cont")])
    # sqrt(v^2 + eps^2) - eps is below |v| by less than eps, and nearer with every smaller eps
    assert (np.array(gap) > 0).all()
    assert (np.diff(gap, axis=0) < 0).all()
    assert max(gap[-1]) < 1e-5


@pytest.mark.parametrize("units", UNITS)
def test_the_smooth_truncation_stays_near_the_exact_energy(units):
    """Its corner is rounded by a share of sigma, whatever eps: within a fifth of sigma a norm."""
    problem, weights, data = tiny(units), weights_for(units), tiny(units).data
    nlp, _ = problem.nlp(weights, form(truncation="smooth", eps=1e-7, eps_pixel=1e-7))
    exact, made = plain.energy(problem.soup, data, weights), by_term(nlp, nlp.x0, nlp.p)
    w = weights
    cap = {
        "arap": 3 * w.arap * w.sigma_arap * data.edge_weight.sum(),
        "proj": w.proj * w.sigma_proj * data.pixel_weight.sum(),
        "cont": w.cont * (w.sigma_cont + w.sigma_cont_ref) * data.pair_weight.sum(),
        "orient": w.orient * w.sigma_orient * data.pair_count.sum(),
    }
    for term in TERMS:
        assert abs(made[term] - exact[term]) <= 0.2 * cap[term]


def parts(nlp: NLP, letter: str) -> dict[str, int]:
    """Index of every slack ("s") or switch ("z") by what it belongs to."""
    return {name[2:]: i for i, name in enumerate(nlp.x_names()) if name.startswith(f"{letter}_")}


def optimal_extras(nlp: NLP) -> np.ndarray:
    """x0 with the smallest feasible slacks and the better end of every switch."""
    x = nlp.x0.copy()
    slack, switch = parts(nlp, "s"), parts(nlp, "z")
    x[list(slack.values())] = 0.0
    g = dict(zip(nlp.g_names(), value(nlp, x)[1]))
    for name, i in slack.items():
        # s^2 - |v|^2 at s = 0
        x[i] = np.sqrt(max(0.0, -g[f"epigraph_{name}"]))
    index = list(switch.values())
    x[index] = (gradient(nlp, x)[index] < 0).astype(float)
    return x


@pytest.mark.parametrize("truncated", [True, False])
@pytest.mark.parametrize("units", UNITS)
@pytest.mark.parametrize("gauge", GAUGES)
def test_epigraph_and_lifted_at_their_optimum_are_the_exact_energy(gauge, units, truncated):
    problem, weights = tiny(units), weights_for(units, truncated)
    nlp, _ = problem.nlp(weights, form(gauge=gauge, norm="epigraph", truncation="lifted"))
    exact = plain.energy(problem.soup, problem.data, weights)
    x = optimal_extras(nlp)
    f, g = value(nlp, x)
    assert f == pytest.approx(exact["total"], rel=1e-10)
    assert np.maximum(nlp.lbg - g, g - nlp.ubg).max() <= 1e-9
    for term, e in by_term(nlp, x, nlp.p).items():
        assert e == pytest.approx(exact[term], rel=1e-10)
    # whatever else the slacks and switches are, as long as they are feasible, f is not lower
    rng = np.random.default_rng(0)
    slack, switch = list(parts(nlp, "s").values()), list(parts(nlp, "z").values())
    for _ in range(10):
        y = x.copy()
        y[slack] += rng.exponential(0.1, len(slack)) * (rng.random(len(slack)) < 0.5)
        y[switch] = rng.uniform(0, 1, len(switch))
        assert value(nlp, y)[0] > f
    # and the start is nearly there
    assert f <= value(nlp, nlp.x0)[0] <= 1.5 * f


@pytest.mark.parametrize("units", UNITS)
def test_lifted_alone_at_its_optimum_is_the_exact_energy_as_eps_vanishes(units):
    problem, weights = tiny(units), weights_for(units)
    nlp, _ = problem.nlp(weights, form(truncation="lifted", eps=1e-9, eps_pixel=1e-9))
    exact = plain.energy(problem.soup, problem.data, weights)["total"]
    assert value(nlp, optimal_extras(nlp))[0] == pytest.approx(exact, rel=1e-7)


def test_epigraph_alone_at_its_optimum_is_the_exact_energy_without_truncations():
    problem = tiny()
    weights = replace(PAPER, sigma_cont=np.inf, orient=0.0)
    nlp, _ = problem.nlp(weights, form(norm="epigraph"))
    exact = plain.energy(problem.soup, problem.data, weights)["total"]
    assert value(nlp, optimal_extras(nlp))[0] == pytest.approx(exact, rel=1e-10)


def test_orientation_can_do_without_truncation():
    problem, weights = tiny(), replace(PAPER, sigma_orient=np.inf)
    nlp, _ = problem.nlp(weights, form())
    exact = plain.energy(problem.soup, problem.data, weights)["orient"]
    assert by_term(nlp, nlp.x0, nlp.p)["orient"] == pytest.approx(exact, rel=1e-12)


@pytest.mark.parametrize("name", ["arap", "proj", "cont", "orient"])
def test_a_weight_scales_its_term_alone(name):
    problem = tiny()
    nlp, _ = problem.nlp(PAPER, form())
    twice, _ = problem.nlp(replace(PAPER, **{name: 2 * getattr(PAPER, name)}), form())
    a, b = by_term(nlp, nlp.x0, nlp.p), by_term(twice, nlp.x0, twice.p)
    for term in TERMS:
        assert b[term] == pytest.approx((2 if term == name else 1) * a[term], rel=1e-12)


# --- zero-energy facts ---------------------------------------------------------------------------

WORLDS = {
    "fronto-parallel, sideways": (plane_pose(2.0), motion((0, 0, 0), (0.1, 0.03, 0))),
    "fronto-parallel, turning": (plane_pose(3.0), motion((0.5, -1, 2), (0.1, 0.03, 0.2))),
    "slanted": (plane_pose(2.5, yaw=25, pitch=-30), motion((1, 0.5, -1), (0.02, 0.1, -0.1))),
    "at rest": (plane_pose(2.0, yaw=10), motion((0, 0, 0), (0, 0, 0))),
}


def world(name: str, units: str, at_anchors: bool) -> tuple[Soup, EnergyData]:
    pose, move = WORLDS[name]
    pair = plane_world(pose, move, WIDTH, HEIGHT)
    seg = build_segmentation(segment(pair.image_ref, 12, "grid"), pair.image_ref, neighbours=5)
    data = build_energy_data(
        seg, pair.flow, pair.K_ref, pair.K_next, 8, 0, arap_at_anchors=at_anchors
    )
    soup = plane_soup(pose, move, len(seg))
    return soup, in_pixels(data, soup, seg) if units == "pixels" else data


@pytest.mark.parametrize("at_anchors", [True, False])
@pytest.mark.parametrize("units", UNITS)
@pytest.mark.parametrize("name", WORLDS)
def test_a_rigid_plane_has_no_energy_at_the_truth(name, units, at_anchors):
    soup, data = world(name, units, at_anchors)
    e = plain.energy(soup, data, PAPER)
    unit = 1.0 if units == "paper" else 100.0  # one radian is about 100 pixels
    assert e["arap"] <= 1e-12 * unit
    assert e["cont"] <= 1e-12 * unit / 0.005  # half a pixel of parallax at the least
    assert e["orient"] <= 1e-12
    assert e["proj"] <= 1e-10  # pixels


@pytest.mark.parametrize(("norm", "truncation"), FORMS)
@pytest.mark.parametrize("name", ["fronto-parallel, turning", "slanted"])
def test_the_truth_of_a_rigid_plane_is_stationary_in_every_form(name, norm, truncation):
    soup, data = world(name, "pixels", False)
    for gauge in GAUGES:
        nlp, layout = build_matrix_nlp(
            soup, data, PAPER, form(gauge=gauge, norm=norm, truncation=truncation, eps=0.03)
        )
        x = optimal_extras(nlp) if norm == "epigraph" or truncation == "lifted" else nlp.x0
        assert value(nlp, x)[0] <= 1e-9
        if norm == "smooth":
            assert np.abs(gradient(nlp, x)[: layout.size]).max() <= 1e-5


def test_energy_is_positive_off_the_truth_and_each_term_reacts():
    soup, data = world("slanted", "paper", False)
    rng = np.random.default_rng(0)

    def terms(**change) -> dict[str, float]:
        return plain.energy(replace(soup, **change), data, PAPER)

    turned = rotation.exp(rng.normal(0, 0.01, (12, 3))) @ soup.R
    e = terms(R=turned)
    assert min(e["arap"], e["proj"], e["cont"]) > 1e-3
    assert e["orient"] <= 1e-12
    n = soup.n + rng.normal(0, 0.05, (12, 3))
    e = terms(n=n / np.linalg.norm(n, axis=1, keepdims=True))
    assert min(e["proj"], e["cont"], e["orient"]) > 1e-3
    # one rigid motion stays rigid, whatever the shape
    assert e["arap"] <= 1e-12
    # scale alone does not change the flow (the homography knows t / d only), but all gaps
    e = terms(lam=soup.lam * rng.uniform(0.8, 1.2, 12))
    assert e["proj"] <= 1e-10
    assert e["orient"] <= 1e-12
    assert min(e["arap"], e["cont"]) > 1e-3


# --- invariances ---------------------------------------------------------------------------------


def energies(soup: Soup, data: EnergyData, weights: Weights) -> np.ndarray:
    e = plain.energy(soup, data, weights)
    return np.array([e[k] for k in TERMS])


@pytest.mark.parametrize("units", UNITS)
@settings(max_examples=15)
@given(seed=st.integers(0, 10_000), scale=st.floats(1e-3, 1e3))
def test_energy_knows_no_global_scale_and_no_gauge(units, seed, scale):
    problem, weights = tiny(units), weights_for(units)
    soup = random_soup(seed, 12)
    c = np.random.default_rng(seed).uniform(0.1, 10, 12)
    expected = energies(soup, problem.data, weights)
    for twin in (
        replace(soup, lam=scale * soup.lam),
        replace(soup, d=scale * soup.d, t=scale * soup.t),
        Soup(c * soup.lam, soup.n, soup.d / c, soup.R, soup.t / c[:, None]),
        soup.normalised(),
    ):
        np.testing.assert_allclose(energies(twin, problem.data, weights), expected, rtol=1e-9)


@pytest.mark.parametrize("at_anchors", [True, False])
@pytest.mark.parametrize("units", UNITS)
@settings(max_examples=15)
@given(seed=st.integers(0, 10_000))
def test_a_rigid_motion_of_the_next_camera_changes_the_projection_only(units, at_anchors, seed):
    """X'' = Q X' + s: distances of all motions and points of the next frame stay."""
    problem, weights = tiny(units, at_anchors), replace(weights_for(units), sigma_proj=np.inf)
    soup = random_soup(seed, 12)
    rng = np.random.default_rng(seed)
    Q, s = rotation.exp(rng.normal(0, 0.3, 3)), rng.normal(0, 0.3, 3)
    moved = replace(soup, R=Q @ soup.R, t=soup.t @ Q.T + s / soup.lam[:, None])
    before, after = (energies(x, problem.data, weights) for x in (soup, moved))
    np.testing.assert_allclose(after[[0, 2, 3]], before[[0, 2, 3]], rtol=1e-9)
    assert after[1] != pytest.approx(before[1], rel=1e-3)


@settings(max_examples=15)
@given(seed=st.integers(0, 10_000))
def test_turning_the_reference_frame_with_all_its_rays_changes_nothing(seed):
    """X -> Q X: rays, normals and rotations turn together. Depth along z alone would not stand it,
    so lengths here are in the paper's unit."""
    problem, weights = tiny("paper", True), weights_for("paper")
    soup, data = random_soup(seed, 12), problem.data
    Q = rotation.exp(np.random.default_rng(seed).normal(0, 0.5, 3))
    turned = replace(soup, n=soup.n @ Q.T, R=soup.R @ Q.T)
    rays = {name: getattr(data, name) @ Q.T for name in ("anchor_ray", "pixel_ray", "boundary_ray")}
    np.testing.assert_allclose(
        energies(turned, replace(data, **rays), weights),
        energies(soup, data, weights),
        rtol=1e-9,
    )


def test_the_order_of_the_superpixels_does_not_matter():
    # every anchor is a neighbour of every other: fewer would be chosen among equally near ones
    problem, weights = Tiny(neighbours=11), weights_for("paper")
    order = np.random.default_rng(0).permutation(12)
    rank = np.argsort(order).astype(np.int32)
    seg = build_segmentation(
        rank[problem.seg.labels], problem.image, neighbours=11, boundary_samples=2
    )
    data = build_energy_data(seg, problem.flow, K_REF, K_NEXT, 3, 0)
    s = problem.soup
    soup = Soup(s.lam[order], s.n[order], s.d[order], s.R[order], s.t[order])
    np.testing.assert_allclose(
        energies(soup, data, weights), energies(s, problem.data, weights), rtol=1e-12
    )


def test_local_units_make_every_edge_blind_to_its_own_scale():
    """Both superpixels of an edge twice as far: its energy stays, while others' does not."""
    problem, weights = tiny("pixels", True), weights_for("pixels", truncated=False)
    i, k = problem.seg.edges[0]
    lam = problem.soup.lam.copy()
    lam[[i, k]] *= 2
    twice = replace(problem.soup, lam=lam)
    a = plain.arap(problem.soup, problem.data, weights)
    b = plain.arap(twice, problem.data, weights)
    assert b[0] == pytest.approx(a[0], rel=1e-12)
    touched = np.isin(problem.seg.edges, [i, k]).any(axis=1)
    np.testing.assert_allclose(b[~touched], a[~touched], rtol=1e-12)
    assert (b[touched][1:] != a[touched][1:]).all()


# --- energy by hand ------------------------------------------------------------------------------


def test_two_superpixels_by_hand():
    """Two fronto-parallel planes at depths 1 and 3, both moved sideways, by 0.1 and 0.3."""
    labels = np.zeros((4, 8), np.int32)
    labels[:, 4:] = 1
    K = camera.intrinsics(10.0, 10.0, 3.5, 1.5)
    image = np.zeros((4, 8, 3), np.uint8)
    seg = build_segmentation(labels, image, neighbours=1, beta=0.1, boundary_samples=None)
    flow = Flow(np.zeros((4, 8, 2), np.float32), np.ones((4, 8), np.float32), "zero")
    data = build_energy_data(seg, flow, K, K, None)
    D, T = np.array([1.0, 3.0]), np.array([[0.1, 0, 0], [0.3, 0, 0]])
    lam = np.array([0.5, 0.5])
    soup = Soup(
        lam, np.tile([0, 0, -1.0], (2, 1)), D / lam, np.tile(np.eye(3), (2, 1, 1)), T / lam[:, None]
    )
    w = replace(PAPER, arap=1, proj=1, cont=1, orient=1, sigma_cont=0.2, sigma_orient=0.5)
    e = plain.energy(soup, data, w)
    mean = 2.0  # of the plane distances: the length unit
    anchor = np.array([[-0.2, 0, 1], [0.2, 0, 1]])  # centroids 1.5 and 5.5 of columns about 3.5
    X = D[:, None] * anchor
    stretch = abs(np.linalg.norm(X[0] - X[1]) - np.linalg.norm(X[0] + T[0] - X[1] - T[1]))
    w1 = 2 * np.exp(-0.1 * 4)
    assert e["arap"] == pytest.approx(w1 * (0.2 + stretch) / mean)
    assert e["proj"] == pytest.approx(2 * 1.0)  # both move by one pixel
    rays = np.array([[0.0, (v - 1.5) / 10, 1] for v in range(4)])
    gap = np.linalg.norm(2 * rays) / mean  # four boundary points, stacked
    after = np.linalg.norm(2 * rays + [0.2, 0, 0]) / mean
    w4 = 2 * 4  # one colour: four neighbours, both directions
    assert e["cont"] == pytest.approx(w4 * (gap + min(after, 0.2)))
    assert e["orient"] == 0


def test_pixel_units_by_hand():
    """At depth Z under a baseline T: a turn costs focal x angle, a motion gap g costs focal g / Z,
    a depth gap g costs the parallax focal (g / Z) (T / Z)."""
    Z, T, g = 2.0, 0.1, 1e-4
    soup, data = world("fronto-parallel, sideways", "pixels", False)
    soup = replace(soup, lam=soup.lam.copy(), R=soup.R.copy(), t=soup.t.copy())
    base = np.linalg.norm(WORLDS["fronto-parallel, sideways"][1][:3, 3])
    assert base == pytest.approx(np.hypot(T, 0.03))
    focal = 90.0
    here = 5
    edge = (data.edges == here).any(axis=1)
    wide = replace(PAPER, sigma_cont=np.inf)
    arap = data.edge_weight * edge
    turned = soup.R.copy()
    angle = 1e-3
    turned[here] = turned[here] @ rotation.exp([0, 0, angle])
    # |R_i - R_k|_F = sqrt(8) sin(angle / 2); turning about z leaves the camera's own motion
    e = plain.arap(replace(soup, R=turned), data, wide)
    rotating = focal * np.sqrt(8) * np.sin(angle / 2)
    np.testing.assert_array_less(arap * rotating - 1e-9, e)
    assert np.median(e[edge] / (arap[edge] * rotating)) == pytest.approx(1, abs=0.5)
    moved = soup.t.copy()
    moved[here] += [0, 0, g / soup.lam[here]]
    gap = plain.arap(replace(soup, t=moved), data, wide)
    at_least = arap * focal * g / Z
    assert (gap >= at_least - 1e-9).all()
    assert (gap <= 2 * at_least + 1e-9).all()
    assert gap[edge].min() > 0
    # deeper by g, with the motion unchanged: both frames' gaps are g along the rays
    deeper = replace(soup, d=np.where(np.arange(12) == here, soup.d * (1 + g / Z), soup.d))
    cont = plain.continuity(deeper, data, wide)
    pair = (data.pairs == here).any(axis=1)
    length = np.linalg.norm(data.boundary_ray, axis=2)
    whole = np.sqrt(np.sum(length**2, axis=1)) * data.pair_factor
    parallax = focal * (g / Z) * (base / Z)
    expected = 2 * data.pair_weight * pair * whole * parallax
    np.testing.assert_allclose(cont, expected, rtol=1e-3, atol=1e-9)


def test_a_camera_at_rest_counts_half_a_pixel_of_parallax():
    data = world("at rest", "pixels", False)[1]
    focal = float(data.K_next[0, 0])
    np.testing.assert_allclose(data.pair_unit, 1 / 0.5)
    np.testing.assert_allclose(data.edge_unit, 1 / focal)
    assert data.local_units


def test_sampled_boundaries_stand_for_the_whole():
    """With constant gaps the sampled Frobenius norm, times its factor, is that of all points."""
    soup = random_soup(0, 12, spread=0.0)
    lam = soup.lam * np.random.default_rng(0).uniform(0.8, 1.2, 12)
    soup = replace(soup, lam=lam)
    few = plain.continuity(soup, Tiny(boundary_samples=3).data, PAPER)
    every = plain.continuity(soup, Tiny(boundary_samples=None).data, PAPER)
    np.testing.assert_allclose(few, every, rtol=0.02)


# --- samples -------------------------------------------------------------------------------------


def test_sampled_pixels_are_distinct_confident_and_from_their_superpixel():
    problem = tiny()
    index, there = sample_pixels(problem.seg.labels, problem.flow, 9, 0)
    confidence = problem.flow.confidence.ravel()
    for i in range(12):
        mine = index[i][there[i]]
        assert len(set(mine.tolist())) == len(mine) == 9
        assert (problem.seg.labels.ravel()[mine] == i).all()
        assert (confidence[mine] > 0).all()
    again, _ = sample_pixels(problem.seg.labels, problem.flow, 9, 0)
    np.testing.assert_array_equal(index, again)
    other, _ = sample_pixels(problem.seg.labels, problem.flow, 9, 1)
    assert (index != other).any()


def test_all_pixels_are_taken_where_none_is_asked_for():
    problem = tiny()
    index, there = sample_pixels(problem.seg.labels, problem.flow, None, 0)
    found = np.sort(index[there])
    np.testing.assert_array_equal(found, np.flatnonzero(problem.flow.confidence.ravel() > 0))


def test_superpixels_without_flow_take_no_pixels_and_have_no_projection():
    problem = tiny()
    confidence = problem.flow.confidence.copy()
    confidence[problem.seg.labels == 5] = 0
    flow = Flow(problem.flow.uv, confidence, "test")
    data = build_energy_data(problem.seg, flow, K_REF, K_NEXT, 6)
    assert (data.pixel_weight[5] == 0).all()
    assert (data.pixel_weight[4] > 0).all()
    error = plain.reprojection(problem.soup, data, PAPER)
    assert error[5] == 0
    nlp, _ = build_matrix_nlp(problem.soup, data, PAPER, form())
    assert np.isfinite(value(nlp, nlp.x0)[0])


def test_confidence_zero_everywhere_leaves_a_valid_problem():
    problem = tiny()
    flow = Flow(problem.flow.uv, np.zeros((HEIGHT, WIDTH), np.float32), "nothing")
    data = build_energy_data(problem.seg, flow, K_REF, K_NEXT, 6)
    nlp, _ = build_matrix_nlp(problem.soup, data, PAPER, form())
    e = plain.energy(problem.soup, data, PAPER)
    assert e["proj"] == 0
    assert np.isfinite(value(nlp, nlp.x0)[0])


def test_one_superpixel_is_a_valid_problem():
    image = np.zeros((16, 16, 3), np.uint8)
    seg = build_segmentation(np.zeros((16, 16), np.int32), image)
    K = camera.intrinsics(20.0, 20.0, 7.5, 7.5)
    flow = Flow(np.ones((16, 16, 2), np.float32), np.ones((16, 16), np.float32), "ones")
    soup = random_soup(0, 1)
    data = in_pixels(build_energy_data(seg, flow, K, K, 6), soup, seg)
    for gauge in GAUGES:
        nlp, _ = build_matrix_nlp(soup, data, PAPER, form(gauge=gauge))
        e = plain.energy(soup, data, PAPER)
        assert e["arap"] == e["cont"] == e["orient"] == 0
        assert value(nlp, nlp.x0)[0] == pytest.approx(e["total"], rel=0.1)
        assert value(nlp, nlp.x0)[1][: 6 + 1] == pytest.approx(0, abs=1e-12)


def test_records_print_themselves():
    problem = tiny()
    assert str(problem.data).startswith("EnergyData(12 superpixels x 3 pixels, ")
    assert str(problem.seg).startswith("Segmentation(12 superpixels of 64x48, K = 4, ")
    arrays = problem.data.arrays()
    assert arrays["edges"].shape == problem.seg.edges.shape
    assert all(isinstance(v, np.ndarray) for v in arrays.values())
