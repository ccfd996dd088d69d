"""Soups solved: constraints, gauges, limits, interruption, a world whose truth is the optimum."""

from types import SimpleNamespace

import numpy as np
import pytest
from helpers_model import GAUGES, PAPER, disturbed, motion, plane_soup, plane_world, world
from helpers_start import scene_problem

from soup_nlp.data.scenes.catalogue import placed
from soup_nlp.geometry.constraints import constraints
from soup_nlp.geometry.graph import build_segmentation
from soup_nlp.model import oracle
from soup_nlp.model.energy_data import EnergyData, build_energy_data
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.programs import build_matrix_nlp
from soup_nlp.model.reweighting import in_pixels
from soup_nlp.pipeline.case import prepare
from soup_nlp.pipeline.record import Case
from soup_nlp.solve.ipopt import run_ipopt
from soup_nlp.solve.kkt import optimality
from soup_nlp.solve.solver_options import Stages
from soup_nlp.solve.stages import Solution, _near, solve_soup

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("simple_starts")]

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
OPTIONS = Stages(presolve_eps=(0.3, 0.1, 0.03), eps=0.03, max_iter=100, max_seconds=3600)


def form(**options) -> Formulation:
    return Formulation(**{"hessian": "gauss-newton+constraints", **options})


# --- soups ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def room() -> Case:
    """A rendered scene with some noise in its flow, cut into about 20 superpixels."""
    few = "segmentation.neighbours=6", "segmentation.boundary_samples=2", "energy.pixel_samples=8"
    return prepare(scene_problem("room", 160, 120, 20, *few, "flow.source=truth+noise:0.2"))


def solve(case: Case, options: Stages = OPTIONS, f: Formulation | None = None) -> Solution:
    return solve_soup(case.soup, case.data, WEIGHTS, f or form(), options)


@pytest.fixture(scope="module")
def solved(room) -> dict[str, Solution]:
    return {gauge: solve(room, f=form(gauge=gauge)) for gauge in GAUGES}


COLD = OPTIONS.replace(
    # wide smoothing: with 0.03 px the way from a cold start is so long that rounding decides it
    eps=0.3,
    presolve_iterations=0,
    max_iter=300,
    tol=1e-3,
    ipopt={"constr_viol_tol": 1e-9},
)


@pytest.fixture(scope="module")
def cold(room) -> Solution:
    """By Ipopt alone, at one smoothing."""
    return solve(room, COLD, form(hessian="exact"))


def assert_constraints(solution: Solution, data: EnergyData, tolerance: float = 1e-8) -> None:
    """What is claimed, and what the arrays of the soup say."""
    assert min(solution.soup.lam.min(), solution.soup.d.min()) > 0
    limits = {"normal": 2 * tolerance, "simplex": 1e-10, "positive": 0, "visible": 1e-8}
    found = constraints(vars(solution.soup), data.rim_ray, form().min_facing)
    for name, violation in found.largest.items():
        limit = limits.get(name, tolerance)
        assert max(solution.residuals[name], violation) <= limit, name


@pytest.mark.parametrize("gauge", GAUGES)
def test_every_gauge_converges_and_keeps_every_constraint(room, solved, gauge):
    solution = solved[gauge]
    assert solution.converged, solution.status
    assert_constraints(solution, room.data)
    # of the raw answer
    assert solution.residuals["nlp_infeasibility"] <= 1e-8
    assert solution.residuals["dual_infeasibility"] <= 1e-2
    assert solution.residuals["complementarity"] <= 1e-3
    assert solution.energy["total"] < solution.energy_start["total"]
    for which, soup in (("energy", solution.soup), ("energy_start", room.soup)):
        assert getattr(solution, which) == oracle.energy(soup, room.data, WEIGHTS)


def test_both_gauges_find_the_same_world(room, solved):
    one, two = solved.values()
    assert two.energy["total"] == pytest.approx(one.energy["total"], rel=1e-4)
    assert two.stages[-1].objective == pytest.approx(one.stages[-1].objective, rel=1e-5)
    ratio = two.soup.depth_at(room.data.anchor_ray) / one.soup.depth_at(room.data.anchor_ray)
    np.testing.assert_allclose(ratio, np.median(ratio), rtol=1e-3)


def test_the_claimed_multipliers_balance_the_gradient(room, solved):
    """Dual infeasibility from the NLP's own functions at the packed solution."""
    nlp, layout = build_matrix_nlp(room.soup, room.data, WEIGHTS, form(eps=0.03, eps_pixel=0.03))
    stage = run_ipopt(nlp, x0=nlp.x0, max_iter=0)
    far = optimality(nlp, stage.x, stage.lam_x, stage.lam_g)["dual_infeasibility"]
    solution = solved["unit-offset"]
    x = layout.pack(solution.soup)
    m = solution.multipliers
    lam_g = np.concatenate([m[f"lam_g_{k}"] for k in ("so3", "normal", "visible", "simplex")])
    near = optimality(nlp, x, m["lam_x"], lam_g)["dual_infeasibility"]
    assert near < 1e-2 < far
    assert np.abs(nlp.gradient(x)).max() > near


def test_the_presolve_narrows_the_smoothing(room, cold):
    assert [s.name for s in cold.stages] == ["constrained NLP"]
    assert cold.converged, cold.status
    assert_constraints(cold, room.data)
    options = COLD.replace(presolve_iterations=60, presolve_eps=(1.0, 0.3), stagnation=3e-3)
    solution = solve(room, options, form(hessian="exact"))
    first, second, *_, exact, last = solution.stages
    assert exact.converged
    # the multipliers go with the point: it is the constrained NLP's KKT point as well
    assert last.iterations <= 3
    assert first.status == "Stagnated"
    assert all(s.history["obj"][-1] < s.history["obj"][0] for s in (first, second))
    assert solution.converged, solution.status
    assert_constraints(solution, room.data)
    assert list(solution.ends) == ["start", "presolve", "constrained NLP"]
    assert solution.ends["constrained NLP"] < solution.ends["start"]
    # the same minimum or one beside it
    assert solution.energy["total"] < 1.02 * cold.energy["total"]


def test_the_second_strategy_keeps_the_lower_energy(room):
    options = OPTIONS.replace(max_iter=1, exact_iterations=0)
    one, two = (solve(room, options.replace(untruncated=both)) for both in (False, True))
    names = [s.name for s in two.stages]
    assert [s.name for s in one.stages] == [n for n in names if "truncated" not in n]
    assert names[3:-1] == [
        "majorant untruncated 1",
        "untruncated exact 1",
        "untruncated exact 0.3",
        "untruncated exact 0.1",
        "majorant truncated 0.1",
        "majorant truncated 0.03",
    ]
    assert two.ends["presolve"] <= one.ends["presolve"] * (1 + 1e-9)
    # there is no second one where E_arap is not truncated anyway
    free = WEIGHTS.replace(sigma_arap=np.inf)
    quick = options.replace(untruncated=True, presolve_iterations=1)
    never = solve_soup(room.soup, room.data, free, form(), quick)
    assert [s.name for s in never.stages] == [s.name for s in one.stages]


# --- limits and interruption of a soup -----------------------------------------------------------


def assert_whole(solution: Solution, problem: Case) -> None:
    """A Solution that can be written and looked at, no worse than the start."""
    assert_constraints(solution, problem.data, 2e-5)
    assert np.isfinite(list(solution.energy.values())).all()
    assert solution.energy["total"] <= solution.energy_start["total"] * (1 + 1e-6)
    assert solution.nlp["variables"] > 0
    assert all(np.isfinite(v).all() for v in solution.multipliers.values())


ONE_ITERATION = {"max_iter": 1, "presolve_iterations": 1, "exact_iterations": 1, "tol": 1e-12}


@pytest.mark.parametrize(
    ("limit", "status"),
    [(ONE_ITERATION, "Maximum_Iterations_Exceeded"), ({"max_seconds": 1e-3}, "Time_Limit")],
)
def test_a_limit_gives_a_whole_solution(room, limit, status):
    solution = solve(room, OPTIONS.replace(**limit))
    assert not solution.converged
    assert solution.status == solution.stages[0].status == status
    assert_whole(solution, room)


# --- a world whose truth is the optimum ----------------------------------------------------------


@pytest.mark.parametrize("gauge", GAUGES)
def test_a_rigid_plane_is_recovered_from_a_disturbed_start(gauge):
    """E >= 0 and E = 0 at the truth: the optimum is known."""
    truth, data = world("slanted", "pixels", False)
    start = disturbed(truth, 0.05)
    weights = PAPER.replace(cont=0.05, prior=0.0, sigma_cont=np.inf, sigma_orient=0.5, proj=1.0)
    options = OPTIONS.replace(presolve_tol=1e-5, max_iter=200)
    solution = solve_soup(start, data, weights, form(gauge=gauge), options)
    before, after = solution.energy_start["total"], solution.energy["total"]
    assert before > 10
    assert after < 1e-3 * before
    assert_constraints(solution, data)
    ratio = solution.soup.depth_at(data.anchor_ray) / truth.depth_at(data.anchor_ray)
    np.testing.assert_allclose(ratio, np.median(ratio), rtol=1e-3)


def test_the_constrained_nlp_starts_at_the_presolves_kkt_point(room, solved):
    """The presolve's multipliers, brought over, leave Ipopt next to nothing to do."""
    # planes that would slant more than they may: their rows of visibility have forces
    narrow = solve(room, f=form(depth_ratio=1.05))
    assert np.abs(narrow.multipliers["lam_g_visible"]).max() > 1e-2
    assert solved["unit-offset"].residuals["dual_infeasibility"] < 1e-5
    for done in (solved["unit-offset"], narrow):
        assert done.stages[-2].converged
        assert done.stages[-1].history["inf_du"][0] < 1e-5
        assert done.stages[-1].iterations <= 1


def test_an_ipopt_without_iterations_is_not_near():
    assert not _near(SimpleNamespace(converged=False, history={}))
    assert _near(SimpleNamespace(converged=False, history={"inf_du": np.array([2.0, 0.5])}))


def test_the_constrained_nlp_is_solved_from_the_start_without_tangent_stages(room, solved):
    solution = solve(room, OPTIONS.replace(coordinates="matrix"))
    assert solution.converged, solution.status
    assert all(stage.x.size == 16 * len(room.data) for stage in solution.stages)
    # each stage begins where the last one ended, with its multipliers
    assert solution.stages[-1].iterations <= 5
    assert_constraints(solution, room.data)
    tangent = solved["unit-offset"].energy["total"]
    assert solution.energy["total"] == pytest.approx(tangent, rel=5e-3)


@pytest.mark.parametrize("gauge", GAUGES)
def test_one_superpixel_is_solved(gauge):
    pose, move = placed(0, 0, 2.0, yaw=20), motion((0, 1, 0), (0.2, 0, 0))
    pair = plane_world(pose, move, 64, 48)
    seg = build_segmentation(np.zeros((48, 64), np.int32), pair.image_ref)
    truth = plane_soup(pose, move, 1)
    data = in_pixels(build_energy_data(seg, pair.flow, pair.K_ref, pair.K_next, 30, 0), truth, seg)
    solution = solve_soup(disturbed(truth, 0.05), data, WEIGHTS, form(gauge=gauge), OPTIONS)
    assert_constraints(solution, data)
    assert not any(solution.energy[term] for term in ("arap", "cont", "orient"))
    assert solution.energy["total"] < 0.05 * solution.energy_start["total"]


def test_a_better_start_is_delivered_beside_the_presolves_kkt_point(room, solved):
    # wide smoothing raises the exact energy above that of a start that was solved with less
    first = solved["unit-offset"].soup
    options = OPTIONS.replace(presolve_eps=(0.3,), eps=0.3)
    again = solve_soup(first, room.data, WEIGHTS, form(), options)
    assert again.converged, again.status
    assert again.stages[-1].history["inf_du"][0] < 1e-2
    assert again.stages[-1].iterations <= 5
    assert again.delivered == "start"
    assert again.energy["total"] == pytest.approx(again.energy_start["total"], rel=1e-9)
    assert_constraints(again, room.data)
