"""The plan of `bench paper`: the rows of every section."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType

from soup_nlp.bench.accuracy import row_identity
from soup_nlp.bench.analyses import ANALYSES, NOISE_PX
from soup_nlp.bench.departures import DEPARTURES, PAPER
from soup_nlp.bench.paper_measures import measure
from soup_nlp.bench.paper_pairs import DATASETS, FAMILIES, masked_pairs, pairs_of, pairs_of_families
from soup_nlp.bench.paper_scale import measure_scale
from soup_nlp.bench.suite_pairs import Item, Options
from soup_nlp.bench.suites import list_suite
from soup_nlp.config.presets import overrides_of
from soup_nlp.storage.rows import Job, attempt

Overrides = tuple[str, ...]

SCALE_SUPERPIXELS = 1000
"""Superpixels of the section on scales of bodies, which solves nothing."""

METHODS: Mapping[str, Overrides] = MappingProxyType({"preset: paper": PAPER, "defaults": ()})
"""Overrides by the name of a method."""


PRINTED_SUPERPIXELS = 1000
"""Number of superpixels for which the preset gives its weights."""
_LENGTHS = tuple(f"energy.weights.{term}" for term in ("arap", "cont"))
_PRINTED: Overrides = tuple(o for o in overrides_of("paper") if o.partition("=")[0] in _LENGTHS)


SECTIONS: Mapping[str, str] = MappingProxyType(
    {
        "terms": "terms of the energy",
        "superpixels": "number of superpixels",
        "neighbours": "K of the K-NN graph",
        "pattern": "superpixels",
        "flow": "flow",
        "stages": "stages",
    }
)
"""Sections that vary one option, with the label of their axis."""
ALL_SECTIONS = (*SECTIONS, "departures", "scale")
"""Sections that can be left out."""


@dataclass(frozen=True)
class Sizes:
    """Size of the benchmark.

    Attributes:
        superpixels: Number of superpixels in the comparison of datasets.
        analysis: Number of superpixels in all other sections.
        limit: Most pairs of a dataset, evenly spaced; None for all.
        numbers: Numbers of superpixels that are compared.
        neighbours: Values of K that are compared.
        width: Columns of rendered scenes.
        seeds: Seeds of rendered scenes for the scales of bodies.
        families: Pairs of the analyses: names of rendered scenes, of datasets, or of families of
            the suite `shared`.
        departures: Pairs of the departures, by the same names.
        overrides: Overrides of every problem.
        sections: Sections of ALL_SECTIONS that are measured beside the comparison.
    """

    superpixels: int = 1000
    analysis: int = 500
    limit: int | None = None
    numbers: tuple[int, ...] = (100, 250, 500, 1000, 2000)
    neighbours: tuple[int, ...] = (4, 8, 15, 20)
    width: int = 1024
    seeds: tuple[int, ...] = (0, 1, 2)
    families: tuple[str, ...] = ("street", "room", "motorcycle", "kitti", "kinect_paper")
    departures: tuple[str, ...] = FAMILIES
    overrides: Overrides = ()
    sections: tuple[str, ...] = ALL_SECTIONS


@dataclass(frozen=True)
class Cell:
    """One row to be measured: a pair under overrides."""

    item: Item
    overrides: Overrides

    @property
    def key(self) -> tuple[str, Overrides]:
        """Unique among all cells."""
        return self.item.key, self.overrides

    def job(self, folder: Path, pictures: bool = False) -> Job:
        """The job of the cell; with `pictures`, depth maps are written to FOLDER/maps."""
        name = row_identity(self.item, self.overrides, ", ".join(self.overrides))
        maps = self.maps(folder) if pictures else None
        work = partial(measure, self.item, self.overrides, maps=maps)
        return Job(name, partial(attempt, work), maps is not None and not maps.is_file())

    def maps(self, folder: Path) -> Path:
        """The file of its small depth maps."""
        kind = "paper" if self.overrides[:1] == PAPER else "defaults"
        return folder / "maps" / f"{self.item.key.replace('/', '-').replace(' ', '_')}-{kind}.npz"


@dataclass(frozen=True)
class Plan:
    """Pairs of the benchmark, and the cells that are measured.

    Attributes:
        sizes: See Sizes.
        datasets: Available pairs with truth by dataset.
        analyses: Pairs of the analyses.
        departing: Pairs of the departures.
        scenes: Rendered scenes and pairs with masks of what moves, for the scales of bodies.
    """

    sizes: Sizes
    datasets: Mapping[str, tuple[Item, ...]]
    analyses: tuple[Item, ...]
    departing: tuple[Item, ...]
    scenes: tuple[Item, ...]

    def cell(self, item: Item, method: str, *overrides: str, superpixels: int = 0) -> Cell:
        """The cell of a pair by a method of METHODS with further overrides."""
        n = superpixels or self.sizes.analysis
        return Cell(item, (*_at_size(METHODS[method], n), *self.sizes.overrides, *overrides))

    def compared(self) -> list[Cell]:
        """Cells of the comparison: all pairs of datasets and analyses, by both methods."""
        items = [i for group in self.datasets.values() for i in group]
        known = {i.key for i in items}
        items += [i for i in self.analyses if i.key not in known]
        n = self.sizes.superpixels
        return [self.cell(i, m, superpixels=n) for i in items for m in METHODS]

    def variants(self, section: str, item: Item, method: str) -> dict[str, Cell]:
        """The cells of a pair in a section that varies one option, by name of the variant."""
        s = self.sizes
        if section == "superpixels":
            return {str(n): self.cell(item, method, superpixels=n) for n in s.numbers}
        if section == "flow" and not item.flow.startswith("truth"):
            sources = ["truth", *(f"truth+noise:{px}" for px in NOISE_PX), "dis"]
            return {
                flow: Cell(replace(item, flow=flow), self.cell(item, method).overrides)
                for flow in sources
            }
        changes = _changes(section, method, s)
        return {name: self.cell(item, method, *own) for name, own in changes.items()}

    def items(self, section: str) -> tuple[Item, ...]:
        """Pairs of a section; the section `flow` has the rendered ones only."""
        if section != "flow":
            return self.analyses
        return tuple(i for i in self.analyses if i.suite == "rendered")

    def departures(self, item: Item) -> dict[str, tuple[Cell, Cell | None]]:
        """Cells "off alone" and "on alone" by name of the departure."""
        n, same = self.sizes.analysis, self.sizes.overrides
        out: dict[str, tuple[Cell, Cell | None]] = {}
        for d in DEPARTURES:
            on = d.on_alone()
            off = Cell(item, (*_at_size((), n), *same, *_scaled(d.off_alone(), n)))
            printed = (*_at_size(PAPER, n), *same)
            out[d.name] = off, None if on is None else Cell(item, (*printed, *on[len(PAPER) :]))
        return out

    def cells(self) -> list[Cell]:
        """All cells without duplicates, those of one pair next to each other."""
        cells = {c.key: c for c in self.compared()}
        wanted = self.sizes.sections
        for section in [name for name in SECTIONS if name in wanted]:
            for item in self.items(section):
                for method in METHODS:
                    for cell in self.variants(section, item, method).values():
                        cells.setdefault(cell.key, cell)
        for item in self.departing if "departures" in wanted else ():
            for cell in (self.cell(item, m) for m in METHODS):
                cells.setdefault(cell.key, cell)
            for pair in self.departures(item).values():
                cells.update({c.key: c for c in pair if c is not None and c.key not in cells})
        place: dict[str, int] = {}
        for key, _ in cells:
            place.setdefault(key, len(place))
        return sorted(cells.values(), key=lambda c: place[c.item.key])

    def jobs(self, folder: Path) -> list[Job]:
        """Jobs of all solves; those of the comparison write depth maps."""
        pictures = {c.key for c in self.compared()}
        return [c.job(folder, c.key in pictures) for c in self.cells()]

    def scale_jobs(self) -> list[Job]:
        """Jobs of the section `scale`."""
        own = (f"segmentation.superpixels={SCALE_SUPERPIXELS}",)
        if "scale" not in self.sizes.sections:
            return []
        return [
            Job(
                row_identity(i, own, "scale of one body"),
                partial(attempt, partial(measure_scale, i, own)),
            )
            for i in self.scenes
        ]


def _at_size(method: Overrides, n: int) -> Overrides:
    """Overrides of a method with n superpixels."""
    weights = _PRINTED if method == PAPER else ()
    return (*method, f"segmentation.superpixels={n}", *_scaled(weights, n))


def _scaled(overrides: Overrides, n: int) -> Overrides:
    """Overrides with the preset's weights, which are given for 1,000 superpixels, scaled to n.

    Since `sum lam = 1`, every length is proportional to 1 / n.
    """
    if not set(_PRINTED) & set(overrides) or n == PRINTED_SUPERPIXELS:
        return overrides
    out = []
    for o in overrides:
        key, _, value = o.partition("=")
        factor = n / PRINTED_SUPERPIXELS if o in _PRINTED else None
        out.append(o if factor is None else f"{key}={float(value) * factor:g}")
    return tuple(out)


def _changes(section: str, method: str, s: Sizes) -> dict[str, Overrides]:
    """Overrides by name of the variant."""
    if section == "terms":
        known = dict(ANALYSES["ablation"].variants)
        if method != "defaults":
            # the paper has no prior
            del known["+ prior"]
            known["+ orient"] = ()
        return known
    if section == "neighbours":
        return {str(k): (f"segmentation.neighbours={k}",) for k in s.neighbours}
    if section == "pattern":
        return {m: (f"segmentation.method={m}",) for m in ("slic", "grid")}
    return {"NLP": ("refine.enabled=false",), "refinement": ("refine.from_start=true",), "both": ()}


def make_plan(data: Path | None, sizes: Sizes) -> Plan:
    """The plan of the pairs that are available in the folder `data`."""
    found = {d.name: pairs_of(d, data, sizes.limit) for d in DATASETS}
    analyses = pairs_of_families(sizes.families, found, data, sizes.width)
    departing = pairs_of_families(sizes.departures, found, data, sizes.width)
    moving = Options(("truth",), sizes.width, sizes.seeds, None, ("street", "room"))
    scenes = [*list_suite("rendered", None, moving).items, *masked_pairs(data)]
    return Plan(sizes, found, analyses, departing, tuple(scenes))
