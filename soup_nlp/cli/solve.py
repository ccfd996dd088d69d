"""Command solve: a pair of frames becomes a result folder."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import typer

from soup_nlp.cli.options import camera, changed
from soup_nlp.cli.progress import SolveLog
from soup_nlp.config.presets import PRESETS
from soup_nlp.config.problem import Problem, dump_problem, load_problem, make_problem, title
from soup_nlp.data.flow.sources import is_path
from soup_nlp.data.formats.images import DataWarning
from soup_nlp.errors import ConfigError, DataError, SoupError
from soup_nlp.pipeline.record import Run
from soup_nlp.pipeline.run import run as run_problem
from soup_nlp.report.certainty import certainty, guess_reason
from soup_nlp.report.folder import prepare_folder, write_failure, write_folder
from soup_nlp.report.verdict import missed, verdict
from soup_nlp.sequence.frames import IMAGES
from soup_nlp.solve.interrupt import interruptible
from soup_nlp.storage.files import as_path
from soup_nlp.storage.folders import default_folder, scratch

SOURCE = "Two images, or a problem file or name (`soup-nlp list`)."
INPUT: Mapping[str, Any] = {"rich_help_panel": "Input"}
FLOW: Mapping[str, Any] = {"rich_help_panel": "Flow"}
PRIOR: Mapping[str, Any] = {"rich_help_panel": "Depth prior"}
SIZE: Mapping[str, Any] = {"rich_help_panel": "Size"}
METHOD: Mapping[str, Any] = {"rich_help_panel": "Method"}
OUTPUT: Mapping[str, Any] = {"rich_help_panel": "Output"}


def solve(
    source: Annotated[
        list[Path] | None, typer.Argument(metavar="PROBLEM | REF NEXT", help=SOURCE)
    ] = None,
    ref: Annotated[str | None, typer.Option(help="Reference image.", **INPUT)] = None,
    next_: Annotated[str | None, typer.Option("--next", help="Next image.", **INPUT)] = None,
    intrinsics: Annotated[
        str | None,
        typer.Option(help="fx,fy,cx,cy in pixels, or a file; default EXIF, else a guess.", **INPUT),
    ] = None,
    fov: Annotated[
        float | None, typer.Option(help="Horizontal field of view, degrees, instead.", **INPUT)
    ] = None,
    intrinsics_next: Annotated[
        str | None, typer.Option(help="Camera of the next frame, if it differs.", **INPUT)
    ] = None,
    depth: Annotated[
        str | None, typer.Option(help="True depth of the reference frame, to score.", **INPUT)
    ] = None,
    undistort: Annotated[
        bool, typer.Option("--undistort", help="Remove the camera file's distortion.", **INPUT)
    ] = False,
    flow: Annotated[
        str | None, typer.Option(help=".flo, KITTI .png, .npy, .onnx or a name; DIS.", **FLOW)
    ] = None,
    flow_backward: Annotated[
        str | None,
        typer.Option(help="From next to ref: the round trip is confidence.", **FLOW),
    ] = None,
    flow_confidence: Annotated[
        str | None, typer.Option(help="Of --flow: .npy in [0, 1], or a grey picture.", **FLOW)
    ] = None,
    depth_prior: Annotated[
        str | None,
        typer.Option(help="Depth of ref from elsewhere: .npy .pfm .png, .onnx.", **PRIOR),
    ] = None,
    depth_prior_kind: Annotated[
        str | None,
        typer.Option(help="metric, relative, inverse, ordinal; default: by the flow.", **PRIOR),
    ] = None,
    superpixels: Annotated[
        int | None, typer.Option(help="Wanted number N; default 1000.", **SIZE)
    ] = None,
    neighbours: Annotated[
        int | None, typer.Option(help="K of the K-NN graph; default 15.", **SIZE)
    ] = None,
    max_size: Annotated[
        float | None,
        typer.Option(help="Megapixels for larger images; default 1.5.", **SIZE),
    ] = None,
    overrides: Annotated[
        list[str] | None, typer.Option("--set", help="Any key, e.g. solver.max_iter=200.", **METHOD)
    ] = None,
    preset: Annotated[
        str | None,
        typer.Option(help=f"Options below the problem's own: {', '.join(PRESETS)}.", **METHOD),
    ] = None,
    no_refine: Annotated[
        bool,
        typer.Option("--no-refine", help="The NLP alone, as refine.enabled=false.", **METHOD),
    ] = False,
    no_nlp: Annotated[
        bool,
        typer.Option("--no-nlp", help="Refine the start, as refine.from_start=true.", **METHOD),
    ] = False,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Output folder; default out/NAME.", **OUTPUT),
    ] = None,
    overwrite: Annotated[
        bool,
        typer.Option("--overwrite", help="Also over other files, or another result.", **OUTPUT),
    ] = False,
    json_: Annotated[
        bool, typer.Option("--json", help="Print summary.json instead of the verdict.", **OUTPUT)
    ] = False,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Verdict only.", **OUTPUT)] = False,
    verbose: Annotated[bool, typer.Option("--verbose", "-v", help="All phases.", **OUTPUT)] = False,
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
        "depth_prior.kind": depth_prior_kind,
    }
    if depth_prior:
        # relative to the working folder, unlike paths in a problem file
        place = as_path(depth_prior, "depth prior", home=True).absolute()
        short["depth_prior.source"] = json.dumps(str(place))
    overrides = changed(preset, overrides, short)
    problem, ref, next_ = _sources(source or [], ref, next_)
    pair = {
        "--ref": ref,
        "--next": next_,
        "--intrinsics": intrinsics,
        "--intrinsics-next": intrinsics_next,
        "--depth": depth,
        "--fov": None if fov is None else str(fov),
        "--undistort": "true" if undistort else None,
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


def _sources(
    words: Sequence[Path], ref: str | None, following: str | None
) -> tuple[Path | None, str | None, str | None]:
    """Problem file, reference and next image of the arguments and of --ref and --next.

    Raises:
        ConfigError: they are neither a problem nor two images.
    """
    pictures = [str(word) for word in words if word.suffix.lower() in IMAGES]
    if len(words) == 1 and not pictures:
        return words[0], ref, following
    named = [*pictures, *(f"--ref {ref}" for _ in [ref] if ref)]
    named += [f"--next {following}" for _ in [following] if following]
    if len(words) == 2 and not (ref or following):
        return None, str(words[0]), str(words[1])
    if words or bool(ref) != bool(following):
        raise ConfigError(
            "a pair is two images",
            found=", ".join([*(str(w) for w in words if str(w) not in pictures), *named]),
            expected="soup-nlp solve REF NEXT, or soup-nlp solve PROBLEM",
            hint="soup-nlp chain solves more than two frames" if len(words) > 2 else None,
        )
    return None, ref, following


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
    ref, following, intrinsics, intrinsics_next, depth, fov, undistort = pair.values()
    if not (ref and following):
        raise ConfigError(
            "nothing to solve",
            found="no image and no problem",
            expected="soup-nlp solve REF NEXT, or soup-nlp solve PROBLEM",
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
    if undistort:
        source["undistort"] = True
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

        code, why = exit_code(run, mre_at_most)

        def log_text(files: list[str]) -> str:
            log.stage("files")
            said = verdict(run, folder, files, mre_at_most)
            log.lines.append(f"{said}\nexit code   {code}: {why}")
            return "\n".join(log.lines) + "\n"

        write_folder(folder, run, dump_problem(chosen), log_text, ipopt_log=ipopt_log)
    summary = folder / "summary.json"
    print(summary.read_text(encoding="utf-8") if as_json else log.lines[-1])
    return code


def exit_code(run: Run, mre_at_most: float | None) -> tuple[int, str]:
    """Exit code of a solve and its reason; `mre_at_most` is the largest MRE that is expected."""
    refined = run.refined is not None and run.refined.status == "interrupted"
    if refined or run.solution.status == "Interrupted":
        return 1, "interrupted; the best iterate is written"
    if not run.solved:
        return 1, f"the NLP did not converge ({run.solution.status}); the best iterate is written"
    if not run.good:
        why = guess_reason(certainty(run))
        return 1, f"{run.confidence.guessed:.0%} of the image is a guess: {why}"
    if mre_at_most is not None and missed(run):
        return 1, f"the MRE is above the expected {mre_at_most:g}"
    return 0, "solved, and at most half of the image is a guess"
