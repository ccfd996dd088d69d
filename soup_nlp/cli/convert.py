"""Command convert: a result for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from soup_nlp.cli.options import Overwrite
from soup_nlp.report.folder import convert as convert_folder
from soup_nlp.report.formats import FORMATS
from soup_nlp.sequence.stored import convert_chain, is_chain

_NAMES = "; ".join(f"{name}: {text}" for name, (_, text) in FORMATS.items())


def convert(
    folder: Annotated[Path, typer.Argument(help="Folder of a result or a chain.")],
    to: Annotated[str, typer.Option("--to", help=f"Comma separated. {_NAMES}.")],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Output folder; default the result's own.")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Write a result for other programs: ply, glb, colmap, npy, pfm, png, rrd, motions."""
    names = [name.strip() for name in to.split(",") if name.strip()]
    target = folder if out is None else out
    write = convert_chain if is_chain(folder) else convert_folder
    for name in write(folder, names, out, overwrite):
        print(target / name)
