"""Command check: every claim of a result folder or of a .sol, recomputed."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from soup_nlp.cli.import_ import foreign_verdict
from soup_nlp.export.foreign import import_sol, sol_table
from soup_nlp.export.residuals import residual_table, table_text
from soup_nlp.report.check import LIMITS, check_folder
from soup_nlp.storage.store import read_h5


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
