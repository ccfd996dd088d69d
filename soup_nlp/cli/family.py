"""Command family: the SOUP problem set as a folder of .nl files."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from soup_nlp.cli.options import Coordinates, Overwrite, listed, numbers
from soup_nlp.errors import DataError
from soup_nlp.export.artefact import parse_formulations
from soup_nlp.family.instances import SCENES, SIZES, STANDARD, STARTS, select
from soup_nlp.family.write import write_family
from soup_nlp.storage.folders import claim, staged

QUICK = "100,250"
"""Default sizes, which take about a minute."""

TABLES = (
    "index.json",
    "index.csv",
    "instancedata.csv",
    "run.py",
    "README.md",
    "LICENSE.txt",
)
"""Files of a set beside its instances."""


def _list(known: tuple[object, ...]) -> str:
    return ",".join(map(str, known))


def family(
    out: Annotated[
        Path, typer.Argument(help="Folder of the set; new, empty or of an earlier one.")
    ],
    sizes: Annotated[str, typer.Option(help=f"Superpixels, of {_list(SIZES)}.")] = QUICK,
    scenes: Annotated[str, typer.Option(help="Rendered scenes.")] = _list(SCENES),
    formulation: Annotated[
        list[str] | None,
        typer.Option("--formulation", help="gauge/norm; may be repeated."),
    ] = None,
    coordinates: Coordinates = "matrix",
    starts: Annotated[
        str, typer.Option(help="easy (presolved), hard (initialisation), cold (constant depth).")
    ] = _list(STARTS),
    overwrite: Overwrite = False,
) -> None:
    """Write the SOUP problem set: .nl files, best known points, index, README, licence."""
    wanted = numbers(sizes, "--sizes")
    forms = ["/".join(form.values()) for form in parse_formulations(formulation, coordinates)]
    chosen = select(wanted, listed(scenes), [form or STANDARD for form in forms], listed(starts))
    if out.is_dir() and any(out.iterdir()) and not (out / "index.json").is_file():
        raise DataError(
            "folder holds other files", where=out, expected="a new or empty folder, or a set"
        )
    claim(out, TABLES, overwrite)
    with staged(out, whole=True, overwrite=overwrite) as new:
        entries = write_family(new, chosen)
    print(f"{len(entries)} instances; {', '.join(TABLES)} in {out}/")
    changed = [e["name"] for e in entries if e["published"] is False]
    if changed:
        print(f"{len(changed)} are not the published bytes: please report processor and versions")
    raise typer.Exit(1 if changed else 0)
