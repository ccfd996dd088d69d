"""Command demo: a real pair and a rendered pair with moving cars, which need no data."""

from __future__ import annotations

from pathlib import Path

import typer

from soup_nlp.cli.options import Out, Overwrite, Quiet
from soup_nlp.cli.progress import SolveLog
from soup_nlp.cli.solve import solve_problem
from soup_nlp.config.problem import load_problem
from soup_nlp.report.result import PAGE

PAIRS = {
    "motorcycle": "a real pair, rigid: here one rigid motion for the whole image is as good",
    "street": "a rendered street: the camera drives and two cars move",
}
"""Problems of the demo with a description."""


def demo(out: Out = Path("out/demo"), overwrite: Overwrite = False, quiet: Quiet = False) -> None:
    """Solve a real pair and a rendered street in which cars move."""
    codes = []
    for name, text in PAIRS.items():
        print(f"\n{name}: {text}", flush=True)
        problem = load_problem(name)
        log, limit = SolveLog(quiet, problem=problem), problem.expected.mre_at_most
        codes.append(solve_problem(problem, out / name, log, limit, overwrite=overwrite))
    pages = " and ".join(str(out / name / PAGE) for name in PAIRS)
    print(f"\nopen        {pages} in a browser")
    raise typer.Exit(max(codes))
