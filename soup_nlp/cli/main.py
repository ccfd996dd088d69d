"""The command line: exit code 0 good, 1 not converged or a claim fails, 2 bad input, 70 a bug,
130 Ctrl-C.
"""

from __future__ import annotations

import os
import sys
import warnings
from collections.abc import Mapping, Sequence
from functools import cache
from importlib import import_module
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from soup_nlp.cli.boundary import (
    BROKEN_PIPE,
    drop_output,
    prepare_streams,
    print_warning,
    refusal,
    refuse_odd,
    report_bug,
)
from soup_nlp.errors import SoupError, StoppedError, printable
from soup_nlp.storage.system import sigterm_as_ctrl_c
from soup_nlp.storage.versions import __version__

ABORTED = 130
"""Exit code of a command that Ctrl-C ended without a result, as in shells."""

COMMANDS: Mapping[str, tuple[str, str]] = {
    "solve": ("solve:solve", "Solve a pair of frames and write a result folder."),
    "demo": ("solve:demo", "Solve a real pair and a rendered street in which cars move."),
    "view": ("view:view", "Open the page of a result in a browser, or serve it."),
    "check": (
        "results:check",
        "Recompute energy, constraints and metrics of a result, or the constraints of a .sol.",
    ),
    "chain": (
        "chain:chain",
        "Solve the consecutive pairs of a sequence and put them on one scale.",
    ),
    "convert": (
        "view:convert",
        "Write a result for other programs: ply, glb, colmap, npy, pfm, png, rrd, motions.",
    ),
    "evaluate": ("results:evaluate", "Score a result against a truth file."),
    "show": (
        "problems:show",
        "Print the merged problem and its hash; without a problem, the options of a preset.",
    ),
    "list": ("problems:list_", "Print the problems that come with the package, or of a folder."),
    "export": (
        "problems:export",
        "Write the NLP for other solvers; several sizes or formulations make a folder each.",
    ),
    "import": (
        "results:import_",
        "Make a result folder of a foreign solver's answer: depth maps, points, residuals.",
    ),
    "family": (
        "family:family",
        "Write the SOUP problem set: .nl files, best known points, index, README, licence.",
    ),
    "compare": (
        "compare:compare",
        "Run real solvers on problems, verify their claims, write table and profiles.",
    ),
}
"""Module and function under `soup_nlp.cli` and first line of the docstring, by command."""

BENCH: Mapping[str, tuple[str, str]] = {
    "accuracy": (
        "bench_accuracy:accuracy",
        "Depth against truth on a suite of pairs; interrupted runs can be continued.",
    ),
    "speed": (
        "bench_speed:speed",
        "Time the solver over N and K, each run in a process of its own; resumes what is stored.",
    ),
    "cost": (
        "bench_speed:cost",
        "Time and memory of whole solves over N and image size, each in a process of its own.",
    ),
    "search": (
        "bench_accuracy:search",
        "Search for better defaults and check them on the families that did not choose them.",
    ),
    "paper": (
        "bench_paper:paper",
        "The paper's tables and figures by `preset: paper` and the defaults; can be continued.",
    ),
    "chain": (
        "bench_speed:chain",
        "What one scale costs on rendered sequences, and on kitti_tracking in the --data folder.",
    ),
}
"""The same for the commands of `soup-nlp bench`."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line.

    Returns:
        0 good, 1 not converged (interrupted too) or a claim fails, 2 bad input, 70 a bug, 130
        interrupted before there was anything to keep, or twice: no result is written.
    """
    prepare_streams()
    if argv is None:
        # pictures go to files, so that the backend of the user does not matter
        os.environ["MPLBACKEND"] = "agg"
    try:
        with sigterm_as_ctrl_c():
            code = _run(argv)
        sys.stdout.flush()
    except BrokenPipeError:
        drop_output()
        return BROKEN_PIPE
    return code


def _run(argv: Sequence[str] | None) -> int:
    """Run the command line; the exit code."""
    words = list(sys.argv[1:] if argv is None else argv)
    try:
        refuse_odd(words)
        with warnings.catch_warnings():
            warnings.showwarning = print_warning
            code = _root()(args=words, standalone_mode=False)
        # the command line library turns a KeyboardInterrupt into this code
        return _aborted() if code == ABORTED else int(code or 0)
    except typer.Exit as done:
        return int(done.exit_code)
    except (KeyboardInterrupt, typer.Abort):
        return _aborted()
    except BrokenPipeError:
        raise
    except Exception as error:
        said: object = error if isinstance(error, SoupError) else refusal(error)
        if said is None and hasattr(error, "format_message"):
            # a usage error; it says nothing for a bare command, whose help is printed
            said = printable(error.format_message())
        if said is None:
            return report_bug(error)
        if said:
            print(said if isinstance(said, StoppedError) else f"error: {said}", file=sys.stderr)
        return ABORTED if isinstance(said, StoppedError) else 2


def _aborted() -> int:
    print("interrupted: no result is written", file=sys.stderr)
    return ABORTED


class _Flags:
    """A command whose flags show no type in its help."""

    def get_params(self, ctx: Any) -> list[Any]:
        """Options and arguments, with that of the help."""
        params: list[Any] = super().get_params(ctx)  # type: ignore[misc]
        for param in params:
            if getattr(param, "is_flag", False):
                param.metavar = ""
        return params


class Command(_Flags, TyperCommand):
    """A command of the program."""


class LazyGroup(_Flags, TyperGroup):
    """A group that imports a command only when it is called, which makes `--help` fast."""

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        """Name, imported command and remaining arguments."""
        name, command, rest = super().resolve_command(ctx, args)
        homes = BENCH if self.name == "bench" else COMMANDS
        if name is not None and name in homes:
            command = _load(name, homes[name][0])
        return name, command, rest


@cache
def _root() -> Any:
    """The command line, built once in a process."""
    return typer.main.get_command(app)


@cache
def _load(name: str, home: str) -> Any:
    """The command of a module and function such as "solve:solve"."""
    module, _, function = home.partition(":")
    alone = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    function_of = getattr(import_module(f"soup_nlp.cli.{module}"), function)
    alone.command(name=name, cls=Command)(function_of)
    return typer.main.get_command(alone)


def _group(text: str, commands: Mapping[str, tuple[str, str]], **options: Any) -> typer.Typer:
    """A group of commands that are imported later."""
    group = typer.Typer(
        cls=LazyGroup,
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        help=text,
        context_settings={"help_option_names": ["-h", "--help"]},
        **options,
    )
    for name, (_, line) in commands.items():
        group.command(name=name, help=line)(_placeholder)
    return group


def _placeholder() -> None:
    """Stands for a command until it is called."""


def _version(asked: bool) -> None:
    if asked:
        print(f"soup-nlp {__version__}")
        raise typer.Exit()


app = _group(
    "Dense 3D of a dynamic scene from two frames: Superpixel Soup as a nonlinear program.", COMMANDS
)
app.add_typer(_group("Measure over many runs; tables, plots and gates.", BENCH), name="bench")


@app.callback()
def every(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Dense 3D of a dynamic scene from two frames: Superpixel Soup as a nonlinear program."""
