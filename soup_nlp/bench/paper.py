"""The cells of `bench paper`: datasets and studies of the paper, by its method and the defaults."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd

from soup_nlp.bench.accuracy import has_depth, scores, solved
from soup_nlp.bench.studies import DEPARTURES, PAPER, STUDIES, without
from soup_nlp.bench.study import Cell, Item, Overrides
from soup_nlp.bench.suites import RENDERED, Options, list_suite, spread
from soup_nlp.config.presets import overrides_of
from soup_nlp.errors import DataError, SoupError
from soup_nlp.pipeline.record import Run
from soup_nlp.storage.files import atomic_path
from soup_nlp.storage.rows import Row

METHODS: Mapping[str, Overrides] = MappingProxyType({"preset: paper": PAPER, "defaults": ()})
"""Overrides by the name of a method."""
DATASETS: Mapping[str, tuple[str, tuple[str, ...], str]] = MappingProxyType(
    {
        "sintel": ("MPI Sintel", ("sintel",), "sintel70"),
        "vkitti": ("Virtual KITTI", ("vkitti",), "eigen80"),
        "kitti": ("KITTI", ("kitti2012", "kitti2015"), "eigen80"),
        "kinect_paper": ("kinect_paper", ("kinect_paper",), ""),
        "kinect_tshirt": ("kinect_tshirt", ("kinect_tshirt",), ""),
    }
)
"""Title, suites, and metric convention with a depth cap of the paper's datasets. Without data of a
suite, the families of these names in the suite `shared` are taken."""
SHARED = ("motorcycle", "driving_synthetic", "tum_fr1", "kitti2015", "kitti_tracking", "rgbd")
FAMILIES = (*RENDERED, *SHARED, "deepdeform", *DATASETS)
"""Every family that the studies can have; one without data is left out."""
SECTIONS = ("ablation", "superpixels", "neighbours", "pattern", "flow", "stages")
"""Studies that the page repeats for both methods."""
ALL_SECTIONS = (*SECTIONS, "departures")
BASE = "as they are"
"""Name of the methods without a change, among the departures."""
PRINTED_SUPERPIXELS = 1000
"""Number of superpixels for which the preset gives its weights."""
MAP_WIDTH = 240
"""Columns of a small depth map, at most."""

_LENGTHS = tuple(f"energy.weights.{term}=" for term in ("arap", "cont"))
PRINTED: Mapping[str, Overrides] = {
    "preset: paper": tuple(o for o in overrides_of("paper") if o.startswith(_LENGTHS)),
    "defaults": (),
}
"""Weights of a method that are given for PRINTED_SUPERPIXELS."""


@dataclass(frozen=True)
class Sizes:
    """Size of the benchmark.

    Attributes:
        superpixels: Number of superpixels in the comparison of datasets.
        analysis: Number of superpixels in all other sections.
        limit: Most pairs of a dataset, evenly spaced; None for all.
        width: Columns of rendered scenes.
        families: Pairs of the sections, of FAMILIES.
        departures: Pairs of the departures, by the same names.
        overrides: Overrides of every problem.
        sections: Sections of ALL_SECTIONS that are measured beside the comparison.
    """

    superpixels: int = 1000
    analysis: int = 500
    limit: int | None = None
    width: int = 1024
    families: tuple[str, ...] = ("street", "room", "motorcycle", "kitti", "kinect_paper")
    departures: tuple[str, ...] = FAMILIES
    overrides: Overrides = ()
    sections: tuple[str, ...] = ALL_SECTIONS


@dataclass(frozen=True)
class Plan:
    """Cells of the benchmark.

    Attributes:
        sizes: See Sizes.
        datasets: Available pairs with truth by dataset.
        table: A line for each cell of each section, with the columns section ("comparison", a
            study, or "departures"), method, change (variant), name (of the pair), cell and key.
    """

    sizes: Sizes
    datasets: Mapping[str, tuple[Item, ...]]
    table: pd.DataFrame

    def cells(self) -> list[Cell]:
        """All cells without duplicates."""
        return list(self.table.drop_duplicates("key")["cell"])

    def sections(self, frame: pd.DataFrame) -> dict[str, pd.DataFrame]:
        """The table with the measured rows, by section; NaN where not measured."""
        rows = frame.drop_duplicates("key").set_index("key")
        whole = self.table.join(rows.drop(columns=["variant"]), on="key")
        return {str(name): rows for name, rows in whole.groupby("section", sort=False)}


def make_plan(data: Path | None, sizes: Sizes, folder: Path) -> Plan:
    """The plan of the pairs that are available in the folder `data`.

    Cells of the comparison write small depth maps to FOLDER/maps.
    """
    datasets = {name: _dataset(name, data, sizes.limit) for name in DATASETS}
    analysed = _families(sizes.families, datasets, data, sizes.width)
    departing = _families(sizes.departures, datasets, data, sizes.width)
    compared = {i.key: i for i in (*(i for group in datasets.values() for i in group), *analysed)}
    lines: list[dict[str, Any]] = []

    def add(section: str, items: Iterable[Item], n: int = sizes.analysis) -> None:
        for item in items:
            for method, base in METHODS.items():
                for change, changes in _variants(section, method).items():
                    count = int(change) if section == "superpixels" else n
                    size = f"segmentation.superpixels={count}", *_scaled(PRINTED[method], count)
                    every = (*base, *size, *sizes.overrides, *_scaled(changes, count))
                    maps = None
                    if section == "comparison":
                        name = f"{item.key}-{method}".replace(": ", "_")
                        maps = folder / "maps" / f"{name.replace('/', '-').replace(' ', '_')}.npz"
                    cell = Cell(item, every, ", ".join(every), maps)
                    line = {"section": section, "method": method, "change": change}
                    lines.append(
                        {**line, "name": item.name, "cell": cell, "key": cell.identity()["key"]}
                    )

    add("comparison", compared.values(), sizes.superpixels)
    for section in SECTIONS:
        if section in sizes.sections:
            rendered = (i for i in analysed if i.suite == "rendered")
            add(section, rendered if section == "flow" else analysed)
    if "departures" in sizes.sections:
        add("departures", departing)
    columns = ["section", "method", "change", "name", "cell", "key"]
    return Plan(sizes, datasets, pd.DataFrame(lines, columns=columns))


def _variants(section: str, method: str) -> Mapping[str, Overrides]:
    """Changes of a method in a section."""
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
        scaled = o in PRINTED["preset: paper"] and n != PRINTED_SUPERPIXELS
        out.append(f"{key}={float(value) * n / PRINTED_SUPERPIXELS:g}" if scaled else o)
    return tuple(out)


def _families(
    names: tuple[str, ...], found: Mapping[str, tuple[Item, ...]], data: Path | None, width: int
) -> tuple[Item, ...]:
    """The first pair of each family that has one; motorcycle needs no data."""
    out: list[Item] = []
    for name in names:
        if name in found:
            out += found[name][:1]
        elif name == "motorcycle":
            out.append(Item("shared", name, name, "dis", {"kind": name}, ("paper", "best")))
        elif name in RENDERED:
            out += list_suite("rendered", None, Options(("dis",), width, (0,), None, (name,))).items
        else:
            out += _with_truth("shared", data, (name,))[:1]
    return tuple(out)


def _dataset(name: str, data: Path | None, limit: int | None) -> tuple[Item, ...]:
    """At most `limit` pairs of a dataset that have a truth, evenly spaced."""
    _, suites, cap = DATASETS[name]
    listed = [i for suite in suites for i in _with_truth(suite, data)]
    listed = listed or _with_truth("shared", data, suites)
    if limit is not None and listed:
        listed = [listed[k] for k in spread(len(listed), limit)]
    return tuple(i.scored_by((*i.presets, cap)) if cap else i for i in listed)


def _with_truth(suite: str, data: Path | None, sequences: tuple[str, ...] = ()) -> list[Item]:
    """The pairs of a suite, or of some of its sequences, that have a depth to compare with."""
    try:
        items = () if data is None else list_suite(suite, data, Options(("dis",))).items
    except DataError:
        return []
    wanted = [i for i in items if not sequences or i.sequence in sequences]
    return [i.scored_by(("paper", "best")) for i in wanted if _has_truth(i)]


def _has_truth(item: Item) -> bool:
    try:
        return has_depth(item.problem().load_pair().truth)
    except SoupError:
        return False


def measure_paper(item: Item, overrides: Overrides = (), maps: Path | None = None) -> Row:
    """The row of `measure_pair` with energies on the way; small depth maps go to a file.

    "curve" has "names" and "values", the smoothed energy by stage and iteration, "exact", the exact
    energies of start and NLP, and "rounds", the objective of the refinement before its rounds and
    after each.

    Raises:
        SoupError: the pair cannot be solved or scored.
    """
    result = solved(item, overrides)
    if maps is not None:
        write_maps(maps, result)
    s, refined = result.solution, result.refined
    rounds = [refined.energy_begin, *(r.energy for r in refined.rounds)] if refined else []
    curve = {
        "names": [stage.name for stage in s.stages],
        "values": [[float(f) for f in stage.history.get("obj", ())] for stage in s.stages],
        "exact": [s.energy_start["total"], s.energy["total"]],
        "rounds": [energy["total"] for energy in rounds],
    }
    return {**scores(result, item.presets), "curve": curve}


def write_maps(path: Path, result: Run) -> None:
    """Write image, truth, start and solution as .npz, subsampled to MAP_WIDTH columns."""
    pair = result.pair
    step = max(1, -(-pair.size[1] // MAP_WIDTH))
    depths = {"start": result.start_reconstruction, "solution": result.reconstruction}
    maps: dict[str, np.ndarray] = {
        name: r.depth_ref.astype(np.float32) for name, r in depths.items()
    }
    if pair.truth is not None and pair.truth.depth_ref is not None:
        maps["truth"] = pair.truth.depth_ref.astype(np.float32)
    maps["image"] = pair.image_ref
    small = {name: m[::step, ::step] for name, m in maps.items()}
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **small)
