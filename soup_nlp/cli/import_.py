"""Command import: a foreign solver's answer as a result folder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from soup_nlp.config.problem import dump_problem
from soup_nlp.errors import ExportError
from soup_nlp.export.foreign import Imported, import_sol
from soup_nlp.report.folder import prepare_folder, write_folder
from soup_nlp.report.verdict import accuracy, protocol


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
    """The solver's message, and whether energy and residuals confirm it."""
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
