"""What pictures and page show of a result: of a run in memory, or of a result folder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from soup_nlp.data.pair import Pair
from soup_nlp.errors import DataError, printable
from soup_nlp.geometry.components import Components, find_components
from soup_nlp.geometry.graph import Segmentation
from soup_nlp.geometry.soup import Soup
from soup_nlp.report.tree import result_tree
from soup_nlp.storage.files import is_file, read_json, read_text
from soup_nlp.storage.h5_files import ReadTree, read_attrs, read_h5
from soup_nlp.storage.store import Array, Tree, plain

if TYPE_CHECKING:
    from soup_nlp.pipeline.run import Run

Float = NDArray[np.float64]
Image = NDArray[np.uint8]
PAGE = "report.html"
"""Name of the page in a result folder."""


@dataclass(frozen=True)
class Shown:
    """Arrays and texts of a result.

    Attributes:
        name: Of the problem.
        tree: Arrays as in result.h5.
        summary: Contents of summary.json.
        image_ref: (H, W, 3) uint8 RGB; None where it is not known any more.
        image_next: (H', W', 3) likewise.
        unit: Unit of length of the truth, "" where there is none.
        verdict: What was printed at the end.
    """

    name: str
    tree: ReadTree = field(repr=False)
    summary: Mapping[str, Any] = field(repr=False)
    image_ref: Image | None = field(repr=False)
    image_next: Image | None = field(repr=False)
    unit: str
    verdict: str = field(repr=False)

    @property
    def labels(self) -> NDArray[np.integer]:
        """(H, W) superpixel of every pixel."""
        return np.asarray(self.tree["segmentation"]["labels"])

    @cached_property
    def components(self) -> Components:
        """The rigid components of the delivered soup, in the result's unit of length."""
        t = self.tree
        kept = {f.name: t["segmentation"].get(f.name) for f in fields(Segmentation)}
        kept.update({k: t["energy"][k] for k in ("edges", "edge_weight", "pairs")})
        soup = Soup(*(self.soup(k) for k in ("lam", "n", "d", "R", "t")))
        K_ref, K_next = (np.asarray(t["input"][f"K_{k}"], float) for k in ("ref", "next"))
        own = soup, Segmentation(**kept), t["start"]["component"], K_ref, K_next
        return find_components(*own, np.asarray(t["start"]["borrowed"], bool))

    @property
    def bending(self) -> bool:
        """Whether surfaces are taken to bend: then nothing is known to be rigid."""
        return bool(self.tree["start"].get("bending", False))

    @property
    def scale(self) -> float:
        """Factor from the result's unit of length to that of the truth; 1 without truth."""
        found = self.summary["metrics"].get("solution", {}).get("scale")
        return float(found) if found else 1.0

    @property
    def length(self) -> str:
        """Name of the unit of length in which depths are shown."""
        return self.unit or "units"

    def array(self, place: str) -> NDArray[Any] | None:
        """The array at "a/b" of the tree, None where there is none."""
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
    """What a run shows.

    Args:
        run: The run.
        summary: Contents of its summary.json.
        verdict: What is printed at the end.
    """
    truth, pair = run.pair.truth, run.pair
    unit = truth.unit if truth is not None and "solution" in run.metrics else ""
    tree, known = _values(result_tree(run)), plain(summary)
    return Shown(run.problem.name, tree, known, pair.image_ref, pair.image_next, unit, verdict)


def of_folder(folder: Path, pair: Pair | None = None) -> Shown:
    """What a result folder shows.

    Args:
        folder: The folder.
        pair: The result's input, for the images of a folder that does not hold them.

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
    text = _ending(folder / "log.txt")
    return Shown(name, tree, summary, images["ref"], images["next"], unit, text)


def _values(tree: Tree) -> ReadTree:
    """The arrays of a tree without their descriptions, as `read_h5` returns them."""
    return {
        key: np.asarray(item.value) if isinstance(item, Array) else _values(item)
        for key, item in tree.items()
    }


def _ending(log: Path) -> str:
    """The verdict at the end of a log; "" where there is none."""
    if not is_file(log):
        return ""
    lines = [printable(line) for line in read_text(log, "log.txt").splitlines()]
    starts = [k for k, line in enumerate(lines) if line.startswith(("status  ", "solver  "))]
    own = lines[starts[-1] :] if starts else []
    return "\n".join(line for line in own if not line.startswith(("files  ", "look  ", "next  ")))
