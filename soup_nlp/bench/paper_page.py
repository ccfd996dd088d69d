"""The page of `bench paper`: the tables and figures of the paper that the rows allow."""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from soup_nlp.bench.paper import BASE, DATASETS, METHODS
from soup_nlp.bench.processes import processor
from soup_nlp.bench.studies import ABLATION, COMPARISON, DATA, DEPARTURES, SOURCE, STUDIES
from soup_nlp.bench.study import (
    markdown,
    metric,
    page_text,
    panels,
    pivot,
    provenance,
    save,
    titled,
)
from soup_nlp.bench.suites import SUITES

PICTURES = ("comparison", "depth_maps", "convergence", "departures", *STUDIES)
FILES = ("README.md", *(f"{name}.png" for name in PICTURES))
"""Names of all files that `write_paper` writes, the page first."""
STAGES = ("flow", "segmentation", "start", "nlp", "refine")
"""Stages of the table of time."""
WITHOUT_TRUTH = {
    "Back sequence": "no true depth is published with it, nor its intrinsics (Garg et al., CVPR"
    " 2013); the paper shows pictures only",
    "YouTube-Objects": "no true depth (Prest et al., CVPR 2012); the paper shows pictures only",
    "KITTI odometry 00-09": "the published KITTI rows are of this set with LiDAR truth,"
    " https://www.cvlibs.net/datasets/kitti/eval_odometry.php; the rows here are of the stereo and"
    " flow sets",
    "ULDEMV": "the paper draws its errors on KITTI and prints no number",
}
"""Data of the paper without a row here, and the reason."""
ABOUT = (
    "`preset: paper` is the method as printed; *defaults* are those of this program. What both"
    " differ in is in [the table of departures](../../docs/formulation.md#the-preset-paper)."
    " MRE is the mean relative error of the reference frame's depth at every true pixel after one"
    f" median scale per image. Published numbers are copied, not measured: {SOURCE}; the paper"
    " names neither its scale rule nor a depth cap. A dash is a number that is not published or not"
    " measured."
)
ALONE = {
    "defaults": "Defaults with one departure undone (*off alone*): above 1 it pays.",
    "preset: paper": "The preset with one departure made (*on alone*): below 1 it pays.",
}
"""Titles of the tables of departures by method."""


def write_paper(
    page: Path, frame: pd.DataFrame, plan: pd.DataFrame, command: str, note: str
) -> None:
    """Write the page and its figures beside it; `note` gives the sizes of the rows."""
    folder = page.parent
    rows = plan.join(frame.set_index("key").drop(columns="variant"), on="key")
    of_section = dict(list(rows.groupby("section", sort=False)))
    compared = of_section["comparison"]
    head = [
        "# The paper, row by row",
        f"Made by `{command}`. {provenance(frame)}. Flow by OpenCV DIS unless named."
        f" Machine: {os.cpu_count()} cores of an {processor()}.\n"
        f"{note} {int(frame['ok'].eq(True).sum())} of the {len(frame)} rows were measured.",
        ABOUT,
    ]
    blocks = [*head, *_comparison(folder, compared), *_pictures(folder, compared)]
    for name in STUDIES:
        blocks += _study(folder, name, of_section[name])
    blocks += [*_convergence(folder, compared), *_time(compared)]
    blocks += _departures(folder, of_section["departures"])
    page.write_text(page_text([*blocks, *_missing(set(plan["dataset"]))], frame), encoding="utf-8")


def _figure(name: str, text: str) -> str:
    return f"![{text}]({name}.png)"


def _comparison(folder: Path, rows: pd.DataFrame) -> list[str]:
    """Tables by dataset and by pair, and the figure of the errors."""
    entries, bars = {}, {}
    for name, (title, _) in DATASETS.items():
        group = rows[rows["dataset"] == name]
        line: dict[str, Any] = {f"{m} (published)": v for m, v in COMPARISON[name].items()}
        line["pairs here"] = str(group["name"].nunique())
        for method in METHODS:
            here = group[group["method"] == method]
            line[method] = metric(here).mean()
        line["constant depth"] = metric(here, "constant").mean()
        line["one rigid motion"] = metric(here, "rigid").mean()
        entries[title] = line
        if len(group):
            shown = {"published": line["Superpixel Soup (published)"]}
            shown |= {method: line[method] for method in METHODS}
            bars[title] = {**shown, "constant depth": line["constant depth"]}
    by_pair = rows[["name", "method"]].assign(
        start=metric(rows, "start"),
        NLP=metric(rows, "nlp"),
        refined=metric(rows),
        constant=metric(rows, "constant"),
        status=rows["status"],
    )
    _plot_bars(folder / "comparison.png", pd.DataFrame(bars).T, "MRE by dataset")
    return [
        "## Mean relative error per dataset",
        markdown(pd.DataFrame.from_dict(entries, orient="index").rename_axis("dataset")),
        "On which pairs: " + "; ".join(f"{n}: {t}" for n, t in DATA.items()) + ".",
        "Every pair, MRE; the constrained NLP's status:",
        markdown(by_pair.set_index(["name", "method"])),
        _figure("comparison", "MRE by dataset"),
    ]


def _plot_bars(path: Path, bars: pd.DataFrame, text: str, base: float = 0.0) -> None:
    """Groups of horizontal bars from `base`: a group for each row, a colour for each column."""
    picture, ((ax,),) = panels(1, 1, 8, 0.4 * len(bars) + 1.5)
    if len(bars):
        style = {"width": 0.8, "fontsize": 7, "grid": True, "logx": base > 0}
        (bars - base).plot.barh(ax=ax, left=base, ylabel="", **style)
        ax.set_title(text, fontsize=10)
        ax.set_axisbelow(True)
        ax.invert_yaxis()
        ax.legend(fontsize=7)
    save(picture, path)


def _pictures(folder: Path, rows: pd.DataFrame) -> list[str]:
    """Figure of image, truth and depths of start, preset and defaults."""
    maps: dict[str, dict[str, Mapping[str, np.ndarray]]] = {}
    for name, method, cell in zip(rows["name"], rows["method"], rows["cell"], strict=True):
        if cell.keep is not None and cell.keep.is_file():
            with np.load(cell.keep) as file:
                maps.setdefault(name, {})[method] = dict(file)
    shown = {name: by_method for name, by_method in maps.items() if len(by_method) == len(METHODS)}
    heads = ("image", "truth", "paper's start", "preset: paper", "defaults")
    picture, axes = panels(len(shown), len(heads), 2.0, 1.2)
    for ax in axes.flat:
        ax.set_axis_off()
    for line, (name, by_method) in zip(axes, shown.items(), strict=False):
        paper, ours = by_method["preset: paper"], by_method["defaults"]
        truth = paper.get("truth", ours["solution"])
        depths = [truth, paper["start"], paper["solution"], ours["solution"]]
        line[0].imshow(paper["image"])
        line[0].set_title(name, fontsize=6, loc="left")
        logs = [np.log(np.where(z > 0, z, np.nan)) for z in depths]
        logs = [z + np.nanmedian(logs[0] - z) for z in logs]
        low, high = np.nanpercentile(logs[0], [2, 98])
        for ax, head, z in zip(line[1:], heads[1:], logs, strict=True):
            ax.imshow(z, cmap="viridis", vmin=low, vmax=high + 0.01)
            ax.set_title(head, fontsize=7)
    picture.suptitle("Depth: dark is near, bright is far; one logarithmic scale a line", fontsize=8)
    save(picture, folder / "depth_maps.png")
    text = "Depth maps: image, truth, unorganised soup, preset, defaults"
    return ["## Depth maps", f"{text}.", _figure("depth_maps", text)]


def _study(folder: Path, name: str, rows: pd.DataFrame) -> list[str]:
    """A study by both methods: a table for each, and a figure."""
    study = STUDIES[name]
    blocks, drawn = [f"## {study.text[0].upper()}{study.text[1:]}"], {}
    for method in METHODS:
        group = rows[rows["method"] == method].assign(value=metric(rows))
        drawn[method] = pivot(group, "value", "name", "change").rename_axis(index="pair")
        blocks += [f"{method}, MRE after median scale, no cap:", markdown(drawn[method])]
    if name == "ablation":
        terms = ["arap", "+ proj", "+ cont", "+ orient"]
        printed = pd.DataFrame.from_dict(ABLATION, orient="index", columns=terms)
        blocks += ["Published MRE:", markdown(printed.rename_axis("sequence"))]
        blocks.append(f"Copied, not measured: {SOURCE}.")
    _plot_lines(folder / f"{name}.png", drawn, name, study.text)
    return [*blocks, study.published, _figure(name, study.text)]


def _plot_lines(path: Path, tables: Mapping[str, pd.DataFrame], axis: str, text: str) -> None:
    """Lines of tables over their columns, a panel for each table; the mean in black."""
    picture, (axes,) = panels(1, len(tables), 4.5, 3.8, sharey=True)
    for ax, (title, table) in zip(axes, tables.items(), strict=True):
        means = [str(name).startswith("mean of") for name in table.index]
        style: dict[str, Any] = {"marker": "o", "ms": 3, "lw": 1, "fontsize": 8, "rot": 20}
        style["color"] = ["black" if mean else f"C{k % 10}" for k, mean in enumerate(means)]
        if len(table):
            ticks = range(table.shape[1])
            table.T.plot(ax=ax, xlabel=axis, ylabel="MRE", logy=True, xticks=ticks, **style)
            ax.grid(alpha=0.3)
            ax.legend(fontsize=5)
        ax.set_title(title, fontsize=9)
    picture.suptitle(text, fontsize=10)
    save(picture, path)


def _convergence(folder: Path, rows: pd.DataFrame) -> list[str]:
    """Table and figure of the energy over iterations and rounds."""
    good = rows[rows["curve.exact"].notna()] if "curve.exact" in rows else rows.iloc[:0]
    entries = []
    picture, axes = panels(len(good), 2, 4.5, 2.5)
    for (left, right), row in zip(axes, good.to_dict("records"), strict=False):
        begin = 0
        for k, (stage, y) in enumerate(zip(row["curve.names"], row["curve.values"], strict=True)):
            left.semilogy(begin + np.arange(len(y)), np.maximum(y, 1e-12), label=stage, c=f"C{k}")
            begin += len(y)
        start, end = row["curve.exact"]
        rounds = row["curve.rounds"]
        right.plot(np.arange(len(rounds)), rounds, "o-", ms=4)
        left.set_title(f"{row['name']}, {row['method']}: solver", fontsize=7)
        left.legend(fontsize=5)
        right.set_title("refinement, exact objective by round", fontsize=7)
        fall = f"{1 - rounds[-1] / rounds[0]:.1%}" if rounds and rounds[0] else "-"
        status = str(row["status"]).replace("_", " ")
        numbers = int(row["iterations"]), f"{start:.5g}", f"{end:.5g}", fall
        entries.append([row["name"], row["method"], status, *numbers])
    save(picture, folder / "convergence.png")
    head = ["pair", "method", "constrained NLP", "iterations", "E start", "E NLP"]
    table = pd.DataFrame(entries, columns=[*head, "refinement lowers E by"])
    return [
        "## Convergence of E over iterations and rounds",
        "The exact energy of start and NLP; the figure has the smoothed energy by stage.",
        markdown(table.set_index("pair"), ""),
        _figure("convergence", "Energy over iterations and rounds"),
    ]


def _time(rows: pd.DataFrame) -> list[str]:
    """Table of seconds by stage."""
    columns = {f"stages.{s}": (s, ".1f") for s in STAGES} | {"cpu_seconds": ("cpu_seconds", ".1f")}
    runs = rows.set_axis(pd.MultiIndex.from_frame(rows[["name", "method"]]))
    text = (
        "Wall seconds by stage, the machine shared with other work, and CPU seconds of the whole"
        " row. Published: 15 to 20 minutes for 1024 x 436 in MATLAB and C++ on an i7."
    )
    return ["## Time", text, titled(runs, columns)]


def _departures(folder: Path, rows: pd.DataFrame) -> list[str]:
    """Tables and figure of the departures, each undone or made alone."""
    blocks = [
        "## Departures, one at a time",
        "MRE, one pair of each family. *Mean* and *median* are of the ratios to the first line (the"
        " mean is geometric, a single diverging solve decides it); *worse / better* counts the"
        " pairs that change by more than 1 %.",
    ]
    bars = {}
    for method, text in ALONE.items():
        group = rows[rows["method"] == method].assign(value=metric(rows))
        values = pivot(group, "value", "change", "name", average=False).dropna(axis=1, how="all")
        ratios = values / values.loc[BASE] if len(values) else values
        mean = np.exp(np.log(ratios).mean(axis=1))
        counts = zip((ratios > 1.01).sum(axis=1), (ratios < 0.99).sum(axis=1), strict=True)
        values.insert(0, "worse / better", [f"{a} / {b}" for a, b in counts])
        values.insert(0, "median", ratios.median(axis=1))
        values.insert(0, "mean", mean)
        bars[method] = mean.drop(BASE, errors="ignore")
        blocks += [text, markdown(values.rename_axis("departure"))]
    text = "MRE relative to all others as they are (geometric mean of the pairs)"
    _plot_bars(folder / "departures.png", pd.DataFrame(bars), text, base=1.0)
    needs = "\n".join(f"- {d.name}: {d.needs}." for d in DEPARTURES if d.needs)
    return [*blocks, needs, _figure("departures", text)]


def _missing(present: set[str]) -> list[str]:
    """Table of the paper's data without rows; `present` names the datasets that have rows."""
    reasons = {}
    for name, (title, suites) in DATASETS.items():
        if name not in present:
            suite = SUITES[suites[0]]
            reasons[title] = f"no pair was given; from {suite.source}, as {suite.layout}"
    table = pd.Series(reasons | WITHOUT_TRUTH, name="why, and where from").rename_axis("data")
    return ["## What is not here", markdown(table.to_frame())]
