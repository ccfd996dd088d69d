"""The paper's tables: its datasets, ablation and studies, by its method and by the defaults."""

import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd

from benchmarks.scores import has_depth
from benchmarks.suites import MOTORCYCLE, RENDERED, Options, list_suite, spread
from benchmarks.table import (
    Cell,
    Item,
    Overrides,
    geometric,
    markdown,
    metric,
    page_text,
    provenance,
)
from soup_nlp import SoupError
from soup_nlp.config.presets import overrides_of

SOURCE = "Superpixel Soup (Kumar, Dai, Li, TPAMI), table of the performance comparison"
METHODS: Mapping[str, Overrides] = {"preset: paper": ("preset=paper",), "defaults": ()}
DATASETS: Mapping[str, tuple[str, ...]] = {
    "MPI Sintel": ("sintel",),
    "Virtual KITTI": ("vkitti",),
    "KITTI": ("kitti2012", "kitti2015"),
    "kinect_paper": ("kinect_paper",),
    "kinect_tshirt": ("kinect_tshirt",),
}
"""Suites of the paper's datasets. Without data of a suite, the families of these names in the suite
`shared` are taken."""
STUDIED = ("street", "room", MOTORCYCLE.name, "KITTI", "kinect_paper")
"""Families whose first pairs all studies have."""
FURTHER = ("banner", "tum_fr1", "kitti_tracking", "rgbd")
"""Families whose first pairs the departures have as well."""
BASE = "as it is"
"""Name of the defaults without a change, among the departures."""
PUBLISHED = pd.DataFrame(
    {
        "DT": (0.4833, 0.2630, 0.2703, 0.2040, 0.2170),
        "GLRT": (0.4101, 0.3237, 0.4112, 0.0920, 0.1030),
        "BMM": (0.3121, 0.2894, 0.3903, 0.0322, 0.0443),
        "PTA": (0.3177, 0.2742, 0.4090, 0.0520, 0.0420),
        "DMDE": (0.297, np.nan, 0.148, np.nan, np.nan),
        "Superpixel Soup": (0.1643, 0.0925, 0.1254, 0.0472, 0.0480),
    },
    index=list(DATASETS),
)
"""MRE printed in the paper, by dataset and method; none is measured. KITTI is the odometry set
00-09 with LiDAR truth, not the stereo and flow sets of the suites."""
ABLATION = pd.DataFrame.from_dict(
    {
        "alley_1": (0.2248, 0.2022, 0.1697, 0.1606),
        "ambush_4": (0.2381, 0.2093, 0.1701, 0.1676),
        "mountain_1": (0.2127, 0.1923, 0.1492, 0.1405),
        "sleeping_1": (0.2418, 0.2026, 0.1912, 0.1823),
    },
    orient="index",
    columns=["arap", "+ proj", "+ cont", "+ orient"],
)
"""MRE of the paper's ablation table."""
ABOUT = (
    "`preset: paper` is the method as printed; *defaults* are those of this program. What both"
    " differ in is in [the table of departures](../../docs/formulation.md#the-preset-paper)."
    " MRE is the mean relative error of the reference frame's depth at every true pixel after one"
    f" median scale per image. Published numbers are copied, not measured: {SOURCE}; the paper"
    " names neither its scale rule nor a depth cap, nor the pairs; its KITTI is the odometry set"
    " with LiDAR truth, here it is the stereo and flow sets. A dash is a number that is not"
    " published or not measured."
)


def without(*terms: str) -> Overrides:
    """Overrides that switch off terms of the energy."""
    return tuple(f"energy.weights.{t}=0.0" for t in terms)


def over(key: str, values: Iterable[object]) -> dict[str, Overrides]:
    """Variants of one option, named by its values."""
    return {str(v): (f"{key}={v}",) for v in values}


STUDIES: Mapping[str, tuple[str, Mapping[str, Overrides]]] = {
    "ablation": (
        "What each term of the energy adds (the paper's ablation table)",
        {
            "arap": without("proj", "cont", "orient", "prior"),
            "+ proj": without("cont", "orient", "prior"),
            "+ cont": without("orient", "prior"),
            "+ orient": without("prior"),
            "+ prior": (),
        },
    ),
    "superpixels": (
        "Number of superpixels (published: the error hardly falls beyond 1,000)",
        over("segmentation.superpixels", (100, 250, 500, 1000, 2000)),
    ),
    "pattern": (
        "SLIC against a regular grid (published for one frame: slic 0.0912, grid 0.1442)",
        over("segmentation.method", ("slic", "grid")),
    ),
    "flow": (
        "Flow: the truth, the truth with noise of 0.1 to 2 pixels, DIS (rendered scenes)",
        over("flow.source", ["truth", *(f"truth+noise:{p}" for p in (0.1, 0.5, 1, 2)), "dis"]),
    ),
    "stages": (
        "NLP and refinement, alone and together",
        {"NLP": ("refine.enabled=false",), "refinement": ("refine.from_start=true",), "both": ()},
    ),
}
"""Title and overrides by variant of the studies, which are measured on the same pairs."""

DEPARTURES: Mapping[str, tuple[str, ...]] = {
    "start: shared motions, scales by contact": (
        *("start.method", "start.samples", "start.threshold_px", "start.ground"),
    ),
    "pixel units and their weights, truncation of E_arap": (
        *("energy.units", "energy.weights.arap", "energy.weights.proj", "energy.weights.cont"),
        *("energy.weights.orient", "energy.weights.sigma_cont", "energy.weights.sigma_arap"),
        *("energy.weights.leak_arap",),
    ),
    "E_arap and E_prior weak across components": ("energy.arap_across",),
    "E_arap joins the scene": ("energy.arap_scene",),
    "E_cont weak at occlusions": ("energy.cont_occluded",),
    "another energy where surfaces bend": ("start.bending",),
    "prior on relief": ("energy.weights.prior",),
    "order by occlusion": ("energy.weights.order",),
    "borders that follow the flow": ("segmentation.follow_flow_px",),
    "confidence of the flow": ("flow.consistency",),
    "flow seen through reflections": ("flow.see_through",),
    "gauge: d constant": ("formulation.gauge",),
    "visibility": ("formulation.min_facing", "formulation.depth_ratio"),
    "proposals beyond walks, depths within reach": ("refine.proposals",),
    "rounds end early": ("refine.rounds", "refine.stagnation"),
    "images in the refinement": ("refine.photo",),
}
"""Options in which the defaults depart from the paper, by departure. A departure is undone by the
preset's values of its options; what no longer is an option is passed over."""


def undone(departure: str) -> Overrides:
    """Overrides of the defaults that undo a departure."""
    keys = DEPARTURES[departure]
    return tuple(o for o in overrides_of("paper") if o.partition("=")[0] in keys)


# --- cells ----------------------------------------------------------------------------------------


def make_plan(
    data: Path | None,
    superpixels: int = 1000,
    analysis: int = 500,
    limit: int | None = None,
    overrides: Overrides = (),
) -> pd.DataFrame:
    """The cells of the pairs that are available in the folder `data`.

    Args:
        data: Root folder of the datasets.
        superpixels: Number of superpixels in the comparison of datasets.
        analysis: Number of superpixels in all other sections.
        limit: Most pairs of a dataset, evenly spaced; None for all.
        overrides: Overrides of every problem.

    Returns:
        A line for each cell of each section: section ("comparison", a study, or "departures"),
        method, change (variant), dataset (of the comparison), name of the pair, cell and its key.
    """
    datasets = {name: _dataset(name, data, limit) for name in DATASETS}
    studied = _families(STUDIED, datasets, data)
    rendered = [item for item in studied if item.suite == "rendered"]
    compared = [(name, item) for name, items in datasets.items() for item in items]
    known = {item.key for _, item in compared}
    compared += [("", item) for item in studied if item.key not in known]
    lines = []

    def add(section: str, item: Item, method: str, n: int, change: str, *more: str) -> None:
        changes = (*METHODS[method], *_scaled(method, n), f"segmentation.superpixels={n}")
        all_overrides = (*changes, *overrides, *more)
        cell = Cell(item, all_overrides, ", ".join(all_overrides))
        lines.append((section, method, change, "", item.name, cell, cell.identity()["key"]))

    for (dataset, item), method in product(compared, METHODS):
        add("comparison", item, method, superpixels, "")
        lines[-1] = (*lines[-1][:3], dataset, *lines[-1][4:])
    for name, (_, variants) in STUDIES.items():
        for item, method in product(rendered if name == "flow" else studied, METHODS):
            for change, more in variants.items():
                # the paper has no prior
                if not (method != "defaults" and change == "+ prior"):
                    n = int(change) if name == "superpixels" else analysis
                    add(name, item, method, n, change, *more)
    for item in studied + _families(FURTHER, datasets, data):
        for change in (BASE, *DEPARTURES):
            more = undone(change) if change in DEPARTURES else ()
            add("departures", item, "defaults", analysis, change, *more)
    columns = ["section", "method", "change", "dataset", "name", "cell", "key"]
    return pd.DataFrame(lines, columns=columns)


def _scaled(method: str, n: int) -> Overrides:
    """The preset's weights of lengths, which are given for 1,000 superpixels, scaled to n.

    Since `sum lam = 1`, every length is proportional to 1 / n.
    """
    lengths = [o.partition("=") for o in overrides_of("paper") if o.partition("=")[0] in LENGTHS]
    return tuple(f"{k}={float(v) * n / 1000:g}" for k, _, v in lengths if method != "defaults")


LENGTHS = ("energy.weights.arap", "energy.weights.cont")


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
    suites = DATASETS[name]
    listed = [i for suite in suites for i in _with_truth(suite, data)]
    listed = listed or _with_truth("shared", data, suites)
    if limit is not None and listed:
        listed = [listed[k] for k in spread(len(listed), limit)]
    return listed


def _with_truth(suite: str, data: Path | None, families: tuple[str, ...] = ()) -> list[Item]:
    """The pairs of a suite, or of some of its families, that have a depth to compare with."""
    try:
        items = [] if data is None else list_suite(suite, data, Options(("dis",)))
    except SoupError:
        return []
    out = []
    for item in items:
        with suppress(SoupError):
            wanted = not families or item.family in families
            if wanted and has_depth(item.problem().load_pair().truth):
                out.append(item)
    return out


# --- the page -------------------------------------------------------------------------------------


def write_paper(page: Path, frame: pd.DataFrame, plan: pd.DataFrame, note: str) -> None:
    """Write the page and its figures beside it; `note` gives the sizes of the rows."""
    rows = plan.join(frame.set_index("key").drop(columns="variant"), on="key")
    rows["mre"] = metric(rows)
    of_section = dict(list(rows.groupby("section", sort=False)))
    tables = {name: _tables(of_section[name]) for name in STUDIES if name in of_section}
    studies = [f"## {STUDIES[name][0]}" for name in tables]
    texts = [_study(head, tables[name]) for head, name in zip(studies, tables, strict=True)]
    ablation = ["Published ablation, MRE:", markdown(ABLATION.rename_axis("sequence"))]
    measured = f"{int(frame['ok'].eq(True).sum())} of the {len(frame)} rows were measured."
    blocks = [
        *("# The paper, row by row", f"{provenance(frame)}; {os.cpu_count()} cores.", ABOUT),
        *(f"{note} {measured}", *_comparison(of_section["comparison"]), *ablation),
        *(block for text in texts for block in text),
        *_departures(of_section["departures"]),
    ]
    page.write_text(page_text(blocks, frame), encoding="utf-8")


def _comparison(rows: pd.DataFrame) -> list[str]:
    """Tables by dataset and by pair."""
    groups = rows[rows["dataset"] != ""].groupby(["dataset", "method"])["mre"].mean()
    table = PUBLISHED.add_suffix(" (published)").join(groups.unstack())
    constant = metric(rows, "constant").groupby(rows["dataset"]).mean()
    table["constant depth"] = constant.reindex(table.index)
    maps = {"start": "start", "NLP": "nlp", "refined": "solution", "constant": "constant"}
    by_pair = pd.DataFrame({title: metric(rows, name) for title, name in maps.items()})
    by_pair[["status", "CPU s"]] = rows[["status", "cpu_seconds"]]
    index = pd.MultiIndex.from_frame(rows[["name", "method"]])
    forms = dict.fromkeys(by_pair, ".4f") | {"CPU s": ".0f"}
    return [
        *("## Mean relative error per dataset", markdown(table.rename_axis("dataset"))),
        *(
            "Every pair, MRE; the constrained NLP's status:",
            markdown(by_pair.set_axis(index), forms),
        ),
    ]


def _tables(rows: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """MRE by pair and variant, for each method; the last line is the mean of complete lines."""
    out = {}
    for method, group in rows.groupby("method", sort=False):
        table = group.pivot(index="name", columns="change", values="mre").astype(float)
        table = table.reindex(group["name"].unique())[list(group["change"].unique())]
        whole = table.dropna()
        table.loc[f"mean of {len(whole)}"] = whole.mean()
        out[str(method)] = table.rename_axis("pair")
    return out


def _study(head: str, tables: Mapping[str, pd.DataFrame]) -> list[str]:
    texts = ((f"{method}, MRE:", markdown(table)) for method, table in tables.items())
    return [head, *(block for text in texts for block in text)]


def _departures(rows: pd.DataFrame) -> list[str]:
    """Table of the departures, each undone alone."""
    table = rows.pivot(index="change", columns="name", values="mre").astype(float)
    table = table.reindex(index=rows["change"].unique(), columns=rows["name"].unique())
    table = table.dropna(axis=1, how="all")
    ratios = table / table.loc[BASE]
    table.insert(0, "mean", ratios.apply(geometric, axis=1))
    counts = zip((ratios > 1.01).sum(axis=1), (ratios < 0.99).sum(axis=1), strict=True)
    table.insert(1, "worse / better", [f"{a} / {b}" for a, b in counts])
    text = (
        "The defaults with one departure undone, MRE. *Mean*: geometric mean of the ratios to the"
        " first line, above 1 if the departure pays; *worse / better*: pairs that change by more"
        " than 1 %."
    )
    return ["## Departures, one at a time", text, markdown(table.rename_axis("departure"))]
