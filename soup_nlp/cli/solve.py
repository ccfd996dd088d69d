"""Commands solve, demo and chain: a pair or a sequence of frames becomes a result folder."""

from __future__ import annotations

import json
import sys
import warnings
from collections.abc import Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from soup_nlp.cli import options
from soup_nlp.cli.options import in_input, in_method, in_output, option
from soup_nlp.config.problem import Problem, load_problem, make_problem, title
from soup_nlp.data.flow.sources import is_path
from soup_nlp.data.formats.images import DataWarning
from soup_nlp.errors import ConfigError, DataError, SoupError
from soup_nlp.pipeline.record import Run
from soup_nlp.pipeline.run import run as run_problem
from soup_nlp.report.findings import certainty, guess_reason
from soup_nlp.report.folder import prepare_folder, write_failure, write_folder
from soup_nlp.report.result import PAGE
from soup_nlp.report.verdict import missed, verdict
from soup_nlp.sequence.folder import CHAIN, SINGLE
from soup_nlp.sequence.frames import IMAGES, Frames
from soup_nlp.sequence.score import chain_lines
from soup_nlp.sequence.solve import AUTO, named, solve_chain
from soup_nlp.storage.files import as_path, is_file, read_json
from soup_nlp.storage.folders import default_folder
from soup_nlp.storage.progress import interruptible
from soup_nlp.storage.system import scratch

SOURCE = "Two images, or a problem file or name (`soup-nlp list`)."
in_flow, in_prior = partial(option, panel="Flow"), partial(option, panel="Depth prior")


def solve(
    source: Annotated[
        list[Path] | None, typer.Argument(metavar="PROBLEM | REF NEXT", help=SOURCE)
    ] = None,
    ref: Annotated[str | None, in_input("Reference image.")] = None,
    next_: Annotated[str | None, in_input("Next image.", "--next")] = None,
    intrinsics: options.Intrinsics = None,
    fov: options.Fov = None,
    intrinsics_next: Annotated[
        str | None, in_input("Camera of the next frame, if it differs.")
    ] = None,
    depth: Annotated[str | None, in_input("True depth of the reference frame, to score.")] = None,
    undistort: options.Undistort = False,
    flow: Annotated[
        str | None, in_flow("File (.flo, KITTI .png, .npy, .onnx) or name; default DIS.")
    ] = None,
    flow_backward: Annotated[
        str | None, in_flow("Flow from next to ref; the consistency is the confidence.")
    ] = None,
    flow_confidence: Annotated[
        str | None, in_flow("Confidence of --flow: .npy in [0, 1], or a grey picture.")
    ] = None,
    depth_prior: Annotated[
        str | None, in_prior("Depth of ref from elsewhere: .npy, .pfm, .png, .onnx.")
    ] = None,
    depth_prior_kind: Annotated[
        str | None, in_prior("metric, relative, inverse, ordinal; default: by the flow.")
    ] = None,
    superpixels: options.Wanted = None,
    neighbours: options.Neighbours = None,
    max_size: options.MaxSize = None,
    overrides: options.Set = None,
    preset: options.PresetName = None,
    no_refine: Annotated[
        bool, in_method("The NLP alone, as refine.enabled=false.", "--no-refine")
    ] = False,
    no_nlp: Annotated[
        bool, in_method("Refine the start, as refine.from_start=true.", "--no-nlp")
    ] = False,
    out: Annotated[Path | None, options.out_option("out/NAME")] = None,
    overwrite: options.Overwrite = False,
    json_: Annotated[
        bool, in_output("Print summary.json instead of the verdict.", "--json")
    ] = False,
    quiet: options.Quiet = False,
    verbose: Annotated[
        bool, in_output("Print every stage and round, and more on the solver.", "--verbose", "-v")
    ] = False,
) -> None:
    """Solve a pair of frames and write a result folder."""
    if no_refine and no_nlp:
        raise ConfigError(
            "nothing is left to do",
            found="--no-nlp and --no-refine",
            expected="one of them at most",
        )
    keys = {
        "segmentation.superpixels": superpixels,
        "segmentation.neighbours": neighbours,
        "max_size": max_size,
        "refine.enabled": "false" if no_refine else None,
        "refine.from_start": "true" if no_nlp else None,
        "flow.source": options.located(flow, "flow")
        if flow and is_path(flow)
        else flow and json.dumps(flow),
        "flow.backward": options.located(flow_backward, "flow"),
        "flow.confidence": options.located(flow_confidence, "confidence of the flow"),
        "depth_prior.source": options.located(depth_prior, "depth prior"),
        "depth_prior.kind": depth_prior_kind,
    }
    changes = options.changed(preset, overrides, keys)
    pair_options = {
        "ref": ref,
        "next": next_,
        "intrinsics": options.camera(intrinsics, "--intrinsics"),
        "intrinsics_next": options.camera(intrinsics_next, "--intrinsics-next"),
        "fov": fov,
        "depth": depth,
        "undistort": undistort or None,
    }
    pair = {key: value for key, value in pair_options.items() if value is not None}
    words = source or []
    if len(words) == 1 and words[0].suffix.lower() not in IMAGES:
        chosen = _from_file(words[0], pair, changes)
    else:
        chosen = _from_images(words, pair, changes)
    # the expected MRE is that of the problem file without overrides
    limit = None if changes else chosen.expected.mre_at_most
    folder = out or default_folder(chosen.name, chosen.subject)
    log = options.SolveLog(quiet, verbose, chosen)
    raise typer.Exit(solve_problem(chosen, folder, log, limit, json_, overwrite))


def _from_file(problem: Path, pair: Mapping[str, Any], changes: Sequence[str]) -> Problem:
    """The problem of a file, which must come without options of a pair."""
    if pair:
        options_text = ", ".join(f"--{key.replace('_', '-')}" for key in pair)
        raise ConfigError(
            "a problem file names its own pair",
            found=f"{problem} and {options_text}",
            expected="a problem file, or the options of a pair",
            hint="--set input.KEY=VALUE changes the input of a problem file",
        )
    return load_problem(problem, changes)


def _from_images(words: Sequence[Path], pair: Mapping[str, Any], changes: Sequence[str]) -> Problem:
    """The problem of two images, which are words or the options --ref and --next."""
    named = {key: pair[key] for key in ("ref", "next") if key in pair}
    images = [word for word in words if word.suffix.lower() in IMAGES or is_file(word)]
    if len(images) == len(words) == 2 and not named:
        named = {"ref": str(words[0]), "next": str(words[1])}
    elif words or len(named) == 1:
        words_found = [*map(str, words), *(f"--{key} {image}" for key, image in named.items())]
        raise ConfigError(
            "a pair is two images",
            found=", ".join(words_found),
            expected="soup-nlp solve REF NEXT, or soup-nlp solve PROBLEM",
            hint="soup-nlp chain solves more than two frames" if len(words) > 2 else None,
        )
    if not named:
        raise ConfigError(
            "nothing to solve",
            found="no image and no problem",
            expected="soup-nlp solve REF NEXT, or soup-nlp solve PROBLEM",
            hint="soup-nlp demo, or soup-nlp solve motorcycle --out out/motorcycle",
        )
    reference = as_path(named["ref"], "reference image", home=True).absolute()
    name = "-".join([reference.parent.name, reference.stem, Path(named["next"]).stem]).lstrip("-")
    raw = {
        "name": title(name),
        "input": {"kind": "files", **pair, **named},
        "base": str(Path.cwd()),
    }
    return make_problem(raw, changes, where="command line")


def solve_problem(
    chosen: Problem,
    out: Path,
    log: options.SolveLog,
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
            # for input that cannot be used the message is enough
            if not isinstance(error, ConfigError | DataError):
                with suppress(SoupError):
                    write_failure(folder, "\n".join(log.lines) + "\n", ipopt_log, overwrite)
            raise
        # files are written completely even after an interruption
        interrupt.deferred = True

        code, why = exit_code(run, mre_at_most)

        verdicts = []

        def log_text(files: list[str]) -> str:
            log.stage("files")
            for details in (log.verbose, True):
                text = verdict(run, folder, files, mre_at_most, details)
                verdicts.append(f"{text}\nexit code   {code}: {why}")
            log.lines.append(verdicts[-1])
            return "\n".join(log.lines) + "\n"

        write_folder(folder, run, log_text, ipopt_log=ipopt_log, overwrite=overwrite)
    summary = folder / "summary.json"
    print(summary.read_text(encoding="utf-8") if as_json else verdicts[0])
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


PAIRS = {
    "motorcycle": "a real pair, rigid: here one rigid motion for the whole image is as good",
    "street": "a rendered street: the camera drives and two cars move",
}
"""Problems of the demo with a description."""


def demo(
    out: options.Out = Path("out/demo"),
    overwrite: options.Overwrite = False,
    quiet: options.Quiet = False,
) -> None:
    """Solve a real pair and a rendered street in which cars move."""
    codes = []
    for name, text in PAIRS.items():
        print(f"\n{name}: {text}", flush=True)
        problem = load_problem(name)
        log, limit = options.SolveLog(quiet, problem=problem), problem.expected.mre_at_most
        codes.append(solve_problem(problem, out / name, log, limit, overwrite=overwrite))
    pages = " and ".join(str(out / name / PAGE) for name in PAIRS)
    print(f"\nopen        {pages} in a browser")
    raise typer.Exit(max(codes))


def chain(
    source: Annotated[
        list[str], typer.Argument(help="Folder, images, 'pattern/*.jpg', video, or scene:NAME.")
    ],
    out: Annotated[Path | None, options.out_option("out/chain-SOURCE")] = None,
    intrinsics: options.Intrinsics = None,
    fov: options.Fov = None,
    undistort: options.Undistort = False,
    stride: Annotated[
        str, option("Take every n-th frame; auto: the next with enough parallax.")
    ] = "1",
    frames: Annotated[
        int | None, option("Largest number of frames; 10 of a scene by default.", min=2)
    ] = None,
    two_frame: Annotated[
        bool, option("Solve frames k and k + 2 too, for more links.", "--two-frame")
    ] = False,
    depth_scale: Annotated[
        float | None, option(options.DEPTH_SCALE.format("true depth_*.png"))
    ] = None,
    preset: options.PresetName = None,
    overrides: options.Set = None,
    superpixels: options.Wanted = None,
    neighbours: options.Neighbours = None,
    max_size: options.MaxSize = None,
    workers: options.Workers = 1,
    overwrite: options.Overwrite = False,
    quiet: options.Quiet = False,
) -> None:
    """Solve the consecutive pairs of a sequence and put them on one scale."""
    frames_of = source[0] if len(source) == 1 else source
    name, subject = named(frames_of)
    out = out or default_folder(f"chain-{name}", subject)

    def begin(sequence: Frames, pairs: int) -> None:
        count = len(sequence)
        names = ", ".join(Path(file).name for file in sequence.names)
        spacing = f", far enough apart: {names}" if stride == AUTO else ""
        if not quiet:
            print(f"{count} frames{spacing}; {pairs} pairs to solve", file=sys.stderr)

    short = {
        "segmentation.superpixels": superpixels,
        "segmentation.neighbours": neighbours,
        "max_size": max_size,
    }
    kept = options.resumable("the pairs that were finished are kept", f"{out}/pairs")
    with kept, warnings.catch_warnings():
        warnings.showwarning = options.SolveLog(quiet).warn
        done = solve_chain(
            frames_of,
            out,
            intrinsics=options.camera(intrinsics, "--intrinsics"),
            fov=fov,
            undistort=undistort,
            stride=stride,
            most=frames,
            two_frame=two_frame,
            depth_scale=depth_scale,
            overrides=options.changed(preset, overrides, short),
            workers=workers,
            overwrite=overwrite,
            begin=begin,
            say=options.RowProgress(quiet),
        )
    print("\n".join(chain_lines(done, read_json(out / CHAIN, CHAIN))))
    print(f"files       {out}/: " + ", ".join([*SINGLE, "depth/", "points/", "pairs/"]))
