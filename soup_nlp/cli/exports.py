"""Command export: problems as files for other solvers."""

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Annotated

from soup_nlp.cli import options
from soup_nlp.cli.options import Words, option
from soup_nlp.config.problem import load_problem
from soup_nlp.export.artefact import (
    EXPORT_FILES,
    FORMATS,
    export_case,
    form_label,
    parse_formulation,
)
from soup_nlp.pipeline.case import prepare
from soup_nlp.storage.folders import claim, default_folder


def export(
    problem: options.Problem,
    out: Annotated[Path | None, options.out_option("out/export-NAME")] = None,
    formulation: options.Formulations = None,
    coordinates: options.Coordinates = "matrix",
    superpixels: options.Superpixels = None,
    format_: Annotated[Words, option(f"{', '.join(FORMATS)}; may be repeated.", "--format")] = None,
    presolve: Annotated[
        bool, option("Start at the presolve's answer, with its multipliers.", "--presolve")
    ] = False,
    suffixes: Annotated[bool, option("Write suffixes; CasADi reads none.", "--suffixes")] = False,
    lift: Annotated[
        bool, option("Shared expressions as variables with rows, as SCIP needs them.", "--lift")
    ] = False,
    overrides: options.Set = None,
    overwrite: options.Overwrite = False,
    quiet: options.Quiet = False,
) -> None:
    """Write the NLP for other solvers, started at the initialisation.

    Several sizes or formulations make a folder each.
    """
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
            here, style, folder, format_ or ["nl"], presolve, overwrite, suffixes, lift
        )
        s = manifest["sizes"]
        if not quiet:
            print(
                f"{folder}/soup.nl  {form_label(style)}  {s['superpixels']} superpixels,"
                f" {s['variables']} variables, {s['constraints']} constraints,"
                f" {s['jacobian_nonzeros']} Jacobian nonzeros,"
                f" {manifest['nl']['bytes'] / 1e6:.1f} MB"
            )
