"""Problems, sizes and formulations as tasks for the comparison, and its command."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from soup_nlp.bench.solvers.page import conclusion, page
from soup_nlp.bench.solvers.profiles import draw_curves, draw_profiles
from soup_nlp.bench.solvers.registry import available, find_solver
from soup_nlp.bench.solvers.runner import compare as run_all
from soup_nlp.bench.solvers.task import Task
from soup_nlp.config.problem import load_problem
from soup_nlp.errors import ConfigError
from soup_nlp.export.artefact import form_label, parse_formulation
from soup_nlp.export.verify import ENERGY_SLACK, Limits
from soup_nlp.model import oracle
from soup_nlp.model.formulation import Formulation
from soup_nlp.pipeline.case import Case, prepare
from soup_nlp.report.folder import prepare_folder
from soup_nlp.storage.atomic import write_text

Label = Mapping[str, Any]
Maker = Callable[[Path], Task]


def make_tasks(
    case: Case, forms: list[dict[str, str]], limits: Limits, presolved: bool
) -> list[tuple[Label, Maker]]:
    """Label and maker of the task of every formulation.

    Args:
        case: Problem with its start.
        forms: Gauge, norm, truncation, each or none.
        limits: For every solver.
        presolved: The case starts at the presolve's answer.
    """
    out: list[tuple[Label, Maker]] = []
    ceiling = oracle.energy(case.start.soup, case.data, case.weights)["total"]
    for chosen in forms:
        form = case.formulation(**chosen, hessian="exact", compiled=False)
        label = {
            "problem": case.problem.name,
            "problem_hash": case.problem.digest(),
            "superpixels": len(case),
            "formulation": form_label(form),
            "start": "presolve" if presolved else "proposal",
            "energy_limit": ceiling * (1 + ENERGY_SLACK),
        }
        out.append((label, _Maker(case, form, limits)))
    return out


class _Maker:
    """Builds the NLPs of a formulation once, when the first solver asks."""

    def __init__(self, case: Case, form: Formulation, limits: Limits) -> None:
        self.case, self.form, self.limits = case, form, limits
        self._built: Task | None = None

    def __call__(self, folder: Path) -> Task:
        if self._built is None:
            nlp, layout = self.case.nlp(self.form)
            second, _ = self.case.nlp(self.form.replace(hessian="gauss-newton+constraints"))
            self._built = Task(
                # a solver's time is its own
                nlp=nlp.assembled(),
                gauss_newton=second.assembled(),
                layout=layout,
                soup=self.case.soup,
                data=self.case.data,
                weights=self.case.weights,
                form=self.form,
                limits=self.limits,
                folder=folder,
            )
        return replace(self._built, folder=folder)


def compare(
    problems: Annotated[list[Path], typer.Argument(help="Problem files.")],
    solvers: Annotated[
        str, typer.Option(help="Comma-separated, or all; a program that reads .nl may be named.")
    ] = "all",
    formulation: Annotated[
        list[str] | None, typer.Option("--formulation", help="gauge/norm/truncation; repeatable.")
    ] = None,
    superpixels: Annotated[list[int] | None, typer.Option(help="Repeatable.")] = None,
    seconds: Annotated[float, typer.Option(help="Time limit of a run.")] = 60.0,
    iterations: Annotated[int, typer.Option(help="Iteration limit of a run.")] = 300,
    tol: Annotated[float, typer.Option(help="Dual infeasibility; constraints get 1/100.")] = 1e-4,
    memory: Annotated[float, typer.Option(help="Memory limit of a run, GiB.")] = 4.0,
    presolve: Annotated[
        bool, typer.Option(help="Start where the tangent presolve ends, not at the proposal.")
    ] = True,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder.")] = Path("results/solvers"),
    overrides: Annotated[list[str] | None, typer.Option("--set", help="Override.")] = None,
) -> None:
    """Run real solvers on problems, verify their claims, write table and profiles."""
    if not (seconds > 0 and iterations > 0 and tol > 0 and memory > 0):
        raise ConfigError(
            "limits must be positive",
            where="compare",
            found=f"{seconds:g} s, {iterations} iterations, tol {tol:g}, {memory:g} GiB",
        )
    wanted = available() if solvers == "all" else [w.strip() for w in solvers.split(",")]
    names = list(dict.fromkeys(w for w in wanted if w))
    if not names:
        raise ConfigError("no solver is named", where="--solvers", found=solvers)
    for name in names:
        find_solver(name)
    forms = [parse_formulation(text) for text in formulation or []] or [{}]
    limits = Limits(seconds, iterations, tol, int(memory * 2**30))
    sizes = [[f"segmentation.superpixels={n}"] for n in superpixels or ()] or [[]]
    # a file that is wrong is found before hours of runs, not after
    chosen = [load_problem(path, [*(overrides or []), *own]) for path in problems for own in sizes]
    folder = prepare_folder(out)
    rows: list[dict[str, Any]] = []
    try:
        with tempfile.TemporaryDirectory() as scratch:
            for problem in chosen:
                tasks = make_tasks(prepare(problem, presolve), forms, limits, presolve)
                rows = run_all(tasks, names, limits, folder / "runs.jsonl", Path(scratch), print)
    finally:
        # an input that cannot be used does not take the others' page away
        if rows:
            write_text(folder / "README.md", page(rows))
            draw_profiles(folder / "profile.png", rows)
            draw_curves(folder / "curves.png", rows)
    print("\n".join(conclusion(rows)))
    print(f"files       {folder}/: README.md, profile.png, curves.png, runs.jsonl")
    raise typer.Exit(0 if any(r["verified"] for r in rows) else 1)
