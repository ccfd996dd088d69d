"""Progress of a solve: one line for each stage, a bar on a terminal, details on request."""

from __future__ import annotations

import logging
import os
import time
from types import TracebackType

from rich.console import Console
from rich.progress import BarColumn, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bars

from soup_nlp.config.problem import Problem
from soup_nlp.data.formats.images import DataWarning
from soup_nlp.storage.progress import Progress

PACKAGE = "soup_nlp"
"""Logger whose messages are printed."""


class SolveLog(logging.Handler):
    """Lines for the terminal and for log.txt, and progress bars, as a context manager.

    Attributes:
        lines: All lines, for log.txt.
    """

    def __init__(self, quiet: bool, verbose: bool = False, problem: Problem | None = None) -> None:
        """Make the log; `problem` gives the length of the bars, `verbose` prints all lines."""
        super().__init__(logging.INFO)
        self.console = Console(stderr=True, highlight=False)
        self.quiet, self.verbose = quiet, verbose
        self.lines: list[str] = []
        self._stages = _stages(problem)
        self._detail, self._announced, self._mark = "", set[str](), time.perf_counter()
        self._bars: Bars | None = None
        self._task, self._step, self._done = TaskID(0), "", 0
        if self.console.is_terminal and not quiet:
            text = TextColumn("{task.description:<13}")
            left = TextColumn("left"), TimeRemainingColumn(compact=True)
            columns = (
                text,
                BarColumn(20),
                TimeElapsedColumn(),
                *left,
                TextColumn("{task.fields[it]}"),
            )
            self._bars = Bars(*columns, console=self.console, transient=True)

    def __enter__(self) -> SolveLog:
        self._logger = logging.getLogger(PACKAGE)
        self._level = self._logger.level
        self._logger.setLevel(logging.INFO)
        self._logger.addHandler(self)
        if self._bars is not None:
            self._bars.start()
            self._task = self._bars.add_task("", total=None, it="")
        self._begin()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._bars is not None:
            self._bars.stop()
        self._logger.removeHandler(self)
        self._logger.setLevel(self._level)

    def say(self, line: str) -> None:
        """Add a line to the log; the last line of a stage is its result."""
        self.lines.append(line)
        self._detail = line.partition("\n")[0]
        if self.verbose:
            self._print(line)

    def announce(self, line: str) -> None:
        """Add a line to the log and print it."""
        self.lines.append(line)
        self._print(line)

    def stage(self, name: str) -> None:
        """End a stage: print its time and result, and begin the next one."""
        now = time.perf_counter()
        self._print(f"{name:<13}{now - self._mark:6.1f} s  {self._detail}".rstrip())
        self._mark, self._detail = now, ""
        self._stages.pop(name, None)
        if name != "files":
            self._begin()

    def iteration(self, progress: Progress) -> None:
        """Add an iteration of presolve, Ipopt or TRW-S."""
        self.lines.append(str(progress))
        if self._bars is None:
            return
        if progress.stage != self._step:
            self._done += bool(self._step)
            self._step = progress.stage
        # the number of iterations of a stage is unknown; most take fewer than 15
        part = progress.iteration / (progress.iteration + 7)
        words = f"{progress.stage}, iteration {progress.iteration}"
        self._bars.update(self._task, completed=self._done + part, it=words)

    def warn(
        self, message: Warning | str, category: type[Warning], *_: object, **__: object
    ) -> None:
        """Print a warning about the input; warnings of libraries are not printed."""
        if issubclass(category, DataWarning):
            self._announce_once(f"warning: {message}")

    def emit(self, record: logging.LogRecord) -> None:
        """Print a message of the logger of the package, unless it was printed before."""
        self._announce_once(record.getMessage())

    def _announce_once(self, line: str) -> None:
        if line not in self._announced:
            self._announced.add(line)
            self.announce(line)

    def interrupted(self, line: str) -> None:
        """Print a line from a signal handler, where Python's streams cannot be used."""
        self.lines.append(line)
        os.write(2, f"\n{line}\n".encode())

    def _begin(self) -> None:
        """Show the bar of the next stage."""
        name, total = next(iter(self._stages.items()), ("files", None))
        self._step, self._done = "", 0
        if self._bars is not None:
            self._bars.reset(self._task, total=total, description=name, it="")

    def _print(self, line: str) -> None:
        if not self.quiet:
            self.console.print(line, markup=False, soft_wrap=True)


def _stages(problem: Problem | None) -> dict[str, int | None]:
    """Stages in their order with the number of steps of their bars; None if unknown."""
    steps: dict[str, int | None] = dict.fromkeys(("load", "flow", "segmentation", "start"))
    if problem is not None:
        refine, solver = problem.refine, problem.solver
        if not (refine.enabled and refine.from_start):
            # majorant, Gauss-Newton and exact Hessians, then the constrained NLP
            steps["nlp"] = (len(solver.presolve_eps) + 4) * solver.presolve + 1
        if refine.enabled:
            steps["refine"] = refine.rounds
    return steps | {"evaluation": None}
