"""Ipopt on kernels and soups: known optima, constraints, limits, interruption, residuals."""

from __future__ import annotations

import os
import signal
import threading
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from helpers_model import (
    GAUGES,
    PAPER,
    gradient,
    hessian,
    motion,
    plane_pose,
    plane_soup,
    plane_world,
    value,
    with_true_flow,
)

from soup_nlp.data.scenes import render_scene
from soup_nlp.errors import SolverError
from soup_nlp.geometry import rotation
from soup_nlp.geometry.graph import build_segmentation
from soup_nlp.geometry.soup import Soup
from soup_nlp.geometry.superpixels import segment
from soup_nlp.model import plain
from soup_nlp.model.energy import EnergyData, Weights, build_energy_data, in_pixels
from soup_nlp.model.formulation import Formulation, build_matrix_nlp
from soup_nlp.model.kernel import HESSIANS, Group, Kernel, Table
from soup_nlp.model.nlp import NLP, assemble
from soup_nlp.solve.ipopt import Ipopt, Progress, Stage, interruptible
from soup_nlp.solve.kkt import constraint_residuals, optimality
from soup_nlp.solve.soup import Solution, SolverOptions, solve_soup
from soup_nlp.start.propose import propose

WEIGHTS = Weights(
    arap=0.15,
    proj=1.0,
    cont=3e-3,
    orient=5e-2,
    sigma_cont=1.0,
    sigma_cont_ref=np.inf,
    sigma_orient=0.5,
    sigma_arap=1.0,
    sigma_proj=np.inf,
)
OPTIONS = SolverOptions(
    presolve_eps=(0.3, 0.1, 0.03), eps=0.03, max_iter=100, tol=1e-3, max_seconds=60
)


def form(**options) -> Formulation:
    return Formulation(
        **{"compiled": False, "hessian": "gauss-newton+constraints", "norm": "smooth", **options}
    )


# --- textbook problems as kernels and tables -----------------------------------------------------


def make_nlp(
    groups: list[Group], x0: list[float], lbx, ubx, lbg, ubg, hessian: str = "exact"
) -> NLP:
    n, m = len(x0), len(lbg)
    return assemble(
        "textbook",
        tuple(groups),
        x0=np.array(x0, float),
        lbx=np.broadcast_to(np.asarray(lbx, float), n),
        ubx=np.broadcast_to(np.asarray(ubx, float), n),
        lbg=np.array(lbg, float),
        ubg=np.array(ubg, float),
        theta={"one": 1.0},
        hessian=hessian,
        x_names=lambda: [f"x[{i}]" for i in range(n)],
        g_names=lambda: [f"g[{i}]" for i in range(m)],
        compiled=False,
    )


def symbols(n: int, data: int = 0) -> tuple[ca.SX, ca.SX, ca.SX]:
    return ca.SX.sym("x", n), ca.SX.sym("row", data), ca.SX.sym("one")


def hs071() -> NLP:
    """Hock and Schittkowski 71; the sum of squares is added up over four elements of one row."""
    x, row, one = symbols(4)
    main = Kernel(
        "main",
        x,
        row,
        one,
        objective=one * x[0] * x[3] * (x[0] + x[1] + x[2]) + x[2],
        constraints=x[0] * x[1] * x[2] * x[3],
    )
    y, weight, two = symbols(1, 1)
    square = Kernel("square", y, weight, two, constraints=weight * y**2)
    groups = [
        Group(main, Table(np.arange(4)[None], np.zeros((1, 0)), np.array([[0]]))),
        Group(square, Table(np.arange(4)[:, None], np.ones((4, 1)), np.ones((4, 1), int))),
    ]
    return make_nlp(groups, [1, 5, 5, 1], 1, 5, [25, 40], [np.inf, 40])


HS071 = np.array([1.0, 4.742999643, 3.821149978, 1.379408294]), 17.0140172892


def rosenbrock(n: int, lbx: float = -np.inf, ubx: float = np.inf) -> NLP:
    """Chained Rosenbrock: one kernel over n - 1 overlapping pairs.

    The later variable comes first in the kernel: tables need not be sorted.
    """
    x, row, one = symbols(2, 1)
    kernel = Kernel(
        "valley", x, row, one, objective=row * (x[0] - x[1] ** 2) ** 2 + (one - x[1]) ** 2
    )
    index = np.stack([np.arange(1, n), np.arange(n - 1)], axis=1)
    table = Table(index, np.full((n - 1, 1), 100.0))
    return make_nlp([Group(kernel, table)], [0.8] * n, lbx, ubx, [], [])


def solve(nlp: NLP, **options) -> Stage:
    return Ipopt(nlp)(x0=nlp.x0, **{"tol": 1e-8, **options})


def test_hs071_is_solved_to_its_known_optimum():
    nlp = hs071()
    stage = solve(nlp)
    assert stage.converged
    assert stage.status == "Solve_Succeeded"
    np.testing.assert_allclose(stage.x, HS071[0], atol=1e-5)
    assert stage.objective == pytest.approx(HS071[1], abs=1e-5)
    # multipliers of the book, in CasADi's sign: negative at a lower bound
    np.testing.assert_allclose(stage.lam_g, [-0.55229366, 0.16146857], atol=1e-4)
    np.testing.assert_allclose(stage.lam_x, [-1.08787121, 0, 0, 0], atol=1e-4)


def test_kkt_residuals_are_small_at_the_optimum_only():
    nlp = hs071()
    stage = solve(nlp)
    best = optimality(nlp, stage.x, stage.lam_x, stage.lam_g)
    assert best["dual_infeasibility"] <= 1e-6
    assert best["complementarity"] <= 1e-4  # mu_init is small but not zero

    def residual(x=stage.x, lam_x=stage.lam_x, lam_g=stage.lam_g) -> float:
        return max(optimality(nlp, x, lam_x, lam_g).values())

    assert residual(x=nlp.x0) > 1
    assert residual(lam_g=0 * stage.lam_g) > 0.1
    assert residual(lam_g=-stage.lam_g) > 0.1
    assert residual(lam_x=0 * stage.lam_x) > 0.1
    # a multiplier on an open bound is not complementary
    assert residual(lam_x=stage.lam_x - [0, 0.5, 0, 0]) > 0.1


def test_a_multiplier_of_the_wrong_sign_is_no_optimum():
    """max x, x >= 0: at 0 the gradient is balanced only by a force from an upper bound."""
    x, row, one = symbols(1)
    kernel = Kernel("line", x, row, one, objective=-x)
    nlp = make_nlp(
        [Group(kernel, Table(np.zeros((1, 1), int), np.zeros((1, 0))))], [0.0], 0, np.inf, [], []
    )
    residual = optimality(nlp, np.zeros(1), np.array([1.0]), np.zeros(0))
    assert max(residual.values()) >= 1


def test_chained_rosenbrock_reaches_the_ones():
    stage = solve(rosenbrock(10))
    assert stage.converged
    np.testing.assert_allclose(stage.x, 1.0, atol=1e-6)
    assert stage.objective == pytest.approx(0, abs=1e-10)
    residual = optimality(rosenbrock(10), stage.x, stage.lam_x, stage.lam_g)
    assert residual == {
        "dual_infeasibility": pytest.approx(0, abs=1e-6),
        "complementarity": 0.0,
    }


def test_hessian_of_an_unsorted_table_is_upper_triangular():
    nlp = rosenbrock(4)
    x = np.array([0.3, -0.5, 0.7, 1.2])
    H = hessian(nlp, x, 1.0, np.zeros(0))
    expected = np.zeros((4, 4))
    for i in range(3):
        expected[i, i] += 1200 * x[i] ** 2 - 400 * x[i + 1] + 2
        expected[i + 1, i + 1] += 200
        expected[i, i + 1] = expected[i + 1, i] = -400 * x[i]
    np.testing.assert_allclose(H, expected, rtol=1e-12)


def test_a_bound_that_cuts_off_the_optimum_is_active_with_its_multiplier():
    nlp = rosenbrock(2, ubx=0.5)
    stage = solve(nlp)
    # on x1 = 0.5 the best x2 is 0.25
    np.testing.assert_allclose(stage.x, [0.5, 0.25], atol=1e-4)
    assert stage.lam_x[0] == pytest.approx(1.0, rel=1e-3)
    assert (stage.x <= 0.5 + 1e-8).all()


def infeasible() -> NLP:
    """x^2 <= -1."""
    x, row, one = symbols(1)
    kernel = Kernel("square", x, row, one, objective=x, constraints=x**2)
    table = Table(np.zeros((1, 1), int), np.zeros((1, 0)), np.zeros((1, 1), int))
    return make_nlp([Group(kernel, table)], [1.0], -np.inf, np.inf, [-np.inf], [-1.0])


def test_an_infeasible_problem_is_a_result_with_its_status():
    stage = solve(infeasible(), max_iter=200)
    assert not stage.converged
    assert stage.status in ("Infeasible_Problem_Detected", "Restoration_Failed")
    assert np.isfinite(stage.x).all()
    assert str(stage).startswith(f"solve: {stage.status}, ")


def test_history_counts_and_call_times_are_kept():
    seen: list[Progress] = []
    stage = solve(hs071(), stage="textbook", listener=seen.append)
    assert [p.iteration for p in seen] == list(range(stage.iterations + 1))
    assert {p.stage for p in seen} == {"textbook"}
    assert (np.diff([p.seconds for p in seen]) >= 0).all()
    assert seen[-1].objective == pytest.approx(stage.objective, rel=1e-6)
    assert seen[-1].infeasibility < 1e-6 < max(p.infeasibility for p in seen)
    assert "it " in str(seen[0])
    assert stage.history.keys() >= {"obj", "inf_pr", "inf_du", "mu"}
    assert all(len(v) == stage.iterations + 1 for v in stage.history.values())
    np.testing.assert_allclose(stage.history["obj"], [p.objective for p in seen])
    assert stage.calls.keys() == {"f", "grad_f", "g", "jac_g", "hess_lag"}
    assert 0 <= sum(stage.calls.values()) <= stage.seconds


@pytest.mark.parametrize(
    "options", [{"no_such_option": 1}, {"max_iter": "many"}, {"linear_solver": "abacus"}]
)
def test_a_wrong_ipopt_option_is_a_solver_error(options):
    nlp = hs071()
    with pytest.raises(SolverError) as caught:
        Ipopt(nlp, options)(x0=nlp.x0)
    assert "textbook" in str(caught.value)


def test_options_reach_ipopt(tmp_path):
    nlp, log = hs071(), tmp_path / "ipopt.log"
    Ipopt(nlp, {"mu_init": 0.123})(x0=nlp.x0, log_file=str(log))
    text = log.read_text()
    assert "Number of nonzeros" in text
    assert "lg(mu)" in text
    stage = Ipopt(nlp, {"mu_init": 0.123})(x0=nlp.x0)
    assert stage.history["mu"][0] == pytest.approx(0.123)


def test_the_iteration_limit_keeps_the_best_iterate():
    nlp = rosenbrock(10)
    start = value(nlp, nlp.x0)[0]
    f = []
    for limit in (0, 1, 3, 6):
        stage = solve(nlp, max_iter=limit)
        assert not stage.converged
        assert stage.status == "Maximum_Iterations_Exceeded"
        assert stage.iterations == limit
        assert value(nlp, stage.x)[0] == pytest.approx(stage.objective)
        assert stage.objective <= start
        f.append(stage.objective)
    assert (np.diff(f) <= 0).all()
    assert f[-1] < start


def test_the_time_limit_stops_and_keeps_the_best_iterate():
    nlp = rosenbrock(10)
    stage = solve(nlp, seconds=0.0)
    assert stage.status == "Time_Limit"
    assert not stage.converged
    assert np.isfinite(stage.x).all()
    assert stage.iterations <= 1


def test_an_event_stops_and_keeps_the_best_iterate():
    nlp, stop, seen = rosenbrock(10), threading.Event(), []

    def listen(p: Progress) -> None:
        seen.append(p.objective)
        if p.iteration == 3:
            stop.set()

    stage = solve(nlp, listener=listen, stop=stop)
    assert stage.status == "Interrupted"
    assert len(seen) == 4
    assert stage.objective == min(seen)
    assert value(nlp, stage.x)[0] == pytest.approx(stage.objective)


def test_stagnation_stops_early():
    nlp = rosenbrock(10)
    assert solve(nlp, stagnation=0.9).status in ("Stagnated", "Solve_Succeeded")
    # twice in a row below a share that everything is below
    stage = solve(nlp, stagnation=1e9)
    assert stage.status == "Stagnated"
    assert stage.iterations <= 3


def test_a_listener_that_fails_ends_the_solve_with_its_message():
    def listen(p: Progress) -> None:
        raise ValueError("no more paper")

    stage = solve(rosenbrock(10), listener=listen)
    assert "no more paper" in stage.status
    assert not stage.converged
    assert np.isfinite(stage.x).all()


def test_control_c_sets_the_event_and_the_old_handler_returns():
    before = signal.getsignal(signal.SIGINT)
    with interruptible() as stop:
        os.kill(os.getpid(), signal.SIGINT)
        assert stop.wait(5)
    assert signal.getsignal(signal.SIGINT) is before


def test_a_nan_in_the_objective_is_a_result_too():
    x, row, one = symbols(1)
    kernel = Kernel("root", x, row, one, objective=ca.sqrt(x - 2))
    table = Table(np.zeros((1, 1), int), np.zeros((1, 0)))
    nlp = make_nlp([Group(kernel, table)], [1.0], -np.inf, np.inf, [], [])
    stage = solve(nlp)
    assert not stage.converged
    assert np.isfinite(stage.x).all()


# --- residuals of soups --------------------------------------------------------------------------


def test_constraint_residuals_by_hand():
    ray = np.array([[[0.0, 0, 1], [1, 0, 1]]])
    n = np.array([[0.6, 0, -0.8]])
    soup = Soup(np.ones(1), n, np.ones(1), np.eye(3)[None], np.zeros((1, 3)))
    r = constraint_residuals(soup, ray, 0.3)
    assert r == pytest.approx(
        {"so3": 0, "normal": 0, "simplex": 0, "positive": 0, "visible": 0.1, "det": 0}, abs=1e-12
    )
    broken = Soup(
        np.array([0.4]), 1.1 * n, np.array([-0.2]), 1.1 * np.eye(3)[None], np.zeros((1, 3))
    )
    r = constraint_residuals(broken, ray, 0.3)
    assert r["so3"] == pytest.approx(0.21)
    assert r["normal"] == pytest.approx(0.21)
    assert r["simplex"] == pytest.approx(0.6)
    assert r["positive"] == pytest.approx(0.2)
    assert r["det"] == pytest.approx(1.1**3 - 1)
    # a reflection passes R^T R = I and fails here
    mirror = replace(soup, R=np.diag([1.0, 1.0, -1.0])[None])
    r = constraint_residuals(mirror, ray, 0.0)
    assert r["so3"] == 0
    assert r["det"] == 2


# --- soups ---------------------------------------------------------------------------------------


class Problem:
    """A rendered scene, cut into about 40 superpixels, with true flow and a start."""

    def __init__(self, name: str) -> None:
        pair = with_true_flow(render_scene(name, 0, 160, 120))
        labels = segment(pair.image_ref, 40)
        seg = build_segmentation(labels, pair.image_ref, neighbours=6)
        noise = np.random.default_rng(5).normal(0, 0.2, pair.flow.uv.shape)
        flow = replace(pair.flow, uv=pair.flow.uv + noise)
        self.start = propose(seg, flow, pair.K_ref, pair.K_next).soup
        data = build_energy_data(seg, flow, pair.K_ref, pair.K_next, 8, 0)
        self.data: EnergyData = in_pixels(data, self.start, seg)

    def solve(self, options: SolverOptions = OPTIONS, f: Formulation | None = None, **more):
        return solve_soup(self.start, self.data, WEIGHTS, f or form(), options, **more)


@pytest.fixture(scope="module")
def room() -> Problem:
    return Problem("room")


@pytest.fixture(scope="module")
def solved(room) -> dict[str, Solution]:
    return {gauge: room.solve(f=form(gauge=gauge)) for gauge in GAUGES}


def assert_constraints(solution: Solution, data: EnergyData, tolerance: float = 1e-8) -> None:
    """Recomputed here from the arrays, not read from the claim."""
    s = solution.soup
    gram = np.einsum("nji,njk->nik", s.R, s.R)
    np.testing.assert_allclose(gram, np.tile(np.eye(3), (len(s), 1, 1)), atol=tolerance)
    np.testing.assert_allclose(np.linalg.det(s.R), 1.0, atol=tolerance)
    np.testing.assert_allclose(np.linalg.norm(s.n, axis=1), 1.0, atol=tolerance)
    assert abs(s.lam.sum() - 1) <= 1e-10
    assert (s.lam > 0).all()
    assert (s.d > 0).all()
    facing = -np.einsum("nc,nvc->nv", s.n, data.rim_ray)
    assert facing.min() >= form().min_facing - 1e-8
    for name, limit in {
        "so3": tolerance,
        "normal": 2 * tolerance,
        "simplex": 1e-10,
        "positive": 0,
        "visible": 1e-8,
        "det": tolerance,
    }.items():
        assert solution.residuals[name] <= limit, name


@pytest.mark.parametrize("gauge", GAUGES)
def test_every_gauge_converges_and_keeps_every_constraint(room, solved, gauge):
    solution = solved[gauge]
    assert solution.converged, solution.status
    assert_constraints(solution, room.data)
    assert solution.residuals["dual_infeasibility"] <= 1e-2
    assert solution.residuals["complementarity"] <= 1e-3
    assert solution.energy["total"] < solution.energy_start["total"]
    for which, soup in (("energy", solution.soup), ("energy_start", room.start)):
        assert getattr(solution, which) == plain.energy(soup, room.data, WEIGHTS)


@pytest.mark.parametrize("gauge", GAUGES[1:])
def test_every_gauge_finds_the_same_world(room, solved, gauge):
    one, two = solved[GAUGES[0]], solved[gauge]
    assert two.energy["total"] == pytest.approx(one.energy["total"], rel=1e-4)
    assert two.stages[-1].objective == pytest.approx(one.stages[-1].objective, rel=1e-5)
    ratio = two.soup.depth_at(room.data.anchor_ray) / one.soup.depth_at(room.data.anchor_ray)
    np.testing.assert_allclose(ratio, np.median(ratio), rtol=1e-3)


def test_the_solution_carries_what_a_report_needs(room, solved):
    solution = solved["unit-offset"]
    n = len(room.start)
    assert [s.name for s in solution.stages][-1] == "constrained NLP"
    assert len(solution.stages) == 2 + len(OPTIONS.presolve_eps)
    assert solution.seconds.keys() >= {"presolve", "build", "compile", "solve"}
    assert solution.nlp["variables"] == 16 * n
    assert solution.multipliers["lam_x"].shape == (16 * n,)
    assert solution.multipliers["lam_g_so3"].shape == (6 * n,)
    assert solution.multipliers["lam_g_normal"].shape == (n,)
    assert solution.multipliers["lam_g_simplex"].shape == (1,)
    assert solution.description.startswith("NLP soup: ")
    assert str(solution).startswith("Solution(Solve_Succeeded, E ")


def test_the_claimed_multipliers_balance_the_gradient(room):
    """Dual infeasibility from the NLP's own functions at the packed solution."""
    nlp, layout = build_matrix_nlp(room.start, room.data, WEIGHTS, form(eps=0.03, eps_pixel=0.03))
    stage = Ipopt(nlp)(x0=nlp.x0, max_iter=0)
    far = optimality(nlp, stage.x, stage.lam_x, stage.lam_g)["dual_infeasibility"]
    solution = room.solve()
    x = layout.pack(solution.soup)
    m = solution.multipliers
    lam_g = np.concatenate([m[f"lam_g_{k}"] for k in ("so3", "normal", "visible", "simplex")])
    near = optimality(nlp, x, m["lam_x"], lam_g)["dual_infeasibility"]
    assert near < 1e-2 < far
    assert np.abs(gradient(nlp, x)).max() > near


def test_without_presolve_the_exact_hessian_converges(room):
    options = replace(OPTIONS, presolve=False, max_iter=300, ipopt={"constr_viol_tol": 1e-9})
    solution = room.solve(options, form(hessian="exact"))
    assert [s.name for s in solution.stages] == ["constrained NLP"]
    assert solution.converged, solution.status
    assert_constraints(solution, room.data)
    assert solution.energy["total"] < solution.energy_start["total"]


def test_the_lifted_truncation_converges(room):
    options = replace(OPTIONS, max_iter=200, ipopt={"constr_viol_tol": 1e-9})
    solution = room.solve(options, form(truncation="lifted"))
    assert solution.converged, solution.status
    assert_constraints(solution, room.data)
    assert solution.energy["total"] < solution.energy_start["total"]


@pytest.mark.parametrize("truncation", ["smooth", "lifted"])
def test_the_epigraph_form_makes_progress_and_stays_feasible(room, truncation):
    options = replace(OPTIONS, max_iter=40)
    solution = room.solve(options, form(norm="epigraph", truncation=truncation))
    assert solution.energy["total"] < solution.energy_start["total"]
    # not converged: the best iterate is feasible to 1e-5 in the solver's own units
    assert_constraints(solution, room.data, 2e-5)


# --- limits and interruption of a soup -----------------------------------------------------------


def assert_whole(solution: Solution, problem: Problem) -> None:
    """A Solution that can be written and looked at, no worse than the start."""
    assert_constraints(solution, problem.data, 2e-5)
    assert np.isfinite(list(solution.energy.values())).all()
    assert solution.energy["total"] <= solution.energy_start["total"] * (1 + 1e-6)
    assert solution.nlp["variables"] > 0
    assert all(np.isfinite(v).all() for v in solution.multipliers.values())


def test_one_iteration_gives_a_whole_solution(room):
    options = replace(OPTIONS, max_iter=1, presolve_iterations=1, polish_iterations=1, tol=1e-12)
    solution = room.solve(options)
    assert not solution.converged
    assert solution.status == "Maximum_Iterations_Exceeded"
    assert_whole(solution, room)


def test_a_stop_that_is_set_before_the_start_gives_the_start(room):
    stop = threading.Event()
    stop.set()
    solution = room.solve(stop=stop)
    assert solution.status == "Interrupted"
    assert not solution.converged
    assert_whole(solution, room)
    assert solution.energy["total"] == pytest.approx(solution.energy_start["total"], rel=1e-3)


@pytest.mark.parametrize("stage", ["presolve 0.1", "constrained NLP"])
def test_a_stop_in_any_stage_keeps_what_was_reached(room, stage):
    stop, seen = threading.Event(), []

    def listen(p: Progress) -> None:
        seen.append(p.stage)
        if p.stage == stage:
            stop.set()

    solution = room.solve(replace(OPTIONS, tol=1e-10), listener=listen, stop=stop)
    assert solution.status == "Interrupted"
    assert_whole(solution, room)
    assert seen.count(stage) == 1
    assert solution.energy["total"] < solution.energy_start["total"]


def test_hardly_any_time_still_gives_a_whole_solution(room):
    solution = room.solve(replace(OPTIONS, max_seconds=1e-3))
    assert_whole(solution, room)


def test_progress_and_sentences_are_delivered(room, tmp_path):
    seen: list[Progress] = []
    said: list[str] = []
    log = tmp_path / "ipopt.log"
    solution = room.solve(listener=seen.append, say=said.append, log_file=str(log))
    stages = list(dict.fromkeys(p.stage for p in seen))
    assert stages == [s.name for s in solution.stages]
    for stage in solution.stages:
        count = [p.iteration for p in seen if p.stage == stage.name]
        assert count == list(range(len(count)))
        assert len(count) >= stage.iterations
    assert any(line.startswith("NLP soup: ") for line in said)
    assert sum(line.startswith(("presolve", "constrained NLP: ")) for line in said) == len(stages)
    assert log.read_text().count("Number of Iterations") >= 1


def test_a_wrong_option_of_the_soup_is_a_solver_error(room):
    with pytest.raises(SolverError, match="no_such_option"):
        room.solve(replace(OPTIONS, presolve=False, ipopt={"no_such_option": 1}))


def test_same_start_same_answer(room, solved):
    again = room.solve(f=form(gauge="unit-offset"))
    for name in ("lam", "n", "R", "t"):
        np.testing.assert_array_equal(
            getattr(again.soup, name), getattr(solved["unit-offset"].soup, name)
        )


# --- a world whose truth is the optimum ----------------------------------------------------------


def disturbed(soup: Soup, size: float) -> Soup:
    rng = np.random.default_rng(3)
    n = soup.n + rng.normal(0, size, soup.n.shape)
    return Soup(
        soup.lam * rng.uniform(1 - size, 1 + size, len(soup)),
        n / np.linalg.norm(n, axis=1, keepdims=True),
        soup.d,
        rotation.exp(rng.normal(0, size / 10, soup.n.shape)) @ soup.R,
        soup.t * rng.uniform(1 - size, 1 + size, soup.t.shape),
    )


@pytest.fixture(scope="module")
def slanted() -> tuple[Soup, EnergyData]:
    pose, move = plane_pose(2.5, yaw=25, pitch=-30), motion((1, 0.5, -1), (0.2, 0.1, -0.1))
    pair = plane_world(pose, move, 96, 72)
    seg = build_segmentation(segment(pair.image_ref, 20, "grid"), pair.image_ref, neighbours=6)
    truth = plane_soup(pose, move, len(seg))
    data = build_energy_data(seg, pair.flow, pair.K_ref, pair.K_next, 12, 0)
    return truth, in_pixels(data, truth, seg)


@pytest.mark.parametrize(
    ("gauge", "kind"),
    [
        *[(g, "gauss-newton+constraints") for g in GAUGES],
        *[("unit-offset", h) for h in HESSIANS if h != "gauss-newton+constraints"],
    ],
)
def test_a_rigid_plane_is_recovered_from_a_disturbed_start(slanted, gauge, kind):
    """E >= 0 and E = 0 at the truth: the optimum is known."""
    truth, data = slanted
    start = disturbed(truth, 0.05)
    weights = replace(PAPER, cont=0.05, sigma_cont=np.inf, sigma_orient=0.5, proj=1.0)
    options = replace(OPTIONS, tol=1e-6, presolve_tol=1e-5, max_iter=200)
    solution = solve_soup(start, data, weights, form(gauge=gauge, hessian=kind), options)
    before, after = solution.energy_start["total"], solution.energy["total"]
    assert before > 10
    assert after < 1e-3 * before
    assert_constraints(solution, data)
    ratio = solution.soup.depth_at(data.anchor_ray) / truth.depth_at(data.anchor_ray)
    np.testing.assert_allclose(ratio, np.median(ratio), rtol=1e-3)


def test_one_superpixel_is_solved():
    pose, move = plane_pose(2.0, yaw=20), motion((0, 1, 0), (0.2, 0, 0))
    pair = plane_world(pose, move, 64, 48)
    seg = build_segmentation(np.zeros((48, 64), np.int32), pair.image_ref)
    truth = plane_soup(pose, move, 1)
    data = in_pixels(build_energy_data(seg, pair.flow, pair.K_ref, pair.K_next, 30, 0), truth, seg)
    solution = solve_soup(disturbed(truth, 0.05), data, WEIGHTS, form(), OPTIONS)
    assert_constraints(solution, data)
    assert solution.energy["total"] < 0.05 * solution.energy_start["total"]


def test_the_constrained_nlp_starts_at_the_presolves_kkt_point(room):
    # the presolve's multipliers, brought over, leave Ipopt next to nothing to do
    done = room.solve(options=replace(OPTIONS, tol=1e-6))
    assert done.stages[-2].converged
    assert done.stages[-1].history["inf_du"][0] < 1e-2
    assert done.stages[-1].iterations <= 3
    assert done.residuals["dual_infeasibility"] < 1e-5
