"""Commands bench accuracy (suites against truth and rivals) and bench search (defaults)."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from soup_nlp.bench.accuracy import Job, Row
from soup_nlp.bench.accuracy_runner import Where, measure_all
from soup_nlp.bench.accuracy_table import get, reason, report, show
from soup_nlp.bench.suites import SUITES, Options, list_suite
from soup_nlp.errors import ConfigError
from soup_nlp.evaluate.protocols import preset
from soup_nlp.storage.atomic import write_text

SuiteName = Annotated[
    list[str] | None, typer.Option("--suite", help=f"{', '.join(SUITES)}; may be repeated.")
]
Data = Annotated[Path | None, typer.Option(help="Root folder of the dataset.")]
Out = Annotated[Path, typer.Option("--out", "-o", help="Folder of rows, tables and plots.")]
Set = Annotated[list[str] | None, typer.Option("--set", help="Override of every problem.")]
Flow = Annotated[
    list[str] | None, typer.Option(help="Flow source instead of the suite's own; may be repeated.")
]
Width = Annotated[int, typer.Option(help="Columns of rendered scenes.", min=64)]
Seeds = Annotated[str, typer.Option(help="Seeds of rendered scenes, such as 0,1,2.")]
Only = Annotated[list[str] | None, typer.Option(help="Only pairs whose name holds this word.")]
Limit = Annotated[int | None, typer.Option(help="At most this many pairs a suite.", min=1)]
Workers = Annotated[int, typer.Option(help="Processes of this machine (extra: bench).", min=1)]
Dask = Annotated[str, typer.Option(help="Address of a Dask scheduler (extra: dask).")]
AnyCode = Annotated[bool, typer.Option(help="Also take stored rows of other code versions.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")]


def register(bench: typer.Typer) -> None:
    """Add the commands to the group."""
    bench.command(name="accuracy")(accuracy)
    bench.command(name="search")(search)


def numbers(text: str, option: str) -> tuple[int, ...]:
    """Whole numbers of a comma-separated list.

    Raises:
        ConfigError: it is none.
    """
    try:
        return tuple(int(x) for x in text.split(","))
    except ValueError:
        raise ConfigError(
            "not a list of whole numbers", where=option, found=text, expected="0,1,2"
        ) from None


class Progress:
    """Pairs done and time left: one rewritten line on a terminal, a line a pair in a log.

    `failed` counts the rows that failed: they are never stored ones.
    """

    def __init__(self, quiet: bool) -> None:
        self.quiet = quiet
        self.live = sys.stderr.isatty()
        self.spent: list[float] = []
        self.failed = 0

    def __call__(self, done: int, total: int, row: Row) -> None:
        """A new row."""
        self.failed += not row["ok"]
        if self.quiet:
            return
        self.spent.append(float(row["seconds"]))
        left = sum(self.spent) / len(self.spent) * (total - done)
        if row["ok"]:
            main = row["presets"][0]
            result = f"MRE {show(get(row, main, 'solution'))}"
        else:
            result = f"failed: {reason(row)}"
        line = f"{done}/{total}  {row['key']}  {result}  {row['seconds']:.0f} s"
        if total > done:
            line += f"  (about {left:.0f} s of work left)"
        if self.live:
            print(f"\r\x1b[2K{line}", end="\n" if done == total else "", file=sys.stderr)
        else:
            print(line, file=sys.stderr)
        sys.stderr.flush()


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
    limit: Limit = None,
    workers: Workers = 1,
    dask: Dask = "",
    folders: Annotated[Path | None, typer.Option(help="Keep every result folder here.")] = None,
    conventions: Annotated[
        list[str] | None, typer.Option("--preset", help="Metric convention; may be repeated.")
    ] = None,
    any_code: AnyCode = False,
    quiet: Quiet = False,
) -> None:
    """Depth against truth on a suite of pairs; stopped runs go on where they were."""
    from soup_nlp.bench.analyses import ANALYSES, run_analysis, split_values

    if analysis == "list":
        for name, entry in ANALYSES.items():
            print(f"{name:<12} {entry.text}")
        return
    if not suite and not analysis:
        for name, known in SUITES.items():
            print(f"{name:<14} {known.text}")
        raise ConfigError("no suite was named", where="--suite", expected=", ".join(SUITES))
    for name in conventions or []:
        preset(name)
    options = Options(
        flows=tuple(flow) if flow else None,
        width=width,
        seeds=numbers(seeds, "--seeds"),
        limit=limit,
        only=tuple(only or ()),
    )
    where, progress = Where(workers, dask), Progress(quiet)
    names: Sequence[str] = suite or ["rendered"]
    if analysis:
        if folders:
            raise ConfigError(
                "result folders are kept of suites, not of analyses",
                where="--folders",
                found=f"--analysis {analysis}",
                hint="give one without the other",
            )
        path = run_analysis(
            analysis,
            [list_suite(name, data, options) for name in names],
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
    # a worker of a cluster is at home in another folder
    folders = folders.expanduser().resolve() if folders else None
    failed = 0
    for name in names:
        listing = list_suite(name, data, options)
        if not quiet:
            print(listing, file=sys.stderr)
        jobs = [
            Job(
                item if not conventions else item.scored_by(tuple(conventions)),
                tuple(overrides or ()),
                folder=folders / item.key.replace(" ", "_") if folders else None,
            )
            for item in listing.items
        ]
        rows = measure_all(jobs, out / f"{name}.jsonl", where, say=progress, any_code=any_code)
        failed += sum(not row["ok"] for row in rows)
        note = f"Suite `{name}`: {listing.suite.text}."
        if overrides:
            note += f" Overrides: {', '.join(f'`{o}`' for o in overrides)}."
        write_text(out / f"{name}.md", report(f"Accuracy on {name}", rows, note))
        print((out / f"{name}.md").read_text(encoding="utf-8"))
        print(f"files       {out / name}.md, {out / name}.jsonl")
    raise typer.Exit(1 if failed else 0)


def search(
    suite: SuiteName = None,
    data: Data = None,
    out: Out = Path("results/accuracy"),
    params: Annotated[
        list[str] | None,
        typer.Option("--param", help="KEY=log|linear|int:LOW:HIGH or KEY=choice:A:B instead."),
    ] = None,
    trials: Annotated[int, typer.Option(help="Configurations beside the default.", min=1)] = 24,
    finalists: Annotated[int, typer.Option(help="Best trials that are validated.", min=1)] = 3,
    seed: Annotated[int, typer.Option(help="Of the trials.", min=0)] = 0,
    seeds: Seeds = "0,1",
    validation_seeds: Annotated[
        str, typer.Option(help="Seeds of rendered scenes that only validate.")
    ] = "2,3",
    overrides: Set = None,
    flow: Flow = None,
    width: Width = 512,
    only: Only = None,
    workers: Workers = 1,
    dask: Dask = "",
    any_code: AnyCode = False,
    quiet: Quiet = False,
) -> None:
    """Search for better defaults on some pairs and check them on others; OUT/search.md, .jsonl."""
    from soup_nlp.bench.tuning import DEFAULT_SPACE, parameter, split
    from soup_nlp.bench.tuning import search as run_search
    from soup_nlp.bench.tuning_report import text_search

    ours, theirs = numbers(seeds, "--seeds"), numbers(validation_seeds, "--validation-seeds")
    options = Options(
        flows=tuple(flow) if flow else None,
        width=width,
        seeds=tuple(dict.fromkeys((*ours, *theirs))),
        only=tuple(only or ()),
    )
    space = tuple(parameter(p) for p in params) if params else DEFAULT_SPACE
    items = [i for name in suite or ["rendered"] for i in list_suite(name, data, options).items]
    train, validation = split(items, ours, theirs)
    if not quiet:
        print(
            f"{trials} trials of {len(space)} settings on {len(train)} pairs,"
            f" {len(validation)} validate",
            file=sys.stderr,
        )
    progress = Progress(quiet)
    found = run_search(
        space,
        train,
        validation,
        out / "search.jsonl",
        trials=trials,
        finalists=finalists,
        seed=seed,
        overrides=tuple(overrides or ()),
        where=Where(workers, dask),
        say=progress,
        any_code=any_code,
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
