"""The study of `soup-nlp bench chain`: error caused by one scale for a sequence."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from soup_nlp.bench.studies import Study, number
from soup_nlp.errors import DataError
from soup_nlp.sequence.chain import make_chain
from soup_nlp.sequence.frames import FileFrames, Frames, SceneFrames, find_depths, find_images
from soup_nlp.sequence.pairs import ROWS, solve_pairs
from soup_nlp.sequence.score import score
from soup_nlp.storage.folders import scratch
from soup_nlp.storage.rows import Row, read_rows

RENDERED = "street", "room", "orbit"
TRACKING = "kitti_tracking"


def measure_chain(
    sequence: str, frames: int, data: str | None, overrides: Sequence[str] = ()
) -> Row:
    """Errors of a sequence with a scale for every frame and with one for all.

    `sequence` is a rendered scene or `TRACKING`, whose folder is in `data`.

    Raises:
        DataError: the sequence has no truth.
    """
    source: Frames = SceneFrames(sequence, frames)
    if data is not None and sequence == TRACKING:
        folder = Path(data) / TRACKING
        images = find_images(folder)[:frames]
        camera = {"intrinsics": str(folder / "K.txt")}
        source = FileFrames(tuple(images), camera, tuple(find_depths(images)), 256.0)
    count = len(source)
    with scratch() as place:
        which = [(k, k + 1) for k in range(count - 1)]
        chain = make_chain(solve_pairs(source, which, place, ["output.page=false", *overrides]))
        spent = {row["key"]: row["cpu_seconds"] for row in read_rows(place / ROWS)}
    found = score(chain)
    if found is None:
        raise DataError("sequence has no truth", where=sequence)
    errors = [abs(np.log(k["estimated"] / k["true"])) for k in found["links"]]
    return {
        "frames": count,
        **{key: found[key] for key in ("mre_own_scale", "mre_one_scale", "cost")},
        "worst_link": float(np.expm1(max(errors))),
        "path": None if found["path"] is None else found["path"]["share"],
        "flagged": sum(k.flagged for k in chain.links),
        "pair_seconds": sum(spent.values()) / len(spent),
    }


def _mean(rows: Sequence[Row]) -> list[str]:
    cost = float(np.mean([r["cost"] for r in rows])) if rows else float("nan")
    return ["", f"Mean cost of one scale: {cost:+.2%} of the MRE."]


CHAIN = Study(
    "chain",
    "MRE (no cap) of sequences whose pairs are put on one scale (`soup-nlp chain`), mean over the"
    " frames: with a median scale for every frame, and with one for the sequence. A link is the"
    " estimated ratio of the scales of two pairs over the true one. Error of the camera's path:"
    " RMSE of its positions after the best similarity, over the path's length (no true path of"
    " kitti_tracking is known). DIS flow, default options.",
    measure_chain,
    {
        "sequence": lambda r: r["settings"]["sequence"],
        "frames": number("frames"),
        "a scale for every frame": number("mre_own_scale", ".4f"),
        "one scale": number("mre_one_scale", ".4f"),
        "cost": number("cost", "+.2%"),
        "worst link off by": number("worst_link", ".2%"),
        "error of the path": lambda r: "" if r["path"] is None else f"{r['path']:.2%}",
        "links without parallax": number("flagged"),
        "CPU s a pair": number("pair_seconds", ".0f"),
    },
    _mean,
)
