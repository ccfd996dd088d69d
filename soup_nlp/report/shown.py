"""What pictures and page show of a result: of a run in memory, or of a result folder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from soup_nlp.data.pair import Pair
from soup_nlp.errors import DataError, printable
from soup_nlp.geometry.components import Components, find_components
from soup_nlp.geometry.graph import Segmentation
from soup_nlp.geometry.soup import Reconstruction, Soup, reconstruct
from soup_nlp.report.tree import result_tree
from soup_nlp.storage.files import is_file, read_json, read_text
from soup_nlp.storage.h5_files import ReadTree, read_attrs, read_h5
from soup_nlp.storage.store import Array, Tree, plain

if TYPE_CHECKING:
    from soup_nlp.pipeline.record import Run

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
        reconstruction: Dense 3D of both frames, in the result's unit of length.
        components: What moves as one, and how, in the same unit.
        summary: Contents of summary.json.
        image_ref: (H, W, 3) uint8 RGB; None where it is not known any more.
        image_next: (H', W', 3) likewise.
        unit: Unit of length of the truth, "" where there is none.
        verdict: What was printed at the end.
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
    def bending(self) -> bool:
        """Whether surfaces are taken to bend: then nothing is known to be rigid."""
        return bool(self.tree["start"].get("bending", False))

    @property
    def at_rest(self) -> bool:
        """Whether the camera was taken to be at rest, or to turn only."""
        return bool(self.tree["start"].get("at_rest", False))

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
    """What a run shows."""
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
    try:
        rec, parts = _rebuilt(tree)
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


def _rebuilt(tree: ReadTree) -> tuple[Reconstruction, Components]:
    """Reconstruction and components of the delivered soup."""
    soup = Soup(*(tree["solution"][k] for k in ("lam", "n", "d", "R", "t")))
    K_ref, K_next = (tree["input"][f"K_{k}"] for k in ("ref", "next"))
    # what rigid components need of it
    kept = {f.name: tree["segmentation"].get(f.name) for f in fields(Segmentation)}
    seg, start = Segmentation(**kept), tree["start"]
    height, width = tree["depth"]["next"].shape
    rec = reconstruct(soup, seg.labels, K_ref, K_next, (height, width))
    borrowed = start["borrowed"].astype(bool)
    return rec, find_components(soup, seg, start["component"], K_ref, K_next, borrowed)


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
