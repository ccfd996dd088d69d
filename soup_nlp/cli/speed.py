"""Command bench speed: seconds, growth and energy against a yardstick, and the gate on them."""

from __future__ import annotations

import json
import sys
from datetime import date
from pathlib import Path
from typing import Annotated

import typer

from soup_nlp.bench.machine import machine
from soup_nlp.bench.speed import Record, measure_all, plan
from soup_nlp.bench.speed_gate import baseline, check, read_baseline
from soup_nlp.bench.speed_plot import plot_energy, plot_growth, plot_phases
from soup_nlp.bench.speed_table import report
from soup_nlp.bench.timed import problem_of
from soup_nlp.data.scenes.catalogue import SCENES
from soup_nlp.errors import ConfigError
from soup_nlp.report.folder import prepare_folder
from soup_nlp.storage.atomic import write_text

QUICK = {"scenes": "street,room", "sizes": "250", "neighbours": "10", "seeds": "0"}
"""What --quick measures, on frames of half the width and height."""
RECORDS = "records.jsonl"


def register(bench: typer.Typer) -> None:
    """Add the command to the group."""
    bench.command(name="speed")(speed)


def speed(
    scenes: Annotated[
        str, typer.Option(help="Rendered scenes and motorcycle, comma separated.")
    ] = "street,room,motorcycle",
    sizes: Annotated[str, typer.Option(help="Superpixels N.")] = "250,500,1000,2000",
    neighbours: Annotated[str, typer.Option(help="K of the K-NN graph.")] = "10,15,20",
    seeds: Annotated[str, typer.Option(help="Seeds of the rendered scenes.")] = "0,1",
    width: Annotated[int, typer.Option(help="Columns of rendered scenes.", min=64)] = 1024,
    height: Annotated[int, typer.Option(help="Rows of rendered scenes.", min=48)] = 436,
    yardstick: Annotated[bool, typer.Option(help="Compare with Levenberg-Marquardt.")] = True,
    wide: Annotated[
        bool, typer.Option(help="Also a yardstick that starts from a wide smoothing.")
    ] = False,
    overrides: Annotated[
        list[str] | None, typer.Option("--set", help="Override of every problem.")
    ] = None,
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
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder.")] = Path("results/speed"),
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="No progress.")] = False,
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
            _scenes(scenes),
            _numbers(sizes, "--sizes", 2),
            _numbers(neighbours, "--neighbours", 1),
            _numbers(seeds, "--seeds", 0),
            width=width,
            height=height,
            yardsticks=("same",) * yardstick + ("wide",) * wide,
            overrides=tuple(overrides or ()),
        )
    for spec in specs:
        # a wrong override stops here, not after an hour
        problem_of(spec)
    prepare_folder(out)

    def say(line: str) -> None:
        if not quiet:
            print(line, file=sys.stderr, flush=True)

    records = []
    for record in measure_all(specs, out / RECORDS, fresh=fresh, say=say):
        records.append(record)
        say(f"    {_line(record)}")
        if table and gate is None:
            _write(out, records)
    if write_baseline is not None:
        text = json.dumps(baseline(records, machine()), indent=1)
        write_text(write_baseline, text + "\n")
    if kept is not None:
        findings = check(records, kept)
        print("\n".join(str(f) for f in findings))
        bad = sum(not f.ok for f in findings)
        print(f"{bad} of {len(findings)} values are worse" if bad else "the gate holds")
        raise typer.Exit(1 if bad else 0)
    failed = sum("error" in r for r in records)
    print(f"{len(records)} runs, {failed} failed, in {out / RECORDS}")
    raise typer.Exit(1 if failed else 0)


def _line(record: Record) -> str:
    """One line on a run."""
    if "error" in record:
        return f"failed: {record['error']}"
    text = (
        f"{record['status']}, {record['cpu']['nlp']:.1f} CPU s, {record['iterations']}"
        f" iterations, E {record['energy']['total']:.4g}"
    )
    for kind, y in record["yardstick"].items():
        text += f"; LM {kind} {y['cpu_seconds']:.1f} CPU s, E {y['energy']['total']:.4g}"
    return text


def _write(out: Path, records: list[Record]) -> None:
    """Table, plots and the plain numbers of the runs."""
    good = [r for r in records if "error" not in r]
    write_text(out / "table.md", report(records, machine(), date.today().isoformat()))
    if good:
        plot_growth(out / "growth.png", good)
        plot_phases(out / "phases.png", good)
        plot_energy(out / "energy.png", good)


def _scenes(text: str) -> list[str]:
    names = [name.strip() for name in text.split(",") if name.strip()]
    known = [*SCENES, "motorcycle"]
    wrong = [name for name in names if name not in known]
    if wrong or not names:
        raise ConfigError(
            "unknown scene",
            where="--scenes",
            found=", ".join(wrong) or text,
            expected=", ".join(known),
        )
    return names


def _numbers(text: str, option: str, least: int) -> list[int]:
    try:
        found = [int(word) for word in text.split(",") if word.strip()]
    except ValueError:
        found = []
    if not found or min(found) < least:
        raise ConfigError(
            "not a list of numbers",
            where=option,
            found=text,
            expected=f"whole numbers from {least}, comma separated",
        )
    return found
