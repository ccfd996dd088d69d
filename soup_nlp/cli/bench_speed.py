"""Commands bench speed, cost and chain: seconds and growth, memory, one scale of a sequence."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Annotated, NoReturn

import pandas as pd
import typer

from soup_nlp.bench import speed as timing
from soup_nlp.bench.accuracy import measure_pair
from soup_nlp.bench.study import Cell, Measure, measure_cells, show
from soup_nlp.bench.suites import Options, list_suite
from soup_nlp.bench.tables import chain_page, cost_cells, cost_page, measure_chain, sequences
from soup_nlp.cli.bench_accuracy import Only, Width
from soup_nlp.cli.options import Data, Out, Overwrite, Quiet, RowProgress, Set, numbers, words
from soup_nlp.data.scenes.catalogue import SCENES
from soup_nlp.errors import ConfigError
from soup_nlp.schema.limits import MAX_NEIGHBOURS, MAX_SIDE, MAX_SUPERPIXELS
from soup_nlp.storage.atomic import write_text
from soup_nlp.storage.folders import claim, staged
from soup_nlp.storage.rows import Row, measure_all


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


def _failed(frame: pd.DataFrame) -> int:
    return int(frame["ok"].ne(True).sum())


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
