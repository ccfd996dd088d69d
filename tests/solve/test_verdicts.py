"""Limits that make a verdict strict: each just inside and just outside."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from helpers_model import PAPER, Tiny
from scipy import sparse

from soup_nlp.cli import results
from soup_nlp.cli.main import main
from soup_nlp.export.compare import problem_task
from soup_nlp.export.verify import Limits, Residuals
from soup_nlp.geometry.constraints import constraints
from soup_nlp.model import oracle
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.programs import build_matrix_nlp
from soup_nlp.report.check import Stored, _constraints
from soup_nlp.solve import stages
from soup_nlp.solve.kkt import optimality, warm_start
from soup_nlp.solve.presolve import _rim
from soup_nlp.solve.solver_options import Stages

FORM = Formulation()


@pytest.mark.parametrize("place", ["primal", "dual", "complementarity"])
def test_a_foreign_point_is_verified_up_to_its_limits(place):
    # `compare` admits ten times as much of the constraints
    limit, compared = {"primal": (1e-6, 1e-5)}.get(place, (1e-3, 1e-3))
    none = dict.fromkeys(("primal", "dual", "complementarity"), 0.0)
    for factor, good in ((0.99, True), (1.01, False)):
        found, other = (
            Residuals(**none | {place: factor * most}, multipliers="", lam_x=(), lam_g=())
            for most in (limit, compared)
        )
        assert found.optimal is good
        assert other.within(Limits()) is good


@pytest.mark.parametrize("place", ["x", "g"])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_complementarity_counts_bounds_and_rows_on_both_sides(place, sign):
    # a gap of 0.5 below and 0.25 above, in the variable or in the row
    at, free = np.array([0.5]), {"x": np.array([7.0]), "g": np.array([7.0])}
    value = free | {place: at}
    infinite = np.array([np.inf])
    bounds = {f"l{k}": -infinite for k in ("bx", "bg")} | {f"u{k}": infinite for k in ("bx", "bg")}
    name = "b" + place
    bounds |= {f"l{name}": np.array([0.0]), f"u{name}": np.array([0.75])}
    nlp = SimpleNamespace(
        gradient=lambda x: np.zeros(1),
        jacobian=lambda x: sparse.csr_matrix(np.zeros((1, 1))),
        constraints=lambda x: value["g"],
        lbx=bounds["lbx"],
        ubx=bounds["ubx"],
        lbg=bounds["lbg"],
        ubg=bounds["ubg"],
    )
    lam = {"x": np.zeros(1), "g": np.zeros(1)} | {place: np.array([4 * sign])}
    found = optimality(nlp, value["x"], lam["x"], lam["g"])
    assert found["complementarity"] == (2.0 if sign < 0 else 1.0)
    assert found["dual_infeasibility"] == (4.0 if place == "x" else 0.0)


def test_an_answer_that_violates_its_constraints_has_not_converged(monkeypatch):
    tiny, call = Tiny(), stages.run_ipopt

    def answered(*args, **given):
        stage = call(*args, **given)
        x, n = stage.x.copy(), stage.x[1:4].copy()
        # tilted about the anchor until a rim ray sees the plane too flat by `off`
        anchor, rim = tiny.data.rim_ray[0, 0], tiny.data.rim_ray[0, 1]
        across = rim - (rim @ anchor) / (anchor @ anchor) * anchor
        for _ in range(50):
            n -= (FORM.min_facing - off + n @ rim) / (across @ rim) * across
            n /= np.linalg.norm(n)
        x[1:4] = n
        return replace(stage, x=x, status="Solve_Succeeded", converged=True)

    monkeypatch.setattr(stages, "run_ipopt", answered)
    options = Stages(presolve_iterations=0, max_iter=1)
    for off, status in ((0.9e-6, "Solve_Succeeded"), (1.1e-6, "Constraints_Violated")):
        found = stages.solve_soup(tiny.soup, tiny.data, PAPER, FORM, options)
        assert found.status == status
        assert found.converged == (off < 1e-6)


def test_multipliers_of_rim_visibility_push_planes_towards_the_camera():
    tiny = Tiny()
    nlp, layout = build_matrix_nlp(tiny.soup, tiny.data, PAPER, FORM)
    rows = next(g for g in nlp.groups if g.kernel.name == "visible").rows
    rim = np.ones((len(tiny.data), tiny.data.rim_ray.shape[1] - 1))
    lam_g = warm_start(nlp, tiny.data, tiny.soup, rim)["lam_g0"]
    facing = -np.einsum("nc,nc->n", tiny.soup.n, tiny.data.anchor_ray)
    # the multiplier of a lower bound is negative in CasADi's sign
    np.testing.assert_allclose(lam_g[rows[:, 1:]], -rim / facing[:, None])
    # and the way back, from the multipliers of a presolve in matrices
    own = SimpleNamespace(nlp=nlp, lam_g=lam_g, layout=layout)
    np.testing.assert_allclose(_rim(own, tiny.soup, tiny.data), rim)
    group = SimpleNamespace(kernel=SimpleNamespace(name="t_visible"), rows=np.array([[0, 1]]))
    held = SimpleNamespace(
        nlp=SimpleNamespace(groups=[group]),
        lam_g=np.array([-2.0, 0.0]),
        layout=SimpleNamespace(chart="depth"),
    )
    np.testing.assert_array_equal(_rim(held, tiny.soup, tiny.data), [[2.0, 0.0]])


@pytest.mark.parametrize(("kind", "limit"), [("so3", 1e-8), ("simplex", 1e-10), ("visible", 1e-6)])
def test_a_stored_result_is_held_to_the_limits_of_a_solve(kind, limit):
    tiny = Tiny()
    soup = tiny.soup.normalised(tiny.data.share).retracted()
    least = (-np.einsum("nc,nvc->nv", soup.n, tiny.data.rim_ray)).min()
    for factor, good in ((0.9, True), (1.1, False)):
        R, lam, facing = soup.R.copy(), soup.lam.copy(), least
        if kind == "so3":
            R[0] *= 1 + factor * limit / 2
        elif kind == "simplex":
            lam[0] += factor * limit
        else:
            facing += factor * limit
        state = vars(soup) | {"R": R, "lam": lam}
        tree = {
            "solution": state,
            "energy": {"rim_ray": tiny.data.rim_ray},
            "weights": {"min_facing": facing},
        }
        said = constraints(state, tiny.data.rim_ray, facing).largest
        claims = {"status": "Skipped", "delivered": "start", "residuals": said}
        rows = {c.name: c for c in _constraints(Stored(Path(), claims, tree))}
        row = rows.pop(f"solution {kind}")
        assert row.found == pytest.approx(factor * limit, rel=1e-3)
        assert row.ok == (row.found <= row.most) == good
        if kind == "so3":
            # |det R - 1| is three halves of it
            del rows["solution det"]
        assert all(other.ok for other in rows.values())


@pytest.mark.parametrize("place", ["rows", "det"])
def test_the_exit_code_of_check_is_the_verdict_on_a_sol(place, monkeypatch):
    tiny = Tiny()
    soup = tiny.soup.normalised(tiny.data.share).retracted()
    problem = SimpleNamespace(formulation=SimpleNamespace(min_facing=-1.0))
    for off, dual, code in ((0.9e-6, 0.9e-3, 0), (0.9e-6, 1.1e-3, 3), (1.1e-6, 0.9e-3, 1)):
        # det R is off by three times a relative change of R, R'R by twice
        point = replace(soup, R=soup.R * (1 + off / 3)) if place == "det" else soup
        run = SimpleNamespace(answer=point, data=tiny.data, problem=problem, metrics={})
        found = Residuals(0.0, dual, 0.0, "", lam_x=(), lam_g=())
        rows = {"rows": np.array([0.0, off if place == "rows" else 0.0])}
        imported = SimpleNamespace(run=run, violations=rows, residuals=found)
        monkeypatch.setattr(results, "import_sol", lambda *_, answer=imported: answer)
        assert main(["check", "soup.sol"]) == code


def test_a_verified_energy_is_at_most_a_thousandth_above_the_start():
    class Case(SimpleNamespace):
        def __len__(self):
            return 4

    tiny = Tiny()
    case = Case(
        formulation=lambda **changes: FORM.replace(**changes),
        start=SimpleNamespace(soup=tiny.soup),
        data=tiny.data,
        weights=PAPER,
        problem=SimpleNamespace(name="tiny", identity=lambda: "0"),
    )
    label, _ = problem_task(case, "matrix")
    start = oracle.energy(tiny.soup, tiny.data, PAPER)["total"]
    assert label["energy_limit"] == pytest.approx(1.001 * start)
