"""Sections of the page of `bench paper`: one change at a time, energies, time, scale of bodies."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from soup_nlp.bench import paper_figures as figures
from soup_nlp.bench.departures import DEPARTURES
from soup_nlp.bench.paper_pairs import title
from soup_nlp.bench.paper_plan import METHODS, SECTIONS, Cell, Plan
from soup_nlp.bench.paper_scale import KINDS, scale_of_least_energy
from soup_nlp.bench.published import ABLATION, GRID_AGAINST_SLIC
from soup_nlp.bench.suite_pairs import Item
from soup_nlp.bench.tables import mean, metric, show, table
from soup_nlp.storage.rows import Row

Number = float | None
TEXTS: Mapping[str, str] = {
    "terms": "What each term of the energy adds (the paper's ablation table and figure)",
    "superpixels": "Number of superpixels",
    "neighbours": "K of the K-NN graph",
    "pattern": "SLIC against a regular grid",
    "flow": "Flow: the truth, the truth with noise, DIS",
    "stages": "NLP and refinement apart",
}
SCALE_TOLERANCE = 0.1
"""Relative error up to which a scale counts as right."""


@dataclass(frozen=True)
class Results:
    """Rows by pair and overrides."""

    plan: Plan
    rows: Sequence[Row]
    scales: Sequence[Row]

    def row(self, cell: Cell) -> Row:
        """The row of a cell; a row that is not ok if the cell was not measured yet."""
        key, overrides = cell.item.key, list(cell.overrides)
        for row in self.rows:
            if row["overrides"] == overrides and row["key"].startswith(key):
                return row
        return {"ok": False, "metrics": {}}

    def mre(self, cell: Cell, convention: str = "paper", method: str = "solution") -> Number:
        """MRE of a cell."""
        return metric(self.row(cell), convention, method)

    def shown(self, cell: Cell) -> str:
        """MRE of a cell as text, with a star where the NLP did not converge."""
        row = self.row(cell)
        return show(self.mre(cell)) + "*" * (bool(row["ok"]) and not row.get("good"))

    def compared(self, item: Item, method: str) -> Cell:
        """The cell of a pair by one method in the comparison of both methods."""
        return self.plan.cell(item, method, superpixels=self.plan.sizes.superpixels)

    def analysed(self) -> Iterator[tuple[str, str, Row]]:
        """Title, method and row of every measured pair of the analyses."""
        for item in self.plan.analyses:
            for method in METHODS:
                row = self.row(self.compared(item, method))
                if row.get("ok"):
                    yield title(item), method, row


def figure(name: str, text: str) -> list[str]:
    """Lines that show a figure of the page."""
    return ["", f"![{text}]({name}.png)", ""]


def section(out: Path, r: Results, name: str) -> list[str]:
    """A section of one change at a time: a table for each method, and a figure."""
    lines = [f"## {TEXTS[name]}", ""]
    measure = "RMSE" if name == "flow" else "MRE"
    items = [i for i in r.plan.items(name) if _compares(r, name, i)]
    drawn: dict[str, dict[str, dict[str, Number]]] = {}
    for method in METHODS:
        pairs: dict[str, dict[str, Number]] = {}
        for item in items:
            cells = r.plan.variants(name, item, method)
            rows = {v: r.row(c) for v, c in cells.items()}
            pairs[title(item)] = {v: metric(row, "paper") for v, row in rows.items()}
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
    return [*lines, *figure(name, TEXTS[name])]


def _compares(r: Results, name: str, item: Item) -> bool:
    """Whether a section has two rows of a pair by one of the methods."""
    own = (r.plan.variants(name, item, method).values() for method in METHODS)
    return any(sum(bool(r.row(c).get("ok")) for c in cells) > 1 for cells in own)


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


def convergence(out: Path, r: Results) -> list[str]:
    """Table and figure of the energy over iterations and rounds."""
    curves: dict[str, dict[str, Row]] = {}
    entries = []
    for pair, method, row in r.analysed():
        curves.setdefault(pair, {})[method] = row["curve"]
        exact, rounds = row["curve"]["exact"], row["curve"]["rounds"]
        fall = f"{1 - rounds[-1] / rounds[0]:.1%}" if rounds and rounds[0] else "-"
        solve = [str(row["iterations"]), f"{exact[0]:.5g}", f"{exact[1]:.5g}"]
        status = str(row["status"]).replace("_", " ")
        entries.append([pair, method, status, *solve, str(max(0, len(rounds) - 1)), fall])
    figures.plot_curves(out / "convergence.png", curves)
    head = ["pair", "method", "constrained NLP", "iterations", "E start", "E NLP", "rounds"]
    text = "Energy over iterations of the solver and rounds of the refinement"
    return [
        *["## Convergence of E over iterations and rounds", ""],
        "The exact energy of start and NLP in each method's own units; the figure has the smoothed"
        " energy that the solver sees, a colour a stage.",
        *["", *table([*head, "refinement lowers E by"], entries)],
        *figure("convergence", text),
    ]


def time(r: Results) -> list[str]:
    """Table of seconds by stage."""
    stages = ("flow", "segmentation", "start", "nlp", "refine")
    entries = []
    for pair, method, row in r.analysed():
        seconds = [f"{row['stages'].get(s, 0.0):.1f}" for s in stages]
        size = "x".join(str(v) for v in reversed(row["size"]))
        entries.append([pair, method, size, *seconds, f"{row['cpu_seconds']:.1f}"])
    return [
        *["## Time", ""],
        "Wall seconds by stage, the machine shared with other work, and CPU seconds of all but the"
        " flow. Published: 15 to 20 minutes for 1024 x 436 in MATLAB and C++ on an i7.",
        *["", *table(["pair", "method", "pixels", *stages, "CPU s"], entries), ""],
    ]


def departures(out: Path, r: Results) -> list[str]:
    """Tables and figure of the departures, each undone or made alone."""
    cells = {i.key: r.plan.departures(i) for i in r.plan.departing}
    items = [i for i in r.plan.departing if _any_measured(r, cells[i.key].values())]
    as_is = {m: [r.plan.cell(i, m) for i in items] for m in METHODS}
    tables: dict[str, list[list[str]]] = {
        m: [["as they are", "", "", "", *map(r.shown, own)]] for m, own in as_is.items()
    }
    bars: dict[str, dict[str, Number]] = {}
    for d in DEPARTURES:
        off, on = zip(*(cells[i.key][d.name] for i in items)) if items else ((), ())
        bars[d.name] = {}
        for method, own, name in (
            ("defaults", off, "defaults, off alone"),
            ("preset: paper", on, "preset, on alone"),
        ):
            bars[d.name][name], line = _beside(r, own, as_is[method])
            tables[method].append([d.name, *line])
    head = ["departure", "mean", "median", "worse / better", *(title(i) for i in items)]
    text = "Departures one at a time"
    label = "MRE relative to all others as they are (geometric mean of the pairs)"
    figures.plot_bars(out / "departures.png", bars, text, label)
    notes = [f"- {d.name}: {d.needs}." for d in DEPARTURES if d.needs]
    return [
        "## Departures, one at a time",
        "",
        "MRE, one pair of each family. *Mean* and *median* are of the ratios to the first line"
        " (the mean is geometric, a single diverging solve decides it); *worse / better* counts the"
        " pairs that change by more than 1 %. Defaults with one departure undone (*off alone*):"
        " above 1 the departure pays.",
        "",
        *table(head, tables["defaults"]),
        "",
        "The preset with one departure made (*on alone*): below 1 the departure pays.",
        "",
        *table(head, tables["preset: paper"]),
        "",
        *notes,
        "",
        *figure("departures", text),
    ]


def _beside(
    r: Results, cells: Sequence[Cell | None], base: Sequence[Cell]
) -> tuple[Number, list[str]]:
    """Geometric mean of the ratios to the base, and the texts of a line of the table."""
    known = [(r.mre(a), r.mre(b)) for a, b in zip(cells, base, strict=True) if a is not None]
    ratios = [a / b for a, b in known if a and b]
    mean_ratio = float(np.exp(np.mean(np.log(ratios)))) if ratios else None
    middle = float(np.median(ratios)) if ratios else None
    above, below = (sum(q > 1.01 for q in ratios), sum(q < 0.99 for q in ratios))
    count = f"{above} / {below}" if ratios else show(None)
    numbers = [show(None) if c is None else r.shown(c) for c in cells]
    return mean_ratio, [show(mean_ratio), show(middle), count, *numbers]


def _any_measured(r: Results, pairs: Iterable[tuple[Cell, Cell | None]]) -> bool:
    """Whether any of the cells of a pair was measured."""
    return any(r.row(c).get("ok") for both in pairs for c in both if c is not None)


def scale(out: Path, r: Results) -> list[str]:
    """Table and figure of energies over the scale of one moving body."""
    bodies: dict[str, Mapping[str, Sequence[float]]] = {}
    entries = []
    for row in r.scales:
        for k, body in enumerate(row.get("bodies", [])):
            name = f"{row['pair']} body {k + 1}"
            bodies[name] = body["curves"]
            lows = [f"{scale_of_least_energy(body['curves'][kind]):.2f}" for kind in KINDS]
            entries.append([name, str(body["superpixels"]), *lows])
    counts = {
        kind: sum(
            abs(scale_of_least_energy(list(c[kind])) - 1) <= SCALE_TOLERANCE
            for c in bodies.values()
        )
        for kind in KINDS
    }
    n = len(bodies)
    heads = ["E_arap", "E_arap in pixels", "E_cont", "E, preset: paper", "E, defaults"]
    verdict = (
        f"The paper claims that E_arap alone gives reasonably correct relative scales. With true"
        f" planes and true motions its minimum over the scale of one moving body is within"
        f" {SCALE_TOLERANCE:.0%} of the truth for {counts['arap']} of {n} bodies (in pixels:"
        f" {counts['arap px']}); that of E_cont for {counts['cont']}, of the whole energy of the"
        f" preset for {counts['paper']}, of the defaults for {counts['defaults']}. The defaults"
        " know here which bodies are apart and, from the true depth, where one hides another;"
        " a solve has both from its start only."
    )
    figures.plot_scale(out / "scale.png", bodies)
    text = "Energy over the scale of one moving body about the truth"
    return [
        "## Does ARAP alone find the scale of what moves?",
        *["", verdict if n else "No bodies.", ""],
        "The scale (1 is the truth) at which each energy is lowest, planes and motions being true"
        " (rendered scenes: exact; KITTI 2015: PnP on true depth and flow):",
        *["", *table(["body", "superpixels", *heads], entries)],
        *figure("scale", text),
    ]
