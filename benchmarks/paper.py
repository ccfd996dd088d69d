"""The paper's tables: its datasets, ablation and studies, by its method and by the defaults."""

import json
import os
from collections.abc import Iterable, Mapping
from contextlib import suppress
from itertools import product
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.scores import has_depth
from benchmarks.suites import MOTORCYCLE, Options, list_suite, spread
from benchmarks.table import (
    Cell,
    Item,
    Overrides,
    geometric,
    markdown,
    mre_of,
    page_text,
    provenance,
)
from soup_nlp import SoupError, make_problem
from soup_nlp.config.trees import PRESETS

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
STUDIED = ("street", "room", MOTORCYCLE.name, "kitti2012", "kinect_paper")
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
    "stages": (
        "NLP and refinement, alone and together",
        {"NLP": ("refine.enabled=false",), "refinement": ("refine.from_start=true",), "both": ()},
    ),
}
"""Title and overrides by variant of the studies, which are measured on the same pairs."""
LENGTHS = ("energy.weights.arap", "energy.weights.cont")
"""Weights of the preset that are proportional to 1 / N, since `sum lam = 1`."""
JOINT = (
    ("start.method", "start.ground"),
    (
        *("energy.units", "energy.weights.arap", "energy.weights.proj", "energy.weights.cont"),
        *("energy.weights.orient", "energy.weights.sigma_cont", "energy.weights.sigma_arap"),
        "energy.weights.leak_arap",
    ),
    ("refine.rounds", "refine.stagnation"),
)
"""Options that are undone together."""
NO_EFFECT = {"max_size", "energy.weights.depth"}
"""Options without a departure here: for images of other sizes, for a depth prior."""


def printed() -> dict[str, str]:
    """Options of the preset, by dotted key, as `--set` takes their values."""
    (options,) = pd.json_normalize(PRESETS["paper"]).to_dict("records")
    return {str(key): _text(value) for key, value in options.items()}


def _text(value: object) -> str:
    return ".inf" if value == float("inf") else json.dumps(value)


def departures() -> dict[str, Overrides]:
    """Overrides of the defaults that undo each departure from the paper, by its first option.

    A departure is an option, or several of `JOINT`, in which defaults and preset differ.
    """
    defaults = make_problem({"input": {"kind": "motorcycle"}})
    out: dict[str, Overrides] = {}
    for key, value in printed().items():
        if _text(attrgetter(key)(defaults)) != value and key not in NO_EFFECT:
            group = next((keys[0] for keys in JOINT if key in keys), key)
            out[group] = (*out.get(group, ()), f"{key}={value}")
    return out


# --- cells ----------------------------------------------------------------------------------------


def make_plan(
    data: Path | None,
    superpixels: int = 1000,
    analysis: int = 500,
    limit: int | None = None,
    overrides: Overrides = (),
) -> pd.DataFrame:
    """The cells of the pairs that are available in the folder `data`.

    The comparison of datasets has `superpixels`, and at most `limit` pairs of a dataset, evenly
    spaced; all other sections have as many superpixels as `analysis` says.

    Returns:
        A line for each cell of each section: section ("comparison", a study, or "departures"),
        method, change (variant), dataset (of the comparison), name of the pair, cell and its key.
    """
    pairs = _with_truth(data)
    lines = []

    def add(section: str, item: Item, n: int, variants: Mapping[str, Overrides], *methods: str,
            dataset: str = "") -> None:  # fmt: skip
        for method, (change, more) in product(methods or METHODS, variants.items()):
            if method != "defaults" and change == "+ prior":
                # the paper has no prior
                continue
            size = int(change) if section == "superpixels" else n
            head = (*METHODS[method], *_scaled(method, size), f"segmentation.superpixels={size}")
            cell = Cell(item, (*head, *overrides, *more), ", ".join((*head, *overrides, *more)))
            key = cell.identity()["key"]
            lines.append((section, method, change, dataset, item.name, cell, key))

    for dataset, suites in DATASETS.items():
        listed = [i for i in pairs if i.suite in suites] or [i for i in pairs if i.family in suites]
        count = len(listed) if limit is None else min(limit, len(listed))
        for k in spread(len(listed), count) if listed else ():
            add("comparison", listed[k], superpixels, {"": ()}, dataset=dataset)
    firsts = {item.family: item for item in reversed(pairs)}
    for family in (*STUDIED, *FURTHER):
        if family in firsts:
            item, changes = firsts[family], {BASE: (), **departures()}
            add("departures", item, analysis, changes, "defaults")
            for name, (_, variants) in STUDIES.items() if family in STUDIED else ():
                add(name, item, analysis, variants)
    columns = ["section", "method", "change", "dataset", "name", "cell", "key"]
    return pd.DataFrame(lines, columns=columns)


def _scaled(method: str, n: int) -> Overrides:
    """The preset's weights of `LENGTHS`, which are given for 1,000 superpixels, for n."""
    options = printed() if method != "defaults" else {}
    return tuple(f"{k}={float(v) * n / 1000:g}" for k, v in options.items() if k in LENGTHS)


def _with_truth(data: Path | None) -> list[Item]:
    """Rendered pairs, the motorcycle, and pairs of the folder with a depth to compare with."""
    out = [*list_suite("rendered", None, Options(("dis",))), MOTORCYCLE]
    for suite in (*(name for suites in DATASETS.values() for name in suites), "shared"):
        with suppress(SoupError):
            out += [] if data is None else list_suite(suite, data, Options(("dis",)))
    kept = []
    for item in out:
        with suppress(SoupError):
            if item.suite == "rendered" or has_depth(item.problem().load_pair().truth):
                kept.append(item)
    return kept


# --- the page -------------------------------------------------------------------------------------


def paper_page(page: Path, frame: pd.DataFrame, plan: pd.DataFrame, note: str) -> str:
    """The page of all rows; `note` gives their sizes. A CSV file by pair is written beside it."""
    rows = plan.join(frame.set_index("key").drop(columns="variant"), on="key")
    rows["mre"] = mre_of(rows)
    sections = dict(list(rows.groupby("section", sort=False)))
    measured = f"{int(frame['ok'].eq(True).sum())} of the {len(frame)} rows were measured."
    blocks = ["# The paper, row by row", f"{provenance(frame)}; {os.cpu_count()} cores."]
    blocks += [ABOUT, f"{note} {measured}"]
    if "comparison" in sections:
        blocks += _comparison(page.with_name("pairs.csv"), sections["comparison"])
    blocks += ["Published ablation, MRE:", markdown(ABLATION.rename_axis("sequence"))]
    for name, (title, _) in STUDIES.items():
        blocks += [f"## {title}", "Median MRE of the pairs:"]
        medians: dict[tuple[Any, int], pd.Series] = {}
        for method, group in sections[name].groupby("method", sort=False):
            table = _pivot(group, "name", "change").dropna()
            medians[method, len(table)] = table.median()
        table = pd.DataFrame(medians).T.rename_axis(["method", "pairs"])
        blocks.append(markdown(table))
    return page_text([*blocks, *_departures(sections["departures"])], frame)


def _pivot(rows: pd.DataFrame, index: str, columns: str) -> pd.DataFrame:
    """MRE by two columns, in the order of the rows."""
    table = rows.pivot(index=index, columns=columns, values="mre").astype(float)
    return table.reindex(index=rows[index].unique(), columns=rows[columns].unique())


def _comparison(by_pair: Path, rows: pd.DataFrame) -> list[str]:
    groups = rows.groupby(["dataset", "method"])["mre"].mean()
    table = PUBLISHED.add_suffix(" (published)").join(groups.unstack())
    constant = mre_of(rows, "constant").groupby(rows["dataset"]).mean()
    table["constant depth"] = constant.reindex(table.index)
    maps = {"start": "start", "NLP": "nlp", "refined": "solution", "constant": "constant"}
    pairs = pd.DataFrame({title: mre_of(rows, name) for title, name in maps.items()})
    pairs[["status", "CPU s"]] = rows[["status", "cpu_seconds"]]
    index = pd.MultiIndex.from_frame(rows[["name", "method"]])
    pairs.set_axis(index).to_csv(by_pair, float_format="%.4f")
    return [
        "## Mean relative error per dataset",
        markdown(table.rename_axis("dataset")),
        f"[{by_pair.name}]({by_pair.name}): MRE and status of the NLP by pair.",
    ]


def _departures(rows: pd.DataFrame) -> list[str]:
    mre = _pivot(rows, "change", "name").dropna(axis=1, how="all")
    ratios = (mre / mre.loc[BASE]).drop(BASE)
    counts = zip((ratios > 1.01).sum(axis=1), (ratios < 0.99).sum(axis=1), strict=True)
    table = pd.DataFrame(
        {
            "mean": ratios.apply(geometric, axis=1),
            "median": ratios.median(axis=1),
            "worse / better": [f"{a} / {b}" for a, b in counts],
        }
    )
    text = (
        f"The defaults with one departure undone, on {', '.join(mre)}. Ratio of the MRE to that of"
        " the defaults, above 1 if the departure pays; *mean* is geometric; *worse / better*: pairs"
        " that change by more than 1 %."
    )
    return ["## Departures, one at a time", text, markdown(table.rename_axis("departure"), ".2f")]
