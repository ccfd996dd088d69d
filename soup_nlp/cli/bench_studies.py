"""Commands bench refine, methods, formulations, cut-off, chain and trws: studies of parts."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from soup_nlp.bench import study_energy, study_parts
from soup_nlp.bench.speed import plan
from soup_nlp.bench.studies import Settings, Study, grid, run_study
from soup_nlp.bench.study_chain import CHAIN, TRACKING
from soup_nlp.bench.study_chain import RENDERED as RENDERED_SEQUENCES
from soup_nlp.bench.suite_pairs import RENDERED
from soup_nlp.cli.options import (
    Data,
    Only,
    Out,
    Overwrite,
    Progress,
    Quiet,
    Seeds,
    Set,
    Size,
    numbers,
    words,
)
from soup_nlp.errors import ConfigError
from soup_nlp.model.layout import GAUGES
from soup_nlp.schema.limits import MAX_SUPERPIXELS
from soup_nlp.storage.rows import failed

SCENES = [*RENDERED, "motorcycle"]
SPEED = Path("out/bench/speed")


def _run(
    study: Study, out: Path, settings: Sequence[Settings], overwrite: bool, quiet: bool
) -> None:
    rows = run_study(study, out, settings, Progress(quiet), overwrite=overwrite)
    bad = sum(map(failed, rows))
    print(f"{len(rows)} rows, {bad} failed, in {out}/{study.name}.md")
    raise typer.Exit(1 if bad else 0)


def refine(
    scenes: Annotated[str, typer.Option("--scenes", "--only", help="Scenes.")] = ",".join(SCENES),
    superpixels: Size = 1000,
    out: Out = Path("out/bench/refine"),
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """What NLP and refinement contribute: E and MRE of start, either alone and both."""
    settings = grid(scene=words(scenes, "--scenes", SCENES), superpixels=[superpixels])
    _run(study_energy.REFINE, out, settings, overwrite, quiet)


def methods(
    scenes: Annotated[str, typer.Option(help="Scenes.")] = "street,room,motorcycle",
    seeds: Seeds = "0,1",
    superpixels: Annotated[str, typer.Option(help="Superpixels N.")] = "1000",
    unrefined: Annotated[bool, typer.Option(help="Leave the refinement out.")] = False,
    out: Out = SPEED,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """How low every method ends on one energy, before and after refinement."""
    chosen = (
        words(scenes, "--scenes", SCENES),
        numbers(superpixels, "--superpixels", 2, MAX_SUPERPIXELS),
    )
    settings = plan(*chosen, [20], numbers(seeds, "--seeds"), refine=not unrefined)
    study = study_energy.METHODS_UNREFINED if unrefined else study_energy.METHODS_REFINED
    _run(study, out, settings, overwrite, quiet)


def formulations(
    scene: Annotated[str, typer.Option(help="A rendered scene.")] = "street",
    superpixels: Size = 250,
    out: Out = SPEED,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Every gauge, norm and truncation of the constrained NLP: which converge."""
    settings = grid(
        scene=words(scene, "--scene", list(RENDERED))[:1],
        superpixels=[superpixels],
        norm=("smooth", "epigraph"),
        truncation=("smooth", "lifted"),
        gauge=GAUGES,
    )
    _run(study_energy.FORMULATIONS, out, settings, overwrite, quiet)


def cut_off(
    seeds: Seeds = "0,1,2,3,4,5,6,7",
    superpixels: Size = 500,
    out: Out = Path("out/bench/accuracy"),
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Depth of components that the lower border cuts off, by contact alone and as shipped."""
    chosen = numbers(seeds, "--seeds")
    settings = grid(scene=("street", "room"), seed=chosen, superpixels=[superpixels])
    _run(study_parts.CUT_OFF, out, settings, overwrite, quiet)


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
    names = [*RENDERED_SEQUENCES, *([TRACKING] if data else [])]
    chosen = [n for n in names if not only or any(word in n for word in only)]
    if not chosen:
        raise ConfigError("no sequence is left", where="--only", expected=", ".join(names))
    folder = str(data.resolve()) if data else None
    settings = grid(sequence=chosen, frames=[frames], data=[folder], overrides=[overrides or []])
    _run(CHAIN, out, settings, overwrite, quiet)


def trws(out: Out = SPEED, overwrite: Overwrite = False, quiet: Quiet = False) -> None:
    """Time and memory of TRW-S at the size of a refinement."""
    _run(study_parts.TRWS, out, grid(dtype=("float64", "float32")), overwrite, quiet)
