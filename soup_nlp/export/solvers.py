"""Solvers by name: CasADi's plug-ins, programs that read .nl, and this package."""

import os
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import casadi as ca
import numpy as np

from soup_nlp.arrays import Float
from soup_nlp.errors import SolverError
from soup_nlp.export.nl import write_nl
from soup_nlp.export.sol import read_sol
from soup_nlp.export.verify import Limits
from soup_nlp.geometry.soup import Soup
from soup_nlp.model.energy_data import EnergyData
from soup_nlp.model.energy_options import Weights
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.layout import Layout, TangentLayout
from soup_nlp.model.nlp import NLP
from soup_nlp.model.programs import build_matrix_nlp, build_tangent_nlp
from soup_nlp.model.symbolic import Graph
from soup_nlp.solve.functions import Functions
from soup_nlp.solve.ipopt import DEFAULTS
from soup_nlp.solve.solver_options import SolverOptions
from soup_nlp.solve.stages import solve_soup
from soup_nlp.storage.system import end_with_parent


@dataclass(frozen=True, eq=False)
class Task:
    """An NLP for a solver, which may write files into the working folder.

    Attributes:
        nlp: The NLP with the exact Hessian.
        layout: Its layout.
        soup: Start.
        data, weights, form: Energy and formulation, for this package, which builds its own NLPs.
        limits: Limits of time, iterations, tolerance and memory.
    """

    nlp: NLP
    layout: Layout
    soup: Soup
    data: EnergyData
    weights: Weights
    form: Formulation
    limits: Limits

    @cached_property
    def gauss_newton(self) -> NLP:
        """The same NLP with the Gauss-Newton Hessian."""
        return replace(self.nlp, hessian_kind="gauss-newton+constraints")

    def point(self, soup: Soup) -> Float:
        """(nx,) vector of a soup, slack variables and switches at their best values."""
        energy = soup, self.data, self.weights, self.form
        if isinstance(self.layout, TangentLayout):
            nlp, _ = build_tangent_nlp(*energy, layout=self.layout)
        else:
            nlp, _ = build_matrix_nlp(*energy)
        return np.concatenate([self.layout.pack(soup), nlp.x0[self.layout.size :]])


@dataclass(frozen=True)
class Answer:
    """The answer of a solver.

    Attributes:
        x: (nx,) point, a soup that stands for its point, or None if the solver returned none.
        lam_g: (ng,) multipliers, or None.
        status: Status text of the solver.
        claimed: Whether the solver claims an optimum.
        iterations: Outer iterations, -1 if unknown.
    """

    x: Float | Soup | None
    lam_g: Float | None
    status: str
    claimed: bool
    iterations: int = -1


WALL_PER_CPU = 8.0
"""Limit of the wall time relative to that of the CPU time: other work may slow a run down, and a
program that waits uses no CPU time."""
Solver = Callable[[Task], Answer]


# --- CasADi's plug-ins ---------------------------------------------------------------------------


class Plugin(NamedTuple):
    """A plug-in of nlpsol with its options.

    Attributes:
        library: Name of the plug-in in CasADi.
        limits: Attribute of `Limits` by name of the plug-in's option.
        options: Further options of the plug-in.
        hessian: "exact" or "gauss-newton".
    """

    library: str
    limits: Mapping[str, str]
    options: Mapping[str, Any]
    hessian: str = "exact"

    def made_for(self, limits: Limits) -> dict[str, Any]:
        """Options of `ca.nlpsol`, for some libraries nested under the name of the library."""
        options = {**self.options, **{k: getattr(limits, name) for k, name in self.limits.items()}}
        return {self.library: options} if self.library in NESTED else options


CLAIMS = ("Solve_Succeeded", "Solved_To_Acceptable_Level", "SUCCESS", "success", "Converged")
NESTED = ("ipopt", "uno", "bonmin")
TOLERANCES = {
    **dict.fromkeys(("tol", "dual_inf_tol", "compl_inf_tol"), "tol"),
    "constr_viol_tol": "feasibility",
    "max_iter": "iterations",
    "max_cpu_time": "seconds",
}
"""Attribute of `Limits` by name of Ipopt's option."""
SQP_LIMITS = {"max_iter": "iterations", "tol_du": "tol", "tol_pr": "feasibility"}
UNO_LIMITS = {
    "max_iterations": "iterations",
    "dual_tolerance": "tol",
    "primal_tolerance": "feasibility",
}
COMMON = {"acceptable_iter": 0, "print_level": 0, "sb": "yes"}
NEAR_START = {k: v for k, v in DEFAULTS.items() if k.startswith(("mu_", "bound_", "nlp_scaling"))}
"""Options for a start near the minimum, for solvers with the options of Ipopt."""
SQP = {
    "qpsol": "osqp",
    "qpsol_options": {
        "osqp": {"verbose": False, "eps_abs": 1e-8, "eps_rel": 1e-8, "max_iter": 20000}
    },
    **dict.fromkeys(("print_header", "print_iteration", "print_status", "error_on_fail"), False),
}
PLUGINS: Mapping[str, Plugin] = {
    "ipopt": Plugin("ipopt", TOLERANCES, COMMON),
    "ipopt-adaptive": Plugin("ipopt", TOLERANCES, {**COMMON, "mu_strategy": "adaptive"}),
    "ipopt-soup": Plugin("ipopt", TOLERANCES, {**DEFAULTS, **COMMON}, "gauss-newton"),
    "ipopt-tuned": Plugin("ipopt", TOLERANCES, {**DEFAULTS, **COMMON}),
    "ipopt-lbfgs": Plugin(
        "ipopt", TOLERANCES, {**COMMON, "hessian_approximation": "limited-memory"}
    ),
    "sqpmethod": Plugin("sqpmethod", SQP_LIMITS, SQP, "gauss-newton"),
    "uno": Plugin("uno", UNO_LIMITS, {"logger": "SILENT"}),
    "bonmin-tuned": Plugin(
        "bonmin", {"max_iter": "iterations", "tol": "tol"}, {"print_level": 0, **NEAR_START}
    ),
}
""""ipopt" has the default options of Ipopt, "ipopt-adaptive" one other: the strategy of the
barrier. "ipopt-soup" has the options of `solve` for a start that is no KKT point, and "ipopt-tuned"
the same with the exact Hessian. Other names with "-tuned" have the options for a start near the
minimum. blocksqp is left out: it needs a linear solver (ma27) that the wheel of CasADi lacks."""

UPPER = ("triu_hess_gamma_x_x",)
IPOPT = {"nlp_grad_f": ("f", "grad_f_x"), "nlp_jac_g": ("g", "jac_g_x"), "nlp_hess_l": UPPER}
CACHED: Mapping[str, Mapping[str, tuple[str, ...]]] = {
    "ipopt": IPOPT,
    "bonmin": IPOPT,
    "uno": {"nlp_grad_f": ("grad_f_x",), "nlp_jac_g": ("jac_g_x",), "nlp_hess_l": UPPER},
    "sqpmethod": {
        "nlp_jac_fg": ("f", "grad_f_x", "g", "jac_g_x"),
        "nlp_hess_l": ("hess_gamma_x_x",),
    },
}
"""Functions that a library requests from CasADi, with their outputs."""
FIRST = ("nlp_grad_f", "nlp_jac")
"""Beginnings of the names of functions without multipliers."""


def plugin(name: str, task: Task) -> Answer:
    """Solve with a plug-in of nlpsol and the derivatives of this package."""
    chosen = PLUGINS[name]
    library = chosen.library
    nlp = task.gauss_newton if chosen.hessian == "gauss-newton" else task.nlp
    # parameters are replaced by numbers, since bonmin has no parameters
    x, functions = ca.MX.sym("x", nlp.nx), Functions(nlp)
    # these libraries differentiate f and g at set-up, in spite of cached derivatives
    symbolic = library in ("bonmin", "uno")
    graph = Graph(nlp) if symbolic else None
    f, g = graph.oracle(x, graph.p) if graph else functions.oracle(x, nlp.thetas())
    common: dict[str, Any] = {
        "print_time": False,
        "show_eval_warnings": False,
        "error_on_fail": False,
        "no_nlp_grad": library in ("ipopt", "sqpmethod"),
        "cache": _derivatives(nlp, functions, CACHED[library]),
    }
    problem = {"x": x, "f": f, "g": g}
    solver = ca.nlpsol("solver", library, problem, common | chosen.made_for(task.limits))
    out = solver(x0=nlp.x0, lbx=nlp.lbx, ubx=nlp.ubx, lbg=nlp.lbg, ubg=nlp.ubg)
    stats = solver.stats()
    status = str(stats.get("return_status", stats.get("unified_return_status", "?")))
    return Answer(
        np.asarray(out["x"]).ravel(),
        np.asarray(out["lam_g"]).ravel(),
        status,
        bool(stats.get("success")) or status in CLAIMS,
        int(stats.get("iter_count", -1)),
    )


def _derivatives(
    nlp: NLP, functions: Functions, wanted: Mapping[str, tuple[str, ...]]
) -> dict[str, ca.Function]:
    """Derivatives of this package with the names and outputs that a library requests."""
    x, q = ca.MX.sym("x", nlp.nx), ca.MX.sym("p", 0)
    lam_f, lam_g = ca.MX.sym("lam_f"), ca.MX.sym("lam_g", nlp.ng)
    theta = nlp.thetas()
    f, grad = functions.grad_f(x, theta)
    g, jac = functions.jac_g(x, theta)
    upper = functions.hess_lag(x, theta, lam_f, lam_g)
    derivatives = {
        "f": f,
        "grad_f_x": grad,
        "g": g,
        "jac_g_x": jac,
        "triu_hess_gamma_x_x": upper,
        "hess_gamma_x_x": ca.triu2symm(upper),
    }
    inputs = {"x": x, "p": q, "lam_f": lam_f, "lam_g": lam_g}
    out = {}
    for name, outputs in wanted.items():
        words = ["x", "p"] if name.startswith(FIRST) else list(inputs)
        values = [derivatives[k] for k in outputs]
        out[name] = ca.Function(name, [inputs[w] for w in words], values, words, list(outputs))
    return out


# --- programs that read .nl ----------------------------------------------------------------------


def executable(command: str, task: Task, options: Sequence[str] = ()) -> Answer:
    """Solve with a program of the AMPL convention, `solver stub -AMPL key=value ...`."""
    path = Path("soup.sol")
    file = write_nl(path.with_suffix(".nl"), task.nlp)
    # remove an answer to an earlier problem
    path.unlink(missing_ok=True)
    with path.with_name("solver.log").open("w") as log:
        try:
            code = subprocess.run(
                [command, "soup", "-AMPL", *options],
                stdout=log,
                stderr=subprocess.STDOUT,
                timeout=WALL_PER_CPU * max(1.0, task.limits.seconds),
                check=False,
                preexec_fn=partial(end_with_parent, os.getpid()),
            ).returncode
        except subprocess.TimeoutExpired:
            return Answer(None, None, "Time_Limit", False)
    if not path.is_file():
        if code < 0:
            return Answer(None, None, f"killed by {signal.Signals(-code).name}", False)
        raise SolverError("solver wrote no .sol", where=Path(command).name, found=f"exit {code}")
    sol = read_sol(path, file.variables, file.rows)
    status = sol.message.splitlines()[-1] if sol.message else sol.status
    return Answer(sol.x, sol.lam_g, status, sol.solved)


def find_program(name: str) -> str | None:
    """Absolute path of an executable on the PATH or beside Python; None if there is none."""
    path = shutil.which(name) or shutil.which(str(Path(sys.executable).parent / name))
    # absolute, since it runs in another folder
    return None if path is None else str(Path(path).absolute())


def pounce(command: str, task: Task, near: bool = False) -> Answer:
    """Solve with POUNCE, which has the options of Ipopt; `near` adds those for a near start."""
    m = task.limits
    options = {option: getattr(m, name) for option, name in TOLERANCES.items()}
    options |= {"acceptable_iter": 0, "max_cpu_time": 0.9 * m.seconds, "print_level": 0}
    options |= NEAR_START if near else {}
    return executable(command, task, [f"{k}={v}" for k, v in options.items()])


# --- by name --------------------------------------------------------------------------------------


def package(task: Task) -> Answer:
    """Solve as this package does: Ipopt's stages, then the constrained NLP."""
    m = task.limits
    options = SolverOptions(
        eps=task.form.eps,
        tol=m.tol,
        max_iter=m.iterations,
        max_seconds=0.9 * WALL_PER_CPU * m.seconds,
    )
    answer = solve_soup(task.soup, task.data, task.weights, task.form, options)
    stage, iterations = answer.stages[-1], sum(s.iterations for s in answer.stages)
    # the package solves the program in matrices, whose multipliers differ from those in tangents
    matrices = task.form.coordinates == "matrix"
    x, lam_g = (stage.x, stage.lam_g) if matrices else (answer.soup, None)
    return Answer(x, lam_g, stage.status, stage.converged, iterations)


def available() -> dict[str, Solver]:
    """Installed solvers by name."""
    names = [name for name, row in PLUGINS.items() if ca.has_nlpsol(row.library)]
    out: dict[str, Solver] = {name: partial(plugin, name) for name in names}
    command = find_program("pounce")
    if command:
        out["pounce"] = partial(pounce, command)
        out["pounce-tuned"] = partial(pounce, command, near=True)
    out["soup-nlp"] = package
    return out


def find_solver(name: str) -> Solver:
    """The solver of a name, or the executable of that name (AMPL convention).

    Raises:
        SolverError: there is neither a solver nor an executable.
    """
    installed = available()
    if name in installed:
        return installed[name]
    # options may follow the name of the program, whose path may have spaces
    command, options = find_program(name), list[str]()
    if command is None:
        program, *options = shlex.split(name) or [""]
        command = find_program(program)
    if command is None or name in PLUGINS:
        raise SolverError(
            "solver is not here",
            where="--solvers",
            found=name,
            expected=", ".join(installed) + ", or a program that reads .nl",
        )
    return partial(executable, command, options=options)
