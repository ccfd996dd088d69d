"""Tables and plots of analyses."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from soup_nlp.bench.accuracy import Row
from soup_nlp.bench.accuracy_table import get, mean, pair_names, reason, show, table
from soup_nlp.bench.analyses_energy import ABOVE, WORSE
from soup_nlp.bench.published import ABLATION, GRID_AGAINST_SLIC, SOURCE
from soup_nlp.evaluate.protocols import preset
from soup_nlp.model.energy_data import TERMS

COLOURS = {"arap": "#4477aa", "proj": "#66ccee", "cont": "#228833", "orient": "#ccbb44"}


def _titles(rows: Sequence[Row]) -> list[str]:
    return [f"{name}, {row['flow']}" for name, row in zip(pair_names(rows), rows, strict=True)]


def _variants(rows: Sequence[Row]) -> list[str]:
    return list(dict.fromkeys(r["variant"] for r in rows))


def _pairs(rows: Sequence[Row]) -> dict[str, dict[str, Row]]:
    """Rows by pair and variant."""
    out: dict[str, dict[str, Row]] = {}
    for title, row in zip(_titles(rows), rows, strict=True):
        out.setdefault(title, {})[row["variant"]] = row
    return out


def _main(row: Row, name: str = "mre") -> float | None:
    return get(row, row["presets"][0], "solution", name)


def _head(name: str, text: str, rows: Sequence[Row], note: str) -> list[str]:
    codes = ", ".join(sorted({str(r.get("code")) for r in rows}))
    cpu = sum(float(r.get("cpu_seconds") or 0) for r in rows)
    used = dict.fromkeys(r["presets"][0] for r in rows)
    return [
        f"# Analysis: {name}",
        "",
        f"{text[0].upper()}{text[1:]}. {note}",
        "",
        f"{date.today()}, {platform.machine()}, {cpu:.0f} CPU seconds in all; code {codes}."
        f" Depth of the reference frame; {'; '.join(str(preset(p)) for p in used)}.",
        "",
    ]


def text_variants(name: str, text: str, rows: Sequence[Row], note: str = "") -> str:
    """Table of an analysis: a pair a line, a variant a column."""
    lines = _head(name, text, rows, note)
    variants, pairs = _variants(rows), _pairs(rows)
    complete = {t: p for t, p in pairs.items() if all(_main(p[v]) is not None for v in variants)}
    for title, measure in (
        ("MRE", lambda r: _main(r)),
        ("Median relative error", lambda r: _main(r, "median_relative")),
        ("Skill over constant depth", lambda r: _main(r, "skill")),
        ("CPU seconds (shared machines count too)", lambda r: r.get("cpu_seconds")),
        ("Exact energy of the solution", _energy),
    ):
        form = ".1f" if "seconds" in title or "energy" in title else ".4f"
        component = [
            [pair, *(show(measure(own[v]), form) for v in variants)] for pair, own in pairs.items()
        ]
        if len(complete) > 1:
            averages = [mean(measure(p[v]) for p in complete.values()) for v in variants]
            component.append([f"mean of {len(complete)}", *(show(a, form) for a in averages)])
        lines += [f"## {title}", "", *table(["pair, flow", *variants], component), ""]
    lines += _beside(name)
    lines += _failures(rows)
    return "\n".join(lines).rstrip() + "\n"


def _energy(row: Row) -> float | None:
    return float(row["energy"]["solution"]["total"]) if row.get("ok") else None


def _beside(name: str) -> list[str]:
    """What the paper prints for the same question."""
    if name == "ablation":
        component = [
            [f"{k} (published)", *(f"{v:.4f}" for v in row)] for k, row in ABLATION.items()
        ]
        head = ["sequence", "arap", "+ proj", "+ cont", "+ orient"]
        return [
            "## Published MRE",
            "",
            *table(head, component),
            "",
            f"Copied, not measured: {SOURCE}.",
        ]
    if name == "pattern":
        both = ", ".join(f"{k} {v:.4f}" for k, v in GRID_AGAINST_SLIC.items())
        return [f"Published for one frame with 1,000 superpixels (copied, not measured): {both}."]
    return []


def _failures(rows: Sequence[Row]) -> list[str]:
    bad = [r for r in rows if not r.get("ok")]
    lines = [f"- {r['key']}: {reason(r)}" for r in bad]
    return ["", "## Failed", "", *lines] if bad else []


def text_energy(name: str, text: str, rows: Sequence[Row], note: str = "") -> str:
    """Table of energies by term and soup, and the two claims about them."""
    lines = _head(name, text, rows, note)
    good = [r for r in rows if r.get("ok")]
    component, summary = [], []
    for title, row in zip(_titles(good), good, strict=True):
        scores = row["metrics"][row["presets"][0]]
        for soup, e in row["energy"].items():
            terms = [f"{e[t]:.4g}" for t in ("total", *TERMS)]
            own = [show(scores[soup]["mre"]), show(scores[soup]["median_relative"])]
            component.append([title, soup, *terms, *own])
        least = row["energy"]["solution"]["total"]
        ratio = row["energy"]["truth"]["total"] / least
        nearest = row["energy"].get("truth rescaled", row["energy"]["truth"])["total"] / least
        last = list(scores)[-1]
        worse = scores[last]["median_relative"] - scores["truth"]["median_relative"]
        summary.append(
            [
                *[title, f"{ratio:.3f}", "yes" if ratio <= ABOVE else "no", f"{nearest:.3f}"],
                *[f"{worse:+.4f}", "yes" if worse <= WORSE else "no", f"{row['mixed']:.1%}"],
            ]
        )
    head = ["pair, flow", "E truth / E solution", f"<= {ABOVE:g}", "components rescaled"]
    head += ["median error from truth", f"<= {WORSE:g}", "mixed superpixels"]
    lines += table(head, summary)
    lines += [
        "",
        "Components rescaled: E of the truth, each component at its scale of lowest E, instead.",
    ]
    lines += ["", "## By term", ""]
    lines += table(["pair, flow", "soup", "E", *TERMS, "MRE", "median"], component)
    lines += _failures(rows)
    return "\n".join(lines).rstrip() + "\n"


def _figure(width: float, height: float) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width, height), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    return figure, figure.add_subplot()


LONG = 60
"""Letters of all variants from which their labels are slanted."""


def plot_variants(
    path: Path, axis: str, title: str, rows: Sequence[Row], numeric: bool = False
) -> None:
    """MRE over the variants, a line a pair, their mean in black."""
    variants, pairs = _variants(rows), _pairs(rows)
    x = np.array([float(v) for v in variants]) if numeric else np.arange(float(len(variants)))
    figure, ax = _figure(7, 4)
    curves = []
    for name, own in pairs.items():
        y = np.array([np.nan if (m := _main(own[v])) is None else m for v in variants])
        ax.plot(x, y, "o-", lw=1, ms=3, alpha=0.7, label=name)
        curves.append(y)
    if len(curves) > 1:
        whole = [c for c in curves if np.isfinite(c).all()]
        if whole:
            ax.plot(x, np.mean(whole, axis=0), "ks-", lw=2, label=f"mean of {len(whole)}")
    if numeric and len(x) > 1 and x.max() > 8 * x.min() > 0:
        ax.set_xscale("log")
    slanted = not numeric and len("".join(variants)) > LONG
    style: dict[str, Any] = {"rotation": 15, "ha": "right", "size": 8} if slanted else {}
    ax.set_xticks(x, variants, **style)
    ax.minorticks_off()
    finite = np.concatenate(curves)
    finite = finite[np.isfinite(finite)]
    if finite.size and finite.min() > 0 and finite.max() > 20 * finite.min():
        ax.set_yscale("log")
    else:
        ax.set_ylim(bottom=0)
    ax.set(xlabel=axis, ylabel=f"MRE ({rows[0]['presets'][0]})")
    figure.suptitle(title, fontsize=10)
    ax.grid(alpha=0.3)
    if len(pairs) <= 14:
        figure.legend(loc="outside right center", fontsize=6)
    figure.savefig(path, format="png")


def plot_energy(path: Path, rows: Sequence[Row]) -> None:
    """Terms of every soup stacked, relative to the solution's energy; a panel a pair.

    A start far above all others is cut off at the top.
    """
    good = [r for r in rows if r.get("ok")]
    columns = min(5, max(1, len(good)))
    lines = max(1, -(-len(good) // columns))
    figure = Figure(figsize=(2.4 * columns + 1, 3.2 * lines), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    for k, (title, row) in enumerate(zip(_titles(good), good, strict=True)):
        ax = figure.add_subplot(lines, columns, k + 1)
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
        if k % columns == 0:
            ax.set_ylabel("E / E(solution)")
        if k == 0:
            ax.legend(fontsize=6)
    figure.savefig(path, format="png")
