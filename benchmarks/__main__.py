"""The command line of the benchmarks."""

import sys
from functools import partial
from pathlib import Path
from typing import Annotated

import pandas as pd
import typer

from benchmarks import chain as chains
from benchmarks import paper as papers
from benchmarks import speed as speeds
from benchmarks.accuracy import comparison, read_pages, suite_page
from benchmarks.family.instances import (
    FORMULATIONS,
    SCENES,
    SIZES,
    STANDARD,
    STARTS,
    VERSION,
    select,
)
from benchmarks.family.write import check_sol, family_tasks, write_family
from benchmarks.scores import measure_pair
from benchmarks.sigma import sigma_page
from benchmarks.solvers import write_results
from benchmarks.suites import SUITES, Options, list_suite
from benchmarks.table import Cell, frame_of, measure
from soup_nlp import SoupError
from soup_nlp.errors import DataError
from soup_nlp.export.compare import compare as run_solvers
from soup_nlp.export.compare import page as solver_page
from soup_nlp.export.verify import Limits
from soup_nlp.storage.each import read_rows
from soup_nlp.storage.files import write_text

app = typer.Typer(
    no_args_is_help=True, pretty_exceptions_enable=False, help="Accuracy and speed, measured."
)
Words = list[str] | None
Suites = Annotated[list[str], typer.Option(help=f"{', '.join(SUITES)}; may be repeated.")]
Width = Annotated[int, typer.Option(min=64, help="Columns of rendered scenes.")]
Data = Annotated[Path | None, typer.Option(help="Root folder of the dataset.")]
Set = Annotated[Words, typer.Option("--set", help="Set any key; may be repeated.")]
Flow = Annotated[Words, typer.Option(help="Flow source instead of the suite's own.")]
Only = Annotated[Words, typer.Option(help="Only pairs whose name holds this word.")]
Workers = Annotated[int, typer.Option(min=1, help="Processes of this machine.")]
Out = Annotated[Path, typer.Option("--out", "-o", help="Folder of the pages and rows.")]


def listed(text: str) -> list[str]:
    """Different words of a comma-separated list."""
    return [*dict.fromkeys(word.strip() for word in text.split(",") if word.strip())]


def numbers(text: str) -> list[int]:
    """Different whole numbers of a comma-separated list."""
    try:
        return [int(word) for word in listed(text)]
    except ValueError:
        raise typer.BadParameter(f"{text!r} is no comma-separated list of whole numbers") from None


def finish(page: Path, frame: pd.DataFrame, text: str) -> int:
    """Write a page and print it; 1 if a row failed."""
    write_text(page, text)
    print(page.read_text(encoding="utf-8"))
    return int(not frame["ok"].eq(True).all())


@app.command()
def accuracy(
    suite: Suites,
    overrides: Set = None,
    flow: Flow = None,
    only: Only = None,
    data: Data = None,
    out: Out = Path("out/bench/accuracy"),
    width: Width = 1024,
    seeds: Annotated[str, typer.Option(help="Seeds of rendered scenes.")] = "0",
    workers: Workers = 1,
    cluster: Annotated[str | None, typer.Option(help="Dask scheduler, tcp://HOST:PORT.")] = None,
    name: Annotated[str, typer.Option(help="Name of the page of one suite.")] = "",
) -> int:
    """Depth against truth on suites of pairs; a run that was stopped goes on."""
    wanted = Options(tuple(flow or ()), width, tuple(numbers(seeds)), tuple(only or ()))
    codes, say = [], partial(print, file=sys.stderr)
    # a suite without data ends the command before anything is measured
    for each, items in {each: list_suite(each, data, wanted, say) for each in suite}.items():
        cells = [Cell(item, tuple(overrides or ())) for item in items]
        page = out / f"{name or each}.md"
        frame = measure(cells, measure_pair, page, workers, cluster=cluster)
        text = suite_page(page, frame, f"Suite `{each}`: {SUITES[each].text}.")
        codes.append(finish(page, frame, text))
    return max(codes)


@app.command()
def sigma(folder: Path) -> int:
    """The factors of sigma, fitted to the rows of `accuracy`, families left out in turn."""
    rows = [row for file in sorted(folder.glob("*.jsonl")) for row in read_rows(file)]
    rows = [row for row in rows if "pixels" in row]
    if not rows:
        hint = "python -m benchmarks accuracy -o FOLDER"
        raise DataError("no rows with pixels", where=folder, found="no such .jsonl", hint=hint)
    frame = frame_of(rows).drop_duplicates("key", keep="last")
    page = folder / "sigma.md"
    return finish(page, frame, sigma_page(page, frame))


@app.command()
def compare(before: Path, after: Path) -> int:
    """Ratios of the MRE by family and half of two pages, or of two folders of pages."""
    print(comparison(read_pages(before), read_pages(after)))
    return 0


@app.command()
def paper(
    data: Data = None,
    out: Out = Path("results/paper"),
    superpixels: Annotated[int, typer.Option(help="N of the comparison.")] = 1000,
    analysis: Annotated[int, typer.Option(help="N of the other sections.")] = 500,
    limit: Annotated[int | None, typer.Option(min=1, help="Most pairs a dataset.")] = None,
    overrides: Set = None,
    workers: Workers = 1,
) -> int:
    """The paper's tables by `preset: paper` and the defaults; a run that was stopped goes on."""
    plan = papers.make_plan(data, superpixels, analysis, limit, tuple(overrides or ()))
    page, cells = out / "README.md", list(plan.drop_duplicates("key")["cell"])
    frame = measure(cells, measure_pair, page, workers)
    note = f"Superpixels wanted: {superpixels} in the comparison, {analysis} elsewhere."
    return finish(page, frame, papers.paper_page(page, frame, plan, note))


@app.command()
def speed(
    scenes: Annotated[str, typer.Option(help="Rendered ones, motorcycle.")] = "street,motorcycle",
    superpixels: Annotated[str, typer.Option(help="N.")] = "250,500,1000,2000",
    neighbours: Annotated[str, typer.Option(help="K of the K-NN graph.")] = "15",
    seeds: str = "0",
    widths: Annotated[str, typer.Option(help="Columns of rendered scenes.")] = "1024",
    overrides: Set = None,
    out: Out = Path("out/bench/speed"),
    name: Annotated[str, typer.Option(help="Name of the page.")] = "table",
) -> int:
    """Time solves over N, K and image size, each in a process of its own.

    The refinement is left out; --set refine.enabled=true measures whole solves.
    """
    pairs = listed(scenes), numbers(seeds), numbers(widths)
    sizes = numbers(superpixels), numbers(neighbours)
    cells, page = speeds.speed_cells(*pairs, *sizes, overrides or []), out / f"{name}.md"
    frame = measure(cells, speeds.measure_speed, page, fresh=True)
    return finish(page, frame, speeds.speed_page(page, frame))


@app.command()
def chain(
    data: Data = None,
    only: Only = None,
    overrides: Set = None,
    out: Out = Path("out/bench/accuracy"),
) -> int:
    """What one scale costs on rendered sequences, and on kitti_tracking in the --data folder."""
    chosen = [i for i in chains.sequences(data) if not only or any(w in i.name for w in only)]
    cells, page = [Cell(item, tuple(overrides or ())) for item in chosen], out / "chain.md"
    frame = measure(cells, chains.measure_chain, page)
    return finish(page, frame, chains.chain_page(frame))


# --- problems for solvers -------------------------------------------------------------------------


@app.command()
def family(
    out: Annotated[Path, typer.Argument(help="Folder of the set, new or of an earlier one.")],
    sizes: Annotated[str, typer.Option(help=f"Superpixels, of {SIZES}.")] = "100,250",
    scenes: str = ",".join(SCENES),
    formulation: Annotated[Words, typer.Option(help=f"Of {', '.join(FORMULATIONS)}.")] = None,
    starts: Annotated[
        str, typer.Option(help="easy (presolved), hard (initialisation), cold (constant depth).")
    ] = ",".join(STARTS),
) -> int:
    """Write the SOUP problem set: .nl files, best known points, index, README, licence."""
    chosen = select(numbers(sizes), listed(scenes), formulation or [STANDARD], listed(starts))
    entries = write_family(out, chosen)
    differing = sum(e["published"] is False for e in entries)
    print(f"{len(entries)} instances in {out}/; {differing} are not the published bytes")
    return int(differing > 0)


@app.command()
def check(sol: Annotated[Path, typer.Argument(help="NAME.sol of an instance of the set.")]) -> int:
    """Recompute objective and residuals of a solver's answer to an instance of the set."""
    text, good = check_sol(sol)
    print(text)
    return int(not good)


@app.command()
def solvers(
    folders: Annotated[list[Path], typer.Argument(help="Folders of `family`.")],
    names: Annotated[str, typer.Option("--solvers", help="As of `soup-nlp compare`.")] = "soup-nlp",
    seconds: Annotated[float, typer.Option(help="CPU time limit of a run.")] = 60.0,
    iterations: Annotated[int, typer.Option(help="Iteration limit of a run.")] = 300,
    out: Out = Path("out/bench/solvers"),
) -> int:
    """Run solvers on the set, verify their claims, draw profiles, write results.json."""
    limits = Limits(seconds, iterations)
    tasks = [task for folder in folders for task in family_tasks(folder)]
    rows = run_solvers(tasks, listed(names), limits, out / "runs.jsonl")
    table = write_results(out, rows, {"set": "SOUP", "version": VERSION})
    write_text(out / "README.md", solver_page(rows, limits) + "\n" + table)
    return int(not any(row.get("verified") for row in rows))


def main(words: list[str] | None = None) -> int:
    """Run a command; returns its exit code."""
    try:
        return int(app(words, standalone_mode=False) or 0)
    except SoupError as error:
        print(error, file=sys.stderr)
    except typer.BadParameter as error:
        print(error.format_message(), file=sys.stderr)
    except KeyboardInterrupt:
        print("interrupted: the rows that were measured are kept", file=sys.stderr)
        return 130
    return 2


if __name__ == "__main__":
    sys.exit(main())
