"""Commands bench: speed, and what else is measured over many runs."""

from __future__ import annotations

import typer

from soup_nlp.cli.accuracy import register as register_accuracy
from soup_nlp.cli.speed import register as register_speed

bench = typer.Typer(no_args_is_help=True, help="Measure over many runs; tables, plots and gates.")


register_accuracy(bench)
register_speed(bench)


@bench.callback()
def _group() -> None:
    """Measure over many runs; tables, plots and gates."""


def register(app: typer.Typer) -> None:
    """Add the group of commands to the program."""
    app.add_typer(bench, name="bench")
