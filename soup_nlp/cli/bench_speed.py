"""Command bench speed: seconds, growth and energy, and the gate on their ratios."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from soup_nlp.bench.processes import machine
from soup_nlp.bench.speed import plan, problem_of
from soup_nlp.bench.speed_gate import baseline, check, read_baseline
from soup_nlp.bench.speed_report import SPEED
from soup_nlp.bench.studies import Settings, run_study
from soup_nlp.cli.options import Out, Overwrite, Progress, Quiet, Set, Width, numbers, words
from soup_nlp.data.scenes.catalogue import SCENES
from soup_nlp.schema.limits import MAX_NEIGHBOURS, MAX_SIDE, MAX_SUPERPIXELS
from soup_nlp.storage.atomic import write_text
from soup_nlp.storage.rows import Row, failed


def speed(
    scenes: Annotated[
        str, typer.Option(help="Rendered scenes and motorcycle, comma separated.")
    ] = "street,room,motorcycle",
    sizes: Annotated[
        str, typer.Option("--superpixels", "--sizes", help="Superpixels N.")
    ] = "250,500,1000,2000",
    neighbours: Annotated[str, typer.Option(help="K of the K-NN graph.")] = "10,15,20",
    seeds: Annotated[str, typer.Option(help="Seeds of the rendered scenes.")] = "0,1",
    width: Width = 1024,
    height: Annotated[
        int, typer.Option(help="Rows of rendered scenes.", min=48, max=MAX_SIDE)
    ] = 436,
    overrides: Set = None,
    gate: Annotated[
        Path | None,
        typer.Option("--check", help="Measure the runs of this baseline and compare ratios."),
    ] = None,
    write_baseline: Annotated[
        Path | None, typer.Option(help="Write the measurement as a baseline.")
    ] = None,
    out: Out = Path("out/bench/speed"),
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Time the solver over N and K, each run in a process of its own; resumes what is stored."""
    kept = [] if gate is None else read_baseline(gate)
    settings: Sequence[Settings] = [run.settings for run in kept] or plan(
        words(scenes, "--scenes", [*SCENES, "motorcycle"]),
        numbers(sizes, "--superpixels", 2, MAX_SUPERPIXELS),
        numbers(neighbours, "--neighbours", 1, MAX_NEIGHBOURS),
        numbers(seeds, "--seeds"),
        width=width,
        height=height,
        overrides=overrides or [],
    )
    for own in settings:
        # check the overrides now instead of after an hour
        problem_of(**own)
    if write_baseline is not None and os.path.lexists(write_baseline) and not overwrite:
        # raises an error if the file is no baseline
        read_baseline(write_baseline)
    say = Progress(quiet, _result_of)
    rows = run_study(SPEED, out, settings, say, page=not kept, overwrite=overwrite)
    if write_baseline is not None:
        write_text(write_baseline, json.dumps(baseline(rows, machine()), indent=1) + "\n")
    if kept:
        findings = list(check(rows, kept))
        print(*findings, sep="\n")
        bad = sum(not f.ok for f in findings)
        print(f"{bad} of {len(findings)} values are worse" if bad else "the gate holds")
    else:
        bad = sum(map(failed, rows))
        print(f"{len(rows)} runs, {bad} failed, in {out / SPEED.name}.md")
    raise typer.Exit(1 if bad else 0)


def _result_of(record: Row) -> str:
    """The result of a run as text for the progress line."""
    y = record["reference"]
    return (
        f"{record['status']}, {record['cpu']['nlp']:.1f} CPU s, {record['iterations']}"
        f" iterations, E {record['energy']['total']:.4g};"
        f" LM {y['cpu_seconds']:.1f} CPU s, E {y['energy']['total']:.4g}"
    )
