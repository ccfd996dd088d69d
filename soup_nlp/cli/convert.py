"""Command convert: a result for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from soup_nlp.cli.options import Overwrite
from soup_nlp.report.formats import FORMATS
from soup_nlp.report.save import convert as convert_folder

_NAMES = "; ".join(f"{name}: {text}" for name, (_, text) in FORMATS.items())


def convert(
    folder: Annotated[Path, typer.Argument(help="Result folder.")],
    to: Annotated[str, typer.Option("--to", help=f"Comma separated. {_NAMES}.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Output folder; default the result's own.")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Write a result for other programs: ply, glb, colmap, npy, pfm, png, rrd, motions."""
    names = [name.strip() for name in to.split(",") if name.strip()]
    target = folder if out is None else out
    for name in convert_folder(folder, names, out, overwrite):
        print(target / name)
