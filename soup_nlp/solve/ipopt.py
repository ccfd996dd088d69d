"""Ipopt on an `NLP`: options, progress, interruption, and the best iterate in every case."""

import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import casadi as ca
import numpy as np

from soup_nlp.arrays import Float
from soup_nlp.errors import SolverError
from soup_nlp.model.nlp import NLP
from soup_nlp.solve.functions import Buffered, Functions
from soup_nlp.storage.progress import Progress, Watch, interruptible, raising

# few bounds are active, so mu starts near its end (docs/solving.md)
DEFAULTS: Mapping[str, Any] = {
    "linear_solver": "mumps",
    "mu_strategy": "monotone",
    "mu_init": 1e-5,
    "nlp_scaling_method": "none",
    "constr_viol_tol": 1e-9,
    "compl_inf_tol": 1e-4,
    "bound_push": 1e-6,
    "bound_frac": 1e-6,
    "mumps_permuting_scaling": 0,
    "watchdog_shortened_iter_trigger": 0,
    # Ipopt would read ipopt.opt of the working folder, which may name a library
    "option_file_name": "",
}
STILL = 2
"""Small changes of f in a row that are a stagnation."""
GOOD = ("Solve_Succeeded", "Solved_To_Acceptable_Level")
_PUSHES = ("bound_push", "bound_frac", "slack_bound_push", "slack_bound_frac", "mult_bound_push")


def warm(push: float) -> dict[str, Any]:
    """Options that leave a given start where it is, except within `push` of a bound."""
    return {"warm_start_init_point": "yes", **{f"warm_start_{k}": push for k in _PUSHES}}


@dataclass(frozen=True, eq=False)
class Stage:
    """One call of Ipopt and how it ended.

    Attributes:
        name: Stage.
        status: Ipopt's return status, or "Interrupted", "Time_Limit", "Stagnated".
        converged: Whether the solver reports success.
        x: Best iterate: the last one when converged, else the lowest f + penalty.
        lam_x: Multipliers of the bounds at x.
        lam_g: Multipliers of the constraints at x.
        objective: f at x.
        iterations: Count.
        seconds: Wall time, set-up included.
        history: objective, inf_pr, inf_du, mu, alpha_pr, regularization by iteration.
    """

    name: str
    status: str
    converged: bool
    x: Float
    lam_x: Float
    lam_g: Float
    objective: float
    iterations: int = 0
    seconds: float = 0.0
    history: Mapping[str, Float] = field(default_factory=dict, repr=False)

    def __str__(self) -> str:
        return (
            f"{self.name}: {self.status}, {self.iterations} iterations, f {self.objective:.6g},"
            f" {self.seconds:.1f} s"
        )

    __repr__ = __str__


class _Iterations:
    """Iterations of one call of Ipopt: progress, limits, the best iterate."""

    def __init__(
        self, nlp: NLP, x0: Float, stage: str, watch: Watch, seconds: float, stagnation: float
    ) -> None:
        self.stagnation, self.last_f, self.still = stagnation, np.inf, 0
        self.nlp, self.stage, self.watch = nlp, stage, watch
        self.signalled = threading.Event()
        self.begin = time.perf_counter()
        self.deadline = time.process_time() + seconds
        self.count = 0
        self.x0, self.least = x0, np.inf
        self.best: tuple[Float, float, Float, Float] | None = None
        self.reason = ""
        sizes = {"x": nlp.nx, "f": 1, "g": nlp.ng}
        sizes |= {"lam_x": nlp.nx, "lam_g": nlp.ng, "lam_p": len(nlp.theta)}
        answer = {"ret": (ca.Sparsity.dense(1, 1), self.stop)}
        self.callback = Buffered(f"watch_{nlp.name}", sizes, answer)

    def stop(self, *outputs: Float) -> float:
        """Whether to stop after this iteration, 1 or 0; a callback must not raise.

        The outputs of nlpsol are valid during the call only.
        """
        try:
            self._step(*outputs)
        except Exception as error:
            self.reason = f"Callback_Failed: {error}"
        return float(bool(self.reason))

    def _step(self, x: Float, value: Float, g: Float, *multipliers: Float) -> None:
        nlp, f = self.nlp, float(value[0])
        infeasible = float(np.maximum(nlp.lbg - g, g - nlp.ubg).max(initial=0.0))
        # an exact penalty: retraction repairs a small violation, not a large one
        rank = f + 10.0 * infeasible * max(1.0, abs(f))
        if np.isfinite(f) and rank < self.least:
            self.least = rank
            self.best = x.copy(), f, multipliers[0].copy(), multipliers[1].copy()
        now = time.perf_counter()
        if self.watch.listener:
            self.watch.listener(Progress(self.stage, self.count, f, infeasible, now - self.begin))
        self.count += 1
        if self.stagnation:
            self.still = self.still + 1 if abs(self.last_f - f) <= self.stagnation * abs(f) else 0
            self.last_f = f
        if self.still >= STILL:
            self.reason = "Stagnated"
        if self.watch.stop.is_set() or self.signalled.is_set():
            self.reason = "Interrupted"
        elif time.process_time() > self.deadline:
            self.reason = "Time_Limit"

    def ended(self, stats: Mapping[str, Any], out: Mapping[str, Float]) -> Stage:
        """Record of the call: the answer `out`, or the best iterate where it did not converge."""
        status = self.reason or str(stats.get("return_status", "Unknown"))
        converged = status in GOOD
        history = {k: np.asarray(v, float) for k, v in stats.get("iterations", {}).items()}
        # Ipopt does not count the iteration that begins its restoration; the history has it
        count = len(history["obj"]) - 1 if len(history.get("obj", ())) else self.count
        last = out["x"], float(out["f"][0]), out["lam_x"], out["lam_g"]
        x, f, lam_x, lam_g = last if converged or self.best is None else self.best
        if not np.isfinite(x).all():
            x, f = self.x0, np.nan
        return Stage(
            name=self.stage,
            status=status,
            converged=converged,
            x=x,
            lam_x=lam_x,
            lam_g=lam_g,
            objective=f,
            iterations=count,
            seconds=time.perf_counter() - self.begin,
            history=history,
        )


def _solver(
    functions: Functions, iterations: _Iterations, user: Mapping[str, Any], ipopt: dict[str, Any]
) -> Any:
    log_file = iterations.watch.log_file
    if log_file:
        # without its log where that cannot be opened
        with suppress(OSError), open(log_file, "a"):
            ipopt |= {"output_file": log_file, "file_print_level": 5, "file_append": "yes"}
    options = {
        "ipopt": ipopt,
        **functions.derivatives,
        "iteration_callback": iterations.callback,
        "print_time": False,
        "calc_lam_p": False,
        "calc_multipliers": False,
        "no_nlp_grad": True,
        "show_eval_warnings": False,
    }
    try:
        return ca.nlpsol("solver", "ipopt", functions.oracle, options)
    except RuntimeError as error:
        raise SolverError(
            "Ipopt could not be set up",
            where=iterations.nlp.name,
            found=str(error).strip().splitlines()[-1],
            hint="check the names of the options under solver" if user else None,
        ) from error


def run_ipopt(
    nlp: NLP,
    options: Mapping[str, Any] = MappingProxyType({}),
    below: Mapping[str, Any] = MappingProxyType({}),
    *,
    x0: Float,
    p: Float | None = None,
    lam_x0: Float | None = None,
    lam_g0: Float | None = None,
    max_iter: int = 100,
    tol: float = 1e-4,
    seconds: float = np.inf,
    stagnation: float = 0.0,
    stage: str = "solve",
    watch: Watch | None = None,
) -> Stage:
    """Solve an NLP from x0.

    Args:
        nlp: The NLP.
        options: Ipopt's by the user.
        below: Options of the stage, which those of the user replace.
        x0: (nx,) start.
        p: (nt,) parameters theta; default the NLP's.
        lam_x0: (nx,) start of the bound multipliers.
        lam_g0: (ng,) start of the constraint multipliers.
        max_iter: Iteration limit.
        tol: Ipopt's tol and dual_inf_tol.
        seconds: Limit of CPU time; the best iterate is kept.
        stagnation: Relative change of f that ends the solve when it was smaller twice in a
            row; 0 for none.
        stage: Name for progress.
        watch: Listener, stop event and log, to which Ipopt's own is appended.

    Raises:
        KeyboardInterrupt: Ctrl-C, which ends the solve at the next iteration.
    """
    iterations = _Iterations(nlp, x0, stage, watch or Watch(), seconds, stagnation)
    ipopt = {**DEFAULTS, "print_level": 0, "sb": "yes", "max_iter": max_iter, "tol": tol}
    # CasADi does not keep a callback alive
    functions = Functions(nlp)
    every = {**ipopt, "dual_inf_tol": tol, **below, **options}
    solver = _solver(functions, iterations, options, every)
    given = {"p": nlp.thetas() if p is None else p, "lam_x0": lam_x0, "lam_g0": lam_g0}
    bounds = {k: getattr(nlp, k) for k in ("lbx", "ubx", "lbg", "ubg")}
    with interruptible(numbers=raising()) as iterations.signalled:
        out = solver(x0=x0, **bounds, **{k: v for k, v in given.items() if v is not None})
    if iterations.signalled.is_set():
        raise KeyboardInterrupt
    return iterations.ended(solver.stats(), {k: np.asarray(v).ravel() for k, v in out.items()})
