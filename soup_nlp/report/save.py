"""Writing of results and of files for other programs: `Run.save` and `soup-nlp convert`."""

from __future__ import annotations

from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING

from soup_nlp.pipeline.record import Run
from soup_nlp.report.figures import strip_figure, without_gaps
from soup_nlp.report.folder import prepare_folder, summary, write_folder
from soup_nlp.report.formats import check_formats, write_formats
from soup_nlp.report.pictures import pictures
from soup_nlp.report.record import extended
from soup_nlp.report.result import html, load, result_of
from soup_nlp.storage.folders import staged

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def save(
    run: Run, folder: str | Path, config: str, formats: Sequence[str] = (), overwrite: bool = False
) -> list[str]:
    """Write the result folder of a run, see `Run.save`; `config` is its merged problem as YAML."""
    none = formats is None or (isinstance(formats, list | tuple) and not formats)
    names = [] if none else check_formats(formats)
    in_memory = run.problem.input.kind == "memory"
    inputs = [] if in_memory else run.problem.input_paths()
    target = prepare_folder(folder, inputs, overwrite, run.problem.subject)
    return write_folder(target, run, config, f"{run}\n", formats=names)


def plot(run: Run) -> Figure:
    """The overview of a run as a figure of matplotlib, which a notebook shows."""
    drawn = pictures(result_of(run, summary(run)))
    return strip_figure(without_gaps(drawn), run.problem.name)


def overview_html(run: Run) -> str:
    """Text and overview of a run as HTML."""
    picture = BytesIO()
    plot(run).savefig(picture, format="png", dpi=80)
    return html(str(run), picture.getvalue())


def convert(
    folder: Path, formats: Sequence[str], out: Path | None = None, overwrite: bool = False
) -> list[str]:
    """Write a result folder in other formats.

    Args:
        folder: Result folder of `solve`, `import` or `Run.save`.
        formats: See `formats.FORMATS`.
        out: Output folder; None for the result folder itself.
        overwrite: Overwrite files that the program did not make.

    Returns:
        Names of the files and folders.

    Raises:
        ConfigError: a format is not known.
        DataError: the folder holds no result, or the other one cannot be written.
    """
    names = check_formats(formats)
    result = load(folder)
    where = extended(folder, overwrite) if out is None else staged(out, overwrite=overwrite)
    with where as new:
        return write_formats(new, result, names)
