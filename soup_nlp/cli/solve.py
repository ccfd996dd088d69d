"""Command solve: a pair of frames becomes a result folder."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import typer

from soup_nlp.cli.options import (
    PROBLEM,
    MaxSize,
    Neighbours,
    Overwrite,
    PresetName,
    Set,
    Wanted,
    camera,
    changed,
)
from soup_nlp.cli.progress import SolveLog
from soup_nlp.config.problem import Problem, dump_problem, load_problem, make_problem, title
from soup_nlp.data.flow.sources import is_path
from soup_nlp.data.formats.images import DataWarning
from soup_nlp.errors import ConfigError, DataError, SoupError
from soup_nlp.pipeline.run import run as run_problem
from soup_nlp.report.folder import prepare_folder, write_failure, write_folder
from soup_nlp.report.verdict import missed, verdict
from soup_nlp.solve.interrupt import interruptible
from soup_nlp.storage.files import as_path
from soup_nlp.storage.folders import default_folder, scratch


def solve(
    problem: Annotated[Path | None, typer.Argument(help=PROBLEM)] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            "--out", "-o", help="Output folder; default out/NAME, named after the frames."
        ),
    ] = None,
    overrides: Set = None,
    preset: PresetName = None,
    ref: Annotated[str | None, typer.Option(help="Reference image.")] = None,
    next_: Annotated[str | None, typer.Option("--next", help="Next image.")] = None,
    intrinsics: Annotated[
        str | None,
        typer.Option(help="fx,fy,cx,cy in pixels, or a file; default EXIF, else a guess."),
    ] = None,
    intrinsics_next: Annotated[
        str | None, typer.Option(help="The same of the next frame, if it differs.")
    ] = None,
    fov: Annotated[
        float | None, typer.Option(help="Horizontal field of view, degrees, for --intrinsics.")
    ] = None,
    flow: Annotated[
        str | None, typer.Option(help=".flo, KITTI .png, .npy, .onnx or a name; default DIS.")
    ] = None,
    flow_backward: Annotated[
        str | None, typer.Option(help="Flow from next to reference: its round trip is confidence.")
    ] = None,
    flow_confidence: Annotated[
        str | None, typer.Option(help="Confidence of --flow: .npy in [0, 1], or a grey picture.")
    ] = None,
    depth: Annotated[str | None, typer.Option(help="True depth of the reference frame.")] = None,
    superpixels: Wanted = None,
    neighbours: Neighbours = None,
    max_size: MaxSize = None,
    no_refine: Annotated[
        bool, typer.Option("--no-refine", help="The NLP alone, as refine.enabled=false.")
    ] = False,
    no_nlp: Annotated[
        bool, typer.Option("--no-nlp", help="Refine the start, as refine.from_start=true.")
    ] = False,
    json_: Annotated[
        bool, typer.Option("--json", help="Print summary.json instead of the verdict.")
    ] = False,
    overwrite: Overwrite = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Only the verdict.")] = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="Every phase.")] = False,
) -> None:
    """Solve a pair of frames and write a result folder."""
    if no_refine and no_nlp:
        raise ConfigError(
            "nothing is left to do",
            found="--no-nlp and --no-refine",
            expected="one of them at most",
        )
    short = {
        "segmentation.superpixels": superpixels,
        "segmentation.neighbours": neighbours,
        "max_size": max_size,
        "refine.enabled": "false" if no_refine else None,
        "refine.from_start": "true" if no_nlp else None,
    }
    overrides = changed(preset, overrides, short)
    pair = {
        "--ref": ref,
        "--next": next_,
        "--intrinsics": intrinsics,
        "--intrinsics-next": intrinsics_next,
        "--depth": depth,
        "--fov": None if fov is None else str(fov),
    }
    flows = {"source": flow, "backward": flow_backward, "confidence": flow_confidence}
    if problem is None:
        chosen = _from_options(pair, flows, overrides)
    else:
        chosen = _from_file(problem, pair, flows, overrides)
    # the expected MRE is that of the problem file without overrides
    limit = None if overrides else chosen.expected.mre_at_most
    folder = out or default_folder(chosen.name, chosen.subject)
    log = SolveLog(quiet, verbose, chosen)
    raise typer.Exit(solve_problem(chosen, folder, log, limit, json_, overwrite))


def _from_file(
    problem: Path,
    pair: Mapping[str, str | None],
    flows: Mapping[str, str | None],
    overrides: Sequence[str],
) -> Problem:
    """The problem of a file, with the flow of the command line."""
    if any(pair.values()):
        raise ConfigError(
            "a problem file names its own pair",
            found=f"{problem} and {', '.join(k for k, v in pair.items() if v)}",
            expected="a problem file, or the options of a pair",
            hint="--set input.KEY=VALUE changes the input of a problem file",
        )
    for key, flow in flows.items():
        if flow:
            # relative to the working folder, unlike paths in a problem file
            place = key != "source" or is_path(flow)
            source = str(as_path(flow, "flow", home=True).absolute()) if place else flow
            overrides = [f"flow.{key}={json.dumps(source)}", *overrides]
    return load_problem(problem, overrides)


def _from_options(
    pair: Mapping[str, str | None], flows: Mapping[str, str | None], overrides: Sequence[str]
) -> Problem:
    """The problem of the pair that the options name."""
    ref, following, intrinsics, intrinsics_next, depth, fov = pair.values()
    if not (ref and following):
        raise ConfigError(
            "nothing to solve",
            found="no problem file",
            expected="PROBLEM.yaml, the name of a problem, or --ref and --next",
            hint="soup-nlp demo, or soup-nlp solve motorcycle --out out/motorcycle",
        )
    source: dict[str, Any] = {"kind": "files", "ref": ref, "next": following}
    if intrinsics:
        source["intrinsics"] = camera(intrinsics, "--intrinsics")
    if intrinsics_next:
        source["intrinsics_next"] = camera(intrinsics_next, "--intrinsics-next")
    if fov:
        source["fov"] = float(fov)
    if depth:
        source["depth"] = depth
    place = as_path(ref, "reference image", home=True).absolute()
    name = title("-".join([place.parent.name, place.stem, Path(following).stem]).lstrip("-"))
    raw: dict[str, Any] = {"name": name, "input": source, "base": str(Path.cwd())}
    raw["flow"] = {key: flow for key, flow in flows.items() if flow}
    return make_problem(raw, overrides, where="command line")


def solve_problem(
    chosen: Problem,
    out: Path,
    log: SolveLog,
    mre_at_most: float | None,
    as_json: bool = False,
    overwrite: bool = False,
) -> int:
    """Solve a problem, write its folder and print the verdict, or summary.json.

    Returns:
        0 for a good result that meets the expectation, else 1.
    """
    folder = prepare_folder(out, chosen.input_paths(), overwrite, chosen.subject)
    interrupt = interruptible(log.interrupted)
    with interrupt as stop, warnings.catch_warnings(), log, scratch() as temporary:
        ipopt_log = temporary / "ipopt.log"
        warnings.simplefilter("always", DataWarning)
        warnings.showwarning = log.warn
        try:
            run = run_problem(
                chosen,
                listener=log.iteration,
                stop=stop,
                log=log.say,
                on_stage=log.stage,
                ipopt_log=str(ipopt_log),
            )
            if interrupt.aborted:
                raise KeyboardInterrupt
        except BaseException as error:
            log.lines.append(f"failed: {str(error) or type(error).__name__}")
            # the message says everything about input that cannot be used
            if not isinstance(error, ConfigError | DataError):
                with suppress(SoupError):
                    write_failure(folder, "\n".join(log.lines) + "\n", ipopt_log)
            raise
        # files are written completely even after an interruption
        interrupt.deferred = True

        def log_text(files: list[str]) -> str:
            log.stage("files")
            log.lines.append(verdict(run, folder, files, mre_at_most))
            return "\n".join(log.lines) + "\n"

        write_folder(folder, run, dump_problem(chosen), log_text, ipopt_log=ipopt_log)
    summary = folder / "summary.json"
    print(summary.read_text(encoding="utf-8") if as_json else log.lines[-1])
    good = run.good and (mre_at_most is None or not missed(run))
    return 0 if good else 1
