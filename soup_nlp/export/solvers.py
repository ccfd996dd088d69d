"""Solvers by name: Ipopt, programs that read .nl, and this package."""

import os
import shlex
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

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
from soup_nlp.model.layout import Layout
from soup_nlp.model.nlp import NLP
from soup_nlp.solve.functions import Functions
from soup_nlp.solve.ipopt import DEFAULTS, GOOD
from soup_nlp.solve.solver_options import Stages
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


# --- Ipopt in this process ------------------------------------------------------------------------

TOLERANCES = {
    **dict.fromkeys(("tol", "dual_inf_tol", "compl_inf_tol"), "tol"),
    "constr_viol_tol": "feasibility",
    "max_iter": "iterations",
    "max_cpu_time": "seconds",
}
"""Attribute of `Limits` by name of Ipopt's option."""
COMMON = {"acceptable_iter": 0, "print_level": 0}
TUNED = {k: v for k, v in DEFAULTS.items() if k.startswith(("mu_", "bound_", "nlp_scaling"))}
"""Options with which Ipopt, and what has its options, solves these programs (docs/solving.md)."""
IPOPT: Mapping[str, Mapping[str, Any]] = {
    "ipopt": {},
    "ipopt-adaptive": {"mu_strategy": "adaptive"},
    "ipopt-tuned": TUNED,
    "ipopt-lbfgs": {"hessian_approximation": "limited-memory"},
}
"""What differs from Ipopt's defaults, by name of the solver."""


def ipopt(different: Mapping[str, Any], task: Task) -> Answer:
    """Solve with Ipopt and the derivatives of this package."""
    nlp, functions = task.nlp, Functions(task.nlp)
    limits = {k: getattr(task.limits, name) for k, name in TOLERANCES.items()}
    # CasADi would differentiate the derivatives for its own multipliers
    own = {**functions.derivatives, "no_nlp_grad": True, "calc_lam_p": False, "print_time": False}
    options = {"ipopt": {**COMMON, "sb": "yes", **different, **limits}, **own}
    solver = ca.nlpsol("solver", "ipopt", functions.oracle, options)
    bounds = {k: getattr(nlp, k) for k in ("x0", "lbx", "ubx", "lbg", "ubg")}
    out, stats = solver(p=nlp.thetas(), **bounds), solver.stats()
    x, lam_g = (np.asarray(out[k]).ravel() for k in ("x", "lam_g"))
    status = str(stats["return_status"])
    return Answer(x, lam_g, status, status in GOOD, int(stats["iter_count"]))


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


def pounce(command: str, task: Task, tuned: bool = False) -> Answer:
    """Solve with POUNCE, which has the options of Ipopt."""
    m = task.limits
    options = {option: getattr(m, name) for option, name in TOLERANCES.items()}
    options |= {**COMMON, "max_cpu_time": 0.9 * m.seconds, **(TUNED if tuned else {})}
    return executable(command, task, [f"{k}={v}" for k, v in options.items()])


# --- by name --------------------------------------------------------------------------------------


def package(task: Task) -> Answer:
    """Solve as this package does: Ipopt's stages, then the constrained NLP."""
    m = task.limits
    options = Stages(
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
    out: dict[str, Solver] = {name: partial(ipopt, options) for name, options in IPOPT.items()}
    command = find_program("pounce")
    if command:
        out["pounce"] = partial(pounce, command)
        out["pounce-tuned"] = partial(pounce, command, tuned=True)
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
    if command is None:
        raise SolverError(
            "solver is not here",
            where="--solvers",
            found=name,
            expected=", ".join(installed) + ", or a program that reads .nl",
        )
    return partial(executable, command, options=options)
