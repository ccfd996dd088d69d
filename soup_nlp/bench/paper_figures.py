"""Figures of `bench paper`, one PNG each."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

from soup_nlp.arrays import Float
from soup_nlp.bench.paper_measures import read_maps
from soup_nlp.bench.paper_scale import SCALES
from soup_nlp.bench.tables import figure, grid_of_panels, save
from soup_nlp.storage.rows import Row

Number = float | None
Lines = Mapping[str, Mapping[str, Mapping[str, Number]]]
"""Values by method, pair and variant."""

COLOURS = {
    "preset: paper": "#cc6677",
    "defaults": "#4477aa",
    "constant depth": "#bbbbbb",
    "published": "#222222",
}
SCALE_STYLES = {
    "arap": ("E_arap, printed", "#cc6677"),
    "cont": ("E_cont, printed", "#228833"),
    "arap px": ("E_arap, pixels", "#ddaa33"),
    "paper": ("E, preset: paper", "#222222"),
    "defaults": ("E, defaults", "#4477aa"),
}
STAGES = ("#88ccee", "#44aa99", "#117733", "#ddaa33", "#882255")
"""Colours of the stages of a solve, in their order."""
MAX_PANELS = 12
"""Number of panels in the figure of scales."""
BAR_LIMIT = 1.0
"""MRE at which bars are cut."""


def plot_lines(path: Path, lines: Lines, axis: str, measure: str, text: str) -> None:
    """Values over the variants: one panel for each method, one line for each pair."""
    picture = figure(9, 3.6)
    axes = picture.subplots(1, len(lines), sharey=True, squeeze=False)[0]
    values: list[float] = []
    for ax, (method, pairs) in zip(axes, lines.items(), strict=True):
        for pair, own in pairs.items():
            y = np.array([np.nan if v is None else v for v in own.values()])
            values += [v for v in y if np.isfinite(v)]
            ax.plot(np.arange(len(own)), y, "o-", lw=1.2, ms=4, label=pair)
        names = list(next(iter(pairs.values()), {}))
        slanted = len("".join(names)) > 36
        ax.set_xticks(np.arange(len(names)), names, rotation=20 if slanted else 0, size=8)
        ax.set(title=method, xlabel=axis)
        ax.grid(alpha=0.3)
    axes[0].set_ylabel(measure)
    _scaled(axes, values)
    if values:
        axes[-1].legend(fontsize=7)
    picture.suptitle(text, fontsize=10)
    save(picture, path)


def _scaled(axes: Sequence[Axes], values: Sequence[float]) -> None:
    """Make the axes logarithmic if the values differ much, else let them begin at 0."""
    for ax in axes:
        if values and min(values) > 0 and max(values) > 20 * min(values):
            ax.set_yscale("log")
        else:
            ax.set_ylim(bottom=0)


def plot_comparison(path: Path, bars: Mapping[str, Mapping[str, Number]], text: str) -> None:
    """MRE by method for every dataset as groups of bars, cut at BAR_LIMIT, with their numbers."""
    names = list(dict.fromkeys(m for own in bars.values() for m in own))
    picture = figure(max(6.0, 1.5 * len(bars) + 1), 4.2)
    ax = picture.add_subplot()
    width = 0.84 / max(1, len(names))
    for k, name in enumerate(names):
        x = np.arange(len(bars)) + (k - (len(names) - 1) / 2) * width
        for place, value in zip(x, (own.get(name) for own in bars.values()), strict=True):
            if value is None:
                continue
            height = min(value, BAR_LIMIT)
            ax.bar(place, height, width, color=COLOURS.get(name))
            form = ".3f" if value < BAR_LIMIT else ".3g"
            at = height + 0.01 * BAR_LIMIT
            ax.text(place, at, format(value, form), ha="center", va="bottom", size=6, rotation=90)
    ax.set_ylim(0, 1.2 * BAR_LIMIT)
    ax.axhline(BAR_LIMIT, color="k", lw=0.6, ls=":")
    ax.set_xticks(np.arange(len(bars)), list(bars), rotation=15, size=8)
    ax.set(ylabel=f"MRE, one median scale; bars end at {BAR_LIMIT:g}")
    keys = [Patch(color=COLOURS.get(name), label=name) for name in names]
    picture.legend(handles=keys, loc="outside lower center", ncols=len(names), fontsize=7)
    ax.set_title(text, fontsize=10)
    save(picture, path)


def plot_curves(path: Path, curves: Mapping[str, Mapping[str, Row]]) -> None:
    """Energies over iterations and rounds: a row of panels for each pair, two panels a method."""
    pairs = list(curves)
    methods = list(dict.fromkeys(m for own in curves.values() for m in own))
    picture = figure(2.6 * 2 * max(1, len(methods)), 2.1 * max(1, len(pairs)) + 0.7)
    axes = picture.subplots(max(1, len(pairs)), 2 * max(1, len(methods)), squeeze=False)
    for ax in axes.flat:
        ax.set_axis_off()
    stages: dict[str, Any] = {}
    for k, pair in enumerate(pairs):
        for m, (method, row) in enumerate(curves[pair].items()):
            left, right = axes[k, 2 * m], axes[k, 2 * m + 1]
            stages |= _stages(left, row)
            rounds = np.asarray(row["rounds"], np.float64)
            right.set_axis_on()
            if rounds.size and rounds[0]:
                percent = 100 * (rounds / rounds[0] - 1)
                right.plot(np.arange(len(rounds)), percent, "o-", color=COLOURS.get(method), ms=4)
                right.set_ylim(top=0.05 * max(1e-3, -percent.min()))
            left.set_title(f"{pair}\n{method}: solver", fontsize=7)
            right.set_title("refinement, exact objective", fontsize=7)
            right.set_ylabel("% of its begin", fontsize=7)
            for ax, label in ((left, "iteration"), (right, "round")):
                ax.tick_params(which="both", labelsize=6)
                ax.ticklabel_format(axis="x", useOffset=False)
                ax.set_xlabel(label, fontsize=7)
                ax.grid(alpha=0.3)
    picture.legend(stages.values(), stages, loc="outside lower center", ncols=5, fontsize=7)
    save(picture, path)


def _stages(ax: Axes, row: Row) -> dict[str, Any]:
    """Draw the smoothed energy of all stages in sequence; the lines by name of the stage."""
    begin = 0
    lines: dict[str, Any] = {}
    ax.set_axis_on()
    for stage in row["stages"]:
        y = np.asarray(stage["objective"], np.float64)
        x = begin + np.arange(len(y))
        colour = STAGES[min(len(lines), len(STAGES) - 1)]
        (lines[stage["name"]],) = ax.semilogy(x, np.maximum(y, 1e-12), "-", lw=1.3, color=colour)
        if len(y) == 1:
            ax.plot(x, y, ".", ms=4, color=colour)
        begin += len(y)
    ax.set_ylabel("E, smoothed", fontsize=7)
    return lines


def plot_bars(path: Path, table: Mapping[str, Mapping[str, Number]], text: str, label: str) -> None:
    """Ratios as horizontal bars from 1 on a logarithmic axis: a group for each row of the table."""
    names = list(table)
    groups = list(dict.fromkeys(g for own in table.values() for g in own))
    picture = figure(8, 0.36 * len(names) + 1.2)
    ax = picture.add_subplot()
    height = 0.8 / max(1, len(groups))
    for k, group in enumerate(groups):
        y = np.arange(len(names)) + (k - (len(groups) - 1) / 2) * height
        x = [table[n].get(group) for n in names]
        ax.barh(y, [np.nan if v is None else v - 1 for v in x], height, left=1, label=group)
    ax.set_xscale("log")
    ax.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    ax.xaxis.set_major_formatter(ScalarFormatter())
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.axvline(1.0, color="k", lw=0.8)
    ax.set_yticks(np.arange(len(names)), names, size=7)
    ax.invert_yaxis()
    ax.set_xlabel(label, fontsize=8)
    ax.grid(alpha=0.3, axis="x")
    ax.legend(fontsize=7)
    ax.set_title(text, fontsize=10)
    save(picture, path)


def plot_scale(path: Path, bodies: Mapping[str, Mapping[str, Sequence[float]]]) -> None:
    """Energies over the scale of one body, from 0 (lowest) to 1 (highest); the truth is 1."""
    shown = dict(list(bodies.items())[:MAX_PANELS])
    picture, panels = grid_of_panels(len(shown), 4, 2.6, 2.3, margin=(0.0, 0.6))
    for ax, (name, curves) in zip(panels, shown.items(), strict=True):
        for kind, (label, colour) in SCALE_STYLES.items():
            y = np.asarray(curves[kind])
            y = (y - y.min()) / max(float(np.ptp(y)), 1e-12)
            ax.semilogx(SCALES, y, color=colour, lw=1.2, label=label)
            ax.plot(SCALES[np.argmin(y)], 0, "v", color=colour, ms=5)
        ax.axvline(1.0, color="k", lw=0.8, ls=":")
        ax.set_xticks([0.25, 0.5, 1, 2, 4], ["1/4", "1/2", "1", "2", "4"])
        ax.minorticks_off()
        ax.set_title(name, fontsize=7)
        ax.tick_params(labelsize=6)
    picture.supylabel("energy, from its lowest to its highest value", fontsize=8)
    if panels:
        keys = panels[0].get_legend_handles_labels()
        columns = min(5, 2 * len(panels))
        picture.legend(*keys, loc="outside lower center", ncols=columns, fontsize=7)
    picture.suptitle("Energy over the scale of one moving body; 1 is the true scale", fontsize=10)
    save(picture, path)


def plot_maps(path: Path, files: Mapping[str, tuple[Path, Path]]) -> None:
    """Image, truth and depths of start, preset and defaults: one row of panels for each pair."""
    found = {name: (read_maps(a), read_maps(b)) for name, (a, b) in files.items()}
    found = {name: maps for name, maps in found.items() if all(maps)}
    heads = ("image", "truth", "paper's start", "preset: paper", "defaults")
    picture = figure(2.0 * len(heads), 1.15 * max(1, len(found)) + 0.4)
    axes = picture.subplots(max(1, len(found)), len(heads), squeeze=False)
    for ax in axes.flat:
        ax.set_axis_off()
    for k, (name, (paper, ours)) in enumerate(found.items()):
        truth = paper.get("truth")
        depths = [truth, paper["start"], paper["solution"], ours["solution"]]
        known = np.asarray(truth if truth is not None else ours["solution"], np.float64)
        low, high = _limits(known)
        axes[k, 0].imshow(paper["image"])
        axes[k, 0].set_title(name, fontsize=6, loc="left")
        for ax, head, depth in zip(axes[k, 1:], heads[1:], depths, strict=True):
            if k == 0:
                ax.set_title(head, fontsize=8)
            if depth is None:
                ax.text(0.5, 0.5, "sparse", ha="center", size=7, transform=ax.transAxes)
                continue
            z = np.asarray(depth, np.float64)
            ax.imshow(np.log(_scaled_to(z, known)), cmap="viridis", vmin=low, vmax=high)
    picture.suptitle("Depth: dark is near, bright is far; one logarithmic scale a line", fontsize=8)
    save(picture, path)


def _limits(z: Float) -> tuple[float, float]:
    good = z[np.isfinite(z) & (z > 0)]
    low, high = np.percentile(good, [2, 98]) if good.size else (1.0, 2.0)
    return float(np.log(low)), float(np.log(max(high, 1.01 * low)))


def _scaled_to(z: Float, known: Float) -> Float:
    """z times the median of known / z; NaN where it is not positive."""
    z = np.where(z > 0, z, np.nan)
    ratio = known / z
    ratio = ratio[np.isfinite(ratio) & (ratio > 0)]
    return z * (np.median(ratio) if ratio.size else 1.0)
