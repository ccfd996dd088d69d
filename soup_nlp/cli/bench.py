"""Commands bench: accuracy on suites, better defaults, the paper's tables, time, one scale."""

import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import pandas as pd

from soup_nlp.bench import search as searching
from soup_nlp.bench import speed as timing
from soup_nlp.bench.accuracy import measure_pair
from soup_nlp.bench.accuracy_page import write_suite
from soup_nlp.bench.chain import chain_page, measure_chain, sequences
from soup_nlp.bench.paper import make_plan, measure_paper, pairs_found
from soup_nlp.bench.paper_page import FILES, write_paper
from soup_nlp.bench.study import Cell, measure_cells, show
from soup_nlp.bench.suites import MOTORCYCLE, RENDERED, SUITES, Options, list_suite
from soup_nlp.cli import options
from soup_nlp.cli.options import Words, option
from soup_nlp.errors import ConfigError
from soup_nlp.schema.limits import MAX_NEIGHBOURS, MAX_SIDE, MAX_SUPERPIXELS
from soup_nlp.storage.files import write_text
from soup_nlp.storage.folders import claim, staged
from soup_nlp.storage.rows import MeasureRows, Row, measure_all

Suites = Annotated[Words, option(f"{', '.join(SUITES)}; may be repeated.", "--suite")]
Flow = Annotated[Words, option("Flow source instead of the suite's own; may be repeated.")]
Only = Annotated[Words, option("Only pairs whose name holds this word.")]
Width = Annotated[int, option("Columns of rendered scenes.", min=64, max=MAX_SIDE)]
Seeds = Annotated[str, option("Seeds of rendered scenes, such as 0,1,2.")]
SIZES: Mapping[str, Any] = {"min": 2, "max": MAX_SUPERPIXELS}


def mre_of(row: Row) -> str:
    """The main error of a row as text for the progress line."""
    return f"MRE {show(row['metrics'].get('solution', {}).get('mre'))}"


def _run(
    page: Path,
    measured: Callable[[Path, MeasureRows], pd.DataFrame],
    write: Callable[[Path, pd.DataFrame], None],
    quiet: bool,
    overwrite: bool,
    files: Sequence[str] = (),
    line: Callable[[Row], str] = mre_of,
    **running: Any,
) -> int:
    """Measure the rows of a study, write its page and print it; returns 1 if a row failed.

    Args:
        page: The page; its rows are in a .jsonl beside it.
        measured: Measures the rows into a file and returns their frame.
        write: Writes the page of a frame, and further `files` beside it.
        line: Text of a row for the progress line.
        running: Further options of `measure_all`.
    """
    out = claim(page.parent, [page.name, *files], overwrite)
    measure_rows = partial(measure_all, say=options.RowProgress(quiet, line), **running)
    rows = page.with_suffix(".jsonl")
    with options.resumable("the rows that were measured are kept", rows):
        frame = measured(rows, measure_rows)
    with staged(out, overwrite=overwrite) as new:
        write(new / page.name, frame)
        written = [name for name in (page.name, *files) if (new / name).is_file()]
    print(page.read_text(encoding="utf-8"))
    print(f"files       {out}/: {', '.join(written)}")
    return int(not frame["ok"].eq(True).all())


def _text(page_of: Callable[[pd.DataFrame], str]) -> Callable[[Path, pd.DataFrame], None]:
    """Writes a page without pictures."""
    return lambda path, frame: write_text(path, page_of(frame))


def _say(quiet: bool) -> Callable[[str], object]:
    """Prints a line on the pairs of a study, unless the command is quiet."""
    return lambda line: None if quiet else print(line, file=sys.stderr)


def _wanted(flow: list[str] | None, width: int, seeds: str, only: list[str] | None) -> Options:
    chosen = tuple(options.numbers(seeds, "--seeds"))
    return Options(tuple(flow or ()), width, chosen, tuple(only or ()))


def _command(name: str, data: Path | None, settings: Mapping[str, Any]) -> str:
    """A command as text, without the place of its data; an option may have several values."""
    words = ["--data DIR"] * (data is not None)
    for key, value in settings.items():
        values = value if isinstance(value, list) else [] if value is None else [value]
        words += [f"--{key} {shlex.quote(str(item))}" for item in values]
    return f"soup-nlp bench {name} {' '.join(words)}"


def accuracy(
    suite: Suites = None,
    data: options.Data = None,
    out: options.Out = Path("out/bench/accuracy"),
    overrides: options.Set = None,
    flow: Flow = None,
    width: Width = 1024,
    seeds: Seeds = "0",
    only: Only = None,
    workers: options.Workers = 1,
    name: Annotated[str, option("Name of the files of one suite.")] = "",
    overwrite: options.Overwrite = False,
    quiet: options.Quiet = False,
) -> int:
    """Depth against truth on a suite of pairs; interrupted runs can be continued."""
    if not suite:
        print("\n".join(f"{entry.name:<14} {entry.text}" for entry in SUITES.values()))
        raise ConfigError("no suite was named", where="--suite", expected=", ".join(SUITES))
    if name and len(suite) > 1:
        raise ConfigError("one name for several suites", where="--name", found=", ".join(suite))
    wanted, changes = _wanted(flow, width, seeds, only), tuple(overrides or ())
    suites = {each: list_suite(each, data, wanted, _say(quiet)) for each in suite}
    # check the names of all pages before the first suite is measured
    pages = {each: out / f"{name or each}.md" for each in suites}
    pictures = {each: page.with_suffix(".png").name for each, page in pages.items()}
    claim(out, [*(page.name for page in pages.values()), *pictures.values()], overwrite)
    codes = []
    for each, items in suites.items():
        note = f"Suite `{each}`: {SUITES[each].text}."
        measured = partial(measure_cells, [Cell(item, changes) for item in items], measure_pair)
        write, files = partial(write_suite, note=note), [pictures[each]]
        codes.append(_run(pages[each], measured, write, quiet, overwrite, files, workers=workers))
    return max(codes)


def search(
    suite: Suites = None,
    data: options.Data = None,
    out: options.Out = Path("out/bench/accuracy"),
    params: Annotated[Words, option("KEY=log|linear|int:LOW:HIGH instead.", "--param")] = None,
    trials: Annotated[int, option("Configurations beside the default.", min=1)] = 24,
    seeds: Seeds = "0,1",
    overrides: options.Set = None,
    flow: Flow = None,
    width: Width = 512,
    only: Only = None,
    workers: options.Workers = 1,
    overwrite: options.Overwrite = False,
    quiet: options.Quiet = False,
) -> int:
    """Search for better defaults and check them on the families that did not choose them."""
    suites, texts = suite or ["rendered"], params or searching.DEFAULT_SPACE
    wanted, space = _wanted(flow, width, seeds, only), searching.parse_space(texts)
    items = [i for name in suites for i in list_suite(name, data, wanted, _say(quiet))]
    settings = {"suite": suites, "trials": trials, "seeds": seeds, "width": width, "flow": flow}
    settings |= {"only": only, "param": params, "set": overrides}
    changes, command = tuple(overrides or ()), _command("search", data, settings)
    measured = partial(searching.search, space, items, trials=trials, overrides=changes)
    write = _text(partial(searching.search_page, space=texts, command=command))
    return _run(out / "search.md", measured, write, quiet, overwrite, workers=workers)


def paper(
    data: options.Data = None,
    out: options.Out = Path("results/paper"),
    superpixels: Annotated[int, option("N of the comparison.", **SIZES)] = 1000,
    analysis: Annotated[int, option("N of the other sections.", **SIZES)] = 500,
    limit: Annotated[int | None, option("At most this many pairs a dataset.", min=1)] = None,
    overrides: options.Set = None,
    workers: options.Workers = 1,
    overwrite: options.Overwrite = False,
    quiet: options.Quiet = False,
) -> int:
    """The paper's tables and figures by `preset: paper` and the defaults; can be continued."""
    changes = tuple(overrides or ())
    # checked here, too, since finding the pairs takes long
    claim(out, FILES, overwrite)
    plan = make_plan(data, out, superpixels, analysis, limit, changes)
    for line in pairs_found(plan):
        _say(quiet)(line)
    settings = {"superpixels": superpixels, "analysis": analysis, "limit": limit, "set": overrides}
    note = f"Superpixels wanted: {superpixels} in the comparison, {analysis} elsewhere."
    measured = partial(measure_cells, list(plan.drop_duplicates("key")["cell"]), measure_paper)
    command = _command("paper", data, settings)
    write = partial(write_paper, plan=plan, command=command, note=note)
    return _run(out / FILES[0], measured, write, quiet, overwrite, FILES[1:], workers=workers)


def speed(
    scenes: Annotated[str, option("Rendered scenes, motorcycle.")] = "street,room,motorcycle",
    sizes: Annotated[str, option("N.", "--superpixels", "--sizes")] = "250,500,1000,2000",
    neighbours: Annotated[str, option("K of the K-NN graph.")] = "10,15,20",
    seeds: Seeds = "0,1",
    pairs: Annotated[str, option("Words of names of pairs of the suite shared.")] = "",
    data: options.Data = None,
    widths: Annotated[str, option("Columns of rendered scenes.", "--width", "--widths")] = "1024",
    overrides: options.Set = None,
    out: options.Out = Path("out/bench/speed"),
    name: Annotated[str, option("Name of the page.")] = "table",
    overwrite: options.Overwrite = False,
    quiet: options.Quiet = False,
) -> int:
    """Time solves over N, K and image size, each in a process of its own; resumes what is stored.

    The refinement is left out; --set refine.enabled=true measures whole solves.
    """
    chosen, known_scenes = options.listed(scenes), [*RENDERED, MOTORCYCLE.name]
    if not chosen or set(chosen) - set(known_scenes):
        raise ConfigError(
            "unknown scene", where="--scenes", found=scenes, expected=", ".join(known_scenes)
        )
    columns = options.numbers(widths, "--widths", 64, MAX_SIDE)
    items = timing.timed_pairs(
        chosen, options.numbers(seeds, "--seeds"), columns, options.listed(pairs), data
    )
    n = options.numbers(sizes, "--superpixels", 2, MAX_SUPERPIXELS)
    k = options.numbers(neighbours, "--neighbours", 1, MAX_NEIGHBOURS)
    cells = timing.speed_cells(items, n, k, overrides or [])
    measured = partial(measure_cells, cells, timing.measure_speed)
    page, write, line = out / f"{name}.md", _text(timing.speed_page), lambda row: row["status"]
    return _run(page, measured, write, quiet, overwrite, line=line, fresh=True)


def chain(
    data: options.Data = None,
    only: Only = None,
    overrides: options.Set = None,
    out: options.Out = Path("out/bench/accuracy"),
    overwrite: options.Overwrite = False,
    quiet: options.Quiet = False,
) -> int:
    """What one scale costs on rendered sequences, and on kitti_tracking in the --data folder."""
    all_sequences = sequences(data)
    chosen = [i for i in all_sequences if not only or any(word in i.name for word in only)]
    if not chosen:
        names = ", ".join(i.name for i in all_sequences)
        raise ConfigError("no sequence is left", where="--only", expected=names)
    cells = [Cell(item, tuple(overrides or ())) for item in chosen]
    measured = partial(measure_cells, cells, measure_chain)
    page, write, line = out / "chain.md", _text(chain_page), lambda row: show(row["cost"], "+.2%")
    return _run(page, measured, write, quiet, overwrite, line=line, fresh=True)
