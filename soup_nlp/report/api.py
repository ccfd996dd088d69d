"""`soup_nlp.run` and `soup_nlp.solve_pair`: a run that writes and draws itself."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import wraps
from io import BytesIO
from pathlib import Path
from typing import ParamSpec

from PIL.Image import Image, fromarray

from soup_nlp import pipeline
from soup_nlp.config.problem import dump_problem
from soup_nlp.report.figures import strip, without_gaps
from soup_nlp.report.folder import prepare_folder, write_folder
from soup_nlp.report.formats import check_formats
from soup_nlp.report.pictures import pictures
from soup_nlp.report.result import html, result_of
from soup_nlp.report.summary import summary

Given = ParamSpec("Given")


@dataclass(frozen=True, eq=False, repr=False)
class WritableRun(pipeline.Run):
    """A run with its result folder and its overview."""

    def save(
        self, folder: str | Path, formats: Sequence[str] = (), overwrite: bool = False
    ) -> list[str]:
        """Write a result folder, as `soup-nlp solve` does.

        Args:
            folder: A new or empty folder, or that of an earlier result.
            formats: Further files for other programs: "glb", "colmap", "npy", "pfm", "rrd" ...
            overwrite: Overwrite files that the program did not make.

        Returns:
            Names of the files.

        Raises:
            ConfigError: a format is not known.
            DataError: the folder cannot be written, or holds what is not to be overwritten.
        """
        none = formats is None or (isinstance(formats, list | tuple) and not formats)
        names = [] if none else check_formats(formats)
        in_memory = self.problem.input.kind == "memory"
        inputs = [] if in_memory else self.problem.input_paths()
        target = prepare_folder(folder, inputs, overwrite, self.problem.subject)
        return write_folder(target, self, dump_problem(self.problem), f"{self}\n", formats=names)

    def plot(self) -> Image:
        """The overview as a picture: notebooks show it, `.save` writes it."""
        drawn = pictures(result_of(self, summary(self)))
        return fromarray(strip(without_gaps(drawn), self.problem.name))

    def _repr_html_(self) -> str:
        """Text and overview, for notebooks."""
        picture = BytesIO()
        self.plot().save(picture, format="png")
        return html(str(self), picture.getvalue())


def _writable(solve: Callable[Given, pipeline.Run]) -> Callable[Given, WritableRun]:
    """The same function with a `WritableRun` as its result."""

    @wraps(solve)
    def solved(*args: Given.args, **options: Given.kwargs) -> WritableRun:
        done = solve(*args, **options)
        return WritableRun(**{field.name: getattr(done, field.name) for field in fields(done)})

    return solved


run, solve_pair = _writable(pipeline.run), _writable(pipeline.solve_pair)
