"""The command line: exit code 0 good, 1 not converged or a claim fails, 2 bad input, 130 Ctrl-C."""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence

import typer

from soup_nlp.cli import bench_all, bench_studies
from soup_nlp.cli.bench_accuracy import accuracy, search
from soup_nlp.cli.bench_speed import speed
from soup_nlp.cli.compare import compare
from soup_nlp.cli.problems import export, list_, show
from soup_nlp.cli.results import check, evaluate, import_
from soup_nlp.cli.solve import solve
from soup_nlp.errors import SoupError
from soup_nlp.pipeline.run import StoppedError

ABORTED = 130
"""Exit code of what Ctrl-C ended without a result, as shells have it."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: Arguments; default sys.argv.

    Returns:
        0 good, 1 not converged (interrupted too) or a claim fails, 2 bad input, 130 interrupted
        before there was anything to keep, or twice: no result is written.
    """
    try:
        code = app(args=list(argv) if argv is not None else None, standalone_mode=False)
        # the command line library makes this code of a KeyboardInterrupt
        return _aborted() if code == ABORTED else int(code or 0)
    except StoppedError as error:
        print(error, file=sys.stderr)
        return ABORTED
    except SoupError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except typer.Exit as done:
        return int(done.exit_code)
    except (KeyboardInterrupt, typer.Abort):
        return _aborted()
    except Exception as error:
        # usage errors of the command line library carry their own message
        if hasattr(error, "format_message"):
            print(f"error: {error.format_message()}", file=sys.stderr)
            return 2
        raise


def _aborted() -> int:
    print("interrupted: no result is written", file=sys.stderr)
    return ABORTED


app = typer.Typer(
    add_completion=False,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    help="Dense 3D of a dynamic scene from two frames: Superpixel Soup as a nonlinear program.",
)
bench = typer.Typer(no_args_is_help=True, help="Measure over many runs; tables, plots and gates.")
COMMANDS: dict[typer.Typer, dict[str, Callable[..., None]]] = {
    app: {
        "solve": solve,
        "check": check,
        "evaluate": evaluate,
        "show": show,
        "list": list_,
        "export": export,
        "import": import_,
        "compare": compare,
    },
    bench: {
        "accuracy": accuracy,
        "speed": speed,
        "search": search,
        "refine": bench_studies.refine,
        "methods": bench_studies.methods,
        "formulations": bench_studies.formulations,
        "cut-off": bench_studies.cut_off,
        "trws": bench_studies.trws,
        "all": bench_all.command(main),
    },
}
for group, commands in COMMANDS.items():
    for name, function in commands.items():
        group.command(name=name)(function)
app.add_typer(bench, name="bench")
