"""Parts that commands share: common options, lists in options, progress."""

import json
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import typer
from rich.console import Console

from soup_nlp.config.problem import shipped_problems
from soup_nlp.config.trees import PRESETS
from soup_nlp.data.formats.images import DataWarning
from soup_nlp.errors import ConfigError, StoppedError, printable
from soup_nlp.storage.each import Row, Say, failed, reason
from soup_nlp.storage.files import as_path
from soup_nlp.storage.progress import Progress


def option(text: str, *names: str, panel: str | None = None, **rules: Any) -> Any:
    """An option with its help, in a panel of the help page."""
    return typer.Option(*names, help=text, rich_help_panel=panel, **rules)


def starting(words: Callable[[], Iterable[str]]) -> Callable[[str], list[str]]:
    """Completion of the last of comma-separated words; without any, shells complete files."""

    def complete(incomplete: str) -> list[str]:
        head, comma, last = incomplete.rpartition(",")
        return [head + comma + word for word in words() if word.startswith(last)]

    return complete


in_input, in_size, in_method, in_output = (
    partial(option, panel=panel) for panel in ("Input", "Size", "Method", "Output")
)


def out_option(default: str) -> Any:
    """The output folder of a command, with its default as text."""
    return in_output(f"Output folder; default {default}.", "--out", "-o")


Text = str | None
CAMERA = "fx,fy,cx,cy in pixels, or a file; default K.txt of a sequence, EXIF, a guess."
Intrinsics = Annotated[str | None, in_input(CAMERA)]
Fov = Annotated[
    float | None, in_input("Horizontal field of view, degrees, instead of --intrinsics.")
]
Undistort = Annotated[bool, in_input("Remove the camera file's distortion.", "--undistort")]
Wanted = Annotated[int | None, in_size("Number N of superpixels; default 1000.", "--superpixels")]
Neighbours = Annotated[int | None, in_size("K of the K-NN graph; default 15.")]
MaxSize = Annotated[
    float | None, in_size("Megapixels to which larger images are reduced; default 1.5.")
]
Set = Annotated[list[str] | None, in_method("Set any key, e.g. solver.max_iter=200.", "--set")]
PresetName = Annotated[
    str | None,
    in_method(
        f"Options below the problem's own: {', '.join(PRESETS)}.",
        autocompletion=starting(lambda: PRESETS),
    ),
]
Out = Annotated[Path, in_output("Output folder.", "--out", "-o")]
Quiet = Annotated[bool, in_output("Print no progress, only warnings.", "--quiet", "-q")]
OTHERS = "Also replace files of your own, and the result of another input."
Overwrite = Annotated[bool, in_output(OTHERS, "--overwrite")]
PROBLEM = "Problem file, or a name that `soup-nlp list` shows."
Problem = Annotated[Path, typer.Argument(help=PROBLEM, autocompletion=starting(shipped_problems))]
Folder = Annotated[Path, typer.Argument(help="Folder of a result or a chain.")]
COORDINATES = "tangent: nine per superpixel about the initialisation, without gauge."
Coordinates = Annotated[Literal["matrix", "tangent"], option(COORDINATES)]
DEPTH_SCALE = "Values per unit of length of a true depth in .png (KITTI 256); default 1000."
DepthScale = Annotated[float | None, option(DEPTH_SCALE)]
Workers = Annotated[int, option("Processes of this machine.", min=1)]


def finish(good: bool, reason_text: str, bad: int = 1) -> int:
    """Print the exit code of a command, 0 or `bad`, with its reason; returns the code."""
    code = 0 if good else bad
    print(f"exit code   {code}: {reason_text}")
    return code


def given(**values: object) -> dict[str, Any]:
    """The values that are not None."""
    return {name: value for name, value in values.items() if value is not None}


def changed(
    preset: str | None,
    overrides: Sequence[str] | None,
    superpixels: int | None = None,
    neighbours: int | None = None,
    max_size: float | None = None,
    **keys: object,
) -> list[str]:
    """Overrides of a preset, of `--set`, which can undo it, and of options that stand for keys."""
    short = {
        "segmentation.superpixels": superpixels,
        "segmentation.neighbours": neighbours,
        "max_size": max_size,
        **keys,
    }
    first, last = ([f"{k}={v}" for k, v in given(**x).items()] for x in ({"preset": preset}, short))
    return [*first, *(overrides or []), *last]


def located(name: str | None, what: str) -> str | None:
    """A file of the command line as the value of a key, whose paths start at the problem file."""
    return name and json.dumps(str(as_path(name, what, home=True).absolute()))


def listed(text: str) -> list[str]:
    """Different names of a comma-separated list."""
    return list(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))


def camera(text: str | None) -> list[float] | str | None:
    """Value of the key `intrinsics`, four numbers or the name of a file; None without a text."""
    try:
        numbers = [] if text is None else [float(x) for x in text.split(",")]
    except ValueError:
        return text
    if numbers and len(numbers) != 4:
        raise ConfigError(
            "intrinsics are not four numbers",
            where="--intrinsics",
            found=text,
            expected="fx,fy,cx,cy in pixels, or a file, which may hold distortion as well",
        )
    return numbers or None


@contextmanager
def resumable(kept: str, where: object) -> Iterator[None]:
    """Context that Ctrl-C ends with a StoppedError, which says what results are kept."""
    try:
        yield
    except KeyboardInterrupt:
        hint = "the same command goes on"
        raise StoppedError(f"interrupted: {kept}", where=where, hint=hint) from None


def row_progress(quiet: bool, result_of: Callable[[Row], str] = lambda row: "done") -> Say:
    """A function that prints finished rows and the time left.

    On a terminal it is one updated line, else a line per row. `result_of` makes a short text from a
    row that did not fail.
    """
    live, begin, kept = sys.stderr.isatty(), time.monotonic(), -1

    def say(done: int, total: int, row: Row) -> None:
        nonlocal kept
        result = f"failed: {reason(row)}" if failed(row) else result_of(row)
        line = f"{done}/{total}  {row['key']}  {result}  {row.get('seconds') or 0:.0f} s"
        # pairs before the first row were kept and took no time
        kept = done - 1 if kept < 0 else kept
        left = (time.monotonic() - begin) / (done - kept) * (total - done) / 60
        line += f", {left:.0f} min left" * (done < total)
        start, end = ("\r\x1b[2K", "\n" if done == total else "") if live else ("", "\n")
        print(f"{start}{line}", end=end, file=sys.stderr, flush=True)

    return (lambda *_: None) if quiet else say


class SolveLog:
    """Lines for the terminal and for log.txt, and the present iteration.

    Attributes:
        lines: All lines, for log.txt.
        now: The present iteration on a terminal, a context manager; None elsewhere.
    """

    def __init__(self, quiet: bool, verbose: bool = False) -> None:
        """Make the log; `verbose` prints all lines."""
        self.console = Console(stderr=True, highlight=False)
        self.quiet, self.verbose = quiet, verbose
        self.lines: list[str] = []
        self.now = self.console.status("") if self.console.is_terminal and not quiet else None
        self._detail, self._warned, self._mark = "", set[str](), time.perf_counter()

    @contextmanager
    def warnings(self) -> Iterator[None]:
        """Context in which warnings about the input become lines; those of libraries do not."""
        with warnings.catch_warnings():
            warnings.simplefilter("always", DataWarning)
            warnings.showwarning = self._warn
            yield

    def say(self, line: str) -> None:
        """Add a line to the log; the last line of a stage is its result."""
        self.lines.append(line)
        self._detail = line.partition("\n")[0]
        if self.verbose:
            self._print(line)

    def stage(self, name: str) -> None:
        """End a stage: print its time and result."""
        now = time.perf_counter()
        self._print(f"{name:<13}{now - self._mark:6.1f} s  {self._detail}".rstrip())
        self._mark, self._detail = now, ""
        if self.now:
            self.now.update("")

    def iteration(self, progress: Progress) -> None:
        """Add an iteration of presolve, Ipopt or TRW-S."""
        self.lines.append(str(progress))
        if self.now:
            self.now.update(f"{progress.stage}, iteration {progress.iteration}")

    def _warn(self, message: Warning | str, category: type[Warning], *_: Any, **__: Any) -> None:
        line = f"warning: {printable(message)}"
        if issubclass(category, DataWarning) and line not in self._warned:
            self._warned.add(line)
            self.lines.append(line)
            self._print(line, even_if_quiet=True)

    def interrupted(self, line: str) -> None:
        """Print a line from a signal handler, where Python's streams cannot be used."""
        self.lines.append(line)
        os.write(2, f"\n{line}\n".encode())

    def _print(self, line: str, even_if_quiet: bool = False) -> None:
        if even_if_quiet or not self.quiet:
            self.console.print(line, markup=False, soft_wrap=True)
