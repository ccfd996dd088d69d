"""The command line: exit code 0 good, 1 not converged (interrupted too) or a claim fails, 2 bad
input, 3 (check) a point of another solver is feasible but not stationary, 70 a bug, 130 Ctrl-C
before there was anything to keep, 141 a closed pipe. A bug is reported in a file.
"""

import os
import re
import signal
import sys
import tempfile
import traceback
import unicodedata
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from soup_nlp.errors import ConfigError, SoupError, StoppedError, printable
from soup_nlp.storage.progress import interruptible
from soup_nlp.storage.system import SIGNALS, keep_memory, prepare_streams, refusal
from soup_nlp.storage.versions import __version__, versions

BUG = 70
"""Exit code of a bug of the program (EX_SOFTWARE of sysexits.h)."""
ABORTED = 130
"""Exit code of a command that Ctrl-C ended without a result, as in shells."""
BROKEN_PIPE = 141
"""Exit code after a broken pipe, as in shells."""


def print_warning(
    message: Warning | str, category: type[Warning], *_: object, **__: object
) -> None:
    """Print a warning about the input on one line; warnings of libraries are not printed."""
    # imported here, so that --help is fast
    from soup_nlp.data.formats.images import DataWarning

    if issubclass(category, DataWarning):
        print(f"warning: {printable(message)}", file=sys.stderr)


def report_bug(error: BaseException) -> int:
    """Write a traceback to a file and ask the user to report it; returns the exit code."""
    lines = traceback.format_exception(error)
    facts = [f"command: {sys.argv!r}", *(f"{k}: {v}" for k, v in versions().items()), ""]
    text = "\n".join(facts) + "".join(lines)
    path = "no file could be written"
    with suppress(OSError):
        handle, path = tempfile.mkstemp(prefix="soup_nlp_bug_", suffix=".txt")
        with os.fdopen(handle, "w", encoding="utf-8", errors="backslashreplace") as file:
            file.write(text)
    summary = printable(f"{type(error).__name__}: {error}", 200)
    print(
        f"error: this is a bug of soup-nlp, please report it with the file below\n"
        f"  found: {summary}\n  where: {path}",
        file=sys.stderr,
    )
    return BUG


def refuse_odd(words: Sequence[str]) -> None:
    """ConfigError for control characters and empty arguments, which unset shell variables cause."""
    for word in words:
        if not word.strip() or re.fullmatch(r"--[a-z-]+=\s*", word):
            raise ConfigError("an argument is empty", where=word or "command line", found=words)
        if any(unicodedata.category(c) == "Cc" and c not in "\n\t" for c in word):
            raise ConfigError("an argument holds control characters", found=word)


COMMANDS: Mapping[str, str] = {
    "solve": "solve:solve",
    "demo": "solve:demo",
    "view": "results:view",
    "check": "results:check",
    "chain": "solve:chain",
    "batch": "solve:batch",
    "convert": "results:convert",
    "evaluate": "results:evaluate",
    "show": "problems:show",
    "list": "problems:list_",
    "export": "problems:export",
    "import": "results:import_",
    "compare": "problems:compare",
}
"""Module and function under `soup_nlp.cli`, by command; in this order the help lists them."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    prepare_streams()
    keep_memory()
    words = list(sys.argv[1:] if argv is None else argv)
    try:
        # a shell has its commands in the background ignore Ctrl-C
        heeded = [n for n in SIGNALS if signal.getsignal(n) is not signal.SIG_IGN]
        with interruptible(numbers=heeded, at_once=True), warnings.catch_warnings():
            refuse_odd(words)
            warnings.showwarning = print_warning
            code = int(root(args=words, standalone_mode=False) or 0)
            # the command line library turns a KeyboardInterrupt into this code
            if code == ABORTED:
                raise KeyboardInterrupt
        sys.stdout.flush()
    except (BrokenPipeError, SystemExit) as error:
        # the command line library exits after a broken pipe
        if isinstance(error, SystemExit) and not isinstance(error.__context__, BrokenPipeError):
            raise
        # nothing reads the output any more
        with suppress(OSError, ValueError):
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE
    except (KeyboardInterrupt, typer.Abort):
        print("interrupted: no result is written", file=sys.stderr)
        return ABORTED
    except Exception as error:
        return _explained(error)
    return code


def _explained(error: Exception) -> int:
    """Print the message of an exception for the user; returns the exit code."""
    explanation: object = error if isinstance(error, SoupError) else refusal(error)
    if explanation is None and hasattr(error, "format_message"):
        # a usage error; its message is empty for a bare command, whose help is printed
        explanation = printable(error.format_message())
    if explanation is None:
        return report_bug(error)
    stopped = isinstance(explanation, StoppedError)
    if explanation:
        print(explanation if stopped else f"error: {explanation}", file=sys.stderr)
    return ABORTED if stopped else 2


class LazyGroup(TyperGroup):
    """A group that imports a command only when it is called, which makes `--help` fast."""

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        """Name, imported command and remaining arguments."""
        name, command, remaining = super().resolve_command(ctx, args)
        if name is not None and name in COMMANDS:
            command = _load(name, COMMANDS[name])
        return name, command, remaining


@cache
def _load(name: str, home: str) -> Any:
    """The command of a module and function such as "solve:solve"."""
    module, _, function = home.partition(":")
    alone = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    alone.command(name=name)(getattr(import_module(f"soup_nlp.cli.{module}"), function))
    return typer.main.get_command(alone)


def _first_line(home: str) -> str:
    """First line of the docstring of a command, whose module is not imported."""
    module, _, function = home.partition(":")
    text = Path(__file__).with_name(f"{module}.py").read_text(encoding="utf-8")
    return re.findall(rf'^def {function}\(.*?"""([^"\n]*)', text, re.MULTILINE | re.DOTALL)[0]


def _version(asked: bool) -> None:
    if asked:
        print(f"soup-nlp {__version__}")
        raise typer.Exit()


app = typer.Typer(
    cls=LazyGroup,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
for _name, _home in COMMANDS.items():
    # the command itself is imported when it is called
    app.command(name=_name, help=_first_line(_home))(lambda: None)


@app.callback()
def program(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Dense 3D of a dynamic scene from two frames: Superpixel Soup as a nonlinear program."""


root: Any = typer.main.get_command(app)
"""The command line as a function of words."""
