"""The page of `bench paper`: the tables and figures of the paper that the rows allow."""

from __future__ import annotations

import os
from pathlib import Path

from soup_nlp.bench import paper_figures as figures
from soup_nlp.bench import paper_sections as sections
from soup_nlp.bench.paper_pairs import DATASETS, WITHOUT_TRUTH, source_of, title
from soup_nlp.bench.paper_plan import ALL_SECTIONS, METHODS, SECTIONS
from soup_nlp.bench.paper_sections import Number, Results, figure
from soup_nlp.bench.processes import processor
from soup_nlp.bench.published import COMPARISON, DATA, SOURCE
from soup_nlp.bench.tables import failures, mean, metric, page_text, provenance, show, table
from soup_nlp.evaluate.protocols import preset
from soup_nlp.solve.ipopt import GOOD
from soup_nlp.storage.atomic import write_text
from soup_nlp.storage.folders import staged
from soup_nlp.storage.rows import Row

PAGE = "README.md"
FIGURES = ("comparison", "depth_maps", "convergence", "departures", "scale", *SECTIONS)
FILES = (PAGE, *(f"{name}.png" for name in FIGURES))
"""Names of all files that `write_page` may write."""


def write_page(out: Path, results: Results, command: str) -> Path:
    """Write OUT/README.md and its figures."""
    chosen = results.plan.sizes.sections
    with staged(out) as new:
        parts = [
            _head(results, command),
            _comparison(new, results),
            _pictures(new, results, out),
            *(sections.section(new, results, name) for name in SECTIONS if name in chosen),
            sections.convergence(new, results),
            sections.time(results),
            sections.departures(new, results) if "departures" in chosen else [],
            sections.scale(new, results) if "scale" in chosen else [],
            _missing(results),
            failures([*results.rows, *results.scales]),
        ]
        write_text(new / PAGE, page_text([line for lines in parts for line in lines]))
    return out / PAGE


def _head(r: Results, command: str) -> list[str]:
    s = r.plan.sizes
    changed = ", ".join(f"`{o}`" for o in s.overrides)
    there = [bool(r.row(cell).get("ok")) for cell in r.plan.cells()]
    partial = "" if all(there) else f" {sum(there)} of the {len(there)} rows were measured."
    return [
        "# The paper, row by row",
        "",
        f"Made by `{command}`. {provenance([*r.rows, *r.scales])}. Flow by OpenCV DIS unless named."
        f" Machine: {os.cpu_count()} cores of an {processor()}.",
        f"Superpixels wanted: {s.superpixels} in the comparison, {s.analysis} elsewhere."
        + (f" Overrides of every row: {changed}." if changed else "")
        + partial,
        "",
        "`preset: paper` is the method as printed; *defaults* are those of this program. What both"
        " differ in is in [the table of departures](../../docs/formulation.md#the-preset-paper)."
        " MRE is the mean relative error of the reference frame's depth after one global scale per"
        " image. Published numbers are copied, not measured:"
        f" {SOURCE}; the paper names neither its scale rule nor a depth cap. A dash is a number"
        " that is not published, or a row that was not measured in this run.",
        "",
    ]


def _comparison(out: Path, r: Results) -> list[str]:
    lines = ["## Mean relative error per dataset", ""]
    rivals = [m for m in COMPARISON["sintel"] if m not in ("ULDEMV", "Superpixel Soup")]
    entries, bars = [], {}
    for d in DATASETS:
        known, items = COMPARISON[d.name], r.plan.datasets[d.name]
        own: dict[str, Number] = {"published": known["Superpixel Soup"]}
        cells = []
        for method in METHODS:
            here = [r.compared(i, method) for i in items]
            own[method] = mean(r.mre(c) for c in here)
            capped = mean(r.mre(c, d.cap) for c in here) if d.cap else None
            cells += [show(own[method]), show(mean(r.mre(c, "best") for c in here)), show(capped)]
        first = [r.compared(i, "defaults") for i in items]
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
    lines += [*table(head, entries), "", *_protocols()]
    lines += _by_pair(r)
    known_pairs = {i.key for group in r.plan.datasets.values() for i in group}
    for item in (i for i in r.plan.analyses if i.key not in known_pairs):
        by = {m: r.mre(r.compared(item, m)) for m in METHODS}
        flat = r.mre(r.compared(item, "defaults"), "paper", "constant")
        bars[title(item)] = {"published": None, **by, "constant depth": flat}
    figures.plot_comparison(out / "comparison.png", bars, "MRE by dataset or pair")
    return [*lines, *figure("comparison", "MRE by dataset")]


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
    """Table of every pair: MRE by stage and median error."""
    items = {i.key: i for group in r.plan.datasets.values() for i in group}
    items |= {i.key: i for i in r.plan.analyses}
    entries = []
    for item in items.values():
        cells = [title(item)]
        for method in METHODS:
            cell = r.compared(item, method)
            row = r.row(cell)
            median = metric(row, "paper", "solution", "median_relative")
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
    """ "yes" if the NLP converged, else its status."""
    status = str(row.get("status", "-"))
    return "yes" if status in GOOD else status.replace("_", " ").lower()


def _pictures(out: Path, r: Results, stored: Path) -> list[str]:
    items = {i.key: i for i in r.plan.analyses}
    items |= {i.key: i for group in r.plan.datasets.values() for i in group[:2]}
    files = {}
    for item in items.values():
        a, b = (r.compared(item, m).maps(stored) for m in METHODS)
        if a.is_file() and b.is_file():
            files[title(item)] = a, b
    text = "Depth maps: image, truth, unorganised soup, preset, defaults"
    figures.plot_maps(out / "depth_maps.png", files)
    return [
        "## Depth maps",
        "",
        f"{text}; logarithmic, one scale a map.",
        *figure("depth_maps", text),
    ]


def _missing(r: Results) -> list[str]:
    entries = [[d.title, source_of(d)] for d in DATASETS if not r.plan.datasets[d.name]]
    entries += [[name, text] for name, text in WITHOUT_TRUTH.items()]
    left = [name for name in ALL_SECTIONS if name not in r.plan.sizes.sections]
    entries += [[f"section {name}", "left out of this run (`--sections`)"] for name in left]
    return ["## What is not here", "", *table(["data", "why, and where from"], entries), ""]
