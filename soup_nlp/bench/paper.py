"""The cells of `bench paper`: datasets and studies of the paper, by its method and the defaults."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from soup_nlp.bench.accuracy import scores, solved
from soup_nlp.bench.studies import DEPARTURES, PAPER, STUDIES, without
from soup_nlp.bench.study import Cell, Overrides
from soup_nlp.bench.suite_pairs import RENDERED, Item, Options, spread
from soup_nlp.bench.suites import list_suite
from soup_nlp.config.presets import overrides_of
from soup_nlp.errors import DataError, SoupError
from soup_nlp.evaluate.metrics import depth_metrics
from soup_nlp.evaluate.scoring import at_truth
from soup_nlp.pipeline.record import Run
from soup_nlp.storage.atomic import atomic_path
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
PRINTED_SUPERPIXELS = 1000
"""Number of superpixels for which the preset gives its weights."""
MAP_WIDTH = 240
"""Columns of a small depth map, at most."""

_LENGTHS = tuple(f"energy.weights.{term}" for term in ("arap", "cont"))
_PRINTED: Overrides = tuple(o for o in overrides_of("paper") if o.partition("=")[0] in _LENGTHS)


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
    """Cells of the benchmark by section, name of the change, method and pair.

    Attributes:
        sizes: See Sizes.
        datasets: Available pairs with truth by dataset.
        sections: Cells by section ("comparison", a study, or "departures"), and by (method, name
            of the variant, pair).
    """

    sizes: Sizes
    datasets: Mapping[str, tuple[Item, ...]]
    sections: Mapping[str, Mapping[tuple[str, str, str], Cell]]

    def cells(self) -> list[Cell]:
        """All cells without duplicates."""
        every = (c for cells in self.sections.values() for c in cells.values())
        return list({(c.item.key, c.overrides): c for c in every}.values())


def make_plan(data: Path | None, sizes: Sizes, folder: Path) -> Plan:
    """The plan of the pairs that are available in the folder `data`.

    Cells of the comparison write small depth maps to FOLDER/maps.
    """
    datasets = {name: _dataset(name, data, sizes.limit) for name in DATASETS}
    analysed = _families(sizes.families, datasets, data, sizes.width)
    compared = list(
        {i.key: i for i in [*(i for group in datasets.values() for i in group), *analysed]}.values()
    )
    sections: dict[str, dict[tuple[str, str, str], Cell]] = {"comparison": {}}
    for item in compared:
        for method in METHODS:
            name = item.key.replace("/", "-").replace(" ", "_")
            maps = folder / "maps" / f"{name}-{method.replace(': ', '_')}.npz"
            own = _at_size(METHODS[method], sizes.superpixels, sizes.overrides)
            cell = Cell(item, own, ", ".join(own), maps)
            sections["comparison"][method, "", item.name] = cell
    for section in SECTIONS:
        if section in sizes.sections:
            sections[section] = _section(section, analysed, sizes)
    if "departures" in sizes.sections:
        departing = _families(sizes.departures, datasets, data, sizes.width)
        sections["departures"] = _departures(departing, sizes)
    return Plan(sizes, datasets, sections)


def _section(name: str, items: tuple[Item, ...], sizes: Sizes) -> dict[tuple[str, str, str], Cell]:
    """Cells of a study by both methods; `flow` has the rendered pairs only."""
    out = {}
    for item in items:
        for method, base in METHODS.items():
            variants = dict(STUDIES[name].variants)
            if name == "ablation" and method != "defaults":
                # the paper has no prior
                del variants["+ prior"]
                variants["+ orient"] = without("prior")
            for variant, changes in variants.items():
                n = int(variant) if name == "superpixels" else sizes.analysis
                own = _at_size(base, n, (*sizes.overrides, *changes))
                if name != "flow" or item.suite == "rendered":
                    out[method, variant, item.name] = Cell(item, own, ", ".join(own))
    return out


def _departures(items: tuple[Item, ...], sizes: Sizes) -> dict[tuple[str, str, str], Cell]:
    """Cells of the departures: both methods as they are, each one undone or made alone."""
    out = {}
    for item in items:
        for method, base in METHODS.items():
            own = _at_size(base, sizes.analysis, sizes.overrides)
            out[method, "as they are", item.name] = Cell(item, own, ", ".join(own))
            for d in DEPARTURES:
                changes = d.off_alone() if method == "defaults" else d.on_alone()
                if changes is not None:
                    change = _scaled(tuple(o for o in changes if o not in PAPER), sizes.analysis)
                    whole = (*own, *change)
                    out[method, d.name, item.name] = Cell(item, whole, ", ".join(whole))
    return out


def _at_size(method: Overrides, n: int, more: Overrides) -> Overrides:
    """Overrides of a method with n superpixels, and further ones."""
    weights = _PRINTED if method == PAPER else ()
    return (*method, f"segmentation.superpixels={n}", *_scaled(weights, n), *more)


def _scaled(overrides: Overrides, n: int) -> Overrides:
    """Overrides with the preset's weights, which are given for 1,000 superpixels, scaled to n.

    Since `sum lam = 1`, every length is proportional to 1 / n.
    """
    out = []
    for o in overrides:
        key, _, value = o.partition("=")
        scaled = o in _PRINTED and n != PRINTED_SUPERPIXELS
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
            listed = (i for i in _listed("shared", data) if i.sequence == name and _has_truth(i))
            out += [i.scored_by(("paper", "best")) for i in listed][:1]
    return tuple(out)


def _dataset(name: str, data: Path | None, limit: int | None) -> tuple[Item, ...]:
    """At most `limit` pairs of a dataset that have a truth, evenly spaced."""
    _, suites, cap = DATASETS[name]
    listed = [i for suite in suites for i in _listed(suite, data) if _has_truth(i)]
    if not listed:
        shared = [i for i in _listed("shared", data) if i.sequence in suites]
        listed = [i for i in shared if _has_truth(i)]
    if limit is not None and listed:
        listed = [listed[k] for k in spread(len(listed), limit)]
    return tuple(i.scored_by(("paper", "best", *([cap] if cap else []))) for i in listed)


def _listed(name: str, data: Path | None) -> tuple[Item, ...]:
    try:
        return () if data is None else list_suite(name, data, Options(("dis",))).items
    except DataError:
        return ()


def _has_truth(item: Item) -> bool:
    """Whether the pair can be loaded and has a depth to compare with."""
    try:
        truth = item.problem().load_pair().truth
    except SoupError:
        return False
    return truth is not None and (truth.depth_ref is not None or truth.points is not None)


def measure_paper(item: Item, overrides: Overrides = (), maps: Path | None = None) -> Row:
    """The row of `measure_pair` with energies on the way; small depth maps go to a file.

    Raises:
        SoupError: the pair cannot be solved or scored.
    """
    result = solved(item, overrides)
    if maps is not None:
        write_maps(maps, result)
    truth, rmse = result.pair.truth, None
    if truth is not None and (truth.depth_ref is not None or truth.points is not None):
        rmse = depth_metrics(*at_truth(truth, result.reconstruction.depth_ref), scale="lsq").rmse
    return {**scores(result, item.presets), "curve": _curve(result), "rmse": rmse}


def _curve(result: Run) -> Row:
    """Energies on the way.

    "names" and "values" have the smoothed energy by stage and iteration, "exact" the exact energies
    of start and NLP, "rounds" the objective of the refinement before its rounds and after each.
    """
    s, refined = result.solution, result.refined
    rounds = []
    if refined is not None:
        rounds = [refined.energy_begin["total"], *(r.energy["total"] for r in refined.rounds)]
    return {
        "names": [stage.name for stage in s.stages],
        "values": [[float(f) for f in stage.history.get("obj", ())] for stage in s.stages],
        "exact": [s.energy_start["total"], s.energy["total"]],
        "rounds": rounds,
    }


def write_maps(path: Path, result: Run) -> None:
    """Write image, truth, start and solution as .npz, subsampled to MAP_WIDTH columns."""
    pair = result.pair
    step = max(1, -(-pair.size[1] // MAP_WIDTH))

    def small(values: NDArray[Any]) -> NDArray[Any]:
        return np.ascontiguousarray(values[::step, ::step])

    maps: dict[str, Any] = {
        "image": small(pair.image_ref),
        "start": small(result.start_reconstruction.depth_ref).astype(np.float32),
        "solution": small(result.reconstruction.depth_ref).astype(np.float32),
    }
    truth = pair.truth
    if truth is not None and truth.depth_ref is not None:
        maps["truth"] = small(truth.depth_ref).astype(np.float32)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, **maps)
