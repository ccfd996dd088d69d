"""Details of the program, its export and its check that mutants showed no other test to see."""

from __future__ import annotations

from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from helpers_formulation import form, tiny
from helpers_model import GAUGES, PAPER, hessian, value, weights_for, wiggle
from scipy import sparse

from soup_nlp.config.problem import Problem, make_problem
from soup_nlp.errors import ConfigError
from soup_nlp.evaluate import recompute
from soup_nlp.export import verify
from soup_nlp.export.artefact import parse_formulation
from soup_nlp.export.names import readable_names
from soup_nlp.export.program import make_program
from soup_nlp.export.residuals import kind
from soup_nlp.export.sol import Sol
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.kernel import Group, Kernel, Table
from soup_nlp.model.layout import TangentLayout
from soup_nlp.model.norms import Norm, smooth_min, solver_form
from soup_nlp.model.reweighting import across_components, across_discontinuities
from soup_nlp.model.sums import Sums
from soup_nlp.model.tangent_nlp import build_tangent_nlp
from soup_nlp.schema.section import Section
from soup_nlp.solve.stages import _near
from soup_nlp.storage.atomic import write_text

# --- the model -----------------------------------------------------------------------------------


def sections(kind: type[Section]) -> list[type[Section]]:
    """A kind of section and all kinds in it that can be left out."""
    inner = [type(f.default) for f in kind.model_fields.values() if isinstance(f.default, Section)]
    return [kind, *(found for one in inner for found in sections(one))]


def test_every_default_is_within_its_bounds():
    street = make_problem({"input": {"kind": "scene", "scene": "street"}}).input
    for section in sections(Problem):
        fields = {k: f for k, f in section.model_fields.items() if not f.is_required()}
        own = {k: f.get_default(call_default_factory=True) for k, f in fields.items()}
        made = section(**own, **({"input": street} if section is Problem else {}))
        assert {k: getattr(made, k) for k in own} == own


def test_results_were_made_with_these_numbers():
    """Nothing but the tables under results/ shows them; a change belongs into CHANGELOG.md."""
    assert (Formulation().theta, Formulation().ridge) == (0.9, 1e-2)


@pytest.mark.parametrize("lifted", [False, True])
def test_near_a_truncation_the_whole_curvature_along_the_residual_is_kept(lifted):
    x, z, theta = ca.SX.sym("x", 2), ca.SX.sym("z"), 0.9
    norm = Norm("cut", ca.SX(1.0), x, ca.SX(0.1), sigma=ca.SX(0.5))
    made = solver_form(norm, x, ca.SX(theta), None, z if lifted else None)
    at = np.array([0.4, 0.3])
    found = np.asarray(ca.Function("c", [x, z], [made.curvature])(at, 1.0))
    root = np.sqrt(at @ at + 0.01)
    slope = float(ca.evalf(smooth_min(ca.SX(root - 0.1), ca.SX(0.5), ca.SX(0.15))[1]))
    assert 0.3 < slope < 0.8
    share, factor = (theta, 1.0) if lifted else (theta * slope**2, slope)
    expected = factor / root * (np.eye(2) - share * np.outer(at, at) / root**2)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


@pytest.mark.parametrize("truncation", ["smooth", "lifted"])
def test_slack_variables_start_at_the_norms(truncation):
    """s = sqrt(|v|^2 + eps^2): every row of the epigraph form is then 0."""
    problem = tiny("pixels")
    options = form(norm="epigraph", truncation=truncation)
    nlp, _ = problem.nlp(weights_for("pixels"), options)
    g, names = value(nlp, nlp.x0)[1], nlp.g_names()
    rows = [k for k, name in enumerate(names) if name.startswith("epigraph")]
    slacks = [k for k, name in enumerate(nlp.x_names()) if name.startswith("s_")]
    assert len(rows) == len(slacks) > 100
    scale = float(np.square(nlp.x0[slacks]).max())
    np.testing.assert_allclose(g[rows], 0, atol=1e-12 * scale)


@pytest.mark.parametrize("gauge", GAUGES)
def test_the_ridge_is_its_factor_times_a_natural_step(gauge):
    """Relative 1 in scale and offset, one radian in R, one anchor depth in the translation."""
    problem, found = tiny("pixels"), {}
    for ridge in (0.0, 0.5):
        options = form(gauge=gauge, hessian="gauss-newton", ridge=ridge)
        nlp, layout = problem.nlp(weights_for("pixels"), options)
        x = wiggle(nlp, layout.size, 1, 0.01)
        found[ridge] = hessian(nlp, x, 1.0, np.zeros(nlp.ng))
    metric = np.diag(found[0.5] - found[0.0])[: layout.count * layout.stride] / 0.5
    metric = metric.reshape(layout.count, layout.stride)
    own = nlp.x0[: layout.count * layout.stride].reshape(metric.shape)
    close = {"rtol": 1e-6}
    np.testing.assert_allclose(metric[:, 0] * own[:, 0] ** 2, 1, **close)
    np.testing.assert_allclose(metric[:, -12:-3], 1, **close)
    depth = layout.unpack(nlp.x0).depth_at(problem.data.anchor_ray)
    step = depth / own[:, 0]
    np.testing.assert_allclose(metric[:, -3:] * step[:, None] ** 2, 1, **close)


def test_the_presolve_starts_feasible_on_inverse_depth_too():
    problem = tiny("pixels")
    own = problem.soup, problem.data, weights_for("pixels"), form()
    nlp, layout = build_tangent_nlp(*own, chart="inverse-depth")
    assert nlp.x_names()[:3] == layout.names()[:3] == ["rho[0]", "g1[0]", "g2[0]"]
    # away from the base of the chart, where rho is 1 and 1 / rho too
    x = nlp.x0.copy()
    x[::9] *= np.linspace(0.8, 1.25, layout.count)
    row = nlp.g_names().index("simplex[0]")
    share = problem.soup.normalised(layout.share).lam
    assert value(nlp, x)[1][row] == pytest.approx((share / x[::9]).sum(), rel=1e-12)
    assert TangentLayout.about(problem.soup, problem.data).names()[0] == "lam[0]"


def test_ties_between_components_and_surfaces_keep_a_share_of_their_weight():
    data, count = tiny("pixels").data, len(tiny().soup)
    part = np.arange(count) % 2
    (a, b), (i, k) = data.edges.T, data.pairs.T
    apart, split = part[a] != part[b], part[i] != part[k]
    one = across_components(data, part, 0.3)
    two = across_discontinuities(data, part, arap=0.3, cont=0.2, orient=0.1)
    for found in (one, two):
        expected = np.where(apart, 0.3, 1.0) * data.edge_weight
        np.testing.assert_allclose(found.edge_weight, expected, rtol=1e-14)
    np.testing.assert_allclose(two.pair_weight, np.where(split, 0.2, 1.0) * data.pair_weight)
    np.testing.assert_allclose(two.orient_weight, np.where(split, 0.1, 1.0) * data.orient_weight)


# --- the export ----------------------------------------------------------------------------------


def least_squares(monkeypatch, x, gradient, jacobian, **bounds):
    """Least-squares multipliers of a program that is given by its numbers at a point."""
    g = np.array(bounds.pop("g"))
    monkeypatch.setattr(verify, "_gradient", lambda *_: np.array(gradient))
    monkeypatch.setattr(verify, "_jacobian", lambda *_: sparse.csr_matrix(np.array(jacobian)))
    own = {k: np.array(v, float) for k, v in bounds.items()}
    n = len(x)
    nlp = SimpleNamespace(
        oracle=lambda *_: (0.0, g), p=None, ng=len(g),
        lbx=np.full(n, -np.inf), ubx=np.full(n, np.inf), **own,
    )  # fmt: skip
    return verify.least_squares_multipliers(nlp, np.array(x, float))


def test_only_signs_that_a_bound_can_have_are_multipliers(monkeypatch):
    rows = {"jacobian": np.eye(4), "g": [1.0, 2.0, 1.0, 2.0]}
    bounds = {"lbg": [1, -np.inf, 1, -np.inf], "ubg": [np.inf, 2, np.inf, 2]}
    # grad f + lam = 0: a lower bound pushes with lam < 0, an upper one with lam > 0
    lam = least_squares(monkeypatch, np.zeros(4), [3.0, -4.0, -5.0, 6.0], **rows, **bounds)
    np.testing.assert_allclose(lam, [-3, 4, 0, 0], atol=1e-9)


def test_rows_near_a_bound_of_zero_are_active(monkeypatch):
    near, far = 0.5 * verify.ACTIVE, 2 * verify.ACTIVE
    rows = {"jacobian": np.eye(4), "g": [-near, -far, near, far]}
    bounds = {"lbg": [-np.inf, -np.inf, 0, 0], "ubg": [0, 0, np.inf, np.inf]}
    lam = least_squares(monkeypatch, np.zeros(4), [-1.0, -1.0, 1.0, 1.0], **rows, **bounds)
    np.testing.assert_allclose(lam, [1, 0, -1, 0], atol=1e-9)


def test_a_variable_at_its_bound_takes_the_whole_gradient(monkeypatch):
    """One at each bound, one in the middle of a distance 4 to the bound that it is pushed to."""
    gradient = np.array([-2.0, 3.0, -5.0])
    monkeypatch.setattr(verify, "_gradient", lambda *_: gradient)
    monkeypatch.setattr(verify, "_jacobian", lambda *_: sparse.csr_matrix((1, 3)))
    nlp = SimpleNamespace(lbx=np.array([-1.0, 2.0, 0.0]), ubx=np.array([3.0, 9.0, 8.0]))
    lam = verify.bound_multipliers(nlp, np.array([3.0, 2.0, 4.0]), np.zeros(1))
    np.testing.assert_allclose(lam, [2.0, -3.0, 1.0], rtol=1e-15)


@pytest.mark.parametrize("place", [0, 1, 2])
def test_residuals_are_within_a_few_times_the_tolerance(place):
    limits = verify.Limits()
    bounds = np.array([limits.feasibility, limits.tol, limits.tol])
    for factor, good in ((0.5, True), (2.0, False)):
        found = np.zeros(3)
        found[place] = factor * verify.SLACK * bounds[place]
        assert verify.Residuals(*found.tolist(), "").within(limits) is good


def test_an_ipopt_without_iterations_is_not_near():
    assert not _near(SimpleNamespace(converged=False, history={}))
    assert _near(SimpleNamespace(converged=False, history={"inf_du": np.array([2.0, 0.5])}))


def test_text_of_names_that_are_no_utf8_is_written(tmp_path):
    write_text(tmp_path / "log.txt", "folder \udcff")
    assert (tmp_path / "log.txt").read_text() == "folder \\udcff"


def test_groups_without_elements_are_passed_over():
    x, none = ca.SX.sym("x"), ca.SX.sym("none", 0)
    groups = []
    for name, index in (("first", [0]), ("empty", []), ("last", [1])):
        kernel = Kernel(name, x, none, ca.SX.sym("theta", 0), objective=ca.sqrt(x))
        table = Table(np.array(index, int).reshape(-1, 1), np.zeros((len(index), 0)))
        groups.append(Group(kernel, table))
    program = make_program(groups, 2, 0, np.zeros(0))
    assert program.in_objective.tolist() == [True, True]
    assert len(program.stamped) == 2


def test_rows_of_one_superpixel_are_named_by_it_alone():
    nlp, layout = tiny().nlp(PAPER, form(gauge="unit-translation"))
    _, names = readable_names(nlp, layout)
    assert {"so3[0,1]", "so3[11,6]", "normal[3]", "visible[5,1]", "translation[4]"} <= set(names)


def test_a_formulation_has_up_to_three_words():
    choices = {"gauge": "free", "norm": "epigraph", "truncation": "lifted"}
    assert parse_formulation("free/epigraph/lifted") == choices
    assert parse_formulation("free") == {"gauge": "free"}
    with pytest.raises(ConfigError, match="too many"):
        parse_formulation("free/epigraph/lifted/exact")


def test_a_row_of_residuals_says_whether_it_holds():
    violation = np.array([0.0, 2e-6])
    assert str(kind("so3", violation, 1e-5)).startswith("ok  ")
    assert str(kind("so3", violation, 1e-6)).startswith("FAIL")


def test_an_answer_does_not_print_its_numbers():
    assert "array" not in repr(Sol("done", 0, np.ones(3), np.ones(3)))


# --- the check -----------------------------------------------------------------------------------


@pytest.mark.parametrize(("rule", "scale"), [("lsq", 16.5 / 9), ("none", 1.0), ("median", 1.75)])
def test_rules_of_scale(rule, scale):
    """By hand: least squares is sum z gt / sum z z, of ratios 1.5, 2, 1.75."""
    z, gt = np.array([1.0, 2.0, 2.0]), np.array([1.5, 4.0, 3.5])
    found = recompute.scores(z, gt, rule, None)
    assert found["scale"] == pytest.approx(scale, rel=1e-12)


def test_theta_and_not_the_ridge_is_the_share_of_curvature_that_is_left_out(small_room):
    own = small_room.soup, small_room.data, small_room.weights
    form = Formulation(compiled=False, hessian="gauss-newton", ridge=0.0)
    found = []
    for theta in (0.0, 0.9):
        nlp, _ = build_tangent_nlp(*own, form.replace(theta=theta))
        found.append(Sums(nlp, ["gauss-newton"], first_order=False))
    whole, less = (s.hessian("gauss-newton", nlp.x0, np.zeros(nlp.ng)) for s in found)
    assert np.abs(whole - less).max() > 1e-3 * np.abs(whole).max()
