"""Solvers by name: CasADi's plug-ins, executables that read .nl, SCIP, and two yardsticks."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from soup_nlp.compare.task import Answer, Limits, Solver, Task, Trace
from soup_nlp.errors import SolverError
from soup_nlp.export.nl import write_nl
from soup_nlp.export.sol import read_sol
from soup_nlp.model.formulation import build_matrix_nlp
from soup_nlp.model.nlp import NLP
from soup_nlp.solve.ipopt import DEFAULTS
from soup_nlp.solve.yardstick import EPS, Yardstick, lbfgs, levenberg_marquardt

Float = NDArray[np.float64]

CLAIMS = ("Solve_Succeeded", "Solved_To_Acceptable_Level", "SUCCESS", "success", "Converged")


TRIU = ("triu_hess_gamma_x_x",)
CACHED: Mapping[str, tuple[tuple[str, ...], ...]] = {
    "uno": (("grad_f_x",), ("jac_g_x",), TRIU),
    "bonmin": (("f", "grad_f_x"), ("g", "jac_g_x"), TRIU),
    "fatrop": (("grad_f_x",), ("g", "jac_g_x"), ("grad_gamma_x", "hess_gamma_x_x")),
}
"""Outputs of nlp_grad_f, nlp_jac_g and nlp_hess_l that a plug-in asks CasADi for."""


class _Watch(ca.Callback):
    """Iterates of a plug-in into the trace; asks it to stop when the time is over."""

    def __init__(self, nlp: NLP, trace: Trace, seconds: float) -> None:
        ca.Callback.__init__(self)
        self.sizes = {"f": 1, "x": nlp.nx, "lam_x": nlp.nx, "g": nlp.ng, "lam_g": nlp.ng}
        self.trace, self.seconds, self.late = trace, seconds, False
        self.construct("watch", {})

    def get_n_in(self) -> int:
        return int(ca.nlpsol_n_out())

    def get_n_out(self) -> int:
        return 1

    def get_name_in(self, i: int) -> str:
        return str(ca.nlpsol_out(i))

    def get_sparsity_in(self, i: int) -> ca.Sparsity:
        size = self.sizes.get(ca.nlpsol_out(i), 0)
        return ca.Sparsity.dense(size) if size else ca.Sparsity(0, 1)

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
    "uno": (
        "uno",
        "exact",
        False,
        lambda m: {
            "uno": {
                "max_iterations": m.iterations,
                "dual_tolerance": m.tol,
                "primal_tolerance": m.feasibility,
                "logger": "SILENT",
            }
        },
    ),
    "alpaqa": ("alpaqa", "exact", False, lambda m: {}),
    "sleqp": ("sleqp", "exact", False, lambda m: {"max_iter": m.iterations}),
    "bonmin": (
        "bonmin",
        "exact",
        False,
        lambda m: {"bonmin": {"max_iter": m.iterations, "tol": m.tol, "print_level": 0}},
    ),
    "fatrop": (
        "fatrop",
        "exact",
        False,
        lambda m: {"fatrop": {"max_iter": m.iterations, "tol": m.tol, "print_level": 0}},
    ),
    "bonmin-tuned": (
        "bonmin",
        "exact",
        False,
        lambda m: {"bonmin": {**NEAR, "max_iter": m.iterations, "tol": m.tol, "print_level": 0}},
    ),
    "fatrop-tuned": (
        "fatrop",
        "exact",
        False,
        lambda m: {
            "fatrop": {
                "mu_init": NEAR["mu_init"],
                "max_iter": m.iterations,
                "tol": m.tol,
                "print_level": 0,
            }
        },
    ),
}
"""Plug-in, Hessian, whether it calls back at every iteration, options. "ipopt-soup" is how `solve`
runs Ipopt, "ipopt-tuned" the same with the exact Hessian, "ipopt" Ipopt as it comes; other names
with "-tuned" have its options for a start near the end. blocksqp is
left out: it needs a linear solver (ma27) that CasADi's wheel lacks."""


def plugin(name: str, task: Task) -> Answer:
    """Solve with a plug-in of CasADi's nlpsol; every one gets this package's own derivatives."""
    library, hessian, calls, options = PLUGINS[name]
    nlp = task.gauss_newton if hessian == "gauss-newton" else task.nlp
    trace = Trace(task.folder / "trace", nlp.nx)
    watch = _Watch(nlp, trace, task.limits.seconds)
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
        common["iteration_callback"] = watch
        watch.sizes["lam_p"] = len(p)
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


def executable(command: str, task: Task, options: tuple[str, ...] = ()) -> Answer:
    """Solve with a program of the AMPL convention, `solver stub -AMPL key=value ...`."""
    begin = time.perf_counter()
    file = write_nl(task.folder / "soup.nl", task.nlp)
    path = task.folder / "soup.sol"
    # the folder may hold the answer to another problem
    path.unlink(missing_ok=True)
    words = [command, "soup", "-AMPL", *options]
    with (task.folder / "solver.log").open("w") as log:
        try:
            code = subprocess.run(
                words,
                cwd=task.folder,
                stdout=log,
                stderr=subprocess.STDOUT,
                timeout=max(1.0, task.limits.seconds - (time.perf_counter() - begin)),
                check=False,
            ).returncode
        except subprocess.TimeoutExpired:
            return Answer(None, None, "Time_Limit", False, -1, time.perf_counter() - begin)
    if not path.is_file():
        raise SolverError("solver wrote no .sol", where=Path(command).name, found=f"exit {code}")
    sol = read_sol(path, file.variables, file.rows)
    seconds = time.perf_counter() - begin
    Trace(task.folder / "trace", task.nlp.nx, begin).add(sol.x)
    status = sol.message.splitlines()[-1] if sol.message else sol.status
    return Answer(sol.x, sol.lam_g, status, sol.solved, -1, seconds)


def _ampl(name: str, task: Task, near: bool = False) -> Answer:
    """An executable that is found on the path or beside Python."""
    m = task.limits
    options: dict[str, tuple[str, ...]] = {
        "pounce": (
            f"tol={m.tol}",
            f"dual_inf_tol={m.tol}",
            f"compl_inf_tol={m.tol}",
            f"constr_viol_tol={m.feasibility}",
            f"max_iter={m.iterations}",
            "acceptable_iter=0",
            f"max_wall_time={0.9 * m.seconds}",
            "print_level=0",
        ),
    }
    words = options.get(name, ())
    if near:
        words = (*words, *(f"{k}={v}" for k, v in NEAR.items()))
    return executable(_find(name) or name, task, words)


def _find(name: str) -> str | None:
    found = shutil.which(name) or shutil.which(str(Path(sys.executable).parent / name))
    # it runs in another folder than this one
    return None if found is None else str(Path(found).absolute())


def scip(task: Task) -> Answer:
    """SCIP, a global solver, on the .nl file: for small problems; it has no start of ours."""
    import pyscipopt

    begin = time.perf_counter()
    write_nl(task.folder / "soup.nl", task.nlp)
    names = (task.folder / "soup.col").read_text().split()
    place = {name: k for k, name in enumerate(task.nlp.x_names())}
    model = pyscipopt.Model()
    model.hideOutput()
    model.readProblem(str(task.folder / "soup.nl"))
    model.setParam("limits/time", max(1.0, task.limits.seconds - (time.perf_counter() - begin)))
    model.setParam("numerics/feastol", max(task.limits.feasibility, 1e-9))
    found = {v.name: v for v in model.getVars()}
    start = model.createPartialSol()
    for name in names:
        model.setSolVal(start, found[name], float(task.nlp.x0[place[name]]))
    model.addSol(start)
    model.optimize()
    best = model.getBestSol()
    if best is None or not model.getNSols():
        status = f"{model.getStatus()}, no point"
        return Answer(None, None, status, False, -1, time.perf_counter() - begin)
    x = np.empty(task.nlp.nx)
    for name in names:
        x[place[name]] = best[found[name]]
    status = str(model.getStatus())
    nodes = int(model.getNTotalNodes())
    return Answer(x, None, status, status == "optimal", nodes, time.perf_counter() - begin)


def yardstick(method: Callable[..., Yardstick], task: Task) -> Answer:
    """On the manifold, without multipliers; it ends where the energy stops falling.

    That is no claim of an optimum: whether the point is one, the residuals say.
    """
    last = task.form.eps
    record = method(
        task.soup,
        task.data,
        task.weights,
        task.form,
        eps=[*(e for e in EPS if e > last), last],
        seconds=0.8 * task.limits.seconds,
    )
    # slack variables and switches at their best for this soup
    x = build_matrix_nlp(record.soup, task.data, task.weights, task.form)[0].x0.copy()
    x[: task.layout.size] = task.layout.pack(record.soup)
    history = np.asarray(record.history, float)
    return Answer(x, None, record.status, False, record.iterations, record.seconds, history)


def available() -> dict[str, Solver]:
    """Every solver that can run here, by name."""
    out: dict[str, Solver] = {
        name: partial(plugin, name) for name, row in PLUGINS.items() if ca.has_nlpsol(row[0])
    }
    if _find("pounce"):
        out["pounce"] = partial(_ampl, "pounce")
        out["pounce-tuned"] = partial(_ampl, "pounce", near=True)
    out["lm"] = partial(yardstick, levenberg_marquardt)
    out["lbfgs"] = partial(yardstick, lbfgs)
    if importlib.util.find_spec("pyscipopt"):
        out["scip"] = scip
    return out


def find_solver(name: str) -> Solver:
    """The solver of a name; another name is an executable of the AMPL convention.

    Raises:
        SolverError: there is none.
    """
    known = available()
    if name in known:
        return known[name]
    if name in PLUGINS or name == "scip" or not _find(name):
        raise SolverError(
            "solver is not here",
            where="--solvers",
            found=name,
            expected=", ".join(known) + ", or a program that reads .nl",
        )
    return partial(_ampl, name)
