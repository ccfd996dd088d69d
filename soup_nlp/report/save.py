"""Results and files for other programs into folders: `Run.save` and `soup-nlp convert`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from soup_nlp.data.datasets.layout import is_result
from soup_nlp.errors import DataError
from soup_nlp.report.folder import prepare_folder, write_folder
from soup_nlp.report.formats import check_formats, write_formats
from soup_nlp.report.result import read_result, result_of

if TYPE_CHECKING:
    from soup_nlp.pipeline.run import Run


def save(run: Run, folder: str | Path, config: str, formats: Sequence[str] = ()) -> list[str]:
    """Write the result folder of a run.

    Args:
        run: The run.
        folder: A new or empty folder, or that of an earlier result.
        config: Merged problem as YAML.
        formats: Files for other programs beside, see `formats.FORMATS`.

    Returns:
        Names of the files.

    Raises:
        ConfigError: a format is not known.
        DataError: the folder cannot be written, or holds what is not to be overwritten.
    """
    names = check_formats(formats) if formats else []
    in_memory = run.problem.input.kind == "memory"
    target = prepare_folder(folder, [] if in_memory else run.problem.input_paths())
    files = write_folder(target, run, config, f"{run}\n")
    if names:
        files += write_formats(target, result_of(run), names)
    return list(dict.fromkeys(files))


def convert(folder: Path, formats: Sequence[str], out: Path | None = None) -> list[str]:
    """Write a result folder in other formats.

    Args:
        folder: Result folder of `solve`, `import` or `Run.save`.
        formats: See `formats.FORMATS`.
        out: Where to; None for the result folder itself. Else a new or empty folder, or one of an
            earlier conversion.

    Returns:
        Names of the files and folders.

    Raises:
        ConfigError: a format is not known.
        DataError: the folder holds no result, or the other one cannot be written.
    """
    names = check_formats(formats)
    result = read_result(folder)
    target = folder if out is None else out
    if out is not None and out.is_dir() and any(out.iterdir()) and not is_result(out):
        raise DataError(
            "output folder holds files of its own",
            where=out,
            expected="a new or empty folder, or one of an earlier conversion",
            hint="choose another --out",
        )
    return write_formats(prepare_folder(target, [] if out is not None else None), result, names)
