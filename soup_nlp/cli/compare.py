"""Command compare: other solvers on the same NLP, verified."""

from pathlib import Path
from typing import Annotated

import typer

from soup_nlp.cli import options
from soup_nlp.cli.options import option, out_option
from soup_nlp.config.problem import load_problem, title
from soup_nlp.errors import ConfigError
from soup_nlp.export.compare import compare as run_all
from soup_nlp.export.compare import conclusion, page, problem_task
from soup_nlp.export.solvers import available, find_solver
from soup_nlp.export.verify import Limits
from soup_nlp.pipeline.case import prepare
from soup_nlp.storage.each import Row
from soup_nlp.storage.files import write_text
from soup_nlp.storage.folders import claim, default_folder, staged

PAGE, ROWS = "README.md", "runs.jsonl"


def compare(
    problems: Annotated[list[Path], typer.Argument(help="Problem files, or names of problems.")],
    solvers: Annotated[
        str, option("Comma-separated, or all; a program that reads .nl may be named.")
    ] = "all",
    coordinates: options.Coordinates = "matrix",
    seconds: Annotated[float, option("CPU time limit of a run.")] = 60.0,
    iterations: Annotated[int, option("Iteration limit of a run.")] = 300,
    out: Annotated[Path | None, out_option("out/solvers-NAMES")] = None,
    overrides: options.Set = None,
    overwrite: options.Overwrite = False,
) -> int:
    """Run real solvers on problems and verify their claims; goes on where it was stopped."""
    if not (seconds > 0 and iterations > 0):
        raise ConfigError(
            "limits must be positive",
            where="compare",
            found=f"{seconds:g} s, {iterations} iterations",
        )
    names = [*available()] if solvers == "all" else options.listed(solvers)
    if not names:
        raise ConfigError("no solver is named", where="--solvers", found=solvers)
    for name in names:
        find_solver(name)
    limits = Limits(seconds, iterations)
    # read all problems first: a wrong file must not stop after hours of runs
    chosen = [load_problem(path, overrides or []) for path in problems]
    subject = ", ".join(dict.fromkeys(p.subject for p in chosen))
    name = title(f"solvers-{'-'.join(dict.fromkeys(p.name for p in chosen))}")
    out = out or default_folder(name, subject)
    folder = claim(out, [PAGE], overwrite, subject, ROWS)
    tasks = [problem_task(prepare(problem), coordinates) for problem in chosen]

    def keep(rows: list[Row]) -> None:
        """Write the page after every run: a run may take minutes, a command may be killed."""
        with staged(folder, overwrite=overwrite, subject=subject) as new:
            write_text(new / PAGE, page(rows, limits))

    with staged(folder, overwrite=overwrite, subject=subject):
        # from here on, the folder is this command's
        pass
    with options.resumable("the runs that were finished are kept, with a page of them", folder):
        rows = run_all(tasks, names, limits, folder / ROWS, print, keep)
    print(conclusion(rows))
    print(f"files       {out}/: {PAGE}, {ROWS}")
    verified = sum(bool(row.get("verified")) for row in rows)
    return options.finish(bool(verified), f"{verified} of {len(rows)} runs are verified")
