"""Command compare: other solvers on the same NLP, verified."""

from pathlib import Path
from typing import Annotated

import typer

from soup_nlp.bench.solvers import runner
from soup_nlp.bench.solvers.page import (
    FILES,
    OF_FAMILY,
    conclusion,
    frame_of_runs,
    page,
    write_pictures,
)
from soup_nlp.cli import options
from soup_nlp.cli.options import option, out_option
from soup_nlp.config.problem import load_problem, title
from soup_nlp.errors import ConfigError
from soup_nlp.export.verify import Limits
from soup_nlp.pipeline.case import prepare
from soup_nlp.storage.files import write_text
from soup_nlp.storage.folders import claim, default_folder, staged
from soup_nlp.storage.rows import Row
from soup_nlp.storage.system import scratch


def compare(
    problems: Annotated[
        list[Path], typer.Argument(help="Problem files, or a folder of `soup-nlp family`.")
    ],
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
    """Run real solvers on problems, verify their claims, write table and profiles."""
    if not (seconds > 0 and iterations > 0):
        raise ConfigError(
            "limits must be positive",
            where="compare",
            found=f"{seconds:g} s, {iterations} iterations",
        )
    names = [*runner.available()] if solvers == "all" else options.listed(solvers)
    if not names:
        raise ConfigError("no solver is named", where="--solvers", found=solvers)
    for name in names:
        runner.find_solver(name)
    limits = Limits(seconds, iterations)
    # prepare all problems first: a wrong file must not stop after hours of runs
    sets = [path for path in problems if runner.is_family(path)]
    chosen = [load_problem(path, overrides or []) for path in problems if path not in sets]
    subjects = [f"family {path.absolute()}" for path in sets] + [p.subject for p in chosen]
    subject = ", ".join(dict.fromkeys(subjects))
    names_of = dict.fromkeys([*(path.name for path in sets), *(p.name for p in chosen)])
    out = out or default_folder(title(f"solvers-{'-'.join(names_of)}"), subject)
    written = (*FILES, *(OF_FAMILY if sets else ()))
    folder = claim(out, written, overwrite, subject)
    tasks = [task for path in sets for task in runner.family_tasks(path, limits)]
    tasks += [runner.problem_task(prepare(problem), limits, coordinates) for problem in chosen]
    rows: list[Row] = []

    def keep(new_rows: list[Row]) -> None:
        """Write the page after every run: a run may take minutes, a command may be killed."""
        rows[:] = new_rows
        with staged(folder, overwrite=overwrite, subject=subject) as new:
            write_text(new / "README.md", page(frame_of_runs(rows)))

    kept = options.resumable("the runs that were finished are kept, with a page of them", folder)
    try:
        with kept, scratch() as temporary:
            runner.compare(tasks, names, limits, folder / "runs.jsonl", temporary, print, keep)
    finally:
        # the runs that were finished before an interruption have pictures, too
        if rows:
            with staged(folder, overwrite=overwrite, subject=subject) as new:
                write_pictures(new, frame_of_runs(rows), limits)
    print("\n".join(conclusion(frame_of_runs(rows))))
    print(f"files       {out}/: {', '.join(written)}, runs.jsonl")
    verified = sum(bool(r["verified"]) for r in rows)
    return options.finish(bool(verified), f"{verified} of {len(rows)} runs are verified")
