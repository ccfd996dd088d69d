"""A sequence from any source, solved into a folder: `soup_nlp.chain` and its command."""

import warnings
from collections.abc import Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Unpack

import numpy as np

from soup_nlp.config.problem import Problem
from soup_nlp.data.formats.images import DataWarning
from soup_nlp.data.pair import Pair
from soup_nlp.errors import ConfigError, DataError, SolverError, SoupError
from soup_nlp.pipeline.case import observed_pair
from soup_nlp.pipeline.run import ProblemKeys, sections
from soup_nlp.report import folder as stored
from soup_nlp.report.chain import Chain
from soup_nlp.sequence.folder import CHAIN, SINGLE, chain_files, read_pairs, write_chain
from soup_nlp.sequence.frames import (
    Frames,
    Raw,
    Source,
    files_of_pairs,
    find_frames,
    named,
    pair_name,
)
from soup_nlp.sequence.links import make_chain
from soup_nlp.storage.each import Row, Say, append_row, each, failed
from soup_nlp.storage.files import as_path, is_file
from soup_nlp.storage.folders import claim, staged

DEFAULTS: Raw = {"output": {"page": False}, "refine": {"rounds": 1}}
"""Keys of every pair unless others are given: the sequence has its own page, and one round of the
refinement does most of its work."""
PROBED = 3
"""Number of pairs whose flow measures a focal length that is not known."""


def solve_chain(
    source: Source,
    out: str | Path,
    *,
    frames: int | None = None,
    intrinsics: Sequence[float] | str | None = None,
    fov: float | None = None,
    undistort: bool = False,
    stride: int = 1,
    depth_scale: float | None = None,
    overrides: Sequence[str] = (),
    workers: int = 1,
    overwrite: bool = False,
    say: Say | None = None,
    **keys: Unpack[ProblemKeys],
) -> Chain:
    """Solve consecutive frames as pairs, put them on one scale, and write the chain's folder.

    A call that was interrupted goes on where it stopped.

    Args:
        source: See `Source`.
        out: Folder of the chain.
        frames: Most frames; of a scene 10 unless given.
        intrinsics: fx, fy, cx, cy in pixels, or a file; None for `fov`, K.txt beside the images,
            EXIF, or a guess.
        fov: Horizontal field of view, degrees.
        undistort: Remove the distortion that the file of the camera holds.
        stride: Take every so many frames.
        depth_scale: Values per unit of length of true depth_*.png beside frame_*.
        overrides: Keys as on the command line, such as `["segmentation.superpixels=500"]`.
        workers: Processes.
        overwrite: Replace the result of another sequence.
        say: Called with (done, total, row) after every pair.
        keys: Those of `solve_pair`: `preset`, `seed`, `max_size`, and sections such as
            `segmentation={"superpixels": 500}`. `source` and `backward` of `flow`, and `source` of
            `depth_prior`, may be a folder, or a pattern such as "flow/*.flo", with a file for each
            pair, in the order of their numbers.

    Raises:
        ConfigError: two cameras are given, or the stride, a key or a scene is wrong.
        DataError: the frames are no sequence, one is damaged, or the folder holds the result of
            another one.
        SolverError: a pair cannot be solved; the others are kept.
    """
    folder = as_path(out, "output folder")
    name, subject = named(source, folder)
    if intrinsics is not None and fov is not None:
        raise ConfigError("two cameras are named", found="intrinsics and fov", expected="one")
    values = intrinsics if isinstance(intrinsics, str | None) else [*intrinsics]
    raw: Raw = {"undistort": undistort or None, "fov": fov, "intrinsics": values}
    camera = {key: value for key, value in raw.items() if value is not None}
    if not isinstance(stride, int) or stride < 1:
        raise ConfigError("unknown stride", found=stride, expected="a number from 1")
    # frames of a video, or of arrays, are written before their number is known
    claim(folder, SINGLE, overwrite, subject)
    # every solve gives the warnings of its images
    with warnings.catch_warnings(action="ignore", category=DataWarning):
        chosen = find_frames(source, folder, camera, stride, frames, depth_scale)
    common = sections(keys, "chain")
    common |= {section: {**own, **common.get(section, {})} for section, own in DEFAULTS.items()}
    count = len(chosen)
    files = files_of_pairs(common, count - 1, stride)
    chosen = replace(chosen, files=files, keys=common, overrides=overrides)
    # a wrong key or scene is found before the first pair is solved
    chosen.problem(0)
    names = stored.places(map(pair_name, range(count - 1)))
    claim(folder, [*chain_files(count), *names], overwrite, subject, stored.ROWS)
    chosen = one_camera(chosen)
    problems = {one.name: one for one in map(chosen.problem, range(count - 1))}
    # a pair that is solved otherwise ends the chain that it was part of
    heads = {name: stored.head(problem) for name, problem in problems.items()}
    kept = {name for name, row in stored.kept_rows(folder, heads).items() if not failed(row)}
    stale = any((folder / stored.PAIRS / name).exists() for name in problems.keys() - kept)
    if stale and is_file(folder / CHAIN) and not overwrite:
        raise DataError(
            "output folder holds a chain that was solved otherwise",
            where=folder,
            expected="the same images, camera, options and version of the program",
            hint="choose another --out, or --overwrite",
        )
    with staged(folder, whole=stale, overwrite=overwrite, subject=subject):
        # from here on, the folder is this chain's
        pass
    solve_pairs(problems, heads, folder, workers, say)
    chain = make_chain(read_pairs(folder, count - 1))
    with staged(folder, whole=True, overwrite=overwrite, subject=subject) as new:
        return write_chain(new, chain, name, chosen.names)


def solve_pairs(
    problems: Mapping[str, Problem],
    heads: Mapping[str, Row],
    folder: Path,
    workers: int = 1,
    say: Say | None = None,
) -> None:
    """Solve the pairs that are not kept into `pairs/000_001/` ...; SolverError if one fails.

    Problems and their `head` are by name of the folder. Fewer than `workers` processes run where
    their memory would not suffice. `say` is called with (done, total, row) after every solve.
    """
    done = {k: row for k, row in stored.kept_rows(folder, heads).items() if not failed(row)}
    todo = {
        name: partial(stored.solve_into, problem, folder.resolve())
        for name, problem in problems.items()
        if name not in done
    }
    # all pairs have one size
    workers = stored.fitting(workers, [problems[name] for name in todo][:1])
    with closing(each(todo, workers)) as ended:
        for name, result in ended:
            row = done[name] = {**heads[name], **result}
            append_row(folder / stored.ROWS, row)
            # those of a worker process would be printed as Python prints them
            for text in row.get("warnings", ()):
                warnings.warn(text, DataWarning, stacklevel=2)
            if say:
                say(len(done), len(problems), row)
    failures = [done[name] for name in problems if failed(done[name])]
    if failures:
        raise SolverError(
            f"{len(failures)} of {len(problems)} pairs cannot be solved",
            where=failures[0]["key"],
            found=failures[0]["error"],
            hint="the others are kept: the same command goes on",
        )


def one_camera(frames: Frames) -> Frames:
    """The frames with one focal length for all, where it is only a guess.

    It is the surest of those that the flows of up to `PROBED` pairs across the sequence suggest. A
    pair that cannot be started is left out.
    """
    if frames.scene is not None or frames.camera.keys() & {"intrinsics", "fov"}:
        return frames
    pairs, last = list[Pair](), len(frames) - 2
    # every solve gives the warnings of its images
    with warnings.catch_warnings(action="ignore", category=DataWarning):
        if not frames.problem(0).load_pair().focal_sigma > 0:
            return frames
        for k in sorted({*np.linspace(0, last, PROBED).astype(int)}):
            with suppress(SoupError):
                pairs.append(observed_pair(frames.problem(int(k))))
    if not pairs:
        return frames
    surest = min(pairs, key=lambda pair: pair.focal_sigma)
    focal, sigma = surest.K_ref[0, 0], surest.focal_sigma
    fov = float(np.degrees(2 * np.arctan(surest.size[1] / (2 * focal))))
    warnings.warn(
        f"{frames.names[0]}: no intrinsics; focal length of all frames by the flow {focal:.0f} px"
        f" ({fov:.0f} degrees of view horizontally), right to {sigma:.0%}",
        DataWarning,
        stacklevel=3,
    )
    return replace(frames, camera={**frames.camera, "fov": fov, "focal_sigma": sigma})
