"""Command bench accuracy: suites against truth and baselines, and the paper's analyses."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from soup_nlp.bench.accuracy import pair_job
from soup_nlp.bench.accuracy_table import report
from soup_nlp.bench.analyses import ANALYSES, run_analysis, split_values
from soup_nlp.bench.rows import Row, Where, measure_all
from soup_nlp.bench.suite_pairs import Options
from soup_nlp.bench.suites import SUITES, list_suite
from soup_nlp.bench.tables import main_metric, show
from soup_nlp.cli.options import (
    AnyCode,
    Dask,
    Data,
    Flow,
    Only,
    Out,
    Progress,
    Quiet,
    Seeds,
    Set,
    SuiteName,
    Width,
    Workers,
    numbers,
)
from soup_nlp.errors import ConfigError
from soup_nlp.evaluate.protocols import preset
from soup_nlp.storage.atomic import write_text


def mre_of(row: Row) -> str:
    """The main error of a row, for the progress line."""
    return f"MRE {show(main_metric(row))}"


def accuracy(
    suite: SuiteName = None,
    data: Data = None,
    out: Out = Path("results/accuracy"),
    analysis: Annotated[
        str | None, typer.Option(help="An analysis instead of the table; `list` names them.")
    ] = None,
    values: Annotated[
        str | None, typer.Option(help="Variants of the analysis, such as 100, 250, 500.")
    ] = None,
    overrides: Set = None,
    flow: Flow = None,
    width: Width = 1024,
    seeds: Seeds = "0",
    only: Only = None,
    limit: Annotated[
        int | None, typer.Option(help="At most this many pairs a suite.", min=1)
    ] = None,
    workers: Workers = 1,
    dask: Dask = "",
    folders: Annotated[Path | None, typer.Option(help="Keep every result folder here.")] = None,
    conventions: Annotated[
        list[str] | None, typer.Option("--preset", help="Metric convention; may be repeated.")
    ] = None,
    name: Annotated[str, typer.Option(help="Name of the files of one suite.")] = "",
    any_code: AnyCode = False,
    quiet: Quiet = False,
) -> None:
    """Depth against truth on a suite of pairs; stopped runs go on where they were."""
    if analysis == "list":
        for known in ANALYSES.values():
            print(f"{known.name:<12} {known.text}")
        return
    if not suite and not analysis:
        for entry in SUITES.values():
            print(f"{entry.name:<14} {entry.text}")
        raise ConfigError("no suite was named", where="--suite", expected=", ".join(SUITES))
    for convention in conventions or []:
        preset(convention)
    options = Options(
        flows=tuple(flow) if flow else None,
        width=width,
        seeds=tuple(numbers(seeds, "--seeds")),
        limit=limit,
        only=tuple(only or ()),
    )
    where, progress = Where(workers, dask), Progress(quiet, mre_of)
    names: Sequence[str] = suite or ["rendered"]
    listings = [list_suite(suite_name, data, options) for suite_name in names]
    if analysis:
        if folders or name:
            raise ConfigError(
                "result folders and names are of suites, not of analyses",
                where="--folders" if folders else "--name",
                found=f"--analysis {analysis}",
                hint="give one without the other",
            )
        path = run_analysis(
            analysis,
            listings,
            out,
            tuple(overrides or ()),
            where,
            values=None if values is None else split_values(analysis, values),
            presets=conventions or (),
            say=progress,
            any_code=any_code,
        )
        print(path.read_text(encoding="utf-8"))
        print(f"files       {path.parent}/{path.stem}.*")
        raise typer.Exit(1 if progress.failed else 0)
    if name and len(names) > 1:
        raise ConfigError("one name for several suites", where="--name", found=", ".join(names))
    # a worker of a cluster may have another working directory
    folders = folders.expanduser().resolve() if folders else None
    for listing in listings:
        if not quiet:
            print(listing, file=sys.stderr)
        jobs = [
            pair_job(
                item if not conventions else item.scored_by(tuple(conventions)),
                overrides or (),
                folder=folders / item.key.replace(" ", "_") if folders else None,
            )
            for item in listing.items
        ]
        page = out / f"{name or listing.suite.name}.md"
        own = page.with_suffix(".jsonl")
        rows = measure_all(jobs, own, where, say=progress, any_code=any_code)
        note = f"Suite `{listing.suite.name}`: {listing.suite.text}."
        if overrides:
            note += f" Overrides: {', '.join(f'`{o}`' for o in overrides)}."
        write_text(page, report(f"Accuracy on {page.stem}", rows, note))
        print(page.read_text(encoding="utf-8"))
        print(f"files       {page}, {own}")
    raise typer.Exit(1 if progress.failed else 0)
