"""Pairs of `bench paper`: the paper's datasets, and one pair of every family."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from soup_nlp.bench.paper_measures import has_truth
from soup_nlp.bench.suite_pairs import RENDERED, Item, Options, spread
from soup_nlp.bench.suites import SUITES, list_suite
from soup_nlp.errors import DataError


@dataclass(frozen=True)
class Dataset:
    """A dataset of the paper.

    Attributes:
        name: Name in `bench.published`.
        title: Title in tables.
        suites: Suites of its pairs; `shared` is used if none of them has a pair.
        cap: Metric convention with a depth cap, "" if none is in use.
        sequences: Families of the suite `shared` that belong to this dataset.
    """

    name: str
    title: str
    suites: tuple[str, ...]
    cap: str = ""
    sequences: tuple[str, ...] = ()


DATASETS = (
    Dataset("sintel", "MPI Sintel", ("sintel",), "sintel70", ("sintel",)),
    Dataset("vkitti", "Virtual KITTI", ("vkitti",), "eigen80"),
    Dataset("kitti", "KITTI", ("kitti2012", "kitti2015"), "eigen80", ("kitti2012", "kitti2015")),
    Dataset("kinect_paper", "kinect_paper", ("kinect_paper",), "", ("kinect_paper",)),
    Dataset("kinect_tshirt", "kinect_tshirt", ("kinect_tshirt",)),
)
SHARED = (
    "motorcycle",
    "driving_synthetic",
    "tum_fr1",
    "kitti2015",
    "kitti_tracking",
    "rgbd",
    "deepdeform",
)
"""Families of the suite `shared` that no dataset of the paper has, and KITTI 2015 by itself."""
FAMILIES = (*RENDERED, *SHARED, *(d.name for d in DATASETS))
"""Every family that the analyses can have; one without data is left out."""
WITHOUT_TRUTH = {
    "Back sequence": "no true depth is published with it, nor its intrinsics (Garg et al., CVPR"
    " 2013); the paper shows pictures only",
    "YouTube-Objects": "no true depth (Prest et al., CVPR 2012); the paper shows pictures only",
    "KITTI odometry 00-09": "the published KITTI rows are of this set with LiDAR truth,"
    " https://www.cvlibs.net/datasets/kitti/eval_odometry.php; the rows here are of the stereo and"
    " flow sets",
    "ULDEMV": "the paper draws its errors on KITTI and prints no number",
}
"""Data of the paper without a row here, and the reason."""


def pairs_of_families(
    names: Iterable[str],
    found: Mapping[str, tuple[Item, ...]],
    data: Path | None,
    width: int,
) -> tuple[Item, ...]:
    """The first pair of each family that has one; motorcycle needs no data.

    Args:
        names: Of FAMILIES.
        found: Pairs of the paper's datasets.
        data: Root folder of the datasets.
        width: Columns of rendered scenes.
    """
    own: list[Item] = []
    for name in names:
        if name in found:
            own += found[name][:1]
        elif name == "motorcycle":
            own.append(Item("shared", name, name, "dis", {"kind": name}, ("paper", "best")))
        elif name in SHARED:
            listed = [i for i in _listed("shared", data) if i.sequence == name and has_truth(i)]
            own += [i.scored_by(("paper", "best")) for i in listed[:1]]
        else:
            o = Options(("dis",), width, (0,), None, (name,))
            own += list_suite("rendered", None, o).items
    return tuple(own)


def masked_pairs(data: Path | None) -> list[Item]:
    """Real pairs with a mask of what moves, a true depth and a true flow."""
    out = []
    for name in ("kitti2015", "shared"):
        try:
            listed = list_suite(name, data, Options(("truth",))).items
        except DataError:
            continue
        out += [i for i in listed if i.sequence == "kitti2015"]
    return list({str(dict(i.input)): i for i in out}.values())


def pairs_of(dataset: Dataset, data: Path | None, limit: int | None) -> tuple[Item, ...]:
    """Pairs of a dataset that have a truth, from its suites or else from the suite `shared`.

    At most `limit` of them, evenly spaced.
    """
    listed: list[Item] = []
    for name in dataset.suites:
        listed += [i for i in _listed(name, data) if has_truth(i)]
    if not listed:
        listed = [i for i in _listed("shared", data) if i.sequence in dataset.sequences]
        listed = [i for i in listed if has_truth(i)]
    if limit is not None:
        listed = [listed[k] for k in spread(len(listed), limit)] if listed else []
    presets = ("paper", "best", *([dataset.cap] if dataset.cap else []))
    return tuple(i.scored_by(presets) for i in listed)


def _listed(name: str, data: Path | None) -> Iterable[Item]:
    if data is None:
        return ()
    try:
        return list_suite(name, data, Options(("dis",))).items
    except DataError:
        return ()


def source_of(dataset: Dataset) -> str:
    """Text on the source and the folder layout of a dataset without pairs."""
    suite = SUITES[dataset.suites[0]]
    return f"no pair was given; from {suite.source}, laid out as {suite.layout}"


def title(item: Item) -> str:
    """Name of a pair for tables."""
    return item.name if item.suite in ("rendered", "shared") else f"{item.suite} {item.name}"
