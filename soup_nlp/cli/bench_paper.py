"""Command bench paper: every table and figure of the paper that the data allow."""

from __future__ import annotations

import shlex
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from soup_nlp.bench.paper import ALL_SECTIONS, FAMILIES, Sizes, make_plan, measure_paper
from soup_nlp.bench.paper_page import FILES, write_page
from soup_nlp.bench.study import measure_cells
from soup_nlp.cli import options
from soup_nlp.cli.bench_accuracy import Width, mre_of
from soup_nlp.cli.options import RowProgress, words
from soup_nlp.schema.limits import MAX_SUPERPIXELS
from soup_nlp.storage.folders import claim, staged
from soup_nlp.storage.rows import measure_all


def paper(
    data: options.Data = None,
    out: options.Out = Path("results/paper"),
    superpixels: Annotated[
        int, typer.Option(help="Superpixels of the comparison.", min=2, max=MAX_SUPERPIXELS)
    ] = 1000,
    analysis: Annotated[
        int, typer.Option(help="Superpixels of the other sections.", min=2, max=MAX_SUPERPIXELS)
    ] = 500,
    limit: Annotated[
        int | None, typer.Option(help="At most this many pairs a dataset.", min=1)
    ] = None,
    families: Annotated[
        str, typer.Option(help=f"Pairs of the sections: {', '.join(FAMILIES)}.")
    ] = ",".join(Sizes.families),
    departures: Annotated[
        str, typer.Option(help="Pairs of the departures, by the same names.")
    ] = ",".join(Sizes.departures),
    width: Width = 1024,
    sections: Annotated[
        str,
        typer.Option(help=f"Of {', '.join(ALL_SECTIONS)}; the comparison is always there."),
    ] = ",".join(ALL_SECTIONS),
    overrides: options.Set = None,
    workers: options.Workers = 1,
    any_code: options.AnyCode = False,
    overwrite: options.Overwrite = False,
    quiet: options.Quiet = False,
) -> None:
    """The paper's tables and figures by `preset: paper` and the defaults; can be continued."""
    sizes = Sizes(
        superpixels=superpixels,
        analysis=analysis,
        limit=limit,
        width=width,
        families=tuple(words(families, "--families", list(FAMILIES))),
        departures=tuple(words(departures, "--departures", list(FAMILIES))),
        overrides=tuple(overrides or ()),
        sections=tuple(words(sections, "--sections", list(ALL_SECTIONS))),
    )
    said = [f"--superpixels {superpixels} --analysis {analysis} --families {families}"]
    said += [f"--width {width} --sections {sections} --departures {departures}"]
    said += [f"--limit {limit}"] * (limit is not None) + ["--data DIR"] * (data is not None)
    said += [f"--set {shlex.quote(o)}" for o in sizes.overrides]
    claim(out, FILES, overwrite)
    plan, progress = make_plan(data, sizes, out), RowProgress(quiet, mre_of)
    run = partial(measure_all, workers=workers, say=progress, any_code=any_code)
    frame = measure_cells(plan.cells(), measure_paper, out / "paper.jsonl", run)
    with staged(out) as new:
        write_page(new, plan, frame, f"soup-nlp bench paper {' '.join(said)}")
    print(f"files       {out}/: {', '.join(FILES)}")
    raise typer.Exit(0 if frame["ok"].eq(True).all() else 1)
