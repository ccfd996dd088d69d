"""Commands bench: accuracy on suites, better defaults, the paper's tables, time, one scale."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, NoReturn

import pandas as pd
import typer

from soup_nlp.bench import search as searching
from soup_nlp.bench import speed as timing
from soup_nlp.bench.accuracy import measure_pair
from soup_nlp.bench.accuracy_page import write_suite
from soup_nlp.bench.paper import ALL_SECTIONS, FAMILIES, Sizes, make_plan, measure_paper
from soup_nlp.bench.paper_page import FILES, write_page
from soup_nlp.bench.study import Cell, Measure, measure_cells, show
from soup_nlp.bench.suites import SUITES, Options, list_suite
from soup_nlp.bench.tables import chain_page, cost_cells, cost_page, measure_chain, sequences
from soup_nlp.cli.options import (
    AnyCode,
    Data,
    Out,
    Overwrite,
    Quiet,
    RowProgress,
    Set,
    Workers,
    numbers,
    words,
)
from soup_nlp.data.scenes.catalogue import SCENES
from soup_nlp.errors import ConfigError
from soup_nlp.evaluate.protocols import preset
from soup_nlp.schema.limits import MAX_NEIGHBOURS, MAX_SIDE, MAX_SUPERPIXELS
from soup_nlp.storage.files import write_text
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
    data: Data = None,
    out: Out = Path("out/bench/accuracy"),
    overrides: Set = None,
    flow: Flow = None,
    width: Width = 1024,
    seeds: Seeds = "0",
    only: Only = None,
    limit: Annotated[
        int | None, typer.Option(help="At most this many pairs a suite.", min=1)
    ] = None,
    workers: Workers = 1,
    folders: Annotated[Path | None, typer.Option(help="Keep every result folder here.")] = None,
    conventions: Annotated[
        list[str] | None, typer.Option("--preset", help="Metric convention; may be repeated.")
    ] = None,
    name: Annotated[str, typer.Option(help="Name of the files of one suite.")] = "",
    any_code: AnyCode = False,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
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


def _command(
    name: str, data: Path | None, overrides: list[str] | None, given: Mapping[str, Any]
) -> str:
    """A command as text, without the place of its data; an option may have several values."""
    said = ["--data DIR"] * (data is not None)
    for key, value in (*given.items(), ("set", overrides)):
        values = value if isinstance(value, list) else [] if value is None else [value]
        said += [f"--{key} {shlex.quote(str(item))}" for item in values]
    return f"soup-nlp bench {name} {' '.join(said)}"


def _failed(frame: pd.DataFrame) -> int:
    """Number of runs that failed."""
    return int(frame["ok"].ne(True).sum())


def _print_page(page: Path) -> None:
    print(page.read_text(encoding="utf-8"))
    print(f"files       {page.parent}/{page.stem}.*")


def search(
    suite: SuiteName = None,
    data: Data = None,
    out: Out = Path("out/bench/accuracy"),
    params: Annotated[
        list[str] | None,
        typer.Option("--param", help="KEY=log|linear|int:LOW:HIGH or KEY=choice:A:B instead."),
    ] = None,
    trials: Annotated[int, typer.Option(help="Configurations beside the default.", min=1)] = 24,
    seed: Annotated[int, typer.Option(help="Of the trials.", min=0)] = 0,
    seeds: Seeds = "0,1",
    overrides: Set = None,
    flow: Flow = None,
    width: Width = 512,
    only: Only = None,
    workers: Workers = 1,
    any_code: AnyCode = False,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
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
    given = {"suite": suite or ["rendered"], "trials": trials, "seed": seed, "seeds": seeds}
    given |= {"width": width, "flow": flow, "only": only}
    command = _command("search", data, overrides, given)
    with staged(out) as new:
        write_text(new / "search.md", searching.search_page(frame, texts, command))
    _print_page(out / "search.md")
    raise typer.Exit(1 if progress.failed else 0)


def paper(
    data: Data = None,
    out: Out = Path("results/paper"),
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
    overrides: Set = None,
    workers: Workers = 1,
    any_code: AnyCode = False,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
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
    given = {"superpixels": superpixels, "analysis": analysis, "families": families}
    given |= {"width": width, "sections": sections, "departures": departures, "limit": limit}
    claim(out, FILES, overwrite)
    plan, progress = make_plan(data, sizes, out), RowProgress(quiet, mre_of)
    run = partial(measure_all, workers=workers, say=progress, any_code=any_code)
    frame = measure_cells(plan.cells(), measure_paper, out / "paper.jsonl", run)
    with staged(out) as new:
        write_page(new, plan, frame, _command("paper", data, overrides, given))
    print(f"files       {out}/: {', '.join(FILES)}")
    raise typer.Exit(1 if _failed(frame) else 0)


def speed(
    scenes: Annotated[
        str, typer.Option(help="Rendered scenes and motorcycle, comma separated.")
    ] = "street,room,motorcycle",
    sizes: Annotated[
        str, typer.Option("--superpixels", "--sizes", help="Superpixels N.")
    ] = "250,500,1000,2000",
    neighbours: Annotated[str, typer.Option(help="K of the K-NN graph.")] = "10,15,20",
    seeds: Annotated[str, typer.Option(help="Seeds of the rendered scenes.")] = "0,1",
    pairs: Annotated[
        str | None, typer.Option(help="Pairs of the suite shared, comma separated.")
    ] = None,
    data: Data = None,
    width: Width = 1024,
    height: Annotated[
        int, typer.Option(help="Rows of rendered scenes.", min=48, max=MAX_SIDE)
    ] = 436,
    overrides: Set = None,
    out: Out = Path("out/bench/speed"),
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Time the solver over N and K, each run in a process of its own; resumes what is stored."""
    chosen = Options(flows=("dis",), only=tuple((pairs or "").split(",")))
    cells = timing.speed_cells(
        words(scenes, "--scenes", [*SCENES, "motorcycle"]),
        numbers(sizes, "--superpixels", 2, MAX_SUPERPIXELS),
        numbers(neighbours, "--neighbours", 1, MAX_NEIGHBOURS),
        numbers(seeds, "--seeds"),
        width,
        height,
        overrides or [],
        list_suite("shared", data, chosen).items if pairs else (),
    )
    claim(out, ("table.md", "growth.png"), overwrite)
    run = partial(measure_all, say=RowProgress(quiet, _result_of))
    frame = measure_cells(cells, timing.measure_speed, out / "table.jsonl", run, own_process=True)
    with staged(out) as new:
        write_text(new / "table.md", timing.speed_page(frame))
        timing.plot_growth(new / "growth.png", frame)
    bad = _failed(frame)
    print(f"{len(frame)} runs, {bad} failed, in {out / 'table.md'}")
    raise typer.Exit(1 if bad else 0)


def _result_of(row: Row) -> str:
    """The result of a run as text for the progress line."""
    reference = row["reference"]
    return (
        f"{row['status']}, {row['cpu']['nlp']:.1f} CPU s, {row['iterations']} iterations,"
        f" E {row['energy']['total']:.4g}; LM {reference['cpu_seconds']:.1f} CPU s,"
        f" E {reference['energy']['total']:.4g}"
    )


def cost(
    out: Out = Path("out/bench/speed"), overwrite: Overwrite = False, quiet: Quiet = False
) -> None:
    """Time and memory of whole solves over N and image size, each in a process of its own."""
    claim(out, ("cost.md",), overwrite)
    say = RowProgress(quiet, lambda row: f"{show(row['seconds'], '.0f')} s")
    _measure(cost_cells(), measure_pair, say, out / "cost.md", cost_page)


def _measure(
    cells: list[Cell],
    measure: Measure,
    say: RowProgress,
    path: Path,
    page: Callable[[pd.DataFrame], str],
) -> NoReturn:
    """Measure cells in processes of their own, write and print their page, and exit."""
    run = partial(measure_all, say=say)
    frame = measure_cells(cells, measure, path.with_suffix(".jsonl"), run, own_process=True)
    with staged(path.parent) as new:
        write_text(new / path.name, page(frame))
    print(path.read_text(encoding="utf-8"))
    raise typer.Exit(1 if _failed(frame) else 0)


def chain(
    data: Data = None,
    only: Only = None,
    frames: Annotated[int, typer.Option(help="Most frames of a sequence.", min=3)] = 10,
    overrides: Set = None,
    out: Out = Path("out/bench/accuracy"),
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """What one scale costs on rendered sequences, and on kitti_tracking in the --data folder."""
    known = sequences(data)
    chosen = [i for i in known if not only or any(word in i.name for word in only)]
    if not chosen:
        names = ", ".join(i.name for i in known)
        raise ConfigError("no sequence is left", where="--only", expected=names)
    claim(out, ("chain.md",), overwrite)
    cells = [Cell(item, tuple(overrides or ()), f"{frames} frames") for item in chosen]
    say = RowProgress(quiet, lambda row: f"cost of one scale {show(row['cost'], '+.2%')}")
    _measure(cells, partial(measure_chain, frames=frames), say, out / "chain.md", chain_page)
