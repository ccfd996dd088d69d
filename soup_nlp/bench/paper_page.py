"""The page of `bench paper`: every table and figure of the paper that its rows allow."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from soup_nlp.bench import paper_figures as figures
from soup_nlp.bench.departures import DEPARTURES
from soup_nlp.bench.paper_plan import (
    ALL,
    DATASETS,
    METHODS,
    SECTIONS,
    WITHOUT_TRUTH,
    Cell,
    Plan,
    source_of,
    title,
)
from soup_nlp.bench.paper_scale import KINDS, lowest
from soup_nlp.bench.processes import processor
from soup_nlp.bench.published import ABLATION, COMPARISON, DATA, GRID_AGAINST_SLIC, SOURCE
from soup_nlp.bench.rows import Row, failed
from soup_nlp.bench.suite_pairs import Item
from soup_nlp.bench.tables import failures, get, joined, made, mean, show, table
from soup_nlp.evaluate.protocols import preset
from soup_nlp.solve.ipopt import GOOD
from soup_nlp.storage.atomic import write_text
from soup_nlp.storage.folders import staged

Number = float | None
TEXTS: Mapping[str, str] = {
    "terms": "What each term of the energy adds (the paper's ablation table and figure)",
    "superpixels": "Number of superpixels",
    "neighbours": "K of the K-NN graph",
    "pattern": "SLIC against a regular grid",
    "flow": "Flow: the truth, the truth with noise, DIS",
    "stages": "NLP and refinement apart",
}
PAGE = "README.md"
FIGURES = ("comparison", "depth_maps", "convergence", "departures", "scale", *SECTIONS)
FILES = (PAGE, *(f"{name}.png" for name in FIGURES))
"""Names of all files that `write_page` may write."""
NEAR = 0.1
"""A scale is right that is within this of the truth."""


@dataclass(frozen=True)
class Results:
    """Rows by pair and overrides."""

    plan: Plan
    rows: Sequence[Row]
    scales: Sequence[Row]

    def row(self, cell: Cell) -> Row:
        """The row of a cell; one that is not ok where it is not there yet."""
        key, overrides = cell.item.key, list(cell.overrides)
        for row in self.rows:
            if row["overrides"] == overrides and row["key"].startswith(key):
                return row
        return {"ok": False, "metrics": {}}

    def mre(self, cell: Cell, convention: str = "paper", method: str = "solution") -> Number:
        """MRE of a cell."""
        return get(self.row(cell), convention, method)


def write_page(out: Path, results: Results, command: str) -> Path:
    """Write OUT/README.md and its figures."""
    chosen = results.plan.sizes.sections
    with staged(out) as new:
        sections = [
            _head(results, command),
            _comparison(new, results),
            _pictures(new, results, out),
            *(_section(new, results, name) for name in SECTIONS if name in chosen),
            _convergence(new, results),
            _time(results),
            _departures(new, results) if "departures" in chosen else [],
            _scale(new, results) if "scale" in chosen else [],
            _missing(results),
            failures([*results.rows, *results.scales]),
        ]
        write_text(new / PAGE, joined([line for lines in sections for line in lines]))
    return out / PAGE


def _head(r: Results, command: str) -> list[str]:
    s = r.plan.sizes
    changed = ", ".join(f"`{o}`" for o in s.overrides)
    return [
        "# The paper, row by row",
        "",
        f"Made by `{command}`. {made([*r.rows, *r.scales])}. Flow by OpenCV DIS unless named."
        f" Machine: {os.cpu_count()} cores of an {processor()}.",
        f"Superpixels wanted: {s.superpixels} in the comparison, {s.analysis} elsewhere."
        + (f" Overrides of every row: {changed}." if changed else ""),
        "",
        "`preset: paper` is the method as printed; *defaults* are those of this program. What both"
        " differ in is in [the table of departures](../../docs/formulation.md#the-preset-paper)."
        " MRE is the mean relative error of the reference frame's depth after one global scale per"
        " image. Published numbers are copied, not measured:"
        f" {SOURCE}; the paper names neither its scale rule nor a depth cap. A dash is a number"
        " that is not published, or a row that was not measured in this run.",
        "",
    ]


def _figure(name: str, text: str) -> list[str]:
    return ["", f"![{text}]({name}.png)", ""]


def _compared(r: Results, items: Sequence[Item], method: str) -> list[Cell]:
    return [r.plan.cell(i, method, superpixels=r.plan.sizes.superpixels) for i in items]


def _comparison(out: Path, r: Results) -> list[str]:
    lines = ["## Mean relative error per dataset", ""]
    rivals = [m for m in COMPARISON["sintel"] if m not in ("ULDEMV", "Superpixel Soup")]
    entries, bars = [], {}
    for d in DATASETS:
        known, items = COMPARISON[d.name], r.plan.datasets[d.name]
        own: dict[str, Number] = {"published": known["Superpixel Soup"]}
        cells = []
        for method in METHODS:
            here = _compared(r, items, method)
            own[method] = mean(r.mre(c) for c in here)
            capped = mean(r.mre(c, d.cap) for c in here) if d.cap else None
            cells += [show(own[method]), show(mean(r.mre(c, "best") for c in here)), show(capped)]
        first = _compared(r, items, "defaults")
        own["constant depth"] = mean(r.mre(c, "paper", "constant") for c in first)
        rigid = mean(r.mre(c, "paper", "rigid") for c in first)
        if own["defaults"] is not None:
            bars[d.title] = own
        published = [show(known[m]) for m in (*rivals, "Superpixel Soup")]
        baselines = [show(own["constant depth"]), show(rigid)]
        entries.append([d.title, *published, str(len(items)), *cells, *baselines])
    head = ["dataset", *(f"{m} (published)" for m in rivals), "the paper (published)", "pairs here"]
    for method in METHODS:
        head += [f"{method}: median", "best", "cap"]
    head += ["constant depth: median", "one rigid motion: median"]
    lines += [
        *table(
            head,
            entries,
        ),
        "",
        *_protocols(),
    ]
    lines += _by_pair(r)
    told = {i.key for group in r.plan.datasets.values() for i in group}
    for item in (i for i in r.plan.analyses if i.key not in told):
        by = {m: r.mre(_compared(r, [item], m)[0]) for m in METHODS}
        flat = r.mre(_compared(r, [item], "defaults")[0], "paper", "constant")
        bars[title(item)] = {"published": None, **by, "constant depth": flat}
    figures.plot_comparison(out / "comparison.png", bars, "MRE by dataset or pair")
    return [*lines, *_figure("comparison", "MRE by dataset")]


def _protocols() -> list[str]:
    caps = dict.fromkeys(d.cap for d in DATASETS if d.cap)
    names = ["paper", "best", *caps]
    return [
        "Columns: *median* and *best* are every true pixel without a cap, after the median scale"
        " and after the scale of least MRE; *cap* is the convention with a depth cap that is in use"
        " on the dataset. In full: " + "; ".join(str(preset(n)) for n in names) + ".",
        "",
        "On which pairs: " + "; ".join(f"{d.title}: {DATA[d.name]}" for d in DATASETS) + ".",
        "",
    ]


def _by_pair(r: Results) -> list[str]:
    """Table of every pair, with medians."""
    items = {i.key: i for group in r.plan.datasets.values() for i in group}
    items |= {i.key: i for i in r.plan.analyses}
    entries = []
    for item in items.values():
        cells = [title(item)]
        for method in METHODS:
            (cell,) = _compared(r, [item], method)
            row = r.row(cell)
            median = get(row, "paper", "solution", "median_relative")
            start, nlp = r.mre(cell, "paper", "start"), r.mre(cell, "paper", "nlp")
            cells += [show(start), show(nlp), show(r.mre(cell)), show(median), _ended(row)]
        cells.append(show(r.mre(cell, "paper", "constant")))
        entries.append(cells)
    head = ["pair"]
    for method in METHODS:
        head += [f"{method}: start", "NLP", "refined", "its median error", "converged"]
    note = (
        "Every pair, MRE after median scale, no cap; the median error of the refined depth; whether"
        " the constrained NLP reached its tolerance:"
    )
    return [note, "", *table([*head, "constant depth"], entries), ""]


def _ended(row: Row) -> str:
    """Whether the NLP converged, or how it ended."""
    status = str(row.get("status", "-"))
    return "yes" if status in GOOD else status.replace("_", " ").lower()


def _pictures(out: Path, r: Results, stored: Path) -> list[str]:
    items = {i.key: i for i in r.plan.analyses}
    items |= {i.key: i for group in r.plan.datasets.values() for i in group[:2]}
    files = {}
    for item in items.values():
        a, b = (_compared(r, [item], m)[0].maps(stored) for m in METHODS)
        if a.is_file() and b.is_file():
            files[title(item)] = a, b
    text = "Depth maps: image, truth, unorganised soup, preset, defaults"
    figures.plot_maps(out / "depth_maps.png", files)
    return [
        "## Depth maps",
        "",
        f"{text}; logarithmic, one scale a map.",
        *_figure("depth_maps", text),
    ]


def _section(out: Path, r: Results, name: str) -> list[str]:
    """Tables of both methods and a figure of one change at a time."""
    lines = [f"## {TEXTS[name]}", ""]
    measure = "RMSE" if name == "flow" else "MRE"
    drawn: dict[str, dict[str, dict[str, Number]]] = {}
    for method in METHODS:
        pairs: dict[str, dict[str, Number]] = {}
        for item in r.plan.items(name):
            cells = r.plan.variants(name, item, method)
            rows = {v: r.row(c) for v, c in cells.items()}
            pairs[title(item)] = {v: get(row, "paper") for v, row in rows.items()}
            if name == "flow":
                pairs[f"{title(item)}, RMSE"] = {v: row.get("rmse") for v, row in rows.items()}
        names = list(next(iter(pairs.values()), {}))
        entries = [[pair, *(show(v) for v in own.values())] for pair, own in pairs.items()]
        whole = [own for own in pairs.values() if None not in own.values()]
        if len(whole) > 1 and name != "flow":
            means = [mean(own[v] for own in whole) for v in names]
            entries.append([f"mean of {len(whole)}", *(show(v) for v in means)])
        lines += [
            f"{method}, MRE after median scale, no cap:",
            "",
            *table(["pair", *names], entries),
            "",
        ]
        drawn[method] = {
            p: own for p, own in pairs.items() if p.endswith("RMSE") == (measure == "RMSE")
        }
    lines += _published(name)
    label = "RMSE, unit of the truth" if measure == "RMSE" else "MRE"
    figures.plot_lines(out / f"{name}.png", drawn, SECTIONS[name], label, TEXTS[name])
    return [*lines, *_figure(name, TEXTS[name])]


def _published(name: str) -> list[str]:
    if name == "terms":
        entries = [[k, *(f"{v:.4f}" for v in row)] for k, row in ABLATION.items()]
        head = ["published, MPI Sintel", "arap", "+ proj", "+ cont", "+ orient"]
        return [*table(head, entries), ""]
    if name == "pattern":
        both = ", ".join(f"{k} {v:.4f}" for k, v in GRID_AGAINST_SLIC.items())
        return [f"Published for one frame with 1,000 superpixels: {both}.", ""]
    if name == "superpixels":
        return ["Published as a figure: the error hardly falls beyond 1,000 superpixels.", ""]
    if name == "neighbours":
        return ["Published as pictures of one pair (K = 4 and 20); K from 15 to 20 is used.", ""]
    if name == "flow":
        return ["Published as a figure of RMSE in metres on Sintel. Here after least squares.", ""]
    return []


def _convergence(out: Path, r: Results) -> list[str]:
    curves: dict[str, dict[str, Row]] = {}
    entries = []
    for item in r.plan.analyses:
        for method in METHODS:
            (cell,) = _compared(r, [item], method)
            row = r.row(cell)
            if not row.get("ok"):
                continue
            curves.setdefault(title(item), {})[method] = row["curve"]
            exact, rounds = row["curve"]["exact"], row["curve"]["rounds"]
            fall = f"{1 - rounds[-1] / rounds[0]:.1%}" if rounds and rounds[0] else "-"
            entries.append(
                [
                    *[title(item), method, str(row["status"]).replace("_", " ")],
                    *[str(row["iterations"]), f"{exact[0]:.5g}", f"{exact[1]:.5g}"],
                    *[str(max(0, len(rounds) - 1)), fall],
                ]
            )
    figures.plot_curves(out / "convergence.png", curves)
    head = ["pair", "method", "constrained NLP", "iterations", "E start", "E NLP", "rounds"]
    text = "Energy over iterations of the solver and rounds of the refinement"
    return [
        *["## Convergence of E over iterations and rounds", ""],
        "The exact energy of start and NLP in each method's own units; the figure has the smoothed"
        " energy that the solver sees, a colour a stage.",
        *["", *table([*head, "refinement lowers E by"], entries)],
        *_figure("convergence", text),
    ]


def _time(r: Results) -> list[str]:
    stages = ("flow", "segmentation", "start", "nlp", "refine")
    entries = []
    for item in r.plan.analyses:
        for method in METHODS:
            (cell,) = _compared(r, [item], method)
            row = r.row(cell)
            if row.get("ok"):
                seconds = [f"{row['stages'].get(s, 0.0):.1f}" for s in stages]
                size = "x".join(str(v) for v in reversed(row["size"]))
                entries.append([title(item), method, size, *seconds, f"{row['cpu_seconds']:.1f}"])
    return [
        *["## Time", ""],
        "Wall seconds by stage, the machine shared with other work, and CPU seconds of all but the"
        " flow. Published: 15 to 20 minutes for 1024 x 436 in MATLAB and C++ on an i7.",
        *["", *table(["pair", "method", "pixels", *stages, "CPU s"], entries), ""],
    ]


def _departures(out: Path, r: Results) -> list[str]:
    items = r.plan.analyses
    lines = ["## Departures, one at a time", ""]
    lines += [
        "MRE of the defaults with one departure undone (*off alone*) and of the preset with one"
        " departure made (*on alone*), by pair; first the defaults and the preset as they are. The"
        " figure has the geometric mean of the ratios to these.",
        "",
    ]
    cells = {i.key: r.plan.departures(i) for i in items}
    base = {m: [r.mre(r.plan.cell(i, m)) for i in items] for m in METHODS}
    entries = [["as they are", *map(show, base["defaults"]), *map(show, base["preset: paper"]), ""]]
    bars = {}
    for d in DEPARTURES:
        both = [cells[i.key][d.name] for i in items]
        off = [r.mre(a) for a, _ in both]
        on = [None if b is None else r.mre(b) for _, b in both]
        entries.append([d.name, *map(show, off), *map(show, on), d.needs])
        bars[d.name] = {
            "defaults, off alone": _ratio(off, base["defaults"]),
            "preset, on alone": _ratio(on, base["preset: paper"]),
        }
    names = [title(i) for i in items]
    head = ["departure", *(f"off: {n}" for n in names), *(f"on: {n}" for n in names), "note"]
    text = "Departures one at a time"
    label = "MRE relative to all others as they are (geometric mean of the pairs)"
    figures.plot_bars(out / "departures.png", bars, text, label)
    return [*lines, *table(head, entries), *_figure("departures", text)]


def _ratio(own: Sequence[Number], base: Sequence[Number]) -> Number:
    """Geometric mean of the ratios that are known."""
    logs = [np.log(a / b) for a, b in zip(own, base, strict=True) if a and b]
    return float(np.exp(np.mean(logs))) if logs else None


def _scale(out: Path, r: Results) -> list[str]:
    bodies: dict[str, Mapping[str, Sequence[float]]] = {}
    entries = []
    for row in r.scales:
        for k, body in enumerate(row.get("bodies", [])):
            name = f"{row['pair']} body {k + 1}"
            bodies[name] = body["curves"]
            lows = [f"{lowest(body['curves'][kind]):.2f}" for kind in KINDS]
            entries.append([name, str(body["superpixels"]), *lows])
    counts = {
        kind: sum(abs(lowest(list(c[kind])) - 1) <= NEAR for c in bodies.values()) for kind in KINDS
    }
    n = len(bodies)
    heads = ["E_arap", "E_arap in pixels", "E_cont", "E, preset: paper", "E, defaults"]
    verdict = (
        f"The paper claims that E_arap alone gives reasonably correct relative scales. With true"
        f" planes and true motions its minimum over the scale of one moving body is within"
        f" {NEAR:.0%} of the truth for {counts['arap']} of {n} bodies (in pixels:"
        f" {counts['arap px']}); that of E_cont for {counts['cont']}, of the whole energy of the"
        f" preset for {counts['paper']}, of the defaults for {counts['defaults']}. The defaults"
        " know here which bodies are apart and, from the true depth, where one hides another;"
        " a solve has both from its start only."
    )
    figures.plot_scale(out / "scale.png", bodies)
    text = "Energy over the scale of one moving body about the truth"
    return [
        *[
            "## Does ARAP alone find the scale of what moves?",
            "",
            verdict if n else "No bodies.",
            "",
        ],
        "The scale (1 is the truth) at which each energy is lowest, planes and motions being true"
        " (rendered scenes: exact; KITTI 2015: PnP on true depth and flow):",
        *["", *table(["body", "superpixels", *heads], entries)],
        *_figure("scale", text),
    ]


def _missing(r: Results) -> list[str]:
    entries = [[d.title, source_of(d)] for d in DATASETS if not r.plan.datasets[d.name]]
    entries += [[name, text] for name, text in WITHOUT_TRUTH.items()]
    left = [name for name in ALL if name not in r.plan.sizes.sections]
    entries += [[f"section {name}", "left out of this run (`--sections`)"] for name in left]
    return ["## What is not here", "", *table(["data", "why, and where from"], entries), ""]


def complete(rows: Sequence[Row]) -> bool:
    """Whether no row failed."""
    return not any(failed(row) for row in rows)
