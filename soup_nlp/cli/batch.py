"""Command batch: many pairs, a table and a folder of results."""

from pathlib import Path
from typing import Annotated

import typer

from soup_nlp.batches.page import summary
from soup_nlp.batches.run import FILES
from soup_nlp.batches.run import batch as solve_batch
from soup_nlp.batches.sources import DATASETS
from soup_nlp.cli import options
from soup_nlp.cli.options import option

PAIRS = f"pairs.csv, a folder of pairs, a pattern, or {':DIR, '.join(DATASETS)}:DIR."


def batch(
    pairs: Annotated[str, typer.Argument(help=PAIRS)],
    out: options.Out = Path("out/batch"),
    preset: options.PresetName = None,
    overrides: options.Set = None,
    superpixels: options.Wanted = None,
    neighbours: options.Neighbours = None,
    max_size: options.MaxSize = None,
    workers: options.Workers = 1,
    cluster: Annotated[
        str | None, option("Dask scheduler instead, tcp://HOST:PORT (docs/cluster.md).")
    ] = None,
    retry_failed: Annotated[bool, option("Solve failed pairs again.", "--retry-failed")] = False,
    overwrite: options.Overwrite = False,
    quiet: options.Quiet = False,
) -> int:
    """Solve many pairs, each into a folder of its own; goes on where it was stopped."""
    short = options.sizes(superpixels, neighbours, max_size)

    def mre(row: options.Row) -> str:
        known = row.get("mre")
        return row["reason"] if known is None else f"MRE {known:.4f}"

    with options.resumable("the pairs that were finished are kept", out):
        done = solve_batch(
            pairs,
            out,
            overrides=options.changed(preset, overrides, short),
            workers=workers,
            cluster=cluster,
            retry_failed=retry_failed,
            overwrite=overwrite,
            say=options.RowProgress(quiet, mre),
        )
    print(summary(done.rows, len(done.rows)))
    print(f"files       {out}/: {', '.join(FILES)}, pairs/")
    return options.finish(done.good, "every pair is solved" if done.good else "a pair failed")
