"""Command bench paper: every table and figure of the paper that the data allow."""

from __future__ import annotations

import shlex
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from soup_nlp.bench.paper_page import FILES, Results, write_page
from soup_nlp.bench.paper_pairs import FAMILIES
from soup_nlp.bench.paper_plan import ALL_SECTIONS, Sizes, make_plan
from soup_nlp.cli import options
from soup_nlp.cli.bench_accuracy import mre_of
from soup_nlp.cli.options import Progress, numbers, words
from soup_nlp.schema.limits import MAX_NEIGHBOURS, MAX_SUPERPIXELS
from soup_nlp.storage.folders import claim
from soup_nlp.storage.rows import failed, measure_all


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
        str, typer.Option(help=f"Pairs of the analyses: {', '.join(FAMILIES)}.")
    ] = ",".join(Sizes.families),
    departures: Annotated[
        str, typer.Option(help="Pairs of the departures, by the same names.")
    ] = ",".join(Sizes.departures),
    sizes: Annotated[
        str, typer.Option("--numbers", help="Numbers of superpixels that are compared.")
    ] = ",".join(map(str, Sizes.numbers)),
    neighbours: Annotated[str, typer.Option(help="K that are compared.")] = ",".join(
        map(str, Sizes.neighbours)
    ),
    width: options.Width = 1024,
    seeds: options.Seeds = "0,1,2",
    sections: Annotated[
        str,
        typer.Option(
            "--sections", help=f"Of {', '.join(ALL_SECTIONS)}; the comparison is always there."
        ),
    ] = ",".join(ALL_SECTIONS),
    overrides: options.Set = None,
    workers: options.Workers = 1,
    any_code: options.AnyCode = False,
    overwrite: options.Overwrite = False,
    quiet: options.Quiet = False,
) -> None:
    """The paper's tables and figures by `preset: paper` and the defaults; can be continued."""
    chosen = Sizes(
        superpixels=superpixels,
        analysis=analysis,
        limit=limit,
        numbers=tuple(numbers(sizes, "--numbers", 2, MAX_SUPERPIXELS)),
        neighbours=tuple(numbers(neighbours, "--neighbours", 1, MAX_NEIGHBOURS)),
        width=width,
        seeds=tuple(numbers(seeds, "--seeds")),
        families=tuple(words(families, "--families", list(FAMILIES))),
        departures=tuple(words(departures, "--departures", list(FAMILIES))),
        overrides=tuple(overrides or ()),
        sections=tuple(words(sections, "--sections", list(ALL_SECTIONS))),
    )
    said = [f"--superpixels {superpixels} --analysis {analysis} --families {families}"]
    said += [f"--numbers {sizes} --neighbours {neighbours} --width {width} --seeds {seeds}"]
    said += [f"--sections {sections}"] * (sections != ",".join(ALL_SECTIONS))
    said += [f"--departures {departures}"] * (departures != ",".join(FAMILIES))
    said += [f"--limit {limit}"] * (limit is not None) + ["--data DIR"] * (data is not None)
    said += [f"--set {shlex.quote(o)}" for o in chosen.overrides]
    claim(out, FILES, overwrite)
    plan, progress = make_plan(data, chosen), Progress(quiet, mre_of)
    run = partial(measure_all, workers=workers, say=progress, any_code=any_code)
    scales = run(plan.scale_jobs(), out / "scale.jsonl")
    rows = run(plan.jobs(out), out / "paper.jsonl")
    command = f"soup-nlp bench paper {' '.join(said)}"
    print(f"files       {write_page(out, Results(plan, rows, scales), command)} and its figures")
    raise typer.Exit(1 if any(map(failed, [*rows, *scales])) else 0)
