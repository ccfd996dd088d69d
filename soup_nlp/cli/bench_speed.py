"""Command bench speed: seconds, growth and energy, and the gate on their ratios."""

from __future__ import annotations

import json
from datetime import date
from pathlib import Path
from typing import Annotated

import typer

from soup_nlp.bench.processes import machine
from soup_nlp.bench.rows import Row, failed
from soup_nlp.bench.speed import measure_specs, plan, problem_of
from soup_nlp.bench.speed_gate import baseline, check, read_baseline
from soup_nlp.bench.speed_report import plot_energy, plot_growth, plot_phases, report
from soup_nlp.cli.options import Out, Progress, Quiet, Set, numbers, words
from soup_nlp.data.scenes.catalogue import SCENES
from soup_nlp.report.folder import prepare_folder
from soup_nlp.storage.atomic import write_text

QUICK = {"scenes": "street,room", "sizes": "250", "neighbours": "10", "seeds": "0"}
"""What --quick measures, on frames of half the width and height."""
RECORDS = "records.jsonl"


def speed(
    scenes: Annotated[
        str, typer.Option(help="Rendered scenes and motorcycle, comma separated.")
    ] = "street,room,motorcycle",
    sizes: Annotated[str, typer.Option(help="Superpixels N.")] = "250,500,1000,2000",
    neighbours: Annotated[str, typer.Option(help="K of the K-NN graph.")] = "10,15,20",
    seeds: Annotated[str, typer.Option(help="Seeds of the rendered scenes.")] = "0,1",
    width: Annotated[int, typer.Option(help="Columns of rendered scenes.", min=64)] = 1024,
    height: Annotated[int, typer.Option(help="Rows of rendered scenes.", min=48)] = 436,
    reference: Annotated[bool, typer.Option(help="Compare with Levenberg-Marquardt.")] = True,
    wide: Annotated[
        bool, typer.Option(help="Also Levenberg-Marquardt from a wide smoothing.")
    ] = False,
    overrides: Set = None,
    quick: Annotated[bool, typer.Option(help="Small frames, N = 250, two scenes.")] = False,
    gate: Annotated[
        Path | None,
        typer.Option("--check", help="Measure the runs of this baseline and compare ratios."),
    ] = None,
    write_baseline: Annotated[
        Path | None, typer.Option(help="Write the measurement as a baseline.")
    ] = None,
    fresh: Annotated[bool, typer.Option(help="Measure again what is stored.")] = False,
    table: Annotated[bool, typer.Option(help="Write the table and the plots.")] = True,
    out: Out = Path("results/speed"),
    quiet: Quiet = False,
) -> None:
    """Time the solver over N and K, each run in a process of its own; resumes what is stored."""
    kept = None
    if gate is not None:
        specs, kept = read_baseline(gate)
    else:
        if quick:
            scenes, sizes, neighbours, seeds = QUICK.values()
            width, height = width // 2, height // 2
        specs = plan(
            words(scenes, "--scenes", [*SCENES, "motorcycle"]),
            numbers(sizes, "--sizes", 2),
            numbers(neighbours, "--neighbours", 1),
            numbers(seeds, "--seeds"),
            width=width,
            height=height,
            references=("same",) * reference + ("wide",) * wide,
            overrides=tuple(overrides or ()),
        )
    for spec in specs:
        # a wrong override stops here, not after an hour
        problem_of(spec)
    prepare_folder(out)

    def after(rows: list[Row]) -> None:
        if table and gate is None:
            _write(out, rows)

    progress = Progress(quiet, _result_of)
    records = measure_specs(specs, out / RECORDS, fresh=fresh, say=progress, after=after)
    if write_baseline is not None:
        text = json.dumps(baseline(records, machine()), indent=1)
        write_text(write_baseline, text + "\n")
    if kept is not None:
        findings = check(records, kept)
        print("\n".join(str(f) for f in findings))
        bad = sum(not f.ok for f in findings)
        print(f"{bad} of {len(findings)} values are worse" if bad else "the gate holds")
        raise typer.Exit(1 if bad else 0)
    bad = sum(map(failed, records))
    print(f"{len(records)} runs, {bad} failed, in {out / RECORDS}")
    raise typer.Exit(1 if bad else 0)


def _result_of(record: Row) -> str:
    """The result of a run in a few words."""
    text = (
        f"{record['status']}, {record['cpu']['nlp']:.1f} CPU s, {record['iterations']}"
        f" iterations, E {record['energy']['total']:.4g}"
    )
    for kind, y in record["reference"].items():
        text += f"; LM {kind} {y['cpu_seconds']:.1f} CPU s, E {y['energy']['total']:.4g}"
    return text


def _write(out: Path, records: list[Row]) -> None:
    """Table, plots and the plain numbers of the runs."""
    good = [r for r in records if not failed(r)]
    write_text(out / "table.md", report(records, machine(), date.today().isoformat()))
    if good:
        plot_growth(out / "growth.png", good)
        plot_phases(out / "phases.png", good)
        plot_energy(out / "energy.png", good)
