"""Solvers on the same NLPs: each run in a process of its own, its answer verified, one table."""

import resource
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import chdir, suppress
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from soup_nlp.export.artefact import form_label
from soup_nlp.export.solvers import WALL_PER_CPU, Answer, Task, find_solver
from soup_nlp.export.verify import ENERGY_SLACK, Limits, examine
from soup_nlp.geometry.soup import Soup
from soup_nlp.model import oracle
from soup_nlp.model.formulation import Formulation
from soup_nlp.model.layout import Layout
from soup_nlp.model.nlp import NLP
from soup_nlp.pipeline.record import Case
from soup_nlp.storage.each import Row, cpu_seconds, measure_all, peak_bytes, reason
from soup_nlp.storage.system import scratch
from soup_nlp.storage.versions import versions

Label = Mapping[str, Any]
Labelled = tuple[Label, Callable[[Limits], Task]]
"""Entries of the rows of a task, and what makes the task."""

KEY = ("problem", "identity", "superpixels", "formulation", "start")
"""Entries of a label that identify a task."""
BUILDING = 600.0
"""Wall seconds for building an NLP, which the limits of a run do not count."""
COLUMNS: Mapping[str, tuple[str, str]] = {
    "problem": ("problem", ""),
    "superpixels": ("N", ""),
    "formulation": ("formulation", ""),
    "solver": ("solver", ""),
    "word": ("verified", ""),
    "energy": ("exact E", ".6g"),
    "energy_start": ("start E", ".6g"),
    "primal": ("primal", ".0e"),
    "dual": ("dual", ".0e"),
    "complementarity": ("compl.", ".0e"),
    "iterations": ("iterations", ".0f"),
    "cpu": ("CPU s", ".2f"),
    "MB": ("MB", ".0f"),
    "ended": ("status", ""),
}
"""Title and format of every column of the table."""
LIMITS = (
    "Verified: KKT residuals and exact energy, recomputed from the point, are those of an optimum,"
    " to one tolerance for all, whether or not the solver claims one. Residuals are unscaled and"
    " may be ten times the tolerance, as every solver scales its own. Times are CPU times of one"
    " run each, set-up included; so is the limit. Local solvers end in local minima: an energy says"
    " where this start led, not what is best. Options are those of soup_nlp/export/solvers.py."
)


def make_task(case: Case, nlp: NLP, layout: Layout, form: Formulation, limits: Limits) -> Task:
    """The task of an NLP of a case, with the exact Hessian."""
    soup = layout.unpack(nlp.x0).retracted()
    # made here, so that the time of a solver does not include it
    return Task(nlp.evaluated(), layout, soup, case.data, case.weights, form, limits)


def problem_task(case: Case, coordinates: str) -> Labelled:
    """Label of a case and the maker of its task; its energy limit is that of the initialisation."""
    form = case.formulation(coordinates=coordinates, hessian="exact")
    ceiling = oracle.energy(case.start.soup, case.data, case.weights)["total"]
    label = {
        "problem": case.problem.name,
        "identity": case.problem.identity(),
        "superpixels": len(case),
        "formulation": form_label(form),
        "start": "proposal",
        "energy_limit": ceiling * (1 + ENERGY_SLACK),
    }
    return label, lambda limits: make_task(case, *case.nlp(form), form, limits)


def compare(
    tasks: Iterable[Labelled],
    solvers: Sequence[str],
    limits: Limits,
    path: Path,
    say: Callable[[str], object] = print,
    after: Callable[[list[Row]], None] | None = None,
) -> list[Row]:
    """Run every solver on every task; runs that the file holds already are not repeated.

    `path` is a JSON-lines file; `say` is called with a line after each run, `after` with all rows
    so far.
    """
    jobs = []
    for label, make in tasks:
        name = {k: label[k] for k in KEY} | {"limits": asdict(limits)}
        for solver in dict.fromkeys(solvers):
            work = partial(run_row, make, label, solver, limits)
            jobs.append(({**name, "solver": solver}, work))
    wall = BUILDING + WALL_PER_CPU * limits.seconds
    told: dict[str, Any] = {"say": lambda done, total, row: say(one_line(row)), "after": after}
    return measure_all(jobs, path, fresh=True, seconds=wall, **told)


def run_row(make: Callable[[Limits], Task], label: Label, solver: str, limits: Limits) -> Row:
    """Run a solver in this process, which gets the limits, and verify its answer.

    `label` has the entries that identify the task, and "energy_limit".
    """
    task = make(limits)
    row: Row = {
        **label,
        "n": task.nlp.nx,
        "m": task.nlp.ng,
        "versions": versions(),
        "energy_start": oracle.energy(task.soup, task.data, task.weights)["total"],
    }
    begin = cpu_seconds()
    limit_process(limits, begin)
    solve = find_solver(solver)
    with scratch() as folder, chdir(folder):
        answer = solve(task)
    children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024
    row["peak_bytes"] = max(peak_bytes(), children)
    return row | verified(task, answer, cpu_seconds() - begin, float(label["energy_limit"]))


def limit_process(limits: Limits, spent: float) -> None:
    """Limit memory and CPU time of this process beyond what it has, and of its children.

    The system ends a process at the limit of its CPU time.
    """
    memory = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (memory + limits.memory,) * 2)
    most = int(spent + 1.2 * limits.seconds) + 1
    resource.setrlimit(resource.RLIMIT_CPU, (most, most + 1))


def verified(task: Task, answer: Answer, seconds: float, energy_limit: float) -> Row:
    """Entries of a row from an answer: claim, exact energy and residuals.

    One tolerance decides what is verified, whether the solver claims an optimum or not. The exact
    energy is that of the point retracted to the constraints; infinite if it is not finite.
    """
    # a claim after the time limit does not count
    x, late = answer.x, not seconds <= task.limits.seconds
    row: Row = {
        "status": f"over the time limit: {answer.status}" if late else answer.status,
        "claimed": answer.claimed and x is not None and not late,
        "verified": False,
        "iterations": answer.iterations,
        "cpu": seconds,
    }
    if x is None:
        return row
    x = task.layout.pack(x) if isinstance(x, Soup) else x
    energy = np.inf
    with np.errstate(all="ignore"):
        value = task.nlp.value(x)
        with suppress(np.linalg.LinAlgError):
            soup = task.layout.unpack(x).retracted()
            energy = oracle.energy(soup, task.data, task.weights)["total"]
    finite = bool(np.isfinite(x).all())
    row["energy"] = float(energy) if finite and np.isfinite(energy) else float("inf")
    row["objective"] = value if np.isfinite(value) else None
    if not finite:
        return row
    residuals = examine(task.nlp, x, answer.lam_g)
    good = residuals.within(task.limits) and row["energy"] <= energy_limit
    shown = {k: v for k, v in vars(residuals).items() if not k.startswith("lam_")}
    return {**row, **shown, "verified": bool(good and not late)}


# --- the table ------------------------------------------------------------------------------------


def word(row: Row) -> str:
    """Whether a run is verified, in a word."""
    return "yes" if row.get("verified") else "claim is FALSE" if row.get("claimed") else "no"


def one_line(row: Row) -> str:
    """A row as one line of text."""
    cells = [f"{row['problem']:<12} {row['superpixels']:>5} {row['solver']:<12} {word(row):<14}"]
    cells += [f"E {_text(row.get('energy'), '.6g'):>9}  dual {_text(row.get('dual'), '.1e'):>7}"]
    return " ".join([*cells, f"{_text(row.get('cpu'), '.1f'):>7} s  {_ended(row)}"])


def _ended(row: Row) -> str:
    status = str(row.get("status") or reason(row))
    return " ".join(status[:100].replace("|", "/").split())


def _text(value: Any, form: str) -> str:
    if value is None:
        return "-"
    return format(value, form) if form else str(value)


def conclusion(rows: Sequence[Row]) -> str:
    """Verified runs by solver, and how many claims were true."""
    good = [row for row in rows if row.get("verified")]
    solvers = dict.fromkeys(row["solver"] for row in rows)
    counts = {s: sum(row["solver"] == s for row in good) for s in solvers}
    shown = ", ".join(f"{s} {n}" for s, n in sorted(counts.items(), key=lambda x: -x[1]))
    problems = len({tuple(row[k] for k in KEY) for row in rows})
    claims = [row for row in rows if row.get("claimed")]
    true = sum(bool(row["verified"]) for row in claims)
    return (
        f"**{problems} problems, {len(solvers)} solvers, {len(rows)} runs: {len(good)} verified.**"
        f" Verified runs by solver: {shown}. Claims of an optimum that were true: {true} of"
        f" {len(claims)}."
    )


def page(rows: Sequence[Row], limits: Limits) -> str:
    """Markdown page of all runs: conclusion, table, limits, versions."""
    lines = [[title for title, _ in COLUMNS.values()], ["---"] * len(COLUMNS)]
    for row in rows:
        size = row.get("peak_bytes")
        further = {"word": word(row), "ended": _ended(row), "MB": size and size / 2**20}
        lines.append([_text({**row, **further}.get(k), form) for k, (_, form) in COLUMNS.items()])
    table = "\n".join("| " + " | ".join(cells) + " |" for cells in lines)
    code = ", ".join(sorted({str(row.get("code")) for row in rows}))
    packages = ", ".join(f"{k} {v}" for k, v in versions().items())
    asked = (
        f"A run has {limits.seconds:g} CPU seconds, {limits.iterations} iterations and"
        f" {limits.memory / 2**30:g} GiB, and is asked for a dual infeasibility of {limits.tol:g}."
    )
    about = f"{asked} {LIMITS}\n\n{packages}; code {code}"
    return f"# Solvers\n\n{conclusion(rows)}\n\n{table}\n\n{about}\n"
