"""Input of pictures and page, from a run in memory or from a result folder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soup_nlp.arrays import Float, Image, Mask
from soup_nlp.data.pair import Pair
from soup_nlp.errors import DataError, printable
from soup_nlp.geometry.components import Components
from soup_nlp.geometry.soup import Reconstruction
from soup_nlp.pipeline.record import Run
from soup_nlp.report.result import rebuilt
from soup_nlp.report.tree import result_tree
from soup_nlp.storage.files import is_file, read_json, read_text
from soup_nlp.storage.h5_files import ReadTree, read_attrs, read_h5
from soup_nlp.storage.store import Array, Tree, plain

PAGE = "report.html"
"""Name of the page in a result folder."""


@dataclass(frozen=True)
class Shown:
    """Arrays and texts of a result.

    Attributes:
        name: Name of the problem.
        tree: Arrays as in result.h5.
        reconstruction: Dense 3D of both frames, in the result's unit of length.
        components: Rigid components with their motions, in the same unit.
        summary: Contents of summary.json.
        image_ref: (H, W, 3) uint8 RGB; None if it is not available any more.
        image_next: (H', W', 3) likewise.
        unit: Unit of length of the truth, "" without truth.
        verdict: Verdict that was printed at the end of the solve.
    """

    name: str
    tree: ReadTree = field(repr=False)
    reconstruction: Reconstruction
    components: Components
    summary: Mapping[str, Any] = field(repr=False)
    image_ref: Image | None = field(repr=False)
    image_next: Image | None = field(repr=False)
    unit: str
    verdict: str = field(repr=False)

    @property
    def labels(self) -> NDArray[np.integer]:
        """(H, W) superpixel of every pixel."""
        return np.asarray(self.tree["segmentation"]["labels"])

    @property
    def bends(self) -> Mask:
        """(N,) True in regions that bend, which are not rigid."""
        return np.asarray(self.tree["start"]["bends"], bool)

    @property
    def bending(self) -> bool:
        """Whether the whole image bends; then no component is rigid."""
        return bool(self.bends.all())

    @property
    def at_rest(self) -> bool:
        """Whether the initialisation found the camera at rest or only rotating."""
        return bool(self.tree["start"]["at_rest"])

    @property
    def scale(self) -> float:
        """Factor from the unit of length of the result to that of the truth; 1 without truth."""
        found = self.summary["metrics"].get("solution", {}).get("scale")
        return float(found) if found else 1.0

    @property
    def length(self) -> str:
        """Name of the unit of length in which depths are shown."""
        return self.unit or "units"

    def array(self, place: str) -> NDArray[Any] | None:
        """The array at "a/b" of the tree; None if there is none."""
        here: Any = self.tree
        for key in place.split("/"):
            if key not in here:
                return None
            here = here[key]
        return np.asarray(here)

    def soup(self, key: str) -> Float:
        """An array of the delivered soup: lam, n, d, R or t."""
        return np.asarray(self.tree["solution"][key], float)


def of_run(run: Run, summary: Mapping[str, Any], verdict: str) -> Shown:
    """Arrays and texts of a run."""
    truth, pair = run.pair.truth, run.pair
    unit = truth.unit if truth is not None and "solution" in run.metrics else ""
    return Shown(
        name=run.problem.name,
        tree=_values(result_tree(run)),
        reconstruction=run.reconstruction,
        components=run.components,
        summary=plain(summary),
        image_ref=pair.image_ref,
        image_next=pair.image_next,
        unit=unit,
        verdict=verdict,
    )


def of_folder(folder: Path, pair: Pair | None = None) -> Shown:
    """Arrays and texts of a result folder.

    Args:
        folder: The folder.
        pair: Input of the result, for the images of a folder that does not hold them.

    Raises:
        DataError: result.h5 or summary.json is missing or damaged.
    """
    tree = read_h5(folder / "result.h5")
    try:
        summary = read_json(folder / "summary.json", "summary.json")
        name, metrics = summary["name"], summary["metrics"]
    except (KeyError, TypeError) as error:
        raise DataError(
            "summary.json cannot be read", where=folder, found=error, hint="run solve first"
        ) from error
    images = {which: tree["input"].get(f"image_{which}") for which in ("ref", "next")}
    unit = str(read_attrs(folder / "result.h5").get("truth_unit", "unit of the truth"))
    if pair is not None:
        images = {"ref": pair.image_ref, "next": pair.image_next}
        unit = pair.truth.unit if pair.truth is not None else unit
    unit = unit if "solution" in metrics else ""
    try:
        rec, parts = rebuilt(tree)
    except (KeyError, ValueError, IndexError, TypeError) as error:
        raise DataError("result does not hold together", where=folder, found=error) from error
    return Shown(
        name=name,
        tree=tree,
        reconstruction=rec,
        components=parts,
        summary=summary,
        image_ref=images["ref"],
        image_next=images["next"],
        unit=unit,
        verdict=_ending(folder / "log.txt"),
    )


def _values(tree: Tree) -> ReadTree:
    """The arrays of a tree without their descriptions, as `read_h5` returns them."""
    return {
        key: np.asarray(item.value) if isinstance(item, Array) else _values(item)
        for key, item in tree.items()
    }


def _ending(log: Path) -> str:
    """The verdict at the end of a log; "" if there is none."""
    if not is_file(log):
        return ""
    lines = [printable(line) for line in read_text(log, "log.txt").splitlines()]
    starts = [k for k, line in enumerate(lines) if line.startswith(("status  ", "solver  "))]
    own = lines[starts[-1] :] if starts else []
    return "\n".join(line for line in own if not line.startswith(("files  ", "look  ", "next  ")))
