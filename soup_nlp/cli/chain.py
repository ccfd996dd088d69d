"""Command chain: a sequence of frames on one scale."""

from __future__ import annotations

import sys
import warnings
from pathlib import Path
from typing import Annotated

import typer

from soup_nlp.cli import options
from soup_nlp.cli.options import option
from soup_nlp.sequence.folder import CHAIN, SINGLE
from soup_nlp.sequence.frames import Frames
from soup_nlp.sequence.score import chain_lines
from soup_nlp.sequence.solve import AUTO, named, solve_chain
from soup_nlp.storage.files import read_json
from soup_nlp.storage.folders import default_folder


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
