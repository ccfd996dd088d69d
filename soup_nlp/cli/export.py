"""Commands export, import and check: the NLP as a file, and foreign answers as results."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from soup_nlp.bench.solvers.compare import compare
from soup_nlp.config.problem import dump_problem, load_problem
from soup_nlp.errors import ExportError
from soup_nlp.export.artefact import FORMATS, export_case, form_label, parse_formulation
from soup_nlp.export.foreign import Imported, import_sol, sol_table
from soup_nlp.export.residuals import residual_table, table_text
from soup_nlp.pipeline.case import prepare
from soup_nlp.report.check import LIMITS, check_folder
from soup_nlp.report.folder import prepare_folder, write_folder
from soup_nlp.report.verdict import accuracy, protocol
from soup_nlp.storage.store import read_h5


def register(app: typer.Typer) -> None:
    """Add the commands to the program."""
    app.command(name="export")(export)
    app.command(name="import")(import_)
    app.command(name="check")(check)
    app.command(name="compare")(compare)


def export(
    problem: Annotated[Path, typer.Argument(help="Problem file.")],
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder.")] = Path("out/export"),
    formulation: Annotated[
        list[str] | None,
        typer.Option(help="gauge/norm/truncation, e.g. free/epigraph/lifted; may be repeated."),
    ] = None,
    superpixels: Annotated[
        list[int] | None, typer.Option(help="Wanted number, 50 to 2000; may be repeated.")
    ] = None,
    format_: Annotated[
        list[str] | None,
        typer.Option("--format", help=f"{', '.join(FORMATS)} (casadi has h5); may be repeated."),
    ] = None,
    presolve: Annotated[
        bool, typer.Option(help="Start where the tangent presolve ends, not at the proposal.")
    ] = False,
    overrides: Annotated[
        list[str] | None, typer.Option("--set", help="Override, e.g. flow.source=truth.")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No lines.")] = False,
) -> None:
    """Write the NLP for other solvers; several sizes or formulations make a folder each."""
    forms = [parse_formulation(text) for text in formulation or []] or [{}]
    # asked for twice is written once
    sizes: list[int | None] = [*dict.fromkeys(superpixels or ())] or [None]
    written = set()
    for size, form in product(sizes, forms):
        own = [] if size is None else [f"segmentation.superpixels={size}"]
        words = [*(overrides or []), *own]
        chosen = load_problem(problem, [*words, *(f"formulation.{k}={v}" for k, v in form.items())])
        if form is forms[0]:
            case = prepare(chosen, presolve)
        # the same soup in another formulation
        here = replace(case, problem=chosen)
        style = here.formulation()
        several = len(sizes) * len(forms) > 1
        # two sizes asked for may give the same number of superpixels
        asked = chosen.segmentation.superpixels
        name = f"{chosen.name}-{asked}-{form_label(style).replace('/', '-')}"
        if name in written:
            continue
        written.add(name)
        folder = prepare_folder(out / name if several else out)
        manifest = export_case(here, style, folder, format_ or ["nl"], presolve)
        if not quiet:
            s = manifest["sizes"]
            print(
                f"{folder}/soup.nl  {form_label(style)}  {s['superpixels']} superpixels,"
                f" {s['variables']} variables, {s['constraints']} constraints,"
                f" {s['jacobian_nonzeros']} Jacobian nonzeros,"
                f" {manifest['nl']['bytes'] / 1e6:.1f} MB"
            )


def import_(
    folder: Annotated[Path, typer.Argument(help="Exported folder.")],
    sol: Annotated[Path, typer.Argument(help="The solver's .sol file.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Result folder; default DIR/result.")
    ] = None,
) -> None:
    """Make a result folder of a foreign solver's answer: depth maps, points, residuals."""
    imported = import_sol(folder, sol)
    s = imported.run.solution
    if not np.isfinite([*s.energy.values(), *s.residuals.values()]).all():
        raise ExportError(
            "the answer is no soup: its energy or residuals are not finite",
            where=sol,
            found=imported.sol.message.splitlines()[0] if imported.sol.message else None,
            hint=f"soup-nlp check {sol} says what is wrong with it",
        )
    run = imported.run
    target = prepare_folder(out or folder / "result", run.problem.input_paths())
    text = foreign_verdict(imported)
    write_folder(target, run, dump_problem(run.problem), f"{imported.sol.message}\n{text}\n")
    print(text)
    print(f"files       {target}/")
    print(f"next        soup-nlp check {target}")
    raise typer.Exit(0 if run.solution.converged else 1)


def foreign_verdict(imported: Imported) -> str:
    """What the solver says, and what is true of it."""
    s, sol = imported.run.solution, imported.sol
    word = "verified" if s.converged else "not verified" if sol.solved else "no success claimed"
    start = imported.manifest["exact_energy_at_start"]["total"]
    said = sol.message.splitlines()[0] if sol.message else "no message"
    lines = [
        f"solver      {said} ({sol.status}, code {sol.code}): {word}",
        # where the solver started, which after a presolve is not where the soup came from
        f"energy      start {start:.6g}  solution {s.energy['total']:.6g}",
        "residuals   " + "  ".join(f"{k} {v:.1e}" for k, v in s.residuals.items()),
    ]
    if imported.run.metrics:
        lines.append(f"accuracy    {protocol(imported.run.metrics)}")
        lines += [" " * 12 + line for line in accuracy(imported.run.metrics)]
    best = imported.manifest["best_known"]
    if best:
        lines.append(f"best known  exact energy {best['exact_energy']:.6g} by {best['found_by']}")
    return "\n".join(lines)


def check(
    folder: Annotated[Path, typer.Argument(help="Result folder, or a .sol file.")],
    export_: Annotated[
        Path | None,
        typer.Option("--export", help="Exported folder of a .sol; default where the .sol lies."),
    ] = None,
) -> None:
    """Recompute energy, constraints and metrics of a result, or the constraints of a .sol."""
    if folder.is_dir() or folder.suffix != ".sol":
        report = check_folder(folder)
        tree = read_h5(folder / "result.h5")
        c = float(tree["weights"]["min_facing"])
        print(table_text(residual_table(tree["solution"], tree["energy"]["rim_ray"], c, LIMITS)))
        print()
        print(report)
        print("every claim holds" if report.ok else "a claim does not hold")
        raise typer.Exit(0 if report.ok else 1)
    imported = import_sol(export_ or folder.parent, folder, renew=False)
    rows = sol_table(imported)
    good = all(r.ok for r in rows)
    print(table_text(rows))
    print(foreign_verdict(imported))
    print("every constraint holds" if good else "a constraint does not hold")
    raise typer.Exit(0 if good else 1)
