"""Command chain: a sequence of frames on one scale."""

from __future__ import annotations

import os
import sys
import warnings
from pathlib import Path
from typing import Annotated, Any

import typer

from soup_nlp.cli import options
from soup_nlp.cli.options import Progress
from soup_nlp.cli.progress import SolveLog
from soup_nlp.config.problem import title
from soup_nlp.errors import ConfigError, StoppedError
from soup_nlp.sequence.chain import make_chain
from soup_nlp.sequence.frames import (
    VIDEOS,
    FileFrames,
    Frames,
    SceneFrames,
    check_sequence,
    find_depths,
    find_images,
    video_frames,
)
from soup_nlp.sequence.key_frames import MAX_STEP
from soup_nlp.sequence.pairs import solve_pairs
from soup_nlp.sequence.report import table
from soup_nlp.sequence.write import SINGLE, chain_files, write_chain
from soup_nlp.storage.files import as_path
from soup_nlp.storage.folders import claim, default_folder, staged

SCENE = "scene:"
"""Prefix of the name of a rendered scene."""
AUTO = "auto"
"""Stride that is chosen by parallax."""


def chain(
    source: Annotated[
        list[str], typer.Argument(help="Folder, images, 'pattern/*.jpg', video, or scene:NAME.")
    ],
    out: Annotated[
        Path | None, typer.Option("--out", "-o", help="Output folder; default out/chain-SOURCE.")
    ] = None,
    intrinsics: Annotated[
        str | None,
        typer.Option(help="fx,fy,cx,cy in pixels, or a file; default K.txt beside the images."),
    ] = None,
    fov: Annotated[
        float | None, typer.Option(help="Horizontal field of view, degrees, instead.")
    ] = None,
    undistort: options.Undistort = False,
    stride: Annotated[
        str, typer.Option(help="Take every so many frames; auto: until there is parallax.")
    ] = "1",
    frames: Annotated[
        int | None, typer.Option(help="Most frames; of a scene 10 unless named.", min=2)
    ] = None,
    two_frame: Annotated[
        bool, typer.Option("--two-frame", help="Solve frames k and k + 2 too, for more links.")
    ] = False,
    depth_scale: Annotated[
        float | None,
        typer.Option(
            help="Values per unit of length of true depth_*.png (KITTI 256); default 1000."
        ),
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
    name, subject = _subject(source)
    out = out or default_folder(f"chain-{name}", subject)
    camera = _camera(intrinsics, fov, undistort)
    sequence = _frames(source, out, camera, _step(stride), frames, depth_scale)
    count = len(sequence)
    claim(out, chain_files(count), overwrite, subject)
    sources = [sequence.source(k) for k in range(count)]
    which = [(k, k + 1) for k in range(count - 1)]
    over = [(k, k + 2) for k in range(count - 2)] if two_frame else []
    if not quiet:
        apart = f", far enough apart: {', '.join(Path(s).name for s in sources)}"
        found = f"{count} frames{apart if stride == AUTO else ''}"
        print(f"{found}; {len(which) + len(over)} pairs to solve", file=sys.stderr)
    short = {
        "segmentation.superpixels": superpixels,
        "segmentation.neighbours": neighbours,
        "max_size": max_size,
    }
    changes = options.changed(preset, overrides, short)
    every = [*which, *over]
    try:
        with warnings.catch_warnings():
            warnings.showwarning = SolveLog(quiet).warn
            pairs = solve_pairs(sequence, every, out, changes, workers, Progress(quiet))
    except KeyboardInterrupt:
        raise StoppedError(
            "interrupted: the pairs that were finished are kept",
            where=f"{out}/pairs",
            hint="the same command goes on",
        ) from None
    done = make_chain(pairs[: len(which)], pairs[len(which) :])
    with staged(out, whole=True, overwrite=overwrite, subject=subject) as new:
        write_chain(new, done, name, sources, over)
    print(table(done))
    print(f"files       {out}/: " + ", ".join([*SINGLE, "depth/", "points/", "pairs/"]))


def _subject(source: list[str]) -> tuple[str, str]:
    """Name of the sequence, and what its folder is the result of."""
    first = source[0]
    if first.startswith(SCENE):
        return title(first.removeprefix(SCENE)), first
    path = as_path(first, "frames", home=True).absolute()
    # several images, or a pattern, are named after their folder
    place = path if len(source) == 1 and path.exists() else path.parent
    return title(place.stem if place.is_file() else place.name), f"sequence {place}"


def _step(stride: str) -> int | None:
    """The stride as a number; None if parallax decides.

    Raises:
        ConfigError: it is neither a positive number nor AUTO.
    """
    if stride == AUTO:
        return None
    # limits the number of digits
    if not stride.isdecimal() or len(stride) > 8 or int(stride) < 1:
        raise ConfigError(
            "unknown stride", where="--stride", found=stride, expected=f"a number from 1, or {AUTO}"
        )
    return int(stride)


def _frames(
    source: list[str],
    out: Path,
    camera: dict[str, Any],
    step: int | None,
    most: int | None,
    depth_scale: float | None,
) -> Frames:
    """The frames of the command line; `step` None takes those with enough parallax."""
    first = source[0]
    if first.startswith(SCENE):
        own = first.removeprefix(SCENE)
        if len(source) > 1 or step != 1 or camera:
            raise ConfigError("a rendered scene has its own camera and steps", found=source)
        return SceneFrames(own, most or 10)
    path = as_path(first, "frames", home=True)
    depths: list[Path] = []
    # with AUTO the limit applies to the chosen frames
    end = most if step else None
    if len(source) > 1:
        images = [as_path(name, "image", home=True) for name in source][:: step or 1][:end]
    elif path.suffix.lower() in VIDEOS:
        read = None if most is None or step else most * MAX_STEP
        images = video_frames(path, out / "frames", step or 1, end or read)
    else:
        images = find_images(path)[:: step or 1][:end]
        check_sequence(images)
        depths = [] if "undistort" in camera else find_depths(images)
    images = [p.absolute() for p in images]
    if len(images) < 2:
        raise ConfigError(
            "a sequence needs two frames at least",
            where="--stride" if step != 1 else None,
            found=len(images),
            expected="more frames, or a smaller stride",
        )
    beside = images[0].parent / "K.txt"
    if not camera.keys() & {"intrinsics", "fov"} and os.path.lexists(beside):
        camera = {"intrinsics": str(beside), **camera}
    found = FileFrames(
        tuple(images),
        camera,
        tuple(p.absolute() for p in depths),
        depth_scale,
    )
    found.check()
    return found if step else found.apart(most)


def _camera(intrinsics: str | None, fov: float | None, undistort: bool) -> dict[str, Any]:
    """Keys of an input of files that the options name."""
    if intrinsics and fov is not None:
        raise ConfigError("two cameras are named", found="--intrinsics and --fov", expected="one")
    out: dict[str, Any] = {"undistort": True} if undistort else {}
    if fov is not None:
        out["fov"] = fov
    if intrinsics:
        out["intrinsics"] = options.camera(intrinsics, "--intrinsics")
    return out
