"""Plots of `bench speed`: time and memory over N, and energy over time against the yardstick."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from soup_nlp.bench.speed_fit import fit, outside
from soup_nlp.storage.atomic import atomic_path

Record = Mapping[str, Any]
PARTS = (
    "flow",
    "segmentation",
    "start",
    "build",
    "functions",
    "linear algebra",
    "evaluation",
    "output",
)


def _save(figure: Figure, path: Path) -> None:
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=110, bbox_inches="tight", metadata={"Software": None})


def _groups(records: Sequence[Record]) -> dict[tuple[str, int], list[Record]]:
    out: dict[tuple[str, int], list[Record]] = defaultdict(list)
    for r in records:
        out[r["spec"]["scene"], r["spec"]["neighbours"]].append(r)
    return dict(sorted(out.items()))


def plot_growth(path: Path, records: Sequence[Record]) -> None:
    """CPU seconds of NLP, yardstick and the rest, and peak memory, over N in log-log axes."""
    figure = Figure(figsize=(11, 4))
    left, right = figure.subplots(1, 2)
    for index, ((scene, k), group) in enumerate(_groups(records).items()):
        n = np.array([r["sizes"]["superpixels"] for r in group], float)
        order, colour = np.argsort(n), f"C{index % 10}"
        cpu = np.array([r["cpu"]["nlp"] for r in group])
        slope = fit(n.tolist(), cpu.tolist())
        label = f"{scene}, K {k}" + (f": N^{slope.exponent:.2f}" if slope else "")
        left.loglog(n[order], cpu[order], "o-", color=colour, label=label)
        rest = np.array([outside(r) for r in group])
        left.loglog(n[order], rest[order], ".:", color=colour, alpha=0.6)
        lm = [(m, r["yardstick"]["same"]) for m, r in zip(n, group) if "same" in r["yardstick"]]
        if lm:
            left.loglog(
                [m for m, _ in lm], [y["cpu_seconds"] for _, y in lm], "x", color=colour, alpha=0.7
            )
        memory = np.array([r["peak_bytes"] for r in group]) / 2**30
        right.loglog(n[order], memory[order], "o-", color=colour)
    left.set(xlabel="superpixels N", ylabel="CPU s")
    left.set_title("NLP (o), yardstick (x), all stages outside (.)", fontsize=10)
    left.legend(fontsize=8)
    right.set(xlabel="superpixels N", ylabel="GB")
    right.set_title("peak memory", fontsize=10)
    for axes in (left, right):
        sizes = sorted({r["spec"]["superpixels"] for r in records})
        axes.set_xticks(sizes, [str(n) for n in sizes])
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 3.0, 5.0)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter(NullFormatter())
    figure.tight_layout()
    _save(figure, path)


def plot_phases(path: Path, records: Sequence[Record]) -> None:
    """Stacked wall seconds by stage, a bar a run."""
    figure = Figure(figsize=(9, 0.32 * len(records) + 1.4))
    axes: Axes = figure.subplots()
    begin = np.zeros(len(records))
    for index, part in enumerate(PARTS):
        width = np.array([r["wall"].get(part, 0.0) for r in records])
        axes.barh(np.arange(len(records)), width, left=begin, label=part, color=f"C{index}")
        begin += width
    axes.set_yticks(np.arange(len(records)), [r["key"] for r in records], fontsize=7)
    axes.invert_yaxis()
    axes.set_xlabel("wall s")
    axes.legend(fontsize=7, ncols=4, loc="upper center", bbox_to_anchor=(0.4, -0.12))
    _save(figure, path)


def plot_energy(path: Path, records: Sequence[Record], most: int = 12) -> None:
    """Exact energy over seconds: the yardsticks' history, Ipopt's end as a point.

    Args:
        path: PNG.
        records: Runs with a yardstick; the largest `most` of them are drawn.
        most: Panels.
    """
    have = [r for r in records if r["yardstick"]]
    have = sorted(have, key=lambda r: -r["sizes"]["superpixels"])[:most]
    if not have:
        return
    columns = min(4, len(have))
    rows = -(-len(have) // columns)
    figure = Figure(figsize=(3.4 * columns, 2.6 * rows))
    panels = np.atleast_1d(figure.subplots(rows, columns)).ravel()
    for panel, r in zip(panels, have):
        for kind, y in r["yardstick"].items():
            history = np.array(y["history"])
            panel.plot(history[:, 0], history[:, 1], label=f"LM, {kind}")
        panel.plot(r["wall"]["nlp"], r["energy"]["total"], "k*", label="Ipopt, end")
        panel.set_title(r["key"], fontsize=7)
        panel.tick_params(labelsize=7)
    for panel in panels[len(have) :]:
        panel.set_axis_off()
    panels[0].legend(fontsize=7)
    figure.supxlabel("wall s", fontsize=8)
    figure.supylabel("exact energy", fontsize=8)
    figure.tight_layout()
    _save(figure, path)
