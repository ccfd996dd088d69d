"""Commands solve, demo, chain and batch: pairs and sequences of frames become result folders."""

import json
import sys
from collections.abc import Mapping, Sequence
from contextlib import nullcontext, suppress
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from soup_nlp.batches.run import FILES, summary
from soup_nlp.batches.run import batch as solve_batch
from soup_nlp.batches.sources import DATASETS
from soup_nlp.cli import options
from soup_nlp.cli.options import Text, in_input, in_method, in_output, option
from soup_nlp.config.problem import Problem, load_problem, make_problem, shipped_problems, title
from soup_nlp.data.flow.sources import is_path
from soup_nlp.data.scenes.catalogue import LAYOUTS
from soup_nlp.errors import ConfigError, DataError, SoupError
from soup_nlp.pipeline.run import run as run_problem
from soup_nlp.report.folder import prepare_folder, write_failure, write_folder
from soup_nlp.report.result import PAGE
from soup_nlp.report.verdict import exit_code, verdict
from soup_nlp.sequence.folder import SINGLE
from soup_nlp.sequence.frames import IMAGES, VIDEOS, named
from soup_nlp.sequence.score import chain_exit_code
from soup_nlp.sequence.solve import solve_chain
from soup_nlp.storage.each import Row
from soup_nlp.storage.files import as_path, is_file, is_folder
from soup_nlp.storage.folders import default_folder
from soup_nlp.storage.progress import interruptible
from soup_nlp.storage.system import scratch

SOURCE = "Two images, or a problem file or name (`soup-nlp list`)."
KIND = "metric, relative, inverse, ordinal; default: by the flow."
in_flow, in_prior = partial(option, panel="Flow"), partial(option, panel="Depth prior")


def solve(
    source: Annotated[
        list[Path] | None,
        typer.Argument(
            metavar="PROBLEM | REF NEXT",
            help=SOURCE,
            autocompletion=options.starting(shipped_problems),
        ),
    ] = None,
    intrinsics: options.Intrinsics = None,
    fov: options.Fov = None,
    depth: Annotated[Text, in_input("True depth of the reference frame, to score.")] = None,
    undistort: options.Undistort = False,
    flow: Annotated[
        Text, in_flow("File (.flo, KITTI .png, .npy, .onnx) or name; else DIS.")
    ] = None,
    flow_backward: Annotated[Text, in_flow("Flow from next to ref; gives the confidence.")] = None,
    flow_confidence: Annotated[Text, in_flow(".npy in [0, 1], or a grey picture.")] = None,
    depth_prior: Annotated[Text, in_prior("Depth of ref: .npy, .npz, .pfm, .png, .onnx.")] = None,
    depth_prior_kind: Annotated[Text, in_prior(KIND)] = None,
    superpixels: options.Wanted = None,
    neighbours: options.Neighbours = None,
    max_size: options.MaxSize = None,
    overrides: options.Set = None,
    preset: options.PresetName = None,
    no_refine: Annotated[bool, in_method("Leave out the refinement.", "--no-refine")] = False,
    no_nlp: Annotated[bool, in_method("Refine the initialisation, no NLP.", "--no-nlp")] = False,
    out: Annotated[Path | None, options.out_option("out/NAME")] = None,
    overwrite: options.Overwrite = False,
    json_: Annotated[bool, in_output("Print summary.json, not the verdict.", "--json")] = False,
    quiet: options.Quiet = False,
    verbose: Annotated[bool, in_output("Print more on the solver.", "--verbose", "-v")] = False,
) -> int:
    """Solve a pair of frames and write a result folder."""
    if no_refine and no_nlp:
        raise ConfigError(
            "nothing is left to do",
            found="--no-nlp and --no-refine",
            expected="one of them at most",
        )
    source_of_flow = options.located(flow, "flow") if flow and is_path(flow) else json.dumps(flow)
    keys = {
        "refine.enabled": "false" if no_refine else None,
        "refine.from_start": "true" if no_nlp else None,
        "flow.source": source_of_flow if flow else None,
        "flow.backward": options.located(flow_backward, "flow"),
        "flow.confidence": options.located(flow_confidence, "confidence of the flow"),
        "depth_prior.source": options.located(depth_prior, "depth prior"),
        "depth_prior.kind": depth_prior_kind,
    }
    changes = options.changed(preset, overrides, superpixels, neighbours, max_size, **keys)
    camera = options.camera(intrinsics)
    pair = options.given(intrinsics=camera, fov=fov, depth=depth, undistort=undistort or None)
    words = source or []
    if len(words) == 1 and words[0].suffix.lower() not in (*IMAGES, *VIDEOS):
        chosen = _from_file(words[0], pair, changes)
    else:
        chosen = _from_images(words, pair, changes)
    # the expected MRE is that of the problem file without overrides
    limit = None if changes else chosen.expected.mre_at_most
    folder = out or default_folder(chosen.name, chosen.subject)
    log = options.SolveLog(quiet, verbose)
    return solve_problem(chosen, folder, log, limit, json_, overwrite)


def _from_file(problem: Path, pair: Mapping[str, Any], changes: Sequence[str]) -> Problem:
    """The problem of a file, which must come without options of a pair."""
    # a folder is refused with the command for it, whatever else was given
    if pair and not is_folder(problem):
        raise ConfigError(
            "a problem file names its own pair",
            found=f"{problem} and {', '.join(f'--{key}' for key in pair)}",
            expected="a problem file, or the options of a pair",
            hint="--set input.KEY=VALUE changes the input of a problem file",
        )
    return load_problem(problem, changes)


def _from_images(words: Sequence[Path], pair: Mapping[str, Any], changes: Sequence[str]) -> Problem:
    """The problem of two images."""
    if len(words) != 2 or not all(w.suffix.lower() in IMAGES or is_file(w) for w in words):
        sequence = len(words) > 2 or any(w.suffix.lower() in VIDEOS for w in words)
        chain_hint = "soup-nlp chain solves videos and more than two images"
        demo_hint = "soup-nlp demo solves two pairs that come with the package"
        raise ConfigError(
            "a pair is two images",
            found=", ".join(map(str, words)) or "no image and no problem",
            expected="soup-nlp solve REF NEXT, or soup-nlp solve PROBLEM",
            hint=chain_hint if sequence else demo_hint,
        )
    ref, following = words
    reference = as_path(ref, "reference image", home=True).absolute()
    name = "-".join([reference.parent.name, reference.stem, following.stem]).lstrip("-")
    raw = {
        "name": title(name),
        "input": {"kind": "files", **pair, "ref": str(ref), "next": str(following)},
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
    """Solve a problem, write its folder, print the verdict or summary.json; the exit code."""
    folder = prepare_folder(out, chosen.input_paths(), overwrite, chosen.subject)
    interrupt = interruptible(log.interrupted, at_once=True)

    def on_stage(stage: str) -> None:
        log.stage(stage)
        # then the start follows, which is kept
        interrupt.at_once = stage in ("load", "flow")

    with interrupt as stop, log.warnings(), log.now or nullcontext(), scratch() as temporary:
        ipopt_log = temporary / "ipopt.log"
        try:
            run = run_problem(
                chosen,
                listener=log.iteration,
                stop=stop,
                log=log.say,
                on_stage=on_stage,
                ipopt_log=str(ipopt_log),
            )
            if interrupt.aborted:
                # in native code, which discarded it
                raise KeyboardInterrupt
        except BaseException as error:
            interrupted = interrupt.aborted or isinstance(error, KeyboardInterrupt)
            words = "interrupted" if interrupted else str(error) or type(error).__name__
            log.lines.append(f"failed: {words}")
            # for input that cannot be used the message is enough
            if not isinstance(error, ConfigError | DataError):
                with suppress(SoupError):
                    write_failure(folder, "\n".join(log.lines) + "\n", ipopt_log, overwrite)
            raise
        # files are written completely even after an interruption
        interrupt.deferred = True

        def log_text(files: list[str]) -> str:
            log.stage("files")
            return "\n".join([*log.lines, verdict(run, folder, files, mre_at_most), ""])

        files = write_folder(folder, run, log_text, ipopt_log=ipopt_log, overwrite=overwrite)
    if as_json:
        print((folder / "summary.json").read_text(encoding="utf-8"))
    else:
        print(verdict(run, folder, files, mre_at_most, log.verbose))
    return exit_code(run, mre_at_most)[0]


PAIRS = {
    "motorcycle": "a real pair, rigid: here one rigid motion for the whole image is as good",
    "street": "a rendered street: the camera drives and two cars move",
}
"""Problems of the demo with a description."""


def demo(
    out: options.Out = Path("out/demo"),
    overwrite: options.Overwrite = False,
    quiet: options.Quiet = False,
) -> int:
    """Solve a real pair and a rendered street in which cars move."""
    codes = []
    for name, text in PAIRS.items():
        print(f"\n{name}: {text}", flush=True)
        problem = load_problem(name)
        log, limit = options.SolveLog(quiet), problem.expected.mre_at_most
        codes.append(solve_problem(problem, out / name, log, limit, overwrite=overwrite))
    pages = " and ".join(str(out / name / PAGE) for name in PAIRS)
    print(f"\nopen        {pages} in a browser")
    return max(codes)


def chain(
    source: Annotated[
        list[str],
        typer.Argument(
            help="Folder, images, 'pattern/*.jpg', video, or scene:NAME.",
            autocompletion=options.starting(lambda: [f"scene:{name}" for name in LAYOUTS]),
        ),
    ],
    out: Annotated[Path | None, options.out_option("out/chain-SOURCE")] = None,
    intrinsics: options.Intrinsics = None,
    fov: options.Fov = None,
    undistort: options.Undistort = False,
    stride: Annotated[int, option("Every n-th frame.", min=1)] = 1,
    frames: Annotated[int | None, option("Most frames to use; of a scene 10.", min=2)] = None,
    depth_scale: options.DepthScale = None,
    flow: Annotated[Text, in_flow("Folder or pattern of flows, one a pair; or a network.")] = None,
    flow_backward: Annotated[Text, in_flow("The same from each next frame back.")] = None,
    depth_prior: Annotated[
        Text, in_prior("Folder or pattern of depth maps, one a frame; or a network.")
    ] = None,
    depth_prior_kind: Annotated[Text, in_prior(KIND)] = None,
    preset: options.PresetName = None,
    overrides: options.Set = None,
    superpixels: options.Wanted = None,
    neighbours: options.Neighbours = None,
    max_size: options.MaxSize = None,
    workers: options.Workers = 1,
    overwrite: options.Overwrite = False,
    quiet: options.Quiet = False,
) -> int:
    """Solve the consecutive pairs of a sequence and put them on one scale."""
    frames_of = source[0] if len(source) == 1 else source
    name, subject = named(frames_of)
    out = out or default_folder(f"chain-{name}", subject)

    flows = options.given(source=flow, backward=flow_backward)
    prior = options.given(source=depth_prior, kind=depth_prior_kind)
    sections: dict[str, Any] = options.given(flow=flows or None, depth_prior=prior or None)
    progress, solved = options.row_progress(quiet), list[Row]()

    def say(done: int, total: int, row: Row) -> None:
        solved.append(row)
        progress(done, total, row)

    kept = options.resumable("pairs that were finished before are kept", f"{out}/pairs")
    with kept, options.SolveLog(quiet).warnings():
        done = solve_chain(
            frames_of,
            out,
            intrinsics=options.camera(intrinsics),
            fov=fov,
            undistort=undistort,
            stride=stride,
            frames=frames,
            depth_scale=depth_scale,
            **sections,
            overrides=options.changed(preset, overrides, superpixels, neighbours, max_size),
            workers=workers,
            overwrite=overwrite,
            say=say,
        )
    if not (solved or quiet):
        print("every pair was solved before: the chain is finished", file=sys.stderr)
    print("\n".join(done.summary["verdict"]))
    print(f"files       {out}/: " + ", ".join([*SINGLE, "depth/", "pairs/"]))
    code, why = chain_exit_code(done)
    return options.finish(not code, why, code)


SOURCES = f"pairs.csv, a folder of pairs, a pattern, or {':DIR, '.join(DATASETS)}:DIR."


def batch(
    pairs: Annotated[str, typer.Argument(help=SOURCES)],
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

    def mre(row: options.Row) -> str:
        known = row.get("mre")
        return row["reason"] if known is None else f"MRE {known:.4f}"

    with options.resumable("the pairs that were finished are kept", out):
        done = solve_batch(
            pairs,
            out,
            overrides=options.changed(preset, overrides, superpixels, neighbours, max_size),
            workers=workers,
            cluster=cluster,
            retry_failed=retry_failed,
            overwrite=overwrite,
            say=options.row_progress(quiet, mre),
        )
    print(summary(done.rows, len(done.rows)))
    print(f"files       {out}/: {', '.join(FILES)}, pairs/")
    return options.finish(done.good, "every pair is solved" if done.good else "a pair failed")
