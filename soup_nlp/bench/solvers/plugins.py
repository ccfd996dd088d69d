"""CasADi's plug-ins as solvers to compare."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from soup_nlp.bench.solvers.task import Answer, Task, Trace
from soup_nlp.export.verify import Limits
from soup_nlp.model.nlp import NLP
from soup_nlp.solve.callback import IterationCallback
from soup_nlp.solve.ipopt import DEFAULTS

Float = NDArray[np.float64]

CLAIMS = ("Solve_Succeeded", "Solved_To_Acceptable_Level", "SUCCESS", "success", "Converged")


TRIU = ("triu_hess_gamma_x_x",)
CACHED: Mapping[str, tuple[tuple[str, ...], ...]] = {
    "uno": (("grad_f_x",), ("jac_g_x",), TRIU),
    "bonmin": (("f", "grad_f_x"), ("g", "jac_g_x"), TRIU),
    "fatrop": (("grad_f_x",), ("g", "jac_g_x"), ("grad_gamma_x", "hess_gamma_x_x")),
}
"""Outputs of nlp_grad_f, nlp_jac_g and nlp_hess_l that a plug-in asks CasADi for."""


class _Watch(IterationCallback):
    """Iterates of a plug-in into the trace; asks it to stop when the time is over."""

    def __init__(self, trace: Trace, seconds: float) -> None:
        super().__init__()
        self.trace, self.seconds, self.late = trace, seconds, False

    def eval(self, arg: list[ca.DM]) -> list[int]:
        self.trace.add(np.asarray(arg[0]))
        self.late = time.perf_counter() - self.trace.begin > self.seconds
        return [int(self.late)]


def _ipopt(limits: Limits) -> dict[str, Any]:
    return {
        "tol": limits.tol,
        "dual_inf_tol": limits.tol,
        "compl_inf_tol": limits.tol,
        "constr_viol_tol": limits.feasibility,
        "acceptable_iter": 0,
        "max_iter": limits.iterations,
        "print_level": 0,
        "sb": "yes",
    }


def _sqp(limits: Limits, qpsol: str, qp: Mapping[str, Any]) -> dict[str, Any]:
    return {
        "qpsol": qpsol,
        "qpsol_options": dict(qp),
        "max_iter": limits.iterations,
        "tol_du": limits.tol,
        "tol_pr": limits.feasibility,
        "print_header": False,
        "print_iteration": False,
        "print_status": False,
        "error_on_fail": False,
    }


def _uno(limits: Limits) -> dict[str, Any]:
    return {
        "max_iterations": limits.iterations,
        "dual_tolerance": limits.tol,
        "primal_tolerance": limits.feasibility,
        "logger": "SILENT",
    }


def _limited(limits: Limits) -> dict[str, Any]:
    return {"max_iter": limits.iterations, "tol": limits.tol, "print_level": 0}


NEAR = {k: v for k, v in DEFAULTS.items() if k.startswith(("mu_", "bound_", "nlp_scaling"))}
"""Options of a start near the end, for solvers of Ipopt's family."""
QUIET_OSQP = {"osqp": {"verbose": False, "eps_abs": 1e-8, "eps_rel": 1e-8, "max_iter": 20000}}
PLUGINS: Mapping[str, tuple[str, str, bool, Callable[[Limits], dict[str, Any]]]] = {
    "ipopt": ("ipopt", "exact", True, lambda m: {"ipopt": _ipopt(m)}),
    "ipopt-soup": ("ipopt", "gauss-newton", True, lambda m: {"ipopt": {**DEFAULTS, **_ipopt(m)}}),
    "ipopt-tuned": ("ipopt", "exact", True, lambda m: {"ipopt": {**DEFAULTS, **_ipopt(m)}}),
    "ipopt-lbfgs": (
        "ipopt",
        "exact",
        True,
        lambda m: {"ipopt": _ipopt(m) | {"hessian_approximation": "limited-memory"}},
    ),
    "sqpmethod": ("sqpmethod", "gauss-newton", True, lambda m: _sqp(m, "osqp", QUIET_OSQP)),
    "uno": ("uno", "exact", False, lambda m: {"uno": _uno(m)}),
    "alpaqa": ("alpaqa", "exact", False, lambda m: {}),
    "sleqp": ("sleqp", "exact", False, lambda m: {"max_iter": m.iterations}),
    "bonmin": ("bonmin", "exact", False, lambda m: {"bonmin": _limited(m)}),
    "fatrop": ("fatrop", "exact", False, lambda m: {"fatrop": _limited(m)}),
    "bonmin-tuned": ("bonmin", "exact", False, lambda m: {"bonmin": {**NEAR, **_limited(m)}}),
    "fatrop-tuned": (
        "fatrop",
        "exact",
        False,
        lambda m: {"fatrop": {"mu_init": NEAR["mu_init"], **_limited(m)}},
    ),
}
"""Plug-in, Hessian, whether it calls back at every iteration, options. "ipopt-soup" is how `solve`
runs Ipopt where it starts from no KKT point, "ipopt-tuned" the same with the exact Hessian, "ipopt"
Ipopt as it comes; other names with "-tuned" have its options for a start near the end. blocksqp is
left out: it needs a linear solver (ma27) that CasADi's wheel lacks."""


def plugin(name: str, task: Task) -> Answer:
    """Solve with a plug-in of CasADi's nlpsol; every one gets this package's own derivatives."""
    library, hessian, calls, options = PLUGINS[name]
    nlp = task.gauss_newton if hessian == "gauss-newton" else task.nlp
    trace = Trace(task.folder / "trace", nlp.nx)
    watch = _Watch(trace, task.limits.seconds)
    common: dict[str, Any] = {
        "print_time": False,
        "show_eval_warnings": False,
        "error_on_fail": False,
    }
    p = nlp.p
    if library in ("ipopt", "sqpmethod"):
        x = ca.MX.sym("x", nlp.nx)
        q = ca.MX.sym("p", len(p))
        f, g = nlp.oracle(x, q)
        problem = {"x": x, "p": q, "f": f, "g": g}
        common["calc_lam_p"] = False
        if library == "ipopt":
            common |= {"grad_f": nlp.grad_f, "jac_g": nlp.jac_g, "no_nlp_grad": True}
            common |= {"calc_multipliers": False, "hess_lag": nlp.hess_lag}
        else:
            _, grad = nlp.grad_f(x, q)
            _, jac = nlp.jac_g(x, q)
            lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", nlp.ng)
            hess = ca.triu2symm(nlp.hess_lag(x, q, lam_f, lam_g))
            common["hess_lag"] = ca.Function("nlp_hess_l", [x, q, lam_f, lam_g], [hess])
            names = ["x", "p"], ["f", "grad_f_x", "g", "jac_g_x"]
            common["jac_fg"] = ca.Function("nlp_jac_fg", [x, q], [f, grad, g, jac], *names)
    elif library in CACHED:
        # with numbers for the parameters: bonmin knows none
        x = ca.MX.sym("x", nlp.nx)
        f, g = nlp.oracle(x, p)
        problem, p = {"x": x, "f": f, "g": g}, np.zeros(0)
        common["cache"] = _cache(nlp, CACHED[library])
    else:
        s = ca.SX.sym("x", nlp.nx)
        f, g = nlp.oracle.expand()(s, p)
        problem = {"x": s, "f": f, "g": ca.densify(g)}
        p = np.zeros(0)
    if calls:
        watch.start("watch", nlp.nx, nlp.ng, len(p))
        common["iteration_callback"] = watch
    solver = ca.nlpsol("solver", library, problem, common | options(task.limits))
    out = solver(x0=nlp.x0, p=p, lbx=nlp.lbx, ubx=nlp.ubx, lbg=nlp.lbg, ubg=nlp.ubg)
    stats = solver.stats()
    status = str(stats.get("return_status", stats.get("unified_return_status", "?")))
    claimed = bool(stats.get("success")) or status in CLAIMS
    x_ = np.asarray(out["x"]).ravel()
    trace.add(x_)
    return Answer(
        x_,
        np.asarray(out["lam_g"]).ravel(),
        "Time_Limit" if watch.late else status,
        claimed and not watch.late,
        int(stats.get("iter_count", -1)),
        time.perf_counter() - trace.begin,
    )


def _cache(nlp: NLP, wanted: tuple[tuple[str, ...], ...]) -> dict[str, ca.Function]:
    """The package's derivatives under the names and with the outputs that a plug-in asks for."""
    x, q = ca.MX.sym("x", nlp.nx), ca.MX.sym("p", 0)
    lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", nlp.ng)
    f, grad = nlp.grad_f(x, nlp.p)
    g, jac = nlp.jac_g(x, nlp.p)
    upper = nlp.hess_lag(x, nlp.p, lam_f, lam_g)
    known = {
        "f": f,
        "grad_f_x": grad,
        "g": g,
        "jac_g_x": jac,
        "triu_hess_gamma_x_x": upper,
        "hess_gamma_x_x": ca.triu2symm(upper),
        "grad_gamma_x": lam_f * grad + ca.mtimes(jac.T, lam_g),
    }
    inputs = ([x, q], ["x", "p"]), ([x, q, lam_f, lam_g], ["x", "p", "lam_f", "lam_g"])
    out = {}
    for name, outputs in zip(("nlp_grad_f", "nlp_jac_g", "nlp_hess_l"), wanted):
        args, words = inputs[name == "nlp_hess_l"]
        values = [known[k] for k in outputs]
        out[name] = ca.Function(name, args, values, words, list(outputs))
    return out
