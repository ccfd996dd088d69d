"""Tables and plots of analyses."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from soup_nlp.bench.published import ABLATION, GRID_AGAINST_SLIC, SOURCE
from soup_nlp.bench.tables import (
    code_versions,
    energy_ratio,
    failures,
    figure,
    grid_of_panels,
    main_metric,
    mean,
    page_text,
    pair_names,
    provenance,
    save,
    show,
    table,
    titles,
)
from soup_nlp.evaluate.protocols import preset
from soup_nlp.model.energy_data import TERMS
from soup_nlp.storage.rows import Row

MAX_LOSS = 0.01
"""Largest increase of the median relative error by a solve that starts from the truth."""
MAX_ENERGY_RATIO = 1.10
"""E(truth) / E(solution) above which the truth is far from a minimum of the energy."""
FLOW_ERRORS = {
    "mean": ("mean", ".3f"),
    "weighted_mean": ("weighted mean", ".3f"),
    "median": ("median", ".3f"),
    "over_3px": ("over 3 px", ".1%"),
    "used": ("used", ".1%"),
}
"""Title and format of every error of a flow."""
MEASURES: dict[str, tuple[str, Callable[[Row], float | None]]] = {
    "MRE": (".4f", main_metric),
    "Median relative error": (".4f", lambda r: main_metric(r, "median_relative")),
    "Skill over constant depth": (".4f", lambda r: main_metric(r, "skill")),
    "CPU seconds (shared machines count too)": (".1f", lambda r: r.get("cpu_seconds")),
    "Exact energy of the solution": (
        ".1f",
        lambda r: float(r["energy"]["solution"]["total"]) if r.get("ok") else None,
    ),
}
"""Format and number of every table of variants."""
COLOURS = dict(zip(TERMS, ("#4477aa", "#66ccee", "#228833", "#ccbb44", "#aa3377")))
SLANTED_FROM = 60
"""Labels of variants are slanted if they have more letters than this together."""


def by_pair(
    rows: Sequence[Row], names: Sequence[str]
) -> tuple[list[str], dict[str, dict[str, Row]]]:
    """Names of the variants, and rows by name of the pair and of the variant."""
    out: dict[str, dict[str, Row]] = {}
    for name, row in zip(names, rows, strict=True):
        out.setdefault(name, {})[row["variant"]] = row
    return list(dict.fromkeys(r["variant"] for r in rows)), out


def lines_by_pair(
    rows: Sequence[Row], measure: Callable[[Row], float | None], form: str = ".4f"
) -> list[list[str]]:
    """Lines of a table: a pair and its flow, then a number for each variant."""
    variants, pairs = by_pair(rows, titles(rows))
    return [[pair, *(show(measure(own[v]), form) for v in variants)] for pair, own in pairs.items()]


def page_head(name: str, text: str, rows: Sequence[Row], note: str) -> list[str]:
    """First lines of a page: title, question, note, date, machine and metric conventions."""
    used = dict.fromkeys(r["presets"][0] for r in rows)
    conventions = "; ".join(str(preset(p)) for p in used)
    lines = [f"# Analysis: {name}", "", f"{text[0].upper()}{text[1:]}. {note}", ""]
    return [*lines, f"{provenance(rows)}. Depth of the reference frame; {conventions}.", ""]


def text_variants(name: str, text: str, rows: Sequence[Row], note: str = "") -> str:
    """Table of an analysis: one line for each pair, one column for each variant."""
    lines = page_head(name, text, rows, note)
    variants, pairs = by_pair(rows, titles(rows))
    complete = [p for p in pairs.values() if all(main_metric(p[v]) is not None for v in variants)]
    for title, (form, measure) in MEASURES.items():
        entries = lines_by_pair(rows, measure, form)
        if len(complete) > 1:
            averages = [mean(measure(p[v]) for p in complete) for v in variants]
            entries.append([f"mean of {len(complete)}", *(show(a, form) for a in averages)])
        lines += [f"## {title}", "", *table(["pair, flow", *variants], entries), ""]
    if name == "ablation":
        entries = [[f"{k} (published)", *(f"{v:.4f}" for v in row)] for k, row in ABLATION.items()]
        lines += ["## Published MRE", ""]
        lines += table(["sequence", "arap", "+ proj", "+ cont", "+ orient"], entries)
        lines += ["", f"Copied, not measured: {SOURCE}."]
    if name == "pattern":
        both = ", ".join(f"{k} {v:.4f}" for k, v in GRID_AGAINST_SLIC.items())
        lines += [f"Published for one frame with 1,000 superpixels (copied, not measured): {both}."]
    return page_text([*lines, *failures(rows)])


def text_energy(name: str, text: str, rows: Sequence[Row], note: str = "") -> str:
    """Page of the analysis `energy`: two claims for each pair, and energies by term and soup."""
    lines = page_head(name, text, rows, note)
    good = [r for r in rows if r.get("ok")]
    entries, summary = [], []
    for title, row in zip(titles(good), good, strict=True):
        scores = row["metrics"][row["presets"][0]]
        for soup, e in row["energy"].items():
            terms = [f"{e[t]:.4g}" for t in ("total", *TERMS)]
            own = [show(scores[soup]["mre"]), show(scores[soup]["median_relative"])]
            entries.append([title, soup, *terms, *own])
        ratio = energy_ratio(row) or 0.0
        nearest = energy_ratio(row, "truth rescaled") or ratio
        last = list(scores)[-1]
        worse = scores[last]["median_relative"] - scores["truth"]["median_relative"]
        claims = ratio <= MAX_ENERGY_RATIO, worse <= MAX_LOSS
        low, kept = ("yes" if claim else "no" for claim in claims)
        own = [title, f"{ratio:.3f}", low, f"{nearest:.3f}", f"{worse:+.4f}", kept]
        summary.append([*own, f"{row['mixed']:.1%}"])
    head = ["pair, flow", "E truth / E solution", f"<= {MAX_ENERGY_RATIO:g}", "components rescaled"]
    head += ["median error from truth", f"<= {MAX_LOSS:g}", "mixed superpixels"]
    about = "Components rescaled: E of the truth, each component at its scale of lowest E, instead."
    lines += [*table(head, summary), "", about, "", "## By term", ""]
    lines += table(["pair, flow", "soup", "E", *TERMS, "MRE", "median"], entries)
    return page_text([*lines, *failures(rows)])


def plot_variants(
    path: Path, axis: str, title: str, rows: Sequence[Row], numeric: bool = False
) -> None:
    """MRE over the variants, one line for each pair, their mean in black."""
    variants, pairs = by_pair(rows, titles(rows))
    x = np.array([float(v) for v in variants]) if numeric else np.arange(float(len(variants)))
    picture = figure(7, 4)
    ax = picture.add_subplot()
    curves = np.array(
        [[main_metric(own[v]) for v in variants] for own in pairs.values()], np.float64
    )
    for name, y in zip(pairs, curves, strict=True):
        ax.plot(x, y, "o-", lw=1, ms=3, alpha=0.7, label=name)
    whole = curves[np.isfinite(curves).all(axis=1)]
    if len(curves) > 1 and len(whole):
        ax.plot(x, whole.mean(axis=0), "ks-", lw=2, label=f"mean of {len(whole)}")
    if numeric and len(x) > 1 and x.max() > 8 * x.min() > 0:
        ax.set_xscale("log")
    slanted = not numeric and len("".join(variants)) > SLANTED_FROM
    style: dict[str, Any] = {"rotation": 15, "ha": "right", "size": 8} if slanted else {}
    ax.set_xticks(x, variants, **style)
    ax.minorticks_off()
    finite = curves[np.isfinite(curves)]
    if finite.size and finite.min() > 0 and finite.max() > 20 * finite.min():
        ax.set_yscale("log")
    else:
        ax.set_ylim(bottom=0)
    ax.set(xlabel=axis, ylabel=f"MRE ({rows[0]['presets'][0]})")
    picture.suptitle(title, fontsize=10)
    ax.grid(alpha=0.3)
    if len(pairs) <= 14:
        picture.legend(loc="outside right center", fontsize=6)
    save(picture, path)


def plot_energy(path: Path, rows: Sequence[Row]) -> None:
    """Terms of every soup as stacked bars, relative to E(solution); one panel for each pair.

    The axis ends above the highest bar that is not the start's.
    """
    good = [r for r in rows if r.get("ok")]
    picture, panels = grid_of_panels(len(good), 5, 2.4, 3.2, margin=(1.0, 0.0))
    for title, row, ax in zip(titles(good), good, panels, strict=True):
        unit = row["energy"]["solution"]["total"] or 1.0
        soups = list(row["energy"])
        bottom = np.zeros(len(soups))
        for term in TERMS:
            part = np.array([row["energy"][s][term] for s in soups]) / unit
            ax.bar(np.arange(len(soups)), part, bottom=bottom, color=COLOURS[term], label=term)
            bottom += part
        ax.set_ylim(0, 1.1 * max(total for s, total in zip(soups, bottom) if s != "start"))
        ax.axhline(1.0, color="k", lw=0.5)
        ax.set_xticks(np.arange(len(soups)), soups, rotation=90, fontsize=7)
        ax.set_title(title, fontsize=7)
        if ax.get_subplotspec().is_first_col():  # type: ignore[union-attr]
            ax.set_ylabel("E / E(solution)")
        if ax is panels[0]:
            ax.legend(fontsize=6)
    save(picture, path)


def text_flow(name: str, text: str, rows: Sequence[Row], note: str = "") -> str:
    """Page of flow errors: means over the pairs that have all sources, then all single errors."""
    good = [r for r in rows if r.get("ok")]
    variants, pairs = by_pair(good, pair_names(good))
    complete = [own for own in pairs.values() if len(own) == len(variants)]

    def cells(some: Iterable[Row]) -> list[str]:
        own = [row["flow_error"] for row in some]
        return [show(mean(e[k] for e in own), form) for k, (_, form) in FLOW_ERRORS.items()]

    heads = [title for title, _ in FLOW_ERRORS.values()]
    means = [[v, *cells(own[v] for own in complete)] for v in variants]
    every = [[pair, v, *cells([row])] for pair, own in pairs.items() for v, row in own.items()]
    lines = [f"# Analysis: {name}", ""]
    lines += [f"{text[0].upper()}{text[1:]}. {note} Code {code_versions(rows)}.", ""]
    lines += [f"Mean of {len(complete)} pairs, pixels:", "", *table(["source", *heads], means)]
    lines += ["", "By pair:", "", *table(["pair", "source", *heads], every)]
    return page_text([*lines, *failures(rows)])


def plot_flow(path: Path, rows: Sequence[Row]) -> None:
    """Weighted flow error: one group of bars for each pair, one bar for each source."""
    good = [r for r in rows if r.get("ok")]
    variants, pairs = by_pair(good, pair_names(good))
    picture = figure(max(5.0, 1.1 * len(pairs)), 4)
    ax = picture.add_subplot()
    width = 0.8 / max(1, len(variants))
    for k, v in enumerate(variants):
        x = np.arange(len(pairs)) + (k - (len(variants) - 1) / 2) * width
        own = [p[v]["flow_error"]["weighted_mean"] if v in p else np.nan for p in pairs.values()]
        ax.bar(x, own, width, label=v)
    ax.set_xticks(np.arange(len(pairs)), list(pairs), rotation=30, ha="right", fontsize=7)
    ax.set(ylabel="flow error weighted with confidence, px", title="Flow sources")
    if good:
        ax.legend(fontsize=7)
    save(picture, path)
