"""Command solve: a pair of frames becomes a result folder."""

from __future__ import annotations

import json
import os
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from soup_nlp.cli.options import PROBLEM, Out, Set
from soup_nlp.config.problem import Problem, dump_problem, load_problem, make_problem
from soup_nlp.data.flow.sources import is_path
from soup_nlp.data.formats.images import DataWarning
from soup_nlp.errors import ConfigError
from soup_nlp.pipeline.run import run as run_problem
from soup_nlp.report.folder import prepare_folder, write_folder
from soup_nlp.report.verdict import missed, verdict
from soup_nlp.solve.interrupt import interruptible
from soup_nlp.solve.ipopt import Progress
from soup_nlp.storage.atomic import write_text


class SolveLog:
    """Lines for the terminal and the log; iterations rewrite one line on a terminal."""

    def __init__(self, quiet: bool) -> None:
        self.console = Console(stderr=True, highlight=False)
        self.quiet = quiet
        self.lines: list[str] = []
        self.live = self.console.is_terminal and not quiet

    def say(self, line: str) -> None:
        """A line after a stage."""
        self.lines.append(line)
        if not self.quiet:
            self._clear()
            self.console.print(line, markup=False, soft_wrap=True)

    def iteration(self, progress: Progress) -> None:
        """A line per iteration."""
        line = str(progress)
        self.lines.append(line)
        if self.live:
            self._clear()
            self.console.file.write(line[: max(1, self.console.width - 1)])
            self.console.file.flush()

    def warn(
        self, message: Warning | str, category: type[Warning], *_: object, **__: object
    ) -> None:
        """Print a warning about the input; warnings of libraries are for developers."""
        if issubclass(category, DataWarning):
            self.say(f"warning: {message}")

    def interrupted(self, line: str) -> None:
        """A line from a signal handler, where Python's own streams must not be entered again."""
        self.lines.append(line)
        os.write(2, f"\n{line}\n".encode())

    def _clear(self) -> None:
        if self.live:
            self.console.file.write("\r\x1b[2K")


def solve(
    problem: Annotated[Path | None, typer.Argument(help=PROBLEM)] = None,
    out: Out = Path("out/run"),
    overrides: Set = None,
    ref: Annotated[str | None, typer.Option(help="Reference image.")] = None,
    next_: Annotated[str | None, typer.Option("--next", help="Next image.")] = None,
    intrinsics: Annotated[
        str | None, typer.Option(help="fx,fy,cx,cy in pixels, or a file.")
    ] = None,
    intrinsics_next: Annotated[
        str | None, typer.Option(help="The same of the next frame, if it differs.")
    ] = None,
    flow: Annotated[str | None, typer.Option(help=".flo, KITTI .png or .npy; default DIS.")] = None,
    depth: Annotated[str | None, typer.Option(help="True depth of the reference frame.")] = None,
    no_refine: Annotated[
        bool, typer.Option("--no-refine", help="The NLP alone, as refine.enabled=false.")
    ] = False,
    no_nlp: Annotated[
        bool, typer.Option("--no-nlp", help="Refine the start, as refine.from_start=true.")
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Only the verdict.")] = False,
) -> None:
    """Solve a pair of frames and write a result folder."""
    if no_refine and no_nlp:
        raise ConfigError(
            "nothing is left to do",
            found="--no-nlp and --no-refine",
            expected="one of them at most",
        )
    halves = {"refine.enabled=false": no_refine, "refine.from_start=true": no_nlp}
    overrides = [*(overrides or []), *(item for item, on in halves.items() if on)]
    pair = {
        "--ref": ref,
        "--next": next_,
        "--intrinsics": intrinsics,
        "--intrinsics-next": intrinsics_next,
        "--depth": depth,
    }
    if problem is None:
        chosen = _from_options(pair, flow, overrides)
    else:
        chosen = _from_file(problem, pair, flow, overrides)
    # a problem file's expectation is of the file without overrides
    limit = None if overrides else chosen.expected.mre_at_most
    raise typer.Exit(solve_problem(chosen, out, quiet, limit))


def _from_file(
    problem: Path, pair: Mapping[str, str | None], flow: str | None, overrides: Sequence[str]
) -> Problem:
    """The problem of a file, with the flow of the command line."""
    if any(pair.values()):
        raise ConfigError(
            "a problem file names its own pair",
            found=f"{problem} and {', '.join(k for k, v in pair.items() if v)}",
            expected="a problem file, or the options of a pair",
            hint="--set input.KEY=VALUE changes the input of a problem file",
        )
    if flow:
        # a path on the command line starts here, one in a problem file from the file
        source = str(Path(flow).expanduser().resolve()) if is_path(flow) else flow
        overrides = [f"flow.source={json.dumps(source)}", *overrides]
    return load_problem(problem, overrides)


def _from_options(
    pair: Mapping[str, str | None], flow: str | None, overrides: Sequence[str]
) -> Problem:
    """The problem of the options of a pair."""
    ref, following, intrinsics, intrinsics_next, depth = pair.values()
    if not (ref and following and intrinsics):
        raise ConfigError(
            "nothing to solve",
            found="no problem file",
            expected="PROBLEM.yaml, or --ref, --next and --intrinsics",
            hint="soup-nlp demo, or soup-nlp solve motorcycle --out out/motorcycle",
        )
    source: dict[str, Any] = {"kind": "files", "ref": ref, "next": following}
    source["intrinsics"] = _camera(intrinsics, "--intrinsics")
    if intrinsics_next:
        source["intrinsics_next"] = _camera(intrinsics_next, "--intrinsics-next")
    if depth:
        source["depth"] = depth
    raw: dict[str, Any] = {"name": Path(ref).stem, "input": source, "base": str(Path.cwd())}
    if flow:
        raw["flow"] = {"source": flow}
    return make_problem(raw, overrides, where="command line")


def solve_problem(chosen: Problem, out: Path, quiet: bool, mre_at_most: float | None) -> int:
    """Solve a problem, write its folder and print the verdict.

    Returns:
        0 for a good result that meets the expectation, else 1.
    """
    folder = prepare_folder(out, chosen.input_paths())
    log = SolveLog(quiet)
    interrupt = interruptible(log.interrupted)
    with interrupt as stop, warnings.catch_warnings():
        warnings.simplefilter("always", DataWarning)
        warnings.showwarning = log.warn
        try:
            run = run_problem(
                chosen,
                listener=log.iteration,
                stop=stop,
                log=log.say,
                ipopt_log=str(folder / "ipopt.log"),
            )
            if interrupt.aborted:
                raise KeyboardInterrupt
        except BaseException as error:
            log.lines.append(f"failed: {str(error) or type(error).__name__}")
            write_text(folder / "log.txt", "\n".join(log.lines) + "\n")
            raise
        # an interruption must not leave half of the files; writing takes seconds only
        interrupt.deferred = True
        files = write_folder(folder, run, dump_problem(chosen), "\n".join(log.lines) + "\n")
        text = verdict(run, folder, files, mre_at_most)
        write_text(folder / "log.txt", "\n".join([*log.lines, text]) + "\n")
    print(text)
    good = run.good and (mre_at_most is None or not missed(run))
    return 0 if good else 1


def _camera(text: str, option: str) -> list[float] | str:
    """Four numbers, or the file that has them, as the key `intrinsics` of a problem file."""
    try:
        values = [float(x) for x in text.split(",")]
    except ValueError:
        values = []
    if not values and Path(text).expanduser().is_file():
        return text
    if len(values) != 4:
        raise ConfigError(
            "camera is neither four numbers nor a file",
            where=option,
            found=text,
            expected="fx,fy,cx,cy or a text file of 4 or 9 numbers",
        )
    return values
