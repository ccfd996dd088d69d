"""Commands bench: accuracy on suites, better defaults, the paper's tables, time, one scale."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
import typer

from soup_nlp.bench import search as searching
from soup_nlp.bench import speed as timing
from soup_nlp.bench.accuracy import measure_pair
from soup_nlp.bench.accuracy_page import write_suite
from soup_nlp.bench.paper import make_plan, measure_paper
from soup_nlp.bench.paper_page import FILES, write_paper
from soup_nlp.bench.study import Cell, measure_cells, show
from soup_nlp.bench.suites import MOTORCYCLE, RENDERED, SUITES, Options, list_suite
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
    listed,
    numbers,
)
from soup_nlp.errors import ConfigError
from soup_nlp.schema.limits import MAX_NEIGHBOURS, MAX_SIDE, MAX_SUPERPIXELS
from soup_nlp.storage.files import write_text
from soup_nlp.storage.folders import claim, staged
from soup_nlp.storage.rows import MeasureRows, Row, measure_all

Suites = Annotated[
    list[str] | None, typer.Option("--suite", help=f"{', '.join(SUITES)}; may be repeated.")
]
Flow = Annotated[
    list[str] | None, typer.Option(help="Flow source instead of the suite's own; may be repeated.")
]
Only = Annotated[list[str] | None, typer.Option(help="Only pairs whose name holds this word.")]
Width = Annotated[int, typer.Option(help="Columns of rendered scenes.", min=64, max=MAX_SIDE)]
Seeds = Annotated[str, typer.Option(help="Seeds of rendered scenes, such as 0,1,2.")]
SIZES: Mapping[str, Any] = {"min": 2, "max": MAX_SUPERPIXELS}
Measured = Callable[[Path, MeasureRows], pd.DataFrame]
"""Measures the rows of a study into a file and returns their frame."""
Write = Callable[[Path, pd.DataFrame], None]
"""Writes the page of a frame, and its pictures beside it."""


def _study(
    page: Path,
    measured: Measured,
    write: Write,
    quiet: bool,
    overwrite: bool,
    files: Sequence[str] = (),
    result_of: Callable[[Row], str] | None = None,
    **options: Any,
) -> int:
    """Measure the rows of a study, write and print its page; 1 if a row failed.

    Args:
        page: The page; its rows are in a .jsonl beside it.
        measured: See Measured.
        write: See Write.
        quiet: Print no progress.
        overwrite: Also over files of the user.
        files: Further files that `write` may write.
        result_of: Text of a row for the progress line; by default its MRE.
        options: Further options of `measure_all`.
    """
    claim(page.parent, [page.name, *files], overwrite)
    say = RowProgress(quiet, result_of or mre_of)
    frame = measured(page.with_suffix(".jsonl"), partial(measure_all, say=say, **options))
    with staged(page.parent) as new:
        write(new / page.name, frame)
        written = [name for name in (page.name, *files) if (new / name).is_file()]
    print(page.read_text(encoding="utf-8"))
    print(f"files       {page.parent}/: {', '.join(written)}")
    return int(frame["ok"].ne(True).any())


def _text(page_of: Callable[[pd.DataFrame], str]) -> Write:
    """Writes a page without pictures."""
    return lambda path, frame: write_text(path, page_of(frame))


def mre_of(row: Row) -> str:
    """The main error of a row as text for the progress line."""
    return f"MRE {show(row['metrics'].get(row['presets'][0], {}).get('solution', {}).get('mre'))}"


def _wanted(flow: list[str] | None, width: int, seeds: str, only: list[str] | None) -> Options:
    chosen = tuple(numbers(seeds, "--seeds"))
    return Options(tuple(flow or ()), width, chosen, tuple(only or ()))


def _command(name: str, data: Path | None, options: Mapping[str, Any]) -> str:
    """A command as text, without the place of its data; an option may have several values."""
    words = ["--data DIR"] * (data is not None)
    for key, value in options.items():
        values = value if isinstance(value, list) else [] if value is None else [value]
        words += [f"--{key} {shlex.quote(str(item))}" for item in values]
    return f"soup-nlp bench {name} {' '.join(words)}"


def accuracy(
    suite: Suites = None,
    data: Data = None,
    out: Out = Path("out/bench/accuracy"),
    overrides: Set = None,
    flow: Flow = None,
    width: Width = 1024,
    seeds: Seeds = "0",
    only: Only = None,
    workers: Workers = 1,
    name: Annotated[str, typer.Option(help="Name of the files of one suite.")] = "",
    any_code: AnyCode = False,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Depth against truth on a suite of pairs; interrupted runs can be continued."""
    if not suite:
        print("\n".join(f"{entry.name:<14} {entry.text}" for entry in SUITES.values()))
        raise ConfigError("no suite was named", where="--suite", expected=", ".join(SUITES))
    if name and len(suite) > 1:
        raise ConfigError("one name for several suites", where="--name", found=", ".join(suite))
    wanted, changes = _wanted(flow, width, seeds, only), tuple(overrides or ())
    say = None if quiet else partial(print, file=sys.stderr)
    cells = {
        suite_name: [Cell(i, changes) for i in list_suite(suite_name, data, wanted, say)]
        for suite_name in suite
    }
    # check all names before the first suite is measured
    claim(
        out,
        [f"{name or suite_name}.{kind}" for suite_name in cells for kind in ("md", "png")],
        overwrite,
    )
    codes = []
    for suite_name in cells:
        note = f"Suite `{suite_name}`: {SUITES[suite_name].text}. Overrides of every pair: "
        note += f"{', '.join(f'`{o}`' for o in changes) or 'none'}."
        codes.append(
            _study(
                out / f"{name or suite_name}.md",
                partial(measure_cells, cells[suite_name], measure_pair),
                partial(write_suite, note=note),
                quiet,
                overwrite,
                [f"{name or suite_name}.png"],
                workers=workers,
                any_code=any_code,
            )
        )
    raise typer.Exit(max(codes))


def search(
    suite: Suites = None,
    data: Data = None,
    out: Out = Path("out/bench/accuracy"),
    params: Annotated[
        list[str] | None,
        typer.Option("--param", help="KEY=log|linear|int:LOW:HIGH instead; may be repeated."),
    ] = None,
    trials: Annotated[int, typer.Option(help="Configurations beside the default.", min=1)] = 24,
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
    suites, texts = suite or ["rendered"], params or searching.DEFAULT_SPACE
    wanted, space = _wanted(flow, width, seeds, only), searching.parse_space(texts)
    items = [i for name in suites for i in list_suite(name, data, wanted)]
    settings = {"suite": suites, "trials": trials, "seeds": seeds, "width": width, "flow": flow}
    settings |= {"only": only, "param": params, "set": overrides}
    command = _command("search", data, settings)
    changes = tuple(overrides or ())
    code = _study(
        out / "search.md",
        partial(searching.search, space, items, trials=trials, overrides=changes),
        _text(partial(searching.search_page, space=texts, command=command)),
        quiet,
        overwrite,
        workers=workers,
        any_code=any_code,
    )
    raise typer.Exit(code)


def paper(
    data: Data = None,
    out: Out = Path("results/paper"),
    superpixels: Annotated[int, typer.Option(help="N of the comparison.", **SIZES)] = 1000,
    analysis: Annotated[int, typer.Option(help="N of the other sections.", **SIZES)] = 500,
    limit: Annotated[
        int | None, typer.Option(help="At most this many pairs a dataset.", min=1)
    ] = None,
    overrides: Set = None,
    workers: Workers = 1,
    any_code: AnyCode = False,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """The paper's tables and figures by `preset: paper` and the defaults; can be continued."""
    changes = tuple(overrides or ())
    claim(out, FILES, overwrite)
    plan = make_plan(data, out, superpixels, analysis, limit, changes)
    settings = {"superpixels": superpixels, "analysis": analysis, "limit": limit, "set": overrides}
    note = f"Superpixels wanted: {superpixels} in the comparison, {analysis} elsewhere."
    if changes:
        note += f" Overrides of every row: {', '.join(f'`{o}`' for o in changes)}."
    code = _study(
        out / FILES[0],
        partial(measure_cells, list(plan.drop_duplicates("key")["cell"]), measure_paper),
        partial(write_paper, plan=plan, command=_command("paper", data, settings), note=note),
        quiet,
        overwrite,
        FILES[1:],
        workers=workers,
        any_code=any_code,
    )
    raise typer.Exit(code)


def speed(
    scenes: Annotated[
        str, typer.Option(help="Rendered scenes and motorcycle, comma separated.")
    ] = "street,room,motorcycle",
    sizes: Annotated[
        str, typer.Option("--superpixels", "--sizes", help="Superpixels N.")
    ] = "250,500,1000,2000",
    neighbours: Annotated[str, typer.Option(help="K of the K-NN graph.")] = "10,15,20",
    seeds: Seeds = "0,1",
    pairs: Annotated[
        str, typer.Option(help="Pairs of the suite shared, comma separated words of their names.")
    ] = "",
    data: Data = None,
    width: Width = 1024,
    overrides: Set = None,
    out: Out = Path("out/bench/speed"),
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Time the solver over N and K, each run in a process of its own; resumes what is stored."""
    chosen, known_scenes = listed(scenes), [*RENDERED, MOTORCYCLE.name]
    if not chosen or set(chosen) - set(known_scenes):
        raise ConfigError(
            "unknown scene", where="--scenes", found=scenes, expected=", ".join(known_scenes)
        )
    items = timing.timed_pairs(chosen, numbers(seeds, "--seeds"), width, listed(pairs), data)
    n = numbers(sizes, "--superpixels", 2, MAX_SUPERPIXELS)
    k = numbers(neighbours, "--neighbours", 1, MAX_NEIGHBOURS)
    cells = timing.speed_cells(items, n, k, overrides or [])
    measured = partial(measure_cells, cells, timing.measure_speed, own_process=True)
    page, write, line = out / "table.md", _text(timing.speed_page), timing.progress_line
    raise typer.Exit(_study(page, measured, write, quiet, overwrite, result_of=line))


def cost(
    out: Out = Path("out/bench/speed"), overwrite: Overwrite = False, quiet: Quiet = False
) -> None:
    """Time and memory of whole solves over N and image size, each in a process of its own."""
    measured = partial(measure_cells, cost_cells(), measure_pair, own_process=True)
    raise typer.Exit(_study(out / "cost.md", measured, _text(cost_page), quiet, overwrite))


def chain(
    data: Data = None,
    only: Only = None,
    overrides: Set = None,
    out: Out = Path("out/bench/accuracy"),
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """What one scale costs on rendered sequences, and on kitti_tracking in the --data folder."""
    all_sequences = sequences(data)
    chosen = [i for i in all_sequences if not only or any(word in i.name for word in only)]
    if not chosen:
        names = ", ".join(i.name for i in all_sequences)
        raise ConfigError("no sequence is left", where="--only", expected=names)
    cells = [Cell(item, tuple(overrides or ())) for item in chosen]
    measured = partial(measure_cells, cells, measure_chain, own_process=True)
    page, write = out / "chain.md", _text(chain_page)
    line = lambda row: f"cost of one scale {show(row['cost'], '+.2%')}"  # noqa: E731
    raise typer.Exit(_study(page, measured, write, quiet, overwrite, result_of=line))
