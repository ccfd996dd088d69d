"""Commands export and family: problems as files for other solvers."""

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Annotated

import typer

from soup_nlp.cli import options
from soup_nlp.cli.options import Words, option
from soup_nlp.config.problem import load_problem
from soup_nlp.errors import DataError
from soup_nlp.export.artefact import (
    EXPORT_FILES,
    FORMATS,
    export_case,
    form_label,
    parse_formulation,
)
from soup_nlp.family.instances import SCENES, SIZES, STARTS, select
from soup_nlp.family.write import write_family
from soup_nlp.pipeline.case import prepare
from soup_nlp.storage.folders import claim, default_folder, staged


def export(
    problem: options.Problem,
    out: Annotated[Path | None, options.out_option("out/export-NAME")] = None,
    formulation: options.Formulations = None,
    coordinates: options.Coordinates = "matrix",
    superpixels: options.Superpixels = None,
    format_: Annotated[Words, option(f"{', '.join(FORMATS)}; may be repeated.", "--format")] = None,
    presolve: options.Presolve = True,
    suffixes: Annotated[bool, option("Write suffixes; CasADi reads none.", "--suffixes")] = False,
    overrides: options.Set = None,
    overwrite: options.Overwrite = False,
    quiet: options.Quiet = False,
) -> None:
    """Write the NLP for other solvers; several sizes or formulations make a folder each."""
    forms = [parse_formulation(text, coordinates) for text in formulation or [""]]
    # without repetitions
    sizes: list[int | None] = [*dict.fromkeys(superpixels or ())] or [None]
    several = len(sizes) * len(forms) > 1
    written = set()
    for size, form in product(sizes, forms):
        changes = [] if size is None else [f"segmentation.superpixels={size}"]
        changes += [f"formulation.{k}={v}" for k, v in form.items() if k != "coordinates"]
        chosen = load_problem(problem, [*(overrides or []), *changes])
        out = out or default_folder(f"export-{chosen.name}", chosen.subject)
        if not several:
            # check the folder before the work
            claim(out, EXPORT_FILES, overwrite, chosen.subject)
        if form is forms[0]:
            case = prepare(chosen, presolve)
        # the same soup in another formulation
        here = replace(case, problem=chosen)
        style = here.formulation(coordinates=form.get("coordinates", "matrix"))
        # the name has the wanted size, since two sizes may give the same number of superpixels
        asked = chosen.segmentation.superpixels
        name = f"{chosen.name}-{asked}-{form_label(style).replace('/', '-')}"
        if name in written:
            continue
        written.add(name)
        folder = out / name if several else out
        manifest = export_case(
            here, style, folder, format_ or ["nl"], presolve, overwrite, suffixes
        )
        s = manifest["sizes"]
        if not quiet:
            print(
                f"{folder}/soup.nl  {form_label(style)}  {s['superpixels']} superpixels,"
                f" {s['variables']} variables, {s['constraints']} constraints,"
                f" {s['jacobian_nonzeros']} Jacobian nonzeros,"
                f" {manifest['nl']['bytes'] / 1e6:.1f} MB"
            )


QUICK = "100,250"
"""Default sizes, which take about a minute."""

TABLES = ("index.json", "instancedata.csv", "README.md", "LICENSE.txt")
"""Files of a set beside its instances."""


def _list(values: tuple[object, ...]) -> str:
    return ",".join(map(str, values))


def family(
    out: Annotated[Path, typer.Argument(help="Folder of the set, new or of an earlier one.")],
    sizes: Annotated[str, option(f"Superpixels, of {_list(SIZES)}.")] = QUICK,
    scenes: Annotated[str, option("Rendered scenes.")] = _list(SCENES),
    formulation: options.Formulations = None,
    coordinates: options.Coordinates = "matrix",
    starts: Annotated[
        str, option("easy (presolved), hard (initialisation), cold (constant depth).")
    ] = _list(STARTS),
    overwrite: options.Overwrite = False,
) -> int:
    """Write the SOUP problem set: .nl files, best known points, index, README, licence."""
    wanted, named = options.numbers(sizes, "--sizes"), options.listed(scenes)
    chosen = select(wanted, named, formulation or [""], options.listed(starts), coordinates)
    if out.is_dir() and any(out.iterdir()) and not (out / "index.json").is_file():
        raise DataError(
            "folder holds other files", where=out, expected="a new or empty folder, or a set"
        )
    claim(out, TABLES, overwrite)
    with staged(out, whole=True, overwrite=overwrite) as new:
        entries = write_family(new, chosen)
    print(f"{len(entries)} instances; {', '.join(TABLES)} in {out}/")
    differing = [e["name"] for e in entries if e["published"] is False]
    if differing:
        print(f"{len(differing)} are not the published bytes: please report processor and versions")
    return 1 if differing else 0
