"""The cells of `bench paper`: datasets and studies of the paper, by its method and the defaults."""

from collections.abc import Mapping
from contextlib import suppress
from itertools import product
from pathlib import Path
from textwrap import shorten

import numpy as np
import pandas as pd

from soup_nlp.bench.accuracy import has_depth, scores, solved
from soup_nlp.bench.studies import DEPARTURES, PAPER, STUDIES, without
from soup_nlp.bench.study import Cell, Item, Overrides
from soup_nlp.bench.suites import MOTORCYCLE, RENDERED, Options, list_suite, spread
from soup_nlp.config.presets import overrides_of
from soup_nlp.errors import DataError, SoupError
from soup_nlp.pipeline.record import Run
from soup_nlp.storage.rows import Row

METHODS: Mapping[str, Overrides] = {"preset: paper": PAPER, "defaults": ()}
"""Overrides by the name of a method."""
DATASETS: Mapping[str, tuple[str, tuple[str, ...]]] = {
    "sintel": ("MPI Sintel", ("sintel",)),
    "vkitti": ("Virtual KITTI", ("vkitti",)),
    "kitti": ("KITTI", ("kitti2012", "kitti2015")),
    "kinect_paper": ("kinect_paper", ("kinect_paper",)),
    "kinect_tshirt": ("kinect_tshirt", ("kinect_tshirt",)),
}
"""Title and suites of the paper's datasets. Without data of a suite, the families of these names in
the suite `shared` are taken."""
STUDIED = ("street", "room", MOTORCYCLE.name, "kitti", "kinect_paper")
"""Families whose first pairs all studies have."""
DEPARTING = (*STUDIED, "banner", "tum_fr1", "kitti_tracking", "rgbd")
"""Families whose first pairs the departures have: three rendered, six real."""
BASE = "as they are"
"""Name of the methods without a change, among the departures."""
PRINTED_SUPERPIXELS = 1000
"""Number of superpixels for which the preset gives its weights."""
MAP_WIDTH = 240
"""Columns of a small depth map, at most."""
COLUMNS = ("section", "method", "change", "dataset", "name", "cell", "key")

_LENGTHS = tuple(f"energy.weights.{term}=" for term in ("arap", "cont"))
PRINTED = tuple(o for o in overrides_of("paper") if o.startswith(_LENGTHS))
"""Weights of the preset that are given for PRINTED_SUPERPIXELS."""


def make_plan(
    data: Path | None,
    folder: Path,
    superpixels: int = 1000,
    analysis: int = 500,
    limit: int | None = None,
    overrides: Overrides = (),
) -> pd.DataFrame:
    """The cells of the pairs that are available in the folder `data`.

    Args:
        data: Root folder of the datasets.
        folder: Cells of the comparison write small depth maps to FOLDER/maps.
        superpixels: Number of superpixels in the comparison of datasets.
        analysis: Number of superpixels in all other sections.
        limit: Most pairs of a dataset, evenly spaced; None for all.
        overrides: Overrides of every problem.

    Returns:
        A line for each cell of each section, with COLUMNS: section ("comparison", a study, or
        "departures"), method, change (variant), dataset (of the comparison), name of the pair, cell
        and its key.
    """
    datasets = {name: _dataset(name, data, limit) for name in DATASETS}
    studied = [("", item) for item in _families(STUDIED, datasets, data)]
    rendered = [("", item) for _, item in studied if item.suite == "rendered"]
    compared = [(name, item) for name, items in datasets.items() for item in items]
    compared_keys = {item.key for _, item in compared}
    compared += [("", item) for _, item in studied if item.key not in compared_keys]
    sections = {
        "comparison": compared,
        **{name: rendered if name == "flow" else studied for name in STUDIES},
        "departures": [("", item) for item in _families(DEPARTING, datasets, data)],
    }
    lines = []
    for section, items in sections.items():
        for (dataset, item), (method, base) in product(items, METHODS.items()):
            for change, changes in _variants(section, method).items():
                n, maps = analysis, None
                if section == "superpixels":
                    n = int(change)
                if section == "comparison":
                    n, name = superpixels, f"{item.key}-{method}".replace(": ", "_")
                    maps = folder / "maps" / f"{name.replace('/', '-').replace(' ', '_')}.npz"
                printed = _scaled(PRINTED if base else (), n)
                size = f"segmentation.superpixels={n}"
                all_overrides = (*base, size, *printed, *overrides, *_scaled(changes, n))
                cell = Cell(item, all_overrides, ", ".join(all_overrides), maps)
                key = cell.identity()["key"]
                lines.append((section, method, change, dataset, item.name, cell, key))
    return pd.DataFrame(lines, columns=COLUMNS)


def pairs_found(plan: pd.DataFrame) -> list[str]:
    """A line for each section, and dataset of the comparison: number and names of its pairs."""
    groups = plan.groupby(["section", "dataset"], sort=False)["name"].unique()
    return [
        f"{' '.join(filter(None, key))}: {len(names)} pairs: {shorten(', '.join(names), 90)}"
        for key, names in groups.items()
    ]


def _variants(section: str, method: str) -> Mapping[str, Overrides]:
    """Overrides of every variant of a method that a section of the page compares."""
    if section == "comparison":
        return {"": ()}
    if section == "departures":
        off = method == "defaults"
        changes = {d.name: d.off_alone() if off else d.on_alone() for d in DEPARTURES}
        return {BASE: (), **changes}
    variants = dict(STUDIES[section].variants)
    if section == "ablation" and method != "defaults":
        # the paper has no prior
        del variants["+ prior"]
        variants["+ orient"] = without("prior")
    return variants


def _scaled(overrides: Overrides, n: int) -> Overrides:
    """Overrides with the preset's weights, which are given for 1,000 superpixels, scaled to n.

    Since `sum lam = 1`, every length is proportional to 1 / n.
    """
    out = []
    for o in overrides:
        key, _, value = o.partition("=")
        out.append(f"{key}={float(value) * n / PRINTED_SUPERPIXELS:g}" if o in PRINTED else o)
    return tuple(out)


def _families(
    names: tuple[str, ...], datasets: Mapping[str, list[Item]], data: Path | None
) -> list[Item]:
    """The first pair of each family that has one; rendered ones and motorcycle need no data."""
    out: list[Item] = []
    for name in names:
        if name in RENDERED:
            out += list_suite("rendered", None, Options(("dis",), only=(name,)))
        elif name == MOTORCYCLE.name:
            out.append(MOTORCYCLE)
        elif name in datasets:
            out += datasets[name][:1]
        else:
            out += _with_truth("shared", data, (name,))[:1]
    return out


def _dataset(name: str, data: Path | None, limit: int | None) -> list[Item]:
    """At most `limit` pairs of a dataset that have a truth, evenly spaced."""
    _, suites = DATASETS[name]
    listed = [i for suite in suites for i in _with_truth(suite, data)]
    listed = listed or _with_truth("shared", data, suites)
    if limit is not None and listed:
        listed = [listed[k] for k in spread(len(listed), limit)]
    return listed


def _with_truth(suite: str, data: Path | None, sequences: tuple[str, ...] = ()) -> list[Item]:
    """The pairs of a suite, or of some of its sequences, that have a depth to compare with."""
    try:
        items = [] if data is None else list_suite(suite, data, Options(("dis",)))
    except DataError:
        return []
    out = []
    for item in items:
        with suppress(SoupError):
            wanted = not sequences or item.sequence in sequences
            if wanted and has_depth(item.problem().load_pair().truth):
                out.append(item)
    return out


def measure_paper(cell: Cell) -> Row:
    """The row of `measure_pair` with energies on the way; small depth maps go to `cell.keep`.

    "curve" has "names" and "values", the smoothed energy by stage and iteration, "exact", the exact
    energies of start and NLP, and "rounds", the objective of the refinement before the first round
    and after each round.

    Raises:
        SoupError: the pair cannot be solved or scored.
    """
    result = solved(cell)
    if cell.keep is not None:
        write_maps(cell.keep, result)
    s, refined = result.solution, result.refined
    rounds = [refined.energy_begin, *(r.energy for r in refined.rounds)] if refined else []
    curve = {
        "names": [stage.name for stage in s.stages],
        "values": [[float(f) for f in stage.history.get("obj", ())] for stage in s.stages],
        "exact": [s.energy_start["total"], s.energy["total"]],
        "rounds": [energy["total"] for energy in rounds],
    }
    return {**scores(result), "curve": curve}


def write_maps(path: Path, result: Run) -> None:
    """Write image, truth, start and solution as .npz, subsampled to MAP_WIDTH columns."""
    pair = result.pair
    step = max(1, -(-pair.size[1] // MAP_WIDTH))
    maps: dict[str, np.ndarray] = {
        "image": pair.image_ref,
        "start": result.depth_maps["start"].astype(np.float32),
        "solution": result.reconstruction.depth_ref.astype(np.float32),
    }
    if pair.truth is not None and pair.truth.depth_ref is not None:
        maps["truth"] = pair.truth.depth_ref.astype(np.float32)
    small = {name: m[::step, ::step] for name, m in maps.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, allow_pickle=False, **small)
