"""The presolve's descent: numbers against differences, KKT points against Ipopt, honest ends."""

from __future__ import annotations

import threading
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from soup_nlp.geometry.soup import Soup
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.layout import Chart
from soup_nlp.model.nlp import to_scipy
from soup_nlp.model.tangent_nlp import build_tangent_nlp
from soup_nlp.solve import descent as descent_module
from soup_nlp.solve import newton
from soup_nlp.solve.descent import Descent
from soup_nlp.solve.factor import superlu
from soup_nlp.solve.ipopt import Ipopt
from soup_nlp.solve.kkt import optimality
from soup_nlp.solve.line_search import Search, along, evaluate, reach
from soup_nlp.solve.phase import Phase
from soup_nlp.solve.tangent_problem import TangentProblem
from soup_nlp.storage.progress import Watch

pytestmark = pytest.mark.slow

FORM = Formulation(compiled=False)
INVERSE: Chart = "inverse-depth"
PHASES = (
    Phase("first", "gauss-newton", 0.3, 1e-3, 60, 1e-4, 1e-6),
    Phase("second", "gauss-newton", 0.1, 1e-5, 60, 1e-5, 1e-6),
)
LAST = Phase("last", "exact", 0.1, 1e-8, 60, 0.0, 1e-6)


@pytest.fixture(scope="module")
def solved(problem):
    runner = Descent(problem)
    stages = [runner.run(p) for p in (*PHASES, LAST)]
    return runner, stages


def inner_point(problem: TangentProblem) -> np.ndarray:
    """A point off the start, inside all slacks."""
    rng = np.random.default_rng(3)
    x = Descent(problem).x
    return problem.normalise(x + 0.01 * rng.normal(size=x.shape))


# --- the numbers of the problem ------------------------------------------------------------------


def test_gradient_and_exact_hessian_are_derivatives(problem):
    problem.smoothing(0.2)
    x = inner_point(problem)
    rng = np.random.default_rng(4)
    h = rng.normal(size=x.shape)
    step = 1e-6
    slope = (problem.value(x + step * h) - problem.value(x - step * h)) / (2 * step)
    assert problem.gradient(x) @ h == pytest.approx(slope, rel=1e-5)
    z = rng.uniform(0.1, 1.0, problem.slacks(x)[0].shape)

    def lagrangian(x):
        _, jacobian = problem.slacks(x)
        out = problem.gradient(x).reshape(-1, 9).copy()
        out[:, :3] -= np.einsum("nrc,nr->nc", jacobian, z)
        return out.ravel()

    U = problem.upper.copy()
    U.data = problem.hessian(x, z, "exact")
    product = U @ h + U.T @ h - U.diagonal() * h
    expected = (lagrangian(x + step * h) - lagrangian(x - step * h)) / (2 * step)
    np.testing.assert_allclose(product, expected, atol=1e-4 * np.abs(expected).max())


def test_the_exact_hessian_beside_the_majorant_is_that_of_an_exact_program(problem, rigid_room):
    form = FORM.replace(norm="smooth", hessian="exact", theta=0.0, ridge=0.0)
    chart = problem.layout.chart
    nlp = build_tangent_nlp(rigid_room.soup, rigid_room.data, rigid_room.weights, form, chart)[0]
    x = inner_point(problem)
    found = problem.upper.copy()
    found.data = problem.hessian(x, np.zeros_like(problem.slacks(x)[0]), "exact")
    p = nlp.with_theta(**dict(zip(nlp.theta, problem.sums.theta)))
    expected = to_scipy(nlp.hess_lag(x, p, 1.0, np.zeros(nlp.ng)))
    assert abs(found - expected).max() <= 1e-12 * abs(expected).max()


def test_the_majorant_lies_above_every_norm(problem, rigid_room):
    # quadratic model with the majorant >= f wherever residuals are linear: translations
    problem.smoothing(0.2)
    x = Descent(problem).x
    z = np.zeros_like(problem.slacks(x)[0])
    U = problem.upper.copy()
    U.data = problem.hessian(x, z, "gauss-newton")
    assert np.linalg.eigvalsh((U + U.T - np.diag(U.diagonal())).astype(float)).min() > -1e-8
    rng = np.random.default_rng(5)
    for size in (1e-4, 1e-3, 1e-2):
        h = np.zeros_like(x).reshape(-1, 9)
        h[:, 6:] = size * rng.normal(size=(len(h), 3))
        h = h.ravel()
        model = problem.gradient(x) @ h + 0.5 * (2 * h @ (U @ h) - U.diagonal() @ h**2)
        assert problem.value(x + h) - problem.value(x) <= model + 1e-3 * abs(model)


def test_slacks_have_the_derivatives_they_claim(problem):
    x = inner_point(problem)
    slack, jacobian = problem.slacks(x)
    assert (slack > 0).all()
    for c in range(3):
        h = np.zeros_like(x).reshape(-1, 9)
        h[:, c] = 1e-6
        up, down = problem.slacks(x + h.ravel())[0], problem.slacks(x - h.ravel())[0]
        np.testing.assert_allclose(jacobian[..., c], (up - down) / 2e-6, atol=1e-7)


def test_growth_changes_the_length_unit_alone(problem):
    problem.smoothing(0.2)
    x = inner_point(problem)
    growth, step = problem.growth(x), 1e-6
    assert problem.length(x) @ growth == pytest.approx(1, rel=1e-12)
    grown = x + step * growth
    # E does not depend on the scale of the scene in units of pixels
    assert problem.value(grown) == pytest.approx(problem.value(x), rel=1e-12)
    np.testing.assert_allclose(problem.normalise(grown), x, atol=1e-11)
    row = problem.nlp.jac_g(x, problem.nlp.p)[1].sparse()[problem.nlp.lbg == problem.nlp.ubg]
    np.testing.assert_allclose(row.toarray().ravel(), problem.length(x), rtol=1e-12)


def test_a_turn_of_a_superpixel_leaves_its_anchor_where_it_is(problem, rigid_room):
    x = inner_point(problem).reshape(-1, 9)
    turned = x.copy()
    turned[:, 3:6] += 0.1

    def anchors(x):
        soup = problem.layout.unpack(x.ravel())
        X = soup.depth_at(rigid_room.data.anchor_ray)[:, None] * rigid_room.data.anchor_ray
        return np.einsum("nij,nj->ni", soup.R, X) + soup.translation

    np.testing.assert_allclose(anchors(turned), anchors(x), rtol=1e-12)


def test_a_plane_moves_in_straight_lines_on_inverse_depths(rigid_room):
    problem = TangentProblem(
        rigid_room.soup, rigid_room.data, rigid_room.weights, FORM, False, INVERSE
    )
    layout, n = problem.layout, len(rigid_room.data)

    def on_plane(m):
        length = np.linalg.norm(m)
        soup = rigid_room.soup
        normal, D = np.tile(-m / length, (n, 1)), np.full(n, 1 / length)
        x = layout.pack(Soup(D, normal, np.ones(n), soup.R, soup.translation / D[:, None]))
        # pack brings to the length unit; undone, rho is linear in m
        return x.reshape(-1, 9)[:, :3] / np.sum(layout.share * D)

    a, b = np.array([0.1, 0.0, 0.5]), np.array([0.0, -0.2, 0.3])
    np.testing.assert_allclose(on_plane(a + b), on_plane(a) + on_plane(b), rtol=1e-10)


def test_another_chart_begins_where_the_first_ended(rigid_room):
    first = Descent(TangentProblem(rigid_room.soup, rigid_room.data, rigid_room.weights, FORM))
    for phase in PHASES:
        first.run(phase)
    problem = TangentProblem(first.soup, rigid_room.data, rigid_room.weights, FORM, chart=INVERSE)
    second = Descent(problem, after=first)
    # one pattern, one symbolic analysis
    assert second.newton._factorise is first.newton._factorise
    for p in (first.problem, problem):
        p.smoothing(LAST.eps)
    assert problem.value(second.x) == pytest.approx(first.problem.value(first.x), rel=1e-9)
    np.testing.assert_allclose(second.rim, first.rim, rtol=1e-9)
    here, there = problem.slacks(second.x)[0], first.problem.slacks(first.x)[0]
    # visibility is one and the same at the base; bounds are each chart's own
    np.testing.assert_allclose(here[:, : problem.rims], there[:, : problem.rims], atol=1e-9)
    last = second.run(LAST)
    assert last.converged
    assert last.objective <= first.problem.value(first.x)


@pytest.mark.parametrize("problem", ["inverse-depth"], indirect=True)
def test_a_second_step_leads_back_into_a_bent_valley(problem):
    """The same matrix takes back most of what a step along stiff norms has cost."""
    runner = Descent(problem)
    for phase in PHASES:
        runner.run(phase)
    problem.smoothing(LAST.eps)
    at = evaluate(problem, runner.x, 1e-8)
    gradient = problem.gradient(at.x)
    curvature = partial(runner._curvature, at, 0.0)
    runner.newton.begin()
    step = runner.newton.step(at, curvature, gradient, 1e-8, "exact", runner.damping)
    search = Search(problem, at, step.h, 1e-8, step.newton)
    trial, _ = search._feasible(np.minimum(1.0, 0.99 * reach(at.slack, along(at.jacobian, step.h))))
    back = search._corrected(trial)
    assert back is not None
    assert back.merit - at.merit < max(0.5 * (trial.merit - at.merit), trial.merit - at.merit)


def test_rounding_of_what_is_far_away_does_not_reach_the_gradient(rigid_room):
    # lengths between near and far, in units of the near: their difference is that of small numbers
    s, far = rigid_room.soup, np.where(np.arange(len(rigid_room.soup)) % 2, 1.0, 60.0)
    mixed = Soup(s.lam * far, s.n, s.d, s.R, s.t / far[:, None])
    problem = TangentProblem(mixed, rigid_room.data, rigid_room.weights, FORM)
    problem.smoothing(0.01)
    x, rng = problem.nlp.x0, np.random.default_rng(0)
    before = problem.gradient(x)
    for _ in range(5):
        rounded = x * (1 + np.finfo(float).eps * rng.choice([-1, 0, 1], size=x.shape))
        assert np.abs(problem.gradient(rounded) - before).max() < 1e-9 * np.abs(before).max()


def test_slopes_are_in_no_edge_but_a_neighbours(problem, rigid_room):
    # E_arap knows anchors alone, whose depth is a variable: 7 of 9 coordinates, a smaller factor
    U, n = problem.upper.tocoo(), len(rigid_room.data)
    i, k = U.row // 9, U.col // 9
    neighbours = {tuple(p) for p in np.sort(rigid_room.data.pairs, axis=1)}
    edges = {tuple(p) for p in np.sort(rigid_room.data.edges, axis=1)} - neighbours
    assert edges
    between = np.bincount(i * n + k, minlength=n * n)
    assert {int(between[a * n + b]) for a, b in edges} == {49}
    assert {int(between[a * n + b]) for a, b in neighbours} == {81}
    slope = np.isin(U.row % 9, (1, 2)) | np.isin(U.col % 9, (1, 2))
    assert not edges & set(zip(i[slope].tolist(), k[slope].tolist()))


def test_it_ends_at_a_kkt_point(problem, solved):
    _, stages = solved
    last = stages[-1]
    assert last.status == "Solve_Succeeded"
    assert last.converged
    theta = {**problem.nlp.theta, "eps": LAST.eps, "eps_pixel": LAST.eps}
    nlp = replace(problem.nlp, theta=theta)
    at = optimality(nlp, last.x, last.lam_x, last.lam_g)
    assert at["dual_infeasibility"] < 1e-5
    assert at["complementarity"] < 1e-5
    g = np.asarray(nlp.oracle(last.x, nlp.p)[1]).ravel()
    assert (g >= nlp.lbg - 1e-9).all()
    assert (g <= nlp.ubg + 1e-9).all()


@pytest.mark.parametrize("problem", ["inverse-depth"], indirect=True)
def test_steps_go_on_beyond_the_tolerance_while_they_pay(problem):
    def end(**options):
        runner = Descent(problem)
        for phase in PHASES:
            runner.run(phase)
        return runner, runner.run(replace(LAST, barrier=1e-10, **options))

    _, plain = end()
    runner, beyond = end(beyond=True)
    assert plain.converged
    assert beyond.converged
    assert beyond.history["inf_du"][-1] <= LAST.tol
    assert beyond.history["mu"][-1] <= 1.01 * plain.history["mu"][-1]
    assert beyond.iterations > plain.iterations
    # no step is made for what no step can better
    done = (beyond.history["inf_du"] <= 0.03 * LAST.tol) & (beyond.history["mu"] <= 1.01e-10)
    np.testing.assert_array_equal(np.flatnonzero(done), [beyond.iterations])
    # what is delivered is the point of the last row
    problem.smoothing(LAST.eps)
    at = evaluate(problem, runner.x, 1e-10)
    np.testing.assert_array_equal(beyond.x, runner.x)
    _, dual = runner._dual(problem.gradient(runner.x), at.jacobian)
    assert dual == pytest.approx(beyond.history["inf_du"][-1], rel=1e-3, abs=1e-10)


@pytest.mark.parametrize("problem", ["inverse-depth"], indirect=True)
@pytest.mark.parametrize("patience", [10, 1000])
def test_a_superpixel_whose_damping_never_falls_is_let_go(problem, monkeypatch, patience):
    runner, adapt = Descent(problem), Descent._adapt
    runner.run(PHASES[0])
    first = [1e6]

    def stuck(self, move):
        before = first.pop() if first else self.damping[0]
        adapt(self, move)
        self.damping[0] = max(self.damping[0], before if before > 1 else 0.0)

    monkeypatch.setattr(Descent, "_adapt", stuck)
    monkeypatch.setattr(descent_module, "PATIENCE", patience)
    assert runner.run(replace(LAST, iterations=30)).converged == (patience == 10)


def test_ipopt_stays_where_it_ends(rigid_room, problem, solved):
    last = solved[1][-1]
    smooth = FORM.replace(hessian="exact", eps=LAST.eps, eps_pixel=LAST.eps)
    nlp, _ = build_tangent_nlp(
        rigid_room.soup, rigid_room.data, rigid_room.weights, smooth, problem.layout.chart
    )
    stage = Ipopt(nlp)(x0=last.x, max_iter=30, tol=1e-6)
    assert stage.converged
    assert stage.objective == pytest.approx(last.objective, rel=1e-6)
    np.testing.assert_allclose(stage.x, last.x, atol=1e-3)


def test_the_energy_never_rises_within_a_phase(solved):
    for stage, phase in zip(solved[1], (*PHASES, LAST)):
        f = stage.history["obj"]
        # f - b log c falls; f alone may rise by what the barrier gives
        assert (np.diff(f) <= 2e3 * phase.barrier).all()
        assert f[-1] < f[0] or stage.iterations == 0
        assert len(f) == stage.iterations + 1


@pytest.mark.parametrize("problem", ["inverse-depth"], indirect=True)
def test_superlu_ends_at_the_same_point(problem, solved, monkeypatch):
    monkeypatch.setattr(newton, "factorisation", lambda upper, _: ("SuperLU", superlu(upper)))
    runner = Descent(problem)
    last = [runner.run(p) for p in (*PHASES, LAST)][-1]
    assert runner.newton.library == "SuperLU"
    assert last.converged
    assert last.objective == pytest.approx(solved[1][-1].objective, rel=1e-3)


@pytest.mark.parametrize("problem", ["inverse-depth"], indirect=True)
@pytest.mark.parametrize("stagnation", [0.0, 1e-12])
def test_a_merit_that_falls_by_less_than_its_rounding_does_not_end_the_polish(
    problem, monkeypatch, stagnation
):
    runner = Descent(problem)
    runner.run(PHASES[0])
    run = Search.run

    def rounded(search, *given):
        move = run(search, *given)
        return move._replace(point=move.point._replace(merit=search.at.merit))

    monkeypatch.setattr(Search, "run", rounded)
    last = runner.run(replace(LAST, tol=1e-8, stagnation=stagnation))
    assert last.converged == (not stagnation)


def test_limits_and_interruption_keep_the_iterate(problem, tmp_path):
    log = tmp_path / "solve.log"
    seen = []
    runner = Descent(problem, watch=Watch(seen.append, log_file=str(log)))
    three = runner.run(replace(PHASES[0], iterations=3, stagnation=0.0))
    assert (three.status, three.iterations) == ("Maximum_Iterations_Exceeded", 3)
    assert [p.iteration for p in seen] == [0, 1, 2, 3]
    assert three.objective < seen[0].objective
    assert "first: gauss-newton Hessian" in log.read_text()
    stop = threading.Event()
    stop.set()
    assert Descent(problem, watch=Watch(stop=stop)).run(PHASES[0]).status == "Interrupted"
    late = Descent(problem, deadline=0.0).run(PHASES[0])
    assert (late.status, late.iterations) == ("Time_Limit", 0)
    assert np.isfinite(late.x).all()
