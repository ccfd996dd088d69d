"""Commands bench accuracy, search and paper: suites, better defaults, the paper's tables."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated

import pandas as pd
import typer

from soup_nlp.bench import search as searching
from soup_nlp.bench.accuracy import measure_pair
from soup_nlp.bench.accuracy_page import write_suite
from soup_nlp.bench.paper import ALL_SECTIONS, FAMILIES, Sizes, make_plan, measure_paper
from soup_nlp.bench.paper_page import FILES, write_page
from soup_nlp.bench.study import Cell, measure_cells
from soup_nlp.bench.suites import SUITES, Options, list_suite
from soup_nlp.cli import options
from soup_nlp.cli.options import RowProgress, numbers, words
from soup_nlp.errors import ConfigError
from soup_nlp.evaluate.protocols import preset
from soup_nlp.schema.limits import MAX_SIDE, MAX_SUPERPIXELS
from soup_nlp.storage.atomic import write_text
from soup_nlp.storage.folders import claim, staged
from soup_nlp.storage.rows import Row, measure_all

SuiteName = Annotated[
    list[str] | None, typer.Option("--suite", help=f"{', '.join(SUITES)}; may be repeated.")
]
Flow = Annotated[
    list[str] | None, typer.Option(help="Flow source instead of the suite's own; may be repeated.")
]
Only = Annotated[list[str] | None, typer.Option(help="Only pairs whose name holds this word.")]
Width = Annotated[int, typer.Option(help="Columns of rendered scenes.", min=64, max=MAX_SIDE)]
Seeds = Annotated[str, typer.Option(help="Seeds of rendered scenes, such as 0,1,2.")]


def mre_of(row: Row) -> str:
    """The main error of a row as text for the progress line."""
    own = row["metrics"].get(row["presets"][0], {}).get("solution", {}).get("mre")
    return "MRE -" if own is None else f"MRE {own:.4f}"


def accuracy(
    suite: SuiteName = None,
    data: options.Data = None,
    out: options.Out = Path("out/bench/accuracy"),
    overrides: options.Set = None,
    flow: Flow = None,
    width: Width = 1024,
    seeds: Seeds = "0",
    only: Only = None,
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
    if not suite:
        print("\n".join(f"{entry.name:<14} {entry.text}" for entry in SUITES.values()))
        raise ConfigError("no suite was named", where="--suite", expected=", ".join(SUITES))
    for convention in conventions or []:
        preset(convention)
    if name and len(suite) > 1:
        raise ConfigError("one name for several suites", where="--name", found=", ".join(suite))
    wanted = _wanted(flow, width, numbers(seeds, "--seeds"), only, limit)
    listings = [list_suite(known, data, wanted) for known in suite]
    progress, changes = RowProgress(quiet, mre_of), tuple(overrides or ())
    measure_rows = partial(measure_all, workers=workers, say=progress, any_code=any_code)
    names = [name or listing.suite.name for listing in listings]
    claim(out, [f"{own}.{kind}" for own in names for kind in ("md", "png")], overwrite)
    for listing, own in zip(listings, names, strict=True):
        if not quiet:
            print(listing, file=sys.stderr)
        cells = [
            Cell(
                item.scored_by(conventions),
                changes,
                keep=folders / item.key.replace(" ", "_") if folders else None,
            )
            for item in listing.items
        ]
        frame = measure_cells(cells, measure_pair, out / f"{own}.jsonl", measure_rows)
        note = f"Suite `{listing.suite.name}`: {listing.suite.text}. Overrides of every pair: "
        note += f"{', '.join(f'`{o}`' for o in changes) or 'none'}."
        with staged(out) as new:
            write_suite(new, own, frame, note)
        _print_page(out / f"{own}.md")
    raise typer.Exit(1 if progress.failed else 0)


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
    suite: SuiteName = None,
    data: options.Data = None,
    out: options.Out = Path("out/bench/accuracy"),
    params: Annotated[
        list[str] | None,
        typer.Option("--param", help="KEY=log|linear|int:LOW:HIGH or KEY=choice:A:B instead."),
    ] = None,
    trials: Annotated[int, typer.Option(help="Configurations beside the default.", min=1)] = 24,
    seed: Annotated[int, typer.Option(help="Of the trials.", min=0)] = 0,
    seeds: Seeds = "0,1",
    overrides: options.Set = None,
    flow: Flow = None,
    width: Width = 512,
    only: Only = None,
    workers: options.Workers = 1,
    any_code: options.AnyCode = False,
    overwrite: options.Overwrite = False,
    quiet: options.Quiet = False,
) -> None:
    """Search for better defaults and check them on the families that did not choose them."""
    wanted = _wanted(flow, width, numbers(seeds, "--seeds"), only)
    texts = params or searching.DEFAULT_SPACE
    space = searching.parse_space(texts)
    items = [i for name in suite or ["rendered"] for i in list_suite(name, data, wanted).items]
    claim(out, ["search.md"], overwrite)
    progress = RowProgress(quiet, mre_of)
    frame: pd.DataFrame = searching.search(
        space,
        items,
        out / "search.jsonl",
        partial(measure_all, workers=workers, say=progress, any_code=any_code),
        trials=trials,
        seed=seed,
        overrides=tuple(overrides or ()),
    )
    said = [f"--suite {s}" for s in suite or ["rendered"]] + (["--data DIR"] if data else [])
    said += [f"--trials {trials} --seed {seed} --seeds {seeds} --width {width}"]
    said += [f"--flow {f}" for f in flow or []] + [f"--only {shlex.quote(o)}" for o in only or []]
    said += [f"--set {shlex.quote(o)}" for o in overrides or []]
    command = f"soup-nlp bench search {' '.join(said)}"
    with staged(out) as new:
        write_text(new / "search.md", searching.search_page(frame, texts, command))
    _print_page(out / "search.md")
    raise typer.Exit(1 if progress.failed else 0)


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
