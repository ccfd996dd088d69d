"""Solvers by name: CasADi's plug-ins, executables that read .nl, the reference solver."""

from __future__ import annotations

import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import casadi as ca

from soup_nlp.bench.reference_solver import EPS, levenberg_marquardt
from soup_nlp.bench.solvers.plugins import (
    NEAR_START,
    PLUGINS,
    TOLERANCES,
    WALL_PER_CPU,
    Answer,
    Solver,
    Task,
    clock,
    plugin,
)
from soup_nlp.errors import SolverError
from soup_nlp.export.nl import write_nl
from soup_nlp.export.sol import read_sol
from soup_nlp.solve.solver_options import SolverOptions
from soup_nlp.solve.stages import solve_soup
from soup_nlp.storage.system import end_with_parent


def executable(command: str, task: Task, options: Sequence[str] = ()) -> Answer:
    """Solve with a program of the AMPL convention, `solver stub -AMPL key=value ...`."""
    begin, path = clock(), Path("soup.sol")
    file = write_nl(path.with_suffix(".nl"), task.nlp)
    # remove an answer to an earlier problem
    path.unlink(missing_ok=True)
    with path.with_name("solver.log").open("w") as log:
        try:
            code = subprocess.run(
                [command, "soup", "-AMPL", *options],
                stdout=log,
                stderr=subprocess.STDOUT,
                timeout=WALL_PER_CPU * max(1.0, task.limits.seconds - (clock() - begin)),
                check=False,
                preexec_fn=end_with_parent,
            ).returncode
        except subprocess.TimeoutExpired:
            return Answer(None, None, "Time_Limit", False)
    if not path.is_file():
        raise SolverError("solver wrote no .sol", where=Path(command).name, found=f"exit {code}")
    sol = read_sol(path, file.variables, file.rows)
    status = sol.message.splitlines()[-1] if sol.message else sol.status
    return Answer(sol.x, sol.lam_g, status, sol.solved)


def _find(name: str) -> str | None:
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


def reference(task: Task) -> Answer:
    """Solve with Levenberg-Marquardt on the manifold; the answer has no multipliers.

    It ends when the energy stops decreasing, and it claims no optimum.
    """
    last = task.form.eps
    eps = [*(e for e in EPS if e > last), last]
    energy = task.soup, task.data, task.weights, task.form
    y = levenberg_marquardt(*energy, eps=eps, seconds=0.8 * WALL_PER_CPU * task.limits.seconds)
    return Answer(y.soup, None, y.status, False, y.iterations)


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
    out: dict[str, Solver] = {
        name: partial(plugin, name) for name, row in PLUGINS.items() if ca.has_nlpsol(row.library)
    }
    command = _find("pounce")
    if command:
        out["pounce"] = partial(pounce, command)
        out["pounce-tuned"] = partial(pounce, command, near=True)
    out["lm"] = reference
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
    command, options = _find(name), list[str]()
    if command is None:
        program, *options = shlex.split(name) or [""]
        command = _find(program)
    if command is None or name in PLUGINS:
        raise SolverError(
            "solver is not here",
            where="--solvers",
            found=name,
            expected=", ".join(installed) + ", or a program that reads .nl",
        )
    return partial(executable, command, options=options)
