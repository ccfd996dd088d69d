"""Page of `bench speed`: conclusion, tables, growth exponents and plots."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.ticker import LogLocator, NullFormatter

from soup_nlp.bench.processes import machine
from soup_nlp.bench.speed import measure
from soup_nlp.bench.studies import Study
from soup_nlp.bench.tables import (
    columns,
    failures,
    figure,
    grid_of_panels,
    page_text,
    save,
    show,
    table,
)
from soup_nlp.storage.atomic import write_text
from soup_nlp.storage.folders import staged
from soup_nlp.storage.rows import failed

Row = Mapping[str, Any]
Cell = Callable[[Row], str]

OUTSIDE = ("flow", "segmentation", "start", "weights", "evaluation", "output")
"""All stages but the NLP and the loading or rendering of the frames."""
PHASES = (
    "load", "flow", "segmentation", "start", "weights",
    "build", "functions", "linear algebra", "evaluation", "output",
)  # fmt: skip
"""Stages of a run; build, functions and linear algebra are the NLP."""
COSTS: dict[str, Callable[[Row], float]] = {
    "NLP, CPU s": lambda r: r["cpu"]["nlp"],
    "CPU s an iteration": lambda r: r["cpu"]["nlp"] / max(1, r["iterations"]),
    "functions, s": lambda r: r["wall"]["functions"],
    "linear algebra, s": lambda r: r["wall"]["linear algebra"],
    "outside the NLP, CPU s": lambda r: outside(r),
    "Hessian nonzeros": lambda r: r["sizes"]["hessian_nonzeros"],
    "peak memory": lambda r: r["peak_bytes"],
}
"""Costs whose growth with N is fitted."""
MAX_PANELS = 12
"""Panels of the picture of energies."""
LIMITS = (
    "Wall times of a shared machine vary with its load; CPU times less so. One thread."
    " Compiling the kernels happens once a machine and is in the wall time (build) of the run"
    " that does it, not in its CPU time. Loading is rendering for the scenes; outside: flow,"
    " segmentation, start, weights, evaluation and output with every picture, point cloud"
    " and HDF5."
)


def outside(record: Row) -> float:
    """CPU seconds of the stages of OUTSIDE."""
    return float(sum(record["cpu"].get(stage, 0.0) for stage in OUTSIDE))


def _energy_ratio(r: Row) -> float:
    return float(r["energy"]["total"] / r["reference"]["energy"]["total"])


def _time_ratio(r: Row) -> float:
    return float(r["cpu"]["nlp"] / r["reference"]["cpu_seconds"])


def _at(form: str, *path: str) -> Cell:
    """Cell with the number of a record at nested keys."""

    def cell(record: Row) -> str:
        value: Any = record
        for key in path:
            value = None if value is None else value.get(key)
        return show(value, form)

    return cell


IDENTITY: dict[str, Cell] = {
    "pair": _at("", "settings", "scene"),
    "seed": _at("d", "settings", "seed"),
    "N": _at("d", "sizes", "superpixels"),
    "K": _at("d", "settings", "neighbours"),
}
COLUMNS: dict[str, Cell] = {
    **IDENTITY,
    "CPU s": _at(".1f", "cpu", "nlp"),
    "presolve CPU s": _at(".1f", "cpu", "presolve"),
    "wall s": _at(".1f", "wall", "nlp"),
    "its": _at("d", "iterations"),
    "E start": _at(".2f", "energy_start", "total"),
    "E": _at(".3f", "energy", "total"),
    "E LM": _at(".3f", "reference", "energy", "total"),
    "E / LM": lambda r: f"{_energy_ratio(r):.4f}",
    "CPU / LM": lambda r: f"{_time_ratio(r):.2f}",
    "LM its": _at("d", "reference", "iterations"),
    "MRE start": _at(".4f", "mre", "start"),
    "MRE": _at(".4f", "mre", "solution"),
    "MRE LM": _at(".4f", "reference", "mre"),
    "dual inf.": _at(".1e", "residuals", "dual_infeasibility"),
    "constraints": _at(".1e", "residuals", "nlp_infeasibility"),
    "nnz H": _at("d", "sizes", "hessian_nonzeros"),
    "GB": lambda r: f"{r['peak_bytes'] / 2**30:.2f}",
    "status": lambda r: r["status"].replace("_", " "),
}
"""The main table."""
STAGES: dict[str, Cell] = {
    **IDENTITY,
    **{name: _at(".2f", "wall", name) for name in PHASES},
    "compiler, CPU s": _at(".2f", "cpu", "compiler"),
    "outside, CPU s": lambda r: f"{outside(r):.2f}",
}


class Growth(NamedTuple):
    """Fit of cost = factor N^exponent.

    Attributes:
        exponent: Slope of log cost over log N.
        error: Standard error of the slope; NaN if no degree of freedom is left.
    """

    exponent: float
    error: float

    def __str__(self) -> str:
        error = "" if np.isnan(self.error) else f" ± {self.error:.2f}"
        return f"{self.exponent:.2f}{error}"


def fit(
    sizes: Sequence[float], costs: Sequence[float], scenes: Sequence[str] | None = None
) -> Growth | None:
    """Least squares of log cost over log N; None with fewer than two different sizes.

    Args:
        sizes: N of every run.
        costs: Positive cost of every run.
        scenes: Scene of every run: one exponent for all scenes, one factor for each. None takes
            one factor for all runs.
    """
    n, c = np.asarray(sizes, float), np.asarray(costs, float)
    use = (n > 0) & (c > 0)
    _, scene = np.unique(np.asarray(scenes or [""] * len(n))[use], return_inverse=True)
    own = np.eye(scene.max(initial=-1) + 1)[scene]
    x = np.log(n[use])
    # actual numbers of superpixels differ a little between seeds of one size
    if not len(x) or np.ptp(x - own @ np.linalg.pinv(own) @ x) < 0.2:
        return None
    X = np.column_stack([x, own])
    solution, rest, *_ = np.linalg.lstsq(X, np.log(c[use]))
    free = len(x) - X.shape[1]
    error = np.sqrt(rest[0] / free * np.linalg.inv(X.T @ X)[0, 0]) if free else np.nan
    return Growth(float(solution[0]), float(error))


def growth_lines(records: Sequence[Row]) -> list[str]:
    """Table of the growth of every cost by scene and K, and over all scenes; may be empty."""
    lines = []
    groups = _groups(records)
    for k in sorted({k for _, k in groups}):
        own = {scene: group for (scene, other), group in groups.items() if other == k}
        if len(own) > 1:
            groups["all", k] = [r for group in own.values() for r in group]
    for (scene, k), group in groups.items():
        n = [r["sizes"]["superpixels"] for r in group]
        scenes = [r["settings"]["scene"] for r in group]
        fits = [fit(n, [cost(r) for r in group], scenes) for cost in COSTS.values()]
        if any(fits):
            texts = ["-" if f is None else str(f) for f in fits]
            lines.append([scene, str(k), f"{min(n)} to {max(n)}", *texts])
    return table(["pair", "K", "N", *COSTS], lines) if lines else []


def conclusion(records: Sequence[Row]) -> str:
    """Summary of the table in sentences."""
    if not records:
        return "No run ended with a result."
    converged = sum(bool(r["converged"]) for r in records)
    n, k = max((r["settings"]["superpixels"], r["settings"]["neighbours"]) for r in records)
    large = [r for r in records if r["settings"]["superpixels"] == n]
    costs = [r["cpu"]["nlp"] for r in large if r["settings"]["neighbours"] == k]
    ratios, times = [_energy_ratio(r) for r in records], [_time_ratio(r) for r in records]
    return (
        f"{converged} of {len(records)} runs converged to their tolerance."
        f" At N = {n}, K = {k} the NLP takes {min(costs):.1f} to {max(costs):.1f} CPU s"
        f" ({len(costs)} runs); all stages outside it at most"
        f" {max(outside(r) for r in large):.1f} CPU s."
        f" Its energy is {min(ratios):.4f} to {max(ratios):.4f} times that of"
        f" Levenberg-Marquardt on the same smoothing, its CPU time"
        f" {min(times):.2f} to {max(times):.2f} times."
    )


class SpeedStudy(Study):
    """The study of `bench speed`, whose page has several tables and plots."""

    @property
    def files(self) -> tuple[str, ...]:
        """Names of the files that are written of all rows."""
        return (f"{self.name}.md", "growth.png", "phases.png", "energy.png")

    def write(self, out: Path, rows: Sequence[dict[str, Any]]) -> None:
        """Write the page and the plots of the rows."""
        good = [r for r in rows if not failed(r)]
        sections = {
            "Growth: cost = factor N^p": growth_lines(good),
            "Wall seconds by stage": columns(STAGES, good),
            "Machine": [f"- {k}: {v}" for k, v in {"date": date.today(), **machine()}.items()],
            "Limits": [LIMITS],
        }
        lines = ["# Speed and growth", "", conclusion(good), ""]
        lines += [*columns(self.cells, good), "", self.note, *failures(list(rows))]
        for title, body in sections.items():
            lines += ["", f"## {title}", "", *body] if body else []
        with staged(out) as new:
            write_text(new / f"{self.name}.md", page_text(lines))
            if good:
                plot_growth(new / "growth.png", good)
                plot_phases(new / "phases.png", good)
                plot_energy(new / "energy.png", good)


SPEED = SpeedStudy(
    "table",
    "CPU s and wall s: the whole NLP (presolve, build, constrained NLP). its: of the presolve"
    " and of Ipopt. E: exact energy, LM: on-manifold Levenberg-Marquardt with reweighting from"
    " the same start on the same smoothing widths, in the same process. MRE after median"
    " scale, no cap. dual inf., constraints: recomputed at Ipopt's answer. GB: peak of the"
    " process before the reference solver runs.",
    measure,
    COLUMNS,
)


def _groups(records: Sequence[Row]) -> dict[tuple[str, int], list[Row]]:
    out: dict[tuple[str, int], list[Row]] = defaultdict(list)
    for r in records:
        out[r["settings"]["scene"], r["settings"]["neighbours"]].append(r)
    return dict(sorted(out.items()))


def _label(r: Row) -> str:
    s = r["settings"]
    return f"{s['scene']}, N {s['superpixels']}, K {s['neighbours']}, seed {s['seed']}"


def plot_growth(path: Path, records: Sequence[Row]) -> None:
    """CPU seconds of NLP, reference solver and other stages, and peak memory, over N (log-log)."""
    picture = figure(11, 4)
    left, right = picture.subplots(1, 2)
    for index, ((scene, k), group) in enumerate(_groups(records).items()):
        group = sorted(group, key=lambda r: r["sizes"]["superpixels"])
        n, colour = [r["sizes"]["superpixels"] for r in group], f"C{index % 10}"
        cpu = [r["cpu"]["nlp"] for r in group]
        slope = fit(n, cpu)
        label = f"{scene}, K {k}" + (f": N^{slope.exponent:.2f}" if slope else "")
        left.loglog(n, cpu, "o-", color=colour, label=label)
        left.loglog(n, [outside(r) for r in group], ".:", color=colour, alpha=0.6)
        reference = [r["reference"]["cpu_seconds"] for r in group]
        left.loglog(n, reference, "x", color=colour, alpha=0.7)
        right.loglog(n, [r["peak_bytes"] / 2**30 for r in group], "o-", color=colour)
    left.set_title("NLP (o), reference solver (x), all stages outside (.)", fontsize=10)
    left.legend(fontsize=8)
    right.set_title("peak memory", fontsize=10)
    sizes = sorted({r["settings"]["superpixels"] for r in records})
    for axes, unit in ((left, "CPU s"), (right, "GB")):
        axes.set(xlabel="superpixels N", ylabel=unit)
        axes.set_xticks(sizes, [str(n) for n in sizes])
        axes.xaxis.set_minor_formatter(NullFormatter())
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 3.0, 5.0)))
        axes.yaxis.set_major_formatter("{x:g}")
        axes.yaxis.set_minor_formatter(NullFormatter())
    save(picture, path)


def plot_phases(path: Path, records: Sequence[Row]) -> None:
    """Wall seconds by stage as stacked bars, one bar for each run."""
    picture = figure(9, 0.32 * len(records) + 1.4)
    axes = picture.subplots()
    keys = [_label(r) for r in records]
    begin = np.zeros(len(records))
    for index, part in enumerate(p for p in PHASES if p not in ("load", "weights")):
        width = np.array([r["wall"].get(part, 0.0) for r in records])
        axes.barh(keys, width, left=begin, label=part, color=f"C{index}")
        begin += width
    axes.tick_params("y", labelsize=7)
    axes.invert_yaxis()
    axes.set_xlabel("wall s")
    picture.legend(fontsize=7, ncols=4, loc="outside lower center")
    save(picture, path)


def plot_energy(path: Path, records: Sequence[Row]) -> None:
    """Exact energy over seconds: history of the reference solver, end of Ipopt, largest runs."""
    drawn = sorted(records, key=lambda r: -r["sizes"]["superpixels"])[:MAX_PANELS]
    picture, panels = grid_of_panels(len(drawn), 4, 3.4, 2.6)
    for r, panel in zip(drawn, panels, strict=True):
        panel.plot(*np.transpose(r["reference"]["history"]), label="Levenberg-Marquardt")
        panel.plot(r["wall"]["nlp"], r["energy"]["total"], "k*", label="Ipopt, end")
        panel.set_title(_label(r), fontsize=7)
        panel.tick_params(labelsize=7)
    panels[0].legend(fontsize=7)
    picture.supxlabel("wall s", fontsize=8)
    picture.supylabel("exact energy", fontsize=8)
    save(picture, path)
