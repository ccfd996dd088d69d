"""Commands check, evaluate, import, view and convert: results are verified, shown, written."""

import webbrowser
from pathlib import Path
from shlex import quote
from typing import Annotated

import numpy as np
import typer

from soup_nlp.cli import options
from soup_nlp.cli.options import option, out_option
from soup_nlp.data.formats.map_files import read_depth
from soup_nlp.errors import ConfigError, ExportError
from soup_nlp.evaluation.metrics import Scale
from soup_nlp.evaluation.scoring import evaluate as evaluate_folder
from soup_nlp.export.foreign import Imported, import_sol, sol_table
from soup_nlp.geometry.constraints import table
from soup_nlp.report.chain import Lazy
from soup_nlp.report.folder import prepare_folder, write_folder
from soup_nlp.report.formats import FORMATS
from soup_nlp.report.result import PAGE
from soup_nlp.report.verdict import accuracy, sectioned
from soup_nlp.sequence import folder as folders
from soup_nlp.sequence.folder import is_chain, read_chain, renew_page
from soup_nlp.sequence.frames import DEPTHS, numbered_files
from soup_nlp.sequence.score import read_path, score, score_lines
from soup_nlp.storage.files import is_folder

NOT_STATIONARY = 3
"""Exit code of `check` for a .sol whose constraints hold, but which is no KKT point."""


def check(
    folder: Annotated[Path, typer.Argument(help="Folder of a result or a chain, or a .sol file.")],
    export_: Annotated[
        Path | None, option("Exported folder of a .sol; default where the .sol lies.", "--export")
    ] = None,
) -> int:
    """Recompute energy, constraints and metrics of a result, or the constraints of a .sol.

    Exit code 1: a claim or a constraint does not hold; 3: a .sol is feasible, but no KKT point.
    """
    if is_folder(folder) or folder.suffix != ".sol":
        report = folders.check(folder)
        print(report)
        return options.finish(
            report.ok, "every claim holds" if report.ok else "a claim does not hold"
        )
    imported = import_sol(export_ or folder.parent, folder)
    rows, r = sol_table(imported), imported.residuals
    print(f"{table(rows)}\n{foreign_verdict(imported)}")
    if not all(row.ok for row in rows):
        return options.finish(False, "a constraint does not hold")
    conclusion = f"every constraint holds, and the point is {'' if r.optimal else 'not '}stationary"
    details = f"{conclusion} (dual {r.dual:.1e}, complementarity {r.complementarity:.1e})"
    return options.finish(r.optimal, details, bad=NOT_STATIONARY)


def evaluate(
    folder: options.Folder,
    depth: Annotated[Path, option("True depth, .dpt .npy .pfm .png; of a chain their folder.")],
    scale: Annotated[Scale, option("Rule of the one global scale.")] = "median",
    cap: Annotated[float | None, option("Drop truth beyond this depth.")] = None,
    depth_scale: options.DepthScale = None,
    moving: Annotated[
        Path | None, option("Picture that is not black where something moves: scored by itself.")
    ] = None,
    path: Annotated[
        Path | None, option("True poses of a chain, a line a frame: TUM, or KITTI odometry.")
    ] = None,
) -> None:
    """Score a result against a truth: MRE (Abs Rel), RMSE, delta < 1.25; of a chain its path."""
    chain = is_chain(folder)
    of_pair = {"--moving": moving, "--cap": cap, "--scale": None if scale == "median" else scale}
    wrong = of_pair if chain else {"--path": path}
    if any(value is not None for value in wrong.values()):
        raise ConfigError(
            f"{'a chain' if chain else 'a pair'} is scored without this option",
            where=folder,
            found=", ".join(f"{name} {x}" for name, x in wrong.items() if x is not None),
            hint="soup-nlp evaluate DIR/pairs/000_001 scores one pair" if chain else None,
        )
    if chain:
        files = numbered_files(depth, DEPTHS, "true depth", "depth_*")
        truths = Lazy(lambda k: read_depth(files[k], depth_scale), len(files))
        poses = None if path is None else read_path(path)
        print("\n".join(score_lines(score(read_chain(folder), truths, poses))))
        return
    rules: list[Scale] = [scale] if scale == "affine" else [scale, "affine"]
    for rule in rules:
        scores = evaluate_folder(
            folder, depth, scale=rule, cap=cap, depth_scale=depth_scale, moving=moving
        )
        print("\n".join(accuracy(scores)))


def import_(
    folder: Annotated[Path, typer.Argument(help="Exported folder.")],
    sol: Annotated[Path, typer.Argument(help="The solver's .sol file.")],
    out: Annotated[Path | None, out_option("DIR/result, or DIR/result-SOL")] = None,
    overwrite: options.Overwrite = False,
) -> int:
    """Make a result folder of a foreign solver's answer: depth maps, points, residuals."""
    imported = import_sol(folder, sol)
    run, s = imported.run, imported.run.solution
    if not np.isfinite([*s.energy.values(), *s.residuals.values()]).all():
        raise ExportError(
            "the answer is no soup: its energy or residuals are not finite",
            where=sol,
            found=imported.sol.headline or None,
            hint=f"soup-nlp check {quote(str(sol))} says what is wrong with it",
        )
    # answers of several solvers do not replace each other
    target = out or folder / ("result" if sol.stem == "soup" else f"result-{sol.stem}")
    prepare_folder(target, run.problem.input_paths(), overwrite, run.problem.subject)
    text = foreign_verdict(imported)
    write_folder(target, run, f"{imported.sol.message}\n{text}\n", text, overwrite=overwrite)
    print(f"{text}\nfiles       {target}/\nnext        soup-nlp check {quote(str(target))}")
    return options.finish(s.converged, f"the answer is {'' if s.converged else 'not '}verified")


def foreign_verdict(imported: Imported) -> str:
    """Verdict on the answer of a foreign solver, and its scores."""
    scores = sectioned({"accuracy": accuracy(imported.run.metrics)})
    return f"{imported}\n{scores}".rstrip()


def view(
    folder: options.Folder,
    renew: Annotated[bool, option("Generate the page again.", "--renew")] = False,
    no_open: Annotated[bool, option("Print the address, open no browser.", "--no-open")] = False,
) -> None:
    """Open the page of a result in a browser."""
    is_chain(folder)
    file = folder / PAGE
    if renew or not file.is_file():
        renew_page(folder)
    address = file.resolve().as_uri()
    opened = not no_open and webbrowser.open(address)
    print(f"opened      {file}" if opened else f"open        {address}")


_NAMES = "; ".join(f"{name}: {one.text}" for name, one in FORMATS.items())


def convert(
    folder: options.Folder,
    to: Annotated[
        str,
        option(
            f"Comma separated. {_NAMES}.",
            "--to",
            autocompletion=options.starting(lambda: FORMATS),
        ),
    ],
    out: Annotated[Path | None, out_option("the result's own")] = None,
    overwrite: options.Overwrite = False,
) -> None:
    """Write a result for other programs."""
    for name in folders.convert(folder, options.listed(to), out, overwrite):
        print((out or folder) / name)
