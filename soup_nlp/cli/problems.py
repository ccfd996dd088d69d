"""Commands show, list, export and compare: problems as text, as files, and for other solvers."""

from pathlib import Path
from typing import Annotated

import typer

from soup_nlp.cli import options
from soup_nlp.cli.options import option, out_option
from soup_nlp.config.problem import dump_problem, load_problem, shipped_problems, title
from soup_nlp.config.trees import PRESET_FILES
from soup_nlp.data.scenes.catalogue import LAYOUTS
from soup_nlp.errors import ConfigError
from soup_nlp.export.artefact import EXPORT_FILES, export_case, form_label
from soup_nlp.export.compare import compare as run_all
from soup_nlp.export.compare import conclusion, page, problem_task
from soup_nlp.export.solvers import available, find_solver
from soup_nlp.export.verify import Limits
from soup_nlp.pipeline.case import prepare
from soup_nlp.report.formats import FORMATS as RESULT_FORMATS
from soup_nlp.storage.each import Row
from soup_nlp.storage.files import write_text
from soup_nlp.storage.folders import claim, default_folder, staged

PAGE, ROWS = "README.md", "runs.jsonl"
"""Files of a comparison."""


def show(
    problem: Annotated[
        Path | None,
        typer.Argument(help=options.PROBLEM, autocompletion=options.starting(shipped_problems)),
    ] = None,
    overrides: options.Set = None,
    preset: options.PresetName = None,
    all_options: Annotated[bool, option("Every key, also the unusual ones.", "--all")] = False,
) -> None:
    """Print the merged problem and its hash; without a problem, the options of a preset."""
    if problem is None:
        if preset is None or preset not in PRESET_FILES or overrides:
            raise ConfigError(
                "nothing to show",
                where="--preset" if preset else None,
                found=preset,
                expected=f"a problem, or --preset {' or '.join(PRESET_FILES)} alone",
            )
        print(PRESET_FILES[preset].read_text("utf-8"), end="")
        return
    chosen = load_problem(problem, options.changed(preset, overrides))
    footer = "" if all_options else "# all other options have their defaults: soup-nlp show --all\n"
    print(f"{dump_problem(chosen, all_options)}{footer}# hash {chosen.digest()}")


def list_() -> None:
    """Print the problems, scenes and formats of the package."""
    for name, path in shipped_problems().items():
        comment = path.read_text("utf-8").splitlines()[0]
        print(f"{name:<14} {comment.removeprefix('# ')}")
    print("\nsoup-nlp solve NAME; templates take --set input.root=DIR, folder input.path=DIR")
    print(f"soup-nlp chain scene:NAME, of {', '.join(LAYOUTS)}")
    print(f"soup-nlp convert RESULT --to {','.join(RESULT_FORMATS)}")


def export(
    problem: options.Problem,
    out: Annotated[Path | None, out_option("out/export-NAME")] = None,
    coordinates: options.Coordinates = "matrix",
    superpixels: Annotated[int | None, option("Number of superpixels, 50 to 2000.")] = None,
    presolve: Annotated[
        bool, option("Start at the presolve's answer, with its multipliers.", "--presolve")
    ] = False,
    lift: Annotated[
        bool, option("Shared expressions as variables with rows, as SCIP needs them.", "--lift")
    ] = False,
    overrides: options.Set = None,
    overwrite: options.Overwrite = False,
    quiet: options.Quiet = False,
) -> None:
    """Write the NLP as .nl for other solvers, started at the initialisation."""
    chosen = load_problem(problem, options.changed(None, overrides, superpixels))
    out = out or default_folder(f"export-{chosen.name}", chosen.subject)
    # check the folder before the work
    claim(out, EXPORT_FILES, overwrite, chosen.subject)
    case = prepare(chosen, presolve)
    form = case.formulation(coordinates=coordinates)
    manifest = export_case(case, form, out, presolve, overwrite, lift)
    s = manifest["sizes"]
    if not quiet:
        print(
            f"{out}/soup.nl  {form_label(form)}  {s['superpixels']} superpixels,"
            f" {s['variables']} variables, {s['constraints']} constraints,"
            f" {s['jacobian_nonzeros']} Jacobian nonzeros,"
            f" {manifest['nl']['bytes'] / 1e6:.1f} MB"
        )


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
