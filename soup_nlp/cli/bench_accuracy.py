"""Commands bench accuracy and bench search: suites, the paper's analyses, better defaults."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from soup_nlp.bench import tuning
from soup_nlp.bench.accuracy import pair_job
from soup_nlp.bench.accuracy_table import report
from soup_nlp.bench.analyses import ANALYSES, run_analysis, split_values
from soup_nlp.bench.suite_pairs import Options
from soup_nlp.bench.suites import SUITES, Listing, list_suite
from soup_nlp.bench.tables import main_metric, show
from soup_nlp.bench.tuning_report import text_search
from soup_nlp.cli import options
from soup_nlp.cli.options import Progress, numbers
from soup_nlp.errors import ConfigError
from soup_nlp.evaluate.protocols import preset
from soup_nlp.storage.atomic import write_text
from soup_nlp.storage.folders import claim, staged
from soup_nlp.storage.rows import MeasureRows, Row, measure_all


def mre_of(row: Row) -> str:
    """The main error of a row as text for the progress line."""
    return f"MRE {show(main_metric(row))}"


def accuracy(
    suite: options.SuiteName = None,
    data: options.Data = None,
    out: options.Out = Path("out/bench/accuracy"),
    analysis: Annotated[
        str | None, typer.Option(help="An analysis instead of the table; `list` names them.")
    ] = None,
    values: Annotated[
        str | None, typer.Option(help="Variants of the analysis, such as 100, 250, 500.")
    ] = None,
    overrides: options.Set = None,
    flow: options.Flow = None,
    width: options.Width = 1024,
    seeds: options.Seeds = "0",
    only: options.Only = None,
    limit: Annotated[
        int | None, typer.Option(help="At most this many pairs a suite.", min=1)
    ] = None,
    workers: options.Workers = 1,
    folders: Annotated[Path | None, typer.Option(help="Keep every result folder here.")] = None,
    conventions: Annotated[
        list[str] | None, typer.Option("--preset", help="Metric convention; may be repeated.")
    ] = None,
    name: Annotated[str, typer.Option(help="Name of the files of one suite.")] = "",
    any_code: options.AnyCode = False,
    overwrite: options.Overwrite = False,
    quiet: options.Quiet = False,
) -> None:
    """Depth against truth on a suite of pairs; interrupted runs can be continued."""
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
    wanted = _wanted(flow, width, numbers(seeds, "--seeds"), only, limit)
    progress, changes = Progress(quiet, mre_of), tuple(overrides or ())
    measure_rows = partial(measure_all, workers=workers, say=progress, any_code=any_code)
    listings = [list_suite(known, data, wanted) for known in suite or ["rendered"]]
    _check_names(analysis, folders, name, suite or [])
    if analysis:
        page = run_analysis(
            analysis,
            listings,
            out,
            changes,
            measure_rows,
            values=None if values is None else split_values(analysis, values),
            presets=conventions or (),
            overwrite=overwrite,
        )
        _print_page(page)
    else:
        pages = [out / f"{name or listing.suite.name}.md" for listing in listings]
        claim(out, [page.name for page in pages], overwrite)
        for listing, page in zip(listings, pages, strict=True):
            if not quiet:
                print(listing, file=sys.stderr)
            _table(listing, page, changes, measure_rows, conventions, folders)
    raise typer.Exit(1 if progress.failed else 0)


def _table(
    listing: Listing,
    page: Path,
    changes: tuple[str, ...],
    measure_rows: MeasureRows,
    conventions: list[str] | None,
    folders: Path | None,
) -> None:
    """Measure the pairs of a suite, and write and print their table."""
    jobs = [
        pair_job(
            item.scored_by(conventions),
            changes,
            folder=folders / item.key.replace(" ", "_") if folders else None,
        )
        for item in listing.items
    ]
    rows = measure_rows(jobs, page.with_suffix(".jsonl"))
    note = f"Suite `{listing.suite.name}`: {listing.suite.text}."
    if changes:
        note += f" Overrides: {', '.join(f'`{o}`' for o in changes)}."
    with staged(page.parent) as new:
        write_text(new / page.name, report(f"Accuracy on {page.stem}", rows, note))
    _print_page(page)


def _check_names(
    analysis: str | None, folders: Path | None, name: str, suites: Sequence[str]
) -> None:
    if analysis and (folders or name):
        raise ConfigError(
            "result folders and names are of suites, not of analyses",
            where="--folders" if folders else "--name",
            found=f"--analysis {analysis}",
            hint="give one without the other",
        )
    if name and len(suites) > 1:
        raise ConfigError("one name for several suites", where="--name", found=", ".join(suites))


def _wanted(
    flow: list[str] | None,
    width: int,
    seeds: Sequence[int],
    only: list[str] | None,
    limit: int | None = None,
) -> Options:
    flows = tuple(flow) if flow else None
    return Options(flows, width, tuple(dict.fromkeys(seeds)), limit, tuple(only or ()))


def _print_page(page: Path) -> None:
    print(page.read_text(encoding="utf-8"))
    print(f"files       {page.parent}/{page.stem}.*")


def search(
    suite: options.SuiteName = None,
    data: options.Data = None,
    out: options.Out = Path("out/bench/accuracy"),
    params: Annotated[
        list[str] | None,
        typer.Option("--param", help="KEY=log|linear|int:LOW:HIGH or KEY=choice:A:B instead."),
    ] = None,
    trials: Annotated[int, typer.Option(help="Configurations beside the default.", min=1)] = 24,
    finalists: Annotated[int, typer.Option(help="Best trials that are validated.", min=1)] = 3,
    seed: Annotated[int, typer.Option(help="Of the trials.", min=0)] = 0,
    seeds: options.Seeds = "0,1",
    validation_seeds: Annotated[
        str, typer.Option(help="Seeds of rendered scenes that only validate.")
    ] = "2,3",
    overrides: options.Set = None,
    flow: options.Flow = None,
    width: options.Width = 512,
    only: options.Only = None,
    workers: options.Workers = 1,
    any_code: options.AnyCode = False,
    overwrite: options.Overwrite = False,
    quiet: options.Quiet = False,
) -> None:
    """Search for better defaults and check them on pairs and families that did not choose."""
    ours, theirs = numbers(seeds, "--seeds"), numbers(validation_seeds, "--validation-seeds")
    wanted = _wanted(flow, width, (*ours, *theirs), only)
    space = tuple(tuning.parameter(p) for p in params) if params else tuning.DEFAULT_SPACE
    items = [i for name in suite or ["rendered"] for i in list_suite(name, data, wanted).items]
    train, validation = tuning.split(items, ours, theirs)
    if not quiet:
        print(
            f"{trials} trials of {len(space)} settings on {len(train)} pairs,"
            f" {len(validation)} validate",
            file=sys.stderr,
        )
    claim(out, ["search.md"], overwrite)
    progress = Progress(quiet, mre_of)
    found = tuning.search(
        space,
        train,
        validation,
        out / "search.jsonl",
        trials=trials,
        finalists=finalists,
        seed=seed,
        overrides=tuple(overrides or ()),
        measure_rows=partial(measure_all, workers=workers, say=progress, any_code=any_code),
    )
    words = [f"--suite {s}" for s in suite or ["rendered"]] + (["--data DIR"] if data else [])
    words += [f"--trials {trials} --seed {seed} --seeds {seeds}"]
    words += [f"--validation-seeds {validation_seeds} --width {width}"]
    words += [f"--flow {f}" for f in flow or []] + [f"--only '{o}'" for o in only or []]
    words += [f"--set '{o}'" for o in overrides or []] + [f"--param '{p}'" for p in params or []]
    page = out / "search.md"
    with staged(out) as new:
        write_text(new / page.name, text_search(found, f"soup-nlp bench search {' '.join(words)}"))
    _print_page(page)
    raise typer.Exit(1 if progress.failed else 0)
