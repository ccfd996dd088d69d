"""Parts that commands share: common options, lists in options, progress."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from soup_nlp.config.presets import PRESETS
from soup_nlp.errors import ConfigError
from soup_nlp.schema.limits import MAX_SEED
from soup_nlp.storage.files import as_path, is_file
from soup_nlp.storage.rows import Row, failed, reason

INPUT: Mapping[str, Any] = {"rich_help_panel": "Input"}
SIZE: Mapping[str, Any] = {"rich_help_panel": "Size"}
METHOD: Mapping[str, Any] = {"rich_help_panel": "Method"}
OUTPUT: Mapping[str, Any] = {"rich_help_panel": "Output"}

Intrinsics = Annotated[
    str | None,
    typer.Option(
        help="fx,fy,cx,cy in pixels, or a file; default K.txt of a sequence, EXIF, a guess.",
        **INPUT,
    ),
]
Fov = Annotated[
    float | None,
    typer.Option(help="Horizontal field of view, degrees, instead of --intrinsics.", **INPUT),
]
Undistort = Annotated[
    bool, typer.Option("--undistort", help="Remove the camera file's distortion.", **INPUT)
]
Wanted = Annotated[
    int | None, typer.Option("--superpixels", help="Number N of superpixels; default 1000.", **SIZE)
]
Neighbours = Annotated[int | None, typer.Option(help="K of the K-NN graph; default 15.", **SIZE)]
MaxSize = Annotated[
    float | None,
    typer.Option(help="Megapixels to which larger images are reduced; default 1.5.", **SIZE),
]
Set = Annotated[
    list[str] | None, typer.Option("--set", help="Set any key, e.g. solver.max_iter=200.", **METHOD)
]
PresetName = Annotated[
    str | None,
    typer.Option(help=f"Options below the problem's own: {', '.join(PRESETS)}.", **METHOD),
]
Out = Annotated[Path, typer.Option("--out", "-o", help="Output folder.", **OUTPUT)]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print no progress.", **OUTPUT)]
Overwrite = Annotated[
    bool,
    typer.Option(
        "--overwrite",
        help="Also over files of others, or the result of another input.",
        **OUTPUT,
    ),
]
PROBLEM = "Problem file, or a name that `soup-nlp list` shows."
Problem = Annotated[Path, typer.Argument(help=PROBLEM)]
Presolve = Annotated[
    bool, typer.Option(help="Start at the presolve's answer, not at the initialisation.")
]
Formulations = Annotated[
    list[str] | None,
    typer.Option(
        "--formulation", help="gauge/norm, e.g. unit-translation/epigraph; may be repeated."
    ),
]
Coordinates = Annotated[
    str,
    typer.Option(
        help="matrix, or tangent: nine per superpixel about the initialisation, without gauge."
    ),
]
Superpixels = Annotated[
    list[int] | None, typer.Option(help="Number of superpixels, 50 to 2000; may be repeated.")
]
Data = Annotated[Path | None, typer.Option(help="Root folder of the dataset.")]
Workers = Annotated[int, typer.Option(help="Processes of this machine.", min=1)]
AnyCode = Annotated[bool, typer.Option(help="Also take stored rows of other code versions.")]


def changed(
    preset: str | None, overrides: Sequence[str] | None, short: Mapping[str, object] | None = None
) -> list[str]:
    """Overrides of a preset, of `--set`, and of the options that stand for keys.

    The preset is first, so that `--set preset=null` can undo it.
    """
    given = [f"{key}={value}" for key, value in (short or {}).items() if value is not None]
    return [*([] if preset is None else [f"preset={preset}"]), *(overrides or []), *given]


def located(name: str | None, what: str) -> str | None:
    """A file of the command line as the value of a key, whose paths start at the problem file."""
    return name and json.dumps(str(as_path(name, what, home=True).absolute()))


def numbers(text: str, option: str, least: int = 0, most: int = MAX_SEED) -> list[int]:
    """Different whole numbers of a comma-separated list.

    Raises:
        ConfigError: a word is no whole number from `least` to `most`.
    """
    try:
        found = list(dict.fromkeys(int(word) for word in text.split(",")))
    except ValueError:
        found = []
    if not found or min(found) < least or max(found) > most:
        raise ConfigError(
            "not a list of whole numbers",
            where=option,
            found=text,
            expected=f"whole numbers from {least} to {most}, comma separated",
        )
    return found


def listed(text: str) -> list[str]:
    """Different names of a comma-separated list."""
    return list(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))


def words(text: str, option: str, known: list[str]) -> list[str]:
    """Different names of a comma-separated list.

    Raises:
        ConfigError: the list is empty, or a name is unknown.
    """
    names = listed(text)
    wrong = [name for name in names if name not in known]
    if wrong or not names:
        raise ConfigError(
            "unknown name", where=option, found=", ".join(wrong) or text, expected=", ".join(known)
        )
    return names


def camera(text: str | None, option: str) -> list[float] | str | None:
    """Value of the key `intrinsics`: four numbers, or the name of a file; None without a text.

    Raises:
        ConfigError: the text is neither.
    """
    if text is None:
        return None
    try:
        values = [float(x) for x in text.split(",")]
    except ValueError:
        values = []
    if not values and is_file(as_path(text, "camera file", home=True)):
        return text
    if len(values) != 4:
        raise ConfigError(
            "camera is neither four numbers nor a file",
            where=option,
            found=text,
            expected="fx,fy,cx,cy or a text file of 4 or 9 numbers",
        )
    return values


class RowProgress:
    """Prints finished rows and time left: one updated line on a terminal, else a line per row.

    Args:
        quiet: Print nothing.
        result_of: Makes a short text from a row that did not fail.

    Attributes:
        failed: Number of new rows that failed.
    """

    def __init__(self, quiet: bool, result_of: Callable[[Row], str] = lambda row: "done") -> None:
        self.quiet, self.result_of = quiet, result_of
        self.live = sys.stderr.isatty()
        self.spent: list[float] = []
        self.failed = 0

    def __call__(self, done: int, total: int, row: Row) -> None:
        """Print a new row."""
        self.failed += failed(row)
        if self.quiet:
            return
        self.spent.append(float(row.get("seconds") or 0.0))
        left = sum(self.spent) / len(self.spent) * (total - done)
        result = f"failed: {reason(row)}" if failed(row) else self.result_of(row)
        line = f"{done}/{total}  {row['key']}  {result}  {self.spent[-1]:.0f} s"
        if total > done:
            line += f"  (about {left:.0f} s of work left)"
        start, end = ("\r\x1b[2K", "\n" if done == total else "") if self.live else ("", "\n")
        print(f"{start}{line}", end=end, file=sys.stderr, flush=True)
