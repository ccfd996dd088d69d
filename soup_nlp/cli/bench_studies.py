"""Commands bench refine, methods, formulations, cut-off and trws: studies of parts."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from soup_nlp.bench import study_methods, study_parts, study_refine
from soup_nlp.bench.rows import Row, failed
from soup_nlp.bench.suite_pairs import RENDERED
from soup_nlp.cli.options import Out, Progress, Quiet, Seeds, numbers, words

Size = Annotated[int, typer.Option(help="Superpixels wanted.")]
Iterations = Annotated[int, typer.Option(help="Iteration limit.", min=1)]
SPEED = Path("results/speed")


def _end(rows: list[Row], out: Path) -> None:
    print(f"{len(rows)} rows, {sum(map(failed, rows))} failed, in {out}/")
    raise typer.Exit(1 if any(map(failed, rows)) else 0)


def refine(
    only: Annotated[str, typer.Option(help="Scenes.")] = ",".join(study_refine.SCENES),
    superpixels: Size = 1000,
    polish: Annotated[bool, typer.Option(help="Measure refine.polish as well.")] = False,
    out: Out = Path("results/refine"),
    quiet: Quiet = False,
) -> None:
    """What NLP and refinement contribute: E and MRE of start, either alone and both."""
    scenes = words(only, "--only", list(study_refine.SCENES))
    _end(study_refine.study(out, scenes, superpixels, polish, Progress(quiet)), out)


def methods(
    scenes: Annotated[str, typer.Option(help="Scenes.")] = "street,room,motorcycle",
    seeds: Seeds = "0,1",
    superpixels: Annotated[str, typer.Option(help="Superpixels N.")] = "1000",
    neighbours: Annotated[int, typer.Option(help="K of the K-NN graph.")] = 20,
    unrefined: Annotated[bool, typer.Option(help="Leave the refinement out.")] = False,
    out: Out = SPEED,
    quiet: Quiet = False,
) -> None:
    """How low every method ends on one energy, before and after refinement."""
    rows = study_methods.study_methods(
        out,
        words(scenes, "--scenes", [*RENDERED, "motorcycle"]),
        numbers(seeds, "--seeds"),
        numbers(superpixels, "--superpixels", 2),
        neighbours,
        not unrefined,
        Progress(quiet),
    )
    _end(rows, out)


def formulations(
    scene: Annotated[str, typer.Option(help="A rendered scene.")] = "street",
    superpixels: Size = 250,
    iterations: Iterations = 300,
    seconds: Annotated[float, typer.Option(help="Time limit of each.")] = 240.0,
    out: Out = SPEED,
    quiet: Quiet = False,
) -> None:
    """Every gauge, norm and truncation of the constrained NLP: which converge."""
    (name,) = words(scene, "--scene", list(RENDERED))[:1]
    own = name, superpixels, iterations, seconds
    _end(study_methods.study_formulations(out, *own, Progress(quiet)), out)


def cut_off(
    seeds: Seeds = "0,1,2,3,4,5,6,7",
    superpixels: Size = 500,
    lower: Annotated[float, typer.Option(help="Share of the rows left out.", min=0, max=0.9)] = 0.3,
    out: Out = Path("results/accuracy"),
    quiet: Quiet = False,
) -> None:
    """Depth of components that the lower border cuts off, by contact alone and as shipped."""
    own = numbers(seeds, "--seeds"), superpixels, lower
    _end(study_parts.study_cut_off(out, *own, Progress(quiet)), out)


def trws(iterations: Iterations = 10, out: Out = SPEED, quiet: Quiet = False) -> None:
    """Time and memory of TRW-S at the size of a refinement."""
    _end(study_parts.study_trws(out, iterations, Progress(quiet)), out)
