"""Solving of the pairs of a sequence into result folders; existing results are reused."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soup_nlp.config.problem import make_problem
from soup_nlp.data.formats.images import DataWarning
from soup_nlp.errors import SolverError
from soup_nlp.geometry.soup import Reconstruction
from soup_nlp.report.folder import run
from soup_nlp.report.result import Result, load
from soup_nlp.sequence.frames import Frames, Raw
from soup_nlp.storage.rows import Job, Row, attempt, failed, measure_all, read_rows

ROWS = "pairs.jsonl"
"""File with a row for each pair of a sequence."""
OF_PAIRS = "output.page=false", "refine.rounds=1"
"""Overrides of every pair: the sequence has its own page, and one round of the refinement does most
of its work."""
MAX_GUESSED = 0.5
"""A pair has no parallax if the depth of a larger share of its background is a guess."""


@dataclass(frozen=True, eq=False)
class SolvedPair:
    """A pair of frames with its result.

    Attributes:
        first: Index of the reference frame.
        second: Index of the next frame.
        result: Result of the solve.
        truth: Arrays of the truth by name, as in result.h5; empty if unknown.
        parallax_px: Median displacement that the camera's translation causes, pixels.
    """

    first: int
    second: int
    result: Result
    truth: dict[str, np.ndarray]
    parallax_px: float

    @property
    def still(self) -> bool:
        """Whether most of the background has no parallax, so that its depth is a guess."""
        return self.result.components.background.borrowed > MAX_GUESSED


def solve_pairs(
    frames: Frames,
    which: Sequence[tuple[int, int]],
    folder: Path,
    overrides: Sequence[str] = (),
    workers: int = 1,
    say: Callable[[int, int, Row], None] | None = None,
) -> list[SolvedPair]:
    """Solve pairs of frames in parallel processes; stored results are read.

    Args:
        frames: The sequence.
        which: Indices of the frames of every pair.
        folder: Output folder for `pairs/000_001/` ... and `pairs.jsonl`.
        overrides: Overrides of the problems, such as segmentation.superpixels=500.
        workers: Number of processes.
        say: Called with (done, total, row) after every solve.

    Raises:
        SolverError: a pair cannot be solved.
    """
    jobs, places = [], []
    overrides = [*OF_PAIRS, *overrides]
    # the last row of a pair describes its folder
    last = {str(row.get("key")): row for row in read_rows(folder / ROWS)}
    for first, second in which:
        place = folder.resolve() / "pairs" / f"{first:03d}_{second:03d}"
        raw = {"name": place.name, "input": frames.pair(first, second), "base": str(Path.cwd())}
        name = {"key": place.name, "input": raw["input"], "overrides": overrides}
        stored = last.get(place.name, {})
        same = (place / "result.h5").is_file() and all(stored.get(k) == name[k] for k in name)
        work = partial(attempt, partial(_solve, raw, tuple(overrides), place))
        jobs.append(Job(name, work, stale=not same))
        places.append(place)

    def told(done: int, total: int, row: Row) -> None:
        # those of a worker process would be printed as Python prints them
        for text in row.get("warnings", ()):
            warnings.warn(text, DataWarning, stacklevel=2)
        if say:
            say(done, total, row)

    rows = measure_all(jobs, folder / ROWS, workers, say=told)
    wrong = [row for row in rows if failed(row)]
    if wrong:
        raise SolverError(
            f"{len(wrong)} of {len(rows)} pairs cannot be solved",
            where=wrong[0]["key"],
            found=wrong[0]["error"],
            hint="the others are kept: the same command goes on",
        )
    return [read_pair(*pair, place) for pair, place in zip(which, places, strict=True)]


def _solve(raw: Raw, overrides: tuple[str, ...], place: Path) -> Row:
    """Solve a pair into its folder."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        done = run(make_problem(raw, overrides, where="sequence"))
        done.save(place)
    said = {str(w.message): None for w in caught if issubclass(w.category, DataWarning)}
    return {
        "warnings": [*said],
        "converged": done.solution.converged,
        "components": len(done.components),
        "mre": done.metrics["solution"].mre if "solution" in done.metrics else None,
    }


def read_pair(first: int, second: int, place: Path) -> SolvedPair:
    """The pair of two frames from its result folder."""
    result = load(place)
    tree = result.tree
    static = result.components.of_superpixel == 0
    parallax = float(np.median(tree["start"]["parallax"][static]))
    # a chain holds many pairs, whose other arrays it does not need
    kept = replace(result, tree={})
    return SolvedPair(first, second, kept, dict(tree.get("truth", {})), parallax)


def carried(of_pixel: NDArray[np.generic], rec: Reconstruction) -> NDArray[Any]:
    """(H', W') labels of the reference frame in the next frame; -1 where not visible."""
    source = rec.source_next
    return np.where(source >= 0, of_pixel.ravel()[source], -1)
