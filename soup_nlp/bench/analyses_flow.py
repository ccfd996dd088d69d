"""How good the flow itself is, by source, with and without robust re-weighting; nothing is solved.

The error that counts is the one weighted with the confidence: that is what the energy sees.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from soup_nlp.bench.accuracy import Job, Row, clean, flow_error, head
from soup_nlp.bench.accuracy_table import mean, pair_names, reason, show, table
from soup_nlp.data.flow.robust import reweighted
from soup_nlp.errors import DataError
from soup_nlp.pipeline.case import superpixels

COLUMNS = {
    "mean": "mean",
    "weighted_mean": "weighted mean",
    "median": "median",
    "over_3px": "over 3 px",
    "used": "used",
}


def measure_flow(job: Job) -> Row:
    """End-point error of the flow of one pair against its truth."""
    row = head(job)
    begin, cpu = time.perf_counter(), time.process_time()
    try:
        problem = job.item.problem(job.overrides)
        pair = problem.load_pair()
        flow = problem.flow.load(pair, problem.path)
        if problem.flow.reweight_px is not None:
            labels = superpixels(problem, pair.with_flow(flow))
            flow = reweighted(flow, labels, problem.flow.reweight_px)
        error = flow_error(pair.with_flow(flow))
        if error is None:
            raise DataError("pair has no true flow", where=pair.name)
        row |= {"ok": True, "error": None, "metrics": {}, "flow_error": error}
    except Exception as error_:
        row |= {"ok": False, "error": f"{type(error_).__name__}: {error_}"}
    row["seconds"] = time.perf_counter() - begin
    row["cpu_seconds"] = time.process_time() - cpu
    return clean(row)


def text_flow(name: str, text: str, rows: Sequence[Row], note: str = "") -> str:
    """Table of flow errors: a pair and a source a line, and the means of complete pairs."""
    codes = ", ".join(sorted({str(r.get("code")) for r in rows}))
    lines = [f"# Analysis: {name}", "", f"{text[0].upper()}{text[1:]}. {note} Code {codes}.", ""]
    good = [r for r in rows if r.get("ok")]
    variants = list(dict.fromkeys(r["variant"] for r in good))
    title = {(r["suite"], r["pair"]): name for name, r in zip(pair_names(good), good, strict=True)}
    pairs = list(title)
    own = {(r["suite"], r["pair"], r["variant"]): r["flow_error"] for r in good}
    component = []
    complete = [p for p in pairs if all((*p, v) in own for v in variants)]
    for v in variants:
        numbers = [mean(own[(*p, v)][k] for p in complete) for k in COLUMNS]
        component.append([v, *map(_shown, COLUMNS, numbers)])
    lines += [f"Mean of {len(complete)} pairs, pixels:", ""]
    lines += [*table(["source", *COLUMNS.values()], component), "", "By pair:", ""]
    component = [
        [title[p], v, *(_shown(k, own[(*p, v)][k]) for k in COLUMNS)]
        for p in pairs
        for v in variants
        if (*p, v) in own
    ]
    lines += table(["pair", "source", *COLUMNS.values()], component)
    bad = [r for r in rows if not r.get("ok")]
    if bad:
        lines += ["", "## Failed", ""]
        lines += [f"- {r['key']}: {reason(r)}" for r in bad]
    return "\n".join(lines) + "\n"


def _shown(name: str, value: float | None) -> str:
    return show(value, ".1%" if name in ("over_3px", "used") else ".3f")


def plot_flow(path: Path, rows: Sequence[Row]) -> None:
    """Weighted error by pair, a bar a source."""
    good = [r for r in rows if r.get("ok")]
    names = pair_names(good)
    pairs = list(dict.fromkeys(names))
    variants = list(dict.fromkeys(r["variant"] for r in good))
    figure = Figure(figsize=(max(5.0, 1.1 * len(pairs)), 4), dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    ax = figure.add_subplot()
    width = 0.8 / max(1, len(variants))
    for k, v in enumerate(variants):
        own = {
            name: r["flow_error"]["weighted_mean"]
            for name, r in zip(names, good, strict=True)
            if r["variant"] == v
        }
        x = np.arange(len(pairs)) + (k - (len(variants) - 1) / 2) * width
        ax.bar(x, [own.get(p, np.nan) for p in pairs], width, label=v)
    ax.set_xticks(np.arange(len(pairs)), pairs, rotation=30, ha="right", fontsize=7)
    ax.set(ylabel="flow error weighted with confidence, px", title="Flow sources")
    if good:
        ax.legend(fontsize=7)
    figure.savefig(path, format="png")
