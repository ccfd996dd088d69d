"""Ipopt on textbook problems as kernels: known optima, multipliers, limits, interruption."""

import os
import re
import signal
import threading
from functools import partial

import casadi as ca
import numpy as np
import pytest
from helpers_nl import plain_nlp

from soup_nlp.errors import SolverError
from soup_nlp.model.kernel import Group, Kernel
from soup_nlp.model.nlp import NLP
from soup_nlp.solve.functions import Functions
from soup_nlp.solve.ipopt import Stage, run_ipopt
from soup_nlp.solve.kkt import optimality
from soup_nlp.storage.progress import Progress, Watch

# --- textbook problems as kernels and tables -----------------------------------------------------


textbook = partial(plain_nlp, "textbook", theta={"one": 1.0})


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
        Group(main, np.arange(4)[None], np.zeros((1, 0)), np.array([[0]])),
        Group(square, np.arange(4)[:, None], np.ones((4, 1)), np.ones((4, 1), int)),
    ]
    return textbook(groups, [1, 5, 5, 1], lbx=1, ubx=5, lbg=[25, 40], ubg=[np.inf, 40])


HS071 = np.array([1.0, 4.742999643, 3.821149978, 1.379408294]), 17.0140172892


def rosenbrock(n: int) -> NLP:
    """Chained Rosenbrock: one kernel over n - 1 overlapping pairs.

    The later variable comes first in the kernel: tables need not be sorted.
    """
    x, row, one = symbols(2, 1)
    kernel = Kernel(
        "valley", x, row, one, objective=row * (x[0] - x[1] ** 2) ** 2 + (one - x[1]) ** 2
    )
    index = np.stack([np.arange(1, n), np.arange(n - 1)], axis=1)
    group = Group(kernel, index, np.full((n - 1, 1), 100.0), np.zeros((n - 1, 0), int))
    return textbook([group], [0.8] * n)


def solve(nlp: NLP, **options) -> Stage:
    return run_ipopt(nlp, x0=nlp.x0, **{"tol": 1e-8, **options})


def test_hs071_is_solved_to_its_known_optimum():
    """And KKT residuals are small there only."""
    nlp = hs071()
    stage = solve(nlp)
    assert stage.converged
    assert stage.status == "Solve_Succeeded"
    np.testing.assert_allclose(stage.x, HS071[0], atol=1e-5)
    assert stage.objective == pytest.approx(HS071[1], abs=1e-5)
    # multipliers of the book, in CasADi's sign: negative at a lower bound
    np.testing.assert_allclose(stage.lam_g, [-0.55229366, 0.16146857], atol=1e-4)
    np.testing.assert_allclose(stage.lam_x, [-1.08787121, 0, 0, 0], atol=1e-4)
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


def of_one_variable(f, g=None, x0: float = 1.0, **bounds: float) -> NLP:
    """min f(x), subject to bounds of x and of g(x)."""
    x, row, one = symbols(1)
    kernel = Kernel("one", x, row, one, objective=f(x), constraints=None if g is None else g(x))
    rows = np.zeros((1, 0 if g is None else 1), int)
    group = Group(kernel, np.zeros((1, 1), int), np.zeros((1, 0)), rows)
    return textbook([group], [x0], **bounds)


def test_a_multiplier_of_the_wrong_sign_is_no_optimum():
    """max x, x >= 0: at 0 the gradient is balanced only by a force from an upper bound."""
    nlp = of_one_variable(lambda x: -x, lbx=0)
    residual = optimality(nlp, np.zeros(1), np.array([1.0]), np.zeros(0))
    assert max(residual.values()) >= 1


def test_hessian_of_an_unsorted_table_is_upper_triangular():
    nlp = rosenbrock(4)
    assert Functions(nlp).derivatives["hess_lag"].sparsity_out(0).is_triu()
    x = np.array([0.3, -0.5, 0.7, 1.2])
    H = nlp.hessian(x, np.zeros(0)).toarray()
    expected = np.zeros((4, 4))
    for i in range(3):
        expected[i, i] += 1200 * x[i] ** 2 - 400 * x[i + 1] + 2
        expected[i + 1, i + 1] += 200
        expected[i, i + 1] = expected[i + 1, i] = -400 * x[i]
    np.testing.assert_allclose(H, expected, rtol=1e-12)


def no_paper(p: Progress) -> None:
    raise ValueError("no more paper")


@pytest.mark.parametrize(
    ("make", "options", "status"),
    [
        (
            lambda: of_one_variable(lambda x: x, lambda x: x**2, ubg=-1.0),
            {"max_iter": 200},
            "Infeasible_Problem_Detected|Restoration_Failed",
        ),
        (lambda: of_one_variable(lambda x: ca.sqrt(x - 2)), {}, "Invalid_Number_Detected"),
        (lambda: rosenbrock(10), {"seconds": 0.0}, "Time_Limit"),
        (lambda: rosenbrock(10), {"watch": Watch(no_paper)}, "Callback_Failed: no more paper"),
    ],
)
def test_a_solve_that_fails_is_a_result_with_its_status(make, options, status):
    stage = solve(make(), **options)
    assert not stage.converged
    assert re.fullmatch(status, stage.status)
    assert np.isfinite(stage.x).all()
    assert str(stage).startswith(f"solve: {stage.status}, ")
    assert stage.iterations <= 1 or status != "Time_Limit"


def test_history_counts_and_call_times_are_kept():
    seen: list[Progress] = []
    stage = solve(hs071(), stage="textbook", watch=Watch(seen.append))
    assert [p.iteration for p in seen] == list(range(stage.iterations + 1))
    assert {p.stage for p in seen} == {"textbook"}
    assert (np.diff([p.seconds for p in seen]) >= 0).all()
    assert seen[-1].objective == pytest.approx(stage.objective, rel=1e-6)
    assert seen[-1].infeasibility < 1e-6 < max(p.infeasibility for p in seen)
    assert "it " in str(seen[0])
    assert stage.history.keys() >= {"obj", "inf_pr", "inf_du", "mu"}
    assert all(len(v) == stage.iterations + 1 for v in stage.history.values())
    np.testing.assert_allclose(stage.history["obj"], [p.objective for p in seen])


@pytest.mark.parametrize(
    "options", [{"no_such_option": 1}, {"max_iter": "many"}, {"linear_solver": "abacus"}]
)
def test_a_wrong_ipopt_option_is_a_solver_error(options):
    nlp = hs071()
    with pytest.raises(SolverError) as caught:
        run_ipopt(nlp, options, x0=nlp.x0)
    assert "textbook" in str(caught.value)
    assert "the names of the options" in str(caught.value)
    with pytest.raises(SolverError) as caught:
        run_ipopt(nlp, {}, options, x0=nlp.x0)
    assert "the names of the options" not in str(caught.value)


def test_a_log_that_cannot_be_opened_is_left_out(tmp_path):
    nlp = hs071()
    log = tmp_path / "removed by another process" / "ipopt.log"
    assert run_ipopt(nlp, x0=nlp.x0, watch=Watch(log_file=str(log))).converged


def test_options_reach_ipopt(tmp_path, monkeypatch):
    # Ipopt's own file of options in the working folder is not read
    (tmp_path / "ipopt.opt").write_text("max_iter 0\nhsllib ./evil.so\n")
    monkeypatch.chdir(tmp_path)
    nlp, log = hs071(), tmp_path / "ipopt.log"
    run_ipopt(nlp, {"mu_init": 0.123}, x0=nlp.x0, watch=Watch(log_file=str(log)))
    text = log.read_text()
    assert "Number of nonzeros" in text
    assert "lg(mu)" in text
    stage = run_ipopt(nlp, {"mu_init": 0.123}, x0=nlp.x0)
    assert stage.history["mu"][0] == pytest.approx(0.123)
    assert stage.converged


def test_the_iteration_limit_keeps_the_best_iterate():
    nlp = rosenbrock(10)
    start = nlp.value(nlp.x0)
    f = []
    for limit in (0, 1, 3, 6):
        stage = solve(nlp, max_iter=limit)
        assert not stage.converged
        assert stage.status == "Maximum_Iterations_Exceeded"
        assert stage.iterations == limit
        assert nlp.value(stage.x) == pytest.approx(stage.objective)
        assert stage.objective <= start
        f.append(stage.objective)
    assert (np.diff(f) <= 0).all()
    assert f[-1] < start
    # without the limit it reaches the ones
    stage = solve(nlp)
    assert stage.converged
    np.testing.assert_allclose(stage.x, 1.0, atol=1e-6)
    assert stage.objective == pytest.approx(0, abs=1e-10)
    residual = optimality(nlp, stage.x, stage.lam_x, stage.lam_g)
    assert residual["dual_infeasibility"] <= 1e-6
    assert residual["complementarity"] == 0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_control_c_ends_a_solve_at_the_next_iteration(number):
    """CasADi swallows what is raised in its callbacks: the caller would go on."""
    seen = []

    def listen(p: Progress) -> None:
        seen.append(p.iteration)
        if p.iteration == 2:
            os.kill(os.getpid(), number)

    old = signal.signal(number, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            solve(rosenbrock(10), watch=Watch(listen))
        assert signal.getsignal(number) is signal.default_int_handler
    finally:
        signal.signal(number, old)
    assert max(seen) <= 3


def test_an_event_stops_and_keeps_the_best_iterate():
    nlp, stop, seen = rosenbrock(10), threading.Event(), []

    def listen(p: Progress) -> None:
        seen.append(p.objective)
        if p.iteration == 3:
            stop.set()

    stage = solve(nlp, watch=Watch(listen, stop))
    assert stage.status == "Interrupted"
    assert len(seen) == 4
    assert stage.objective == min(seen)
    assert nlp.value(stage.x) == pytest.approx(stage.objective)
