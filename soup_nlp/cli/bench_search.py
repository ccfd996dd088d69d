"""Command bench search: better defaults, chosen on some pairs and checked on others."""

from __future__ import annotations

import sys
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from soup_nlp.bench.rows import measure_all
from soup_nlp.bench.suite_pairs import Options
from soup_nlp.bench.suites import list_suite
from soup_nlp.bench.tuning import DEFAULT_SPACE, parameter, split
from soup_nlp.bench.tuning import search as run_search
from soup_nlp.bench.tuning_report import text_search
from soup_nlp.cli import options
from soup_nlp.cli.bench_accuracy import mre_of
from soup_nlp.cli.options import Progress, numbers
from soup_nlp.storage.atomic import write_text


def search(
    suite: options.SuiteName = None,
    data: options.Data = None,
    out: options.Out = Path("results/accuracy"),
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
    quiet: options.Quiet = False,
) -> None:
    """Search for better defaults and check them on pairs and families that did not choose."""
    ours, theirs = numbers(seeds, "--seeds"), numbers(validation_seeds, "--validation-seeds")
    whose = Options(
        flows=tuple(flow) if flow else None,
        width=width,
        seeds=tuple(dict.fromkeys((*ours, *theirs))),
        only=tuple(only or ()),
    )
    space = tuple(parameter(p) for p in params) if params else DEFAULT_SPACE
    items = [i for name in suite or ["rendered"] for i in list_suite(name, data, whose).items]
    train, validation = split(items, ours, theirs)
    if not quiet:
        print(
            f"{trials} trials of {len(space)} settings on {len(train)} pairs,"
            f" {len(validation)} validate",
            file=sys.stderr,
        )
    progress = Progress(quiet, mre_of)
    found = run_search(
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
    write_text(out / "search.md", text_search(found, f"soup-nlp bench search {' '.join(words)}"))
    print((out / "search.md").read_text(encoding="utf-8"))
    print(f"files       {out}/search.md, {out}/search.jsonl")
    raise typer.Exit(1 if progress.failed else 0)
