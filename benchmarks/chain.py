"""The error that one scale for a whole sequence causes."""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd

from benchmarks.table import Cell, Item, numbers, page_text, provenance, titled
from soup_nlp import chain
from soup_nlp.errors import DataError
from soup_nlp.sequence.score import score
from soup_nlp.storage.each import Row

NOTE = (
    "MRE (no cap) of sequences whose pairs are put on one scale (`soup-nlp chain`), mean over the"
    " frames: with a median scale for every frame, and with one for the sequence. A link is the"
    " estimated ratio of the scales of two pairs over the true one. Error of the camera's path:"
    " RMSE of its positions after the best similarity, over the path's length (no true path of"
    " kitti_tracking is known). DIS flow."
)
COLUMNS = {
    "frames": ("frames", ".0f"),
    "mre_own_scale": ("a scale for every frame", ".4f"),
    "mre_one_scale": ("one scale", ".4f"),
    "cost": ("cost", "+.2%"),
    "worst_link": ("worst link off by", ".2%"),
    "path": ("error of the path", ".2%"),
    "flagged": ("links without parallax", ".0f"),
    "cpu_seconds": ("CPU s", ".0f"),
}
"""Title and format of every column of the table."""


def sequences(data: Path | None) -> list[Item]:
    """Rendered sequences, and kitti_tracking where its folder is there."""
    scenes = ("street", "room", "orbit")
    out = [Item(s, s, {"kind": "scene", "scene": s}) for s in scenes]
    folder = (data or Path()).resolve() / "kitti_tracking"
    if data is not None and folder.is_dir():
        source = {"kind": "folder", "path": str(folder)}
        out.append(Item(folder.name, folder.name, source, suite="shared"))
    return out


def measure_chain(cell: Cell, frames: int = 10) -> Row:
    """Errors of a sequence with a scale for every frame and with one for all."""
    item = cell.item
    source = item.input.get("path", f"scene:{item.family}")
    with TemporaryDirectory() as folder:
        # KITTI: 256 values per metre
        solved = chain(
            source,
            Path(folder) / "chain",
            frames=frames,
            depth_scale=256.0,
            overrides=cell.overrides,
        )
        scores = score(solved)
    if scores is None:
        raise DataError("sequence has no truth", where=item.name)
    # the scales of consecutive frames would be the same without an error of their link
    errors = np.abs(np.diff(np.log([frame["own_scale"] for frame in scores["frames"]])))
    return {
        "frames": len(solved),
        **{key: scores[key] for key in ("mre_own_scale", "mre_one_scale", "cost")},
        "worst_link": float(np.expm1(max(errors))),
        "path": None if scores["path"] is None else scores["path"]["share"],
        "flagged": sum(k.flagged for k in solved.links),
    }


def chain_page(frame: pd.DataFrame) -> str:
    """The page of all rows."""
    blocks, good = [NOTE, f"{provenance(frame)}."], frame[frame["ok"].eq(True)]
    if len(good):
        blocks.append(titled(good.set_axis(pd.Index(good["pair"], name="sequence")), COLUMNS))
        mean = numbers(good, "cost").mean()
        blocks.append(f"Mean cost of one scale: {mean:+.2%} of the MRE.")
    return page_text(blocks, frame)
