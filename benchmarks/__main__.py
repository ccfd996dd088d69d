"""The command line of the benchmarks."""

import sys
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from benchmarks.accuracy import comparison, read_pages, write_suite
from benchmarks.scores import measure_pair
from benchmarks.suites import SUITES, Options, list_suite
from benchmarks.table import Cell, measure
from soup_nlp import SoupError

app = typer.Typer(
    no_args_is_help=True, pretty_exceptions_enable=False, help="Accuracy and speed, measured."
)
Words = list[str] | None
Data = Annotated[Path | None, typer.Option(help="Root folder of the dataset.")]
Set = Annotated[Words, typer.Option("--set", help="Set any key; may be repeated.")]
Flow = Annotated[Words, typer.Option(help="Flow source instead of the suite's own.")]
Only = Annotated[Words, typer.Option(help="Only pairs whose name holds this word.")]
Workers = Annotated[int, typer.Option(min=1, help="Processes of this machine.")]
Out = Annotated[Path, typer.Option("--out", "-o", help="Folder of the pages and rows.")]


def numbers(text: str) -> list[int]:
    """Different whole numbers of a comma-separated list."""
    try:
        return list(dict.fromkeys(int(word) for word in text.split(",")))
    except ValueError:
        raise typer.BadParameter(f"{text!r} is no comma-separated list of whole numbers") from None


@app.command()
def accuracy(
    suite: Annotated[list[str], typer.Option(help=f"{', '.join(SUITES)}; may be repeated.")],
    overrides: Set = None,
    flow: Flow = None,
    only: Only = None,
    data: Data = None,
    out: Out = Path("out/bench/accuracy"),
    width: Annotated[int, typer.Option(min=64, help="Columns of rendered scenes.")] = 1024,
    seeds: Annotated[str, typer.Option(help="Seeds of rendered scenes.")] = "0",
    workers: Workers = 1,
    name: Annotated[str, typer.Option(help="Name of the page of one suite.")] = "",
) -> int:
    """Depth against truth on suites of pairs; a run that was stopped goes on."""
    wanted = Options(tuple(flow or ()), width, tuple(numbers(seeds)), tuple(only or ()))
    say = partial(print, file=sys.stderr)
    suites = {each: list_suite(each, data, wanted, say) for each in suite}
    good = True
    for each, items in suites.items():
        page = out / f"{name or each}.md"
        cells = [Cell(item, tuple(overrides or ())) for item in items]
        frame = measure(cells, measure_pair, page.with_suffix(".jsonl"), workers)
        write_suite(page, frame, f"Suite `{each}`: {SUITES[each].text}.")
        print(page.read_text(encoding="utf-8"))
        good &= bool(frame["ok"].eq(True).all())
    return int(not good)


@app.command()
def compare(before: Path, after: Path) -> int:
    """Ratios of the MRE by family and half of two pages, or of two folders of pages."""
    print(comparison(read_pages(before), read_pages(after)))
    return 0


def main(words: list[str] | None = None) -> int:
    """Run a command; returns its exit code."""
    try:
        return int(app(words, standalone_mode=False) or 0)
    except SoupError as error:
        print(error, file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
