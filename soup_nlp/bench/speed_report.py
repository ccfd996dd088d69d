"""Report of `bench speed`: growth exponents, tables with the conclusion first, and plots."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from soup_nlp.bench.rows import failed
from soup_nlp.bench.speed_fit import ALL, COSTS, fit, growth, outside
from soup_nlp.bench.tables import columns, save, show, table

Row = Mapping[str, Any]
Cell = Callable[[Row], str]


def _reference(record: Row, kind: str = "same") -> Mapping[str, Any] | None:
    found: Mapping[str, Any] | None = record["reference"].get(kind)
    return found


COLUMNS: dict[str, Cell] = {
    "pair": lambda r: r["spec"]["scene"],
    "seed": lambda r: str(r["spec"]["seed"]),
    "N": lambda r: str(r["sizes"]["superpixels"]),
    "K": lambda r: str(r["spec"]["neighbours"]),
    "CPU s": lambda r: f"{r['cpu']['nlp']:.1f}",
    "presolve CPU s": lambda r: show(r["cpu"].get("presolve"), ".1f"),
    "wall s": lambda r: f"{r['wall']['nlp']:.1f}",
    "its": lambda r: str(r["iterations"]),
    "E start": lambda r: f"{r['energy_start']['total']:.2f}",
    "E": lambda r: f"{r['energy']['total']:.3f}",
    "E LM": lambda r: show((_reference(r) or {}).get("energy", {}).get("total"), ".3f"),
    "E / LM": lambda r: (
        f"{r['energy']['total'] / y['energy']['total']:.4f}" if (y := _reference(r)) else "-"
    ),
    "CPU / LM": lambda r: (
        f"{r['cpu']['nlp'] / y['cpu_seconds']:.2f}" if (y := _reference(r)) else "-"
    ),
    "LM its": lambda r: str(y["iterations"]) if (y := _reference(r)) else "-",
    "MRE start": lambda r: show(r["mre"].get("start"), ".4f"),
    "MRE": lambda r: show(r["mre"].get("solution"), ".4f"),
    "MRE LM": lambda r: show((_reference(r) or {}).get("mre"), ".4f"),
    "dual inf.": lambda r: f"{r['residuals']['dual_infeasibility']:.1e}",
    "constraints": lambda r: f"{r['residuals']['nlp_infeasibility']:.1e}",
    "GB": lambda r: f"{r['peak_bytes'] / 2**30:.2f}",
    "status": lambda r: r["status"].replace("_", " "),
}
"""The main table."""

IDENTITY = {name: COLUMNS[name] for name in ("pair", "seed", "N", "K")}
NLP_PARTS = ("build", "functions", "linear algebra")
PHASES = ("load", "flow", "segmentation", "start", "weights", *NLP_PARTS, "evaluation", "output")
"""Stages of a run; build, functions and linear algebra are the NLP."""


def _phase(name: str) -> Cell:
    return lambda r: f"{r['wall'].get(name, 0.0):.2f}"


def _size(name: str) -> Cell:
    return lambda r: str(r["sizes"][name])


STAGES: dict[str, Cell] = {
    **IDENTITY,
    **{name: _phase(name) for name in PHASES},
    "compiler, CPU s": lambda r: f"{r['cpu'].get('compiler', 0.0):.2f}",
    "outside, CPU s": lambda r: f"{outside(r):.2f}",
}
SIZES: dict[str, Cell] = {
    **IDENTITY,
    "K-NN edges": _size("knn_edges"),
    "pairs": _size("pairs"),
    "variables": _size("variables"),
    "constraints": _size("constraints"),
    "nnz J": _size("jacobian_nonzeros"),
    "nnz H": _size("hessian_nonzeros"),
    "SO(3)": lambda r: f"{r['residuals']['so3']:.1e}",
    "normals": lambda r: f"{r['residuals']['normal']:.1e}",
    "simplex": lambda r: f"{r['residuals']['simplex']:.1e}",
    "visible": lambda r: f"{r['residuals']['visible']:.1e}",
    "complementarity": lambda r: f"{r['residuals']['complementarity']:.1e}",
}


def stage_lines(rows: Sequence[Row]) -> list[str]:
    """A table of every phase of every run."""
    lines = [
        [
            r["key"],
            s["name"],
            str(s["iterations"]),
            f"{s['seconds']:.2f}",
            show(s["inf_du"], ".1e"),
            s["status"].replace("_", " "),
        ]
        for r in rows
        for s in r["stages"]
    ]
    return table(["run", "stage", "iterations", "s", "dual inf.", "status"], lines)


def growth_lines(rows: Sequence[Row], least: int = 0) -> list[str]:
    """A table of exponents, all scenes together last; empty where no size changes."""
    lines = []
    for (scene, k), fits in sorted(growth(rows, least).items(), key=lambda i: (i[0][0] == ALL, i)):
        one = next(iter(fits.values()))
        cells = [scene, str(k), f"{one.low:.0f} to {one.high:.0f}"]
        lines.append([*cells, *(str(fits.get(name, "-")) for name in COSTS)])
    return table(["pair", "K", "N", *COSTS], lines) if lines else []


WIDE: dict[str, Cell] = {
    "run": lambda r: r["key"],
    "E": lambda r: f"{r['energy']['total']:.3f}",
    "E wide": lambda r: f"{r['reference']['wide']['energy']['total']:.3f}",
    "MRE": lambda r: show(r["mre"].get("solution")),
    "MRE wide": lambda r: show(r["reference"]["wide"]["mre"]),
    "wide its": lambda r: str(r["reference"]["wide"]["iterations"]),
    "wide CPU s": lambda r: f"{r['reference']['wide']['cpu_seconds']:.1f}",
}
"""The table of the reference solver that starts from a wide smoothing."""


def conclusion(records: Sequence[Row]) -> str:
    """What the table says, in sentences made of its numbers."""
    good = [r for r in records if not failed(r)]
    if not good:
        return "No run ended with a result."
    converged = sum(bool(r["converged"]) for r in good)
    text = [f"{converged} of {len(good)} runs converged to their tolerance."]
    by_size: dict[tuple[int, int], list[float]] = defaultdict(list)
    for r in good:
        by_size[r["spec"]["superpixels"], r["spec"]["neighbours"]].append(r["cpu"]["nlp"])
    n, k = max(by_size)
    costs = by_size[n, k]
    text.append(
        f"At N = {n}, K = {k} the NLP takes {min(costs):.1f} to {max(costs):.1f} CPU s"
        f" ({len(costs)} runs); all stages outside it at most"
        f" {max(outside(r) for r in good if r['spec']['superpixels'] == n):.1f} CPU s."
    )
    ratios = [r["energy"]["total"] / y["energy"]["total"] for r in good if (y := _reference(r))]
    if ratios:
        times = [r["cpu"]["nlp"] / y["cpu_seconds"] for r in good if (y := _reference(r))]
        text.append(
            f"Its energy is {min(ratios):.4f} to {max(ratios):.4f} times that of"
            f" Levenberg-Marquardt on the same smoothing, its CPU time"
            f" {min(times):.2f} to {max(times):.2f} times."
        )
    return " ".join(text)


def report(records: Sequence[Row], machine: Mapping[str, str], day: str) -> str:
    """results/speed/table.md.

    Args:
        records: Of `measure_all`, failures included.
        machine: Of `machine.machine`.
        day: Date of the measurement.
    """
    good = [r for r in records if not failed(r)]
    wide = [r for r in good if "wide" in r["reference"]]
    lines = ["# Speed and growth", "", conclusion(records), ""]
    lines += columns(COLUMNS, good)
    lines += [
        "",
        "CPU s and wall s: the whole NLP (presolve, build, constrained NLP). its: of the presolve"
        " and of Ipopt. E: exact energy, LM: on-manifold Levenberg-Marquardt with reweighting from"
        " the same start on the same smoothing widths, in the same process. MRE after median"
        " scale, no cap. dual inf., constraints: recomputed at Ipopt's answer. GB: peak of the"
        " process before the reference solver runs.",
    ]
    for r in records:
        if failed(r):
            lines.append(f"\n{r['key']} failed: {r['error']}")
    for title, body in (
        ("Growth: cost = factor N^p", growth_lines(good)),
        ("Growth from N = 500", growth_lines(good, 500)),
        ("Wall seconds by stage", columns(STAGES, good)),
        ("Phases of the presolve, and Ipopt's call", stage_lines(good)),
        ("Sizes and residuals of the delivered soup", columns(SIZES, good)),
        ("The reference solver from a wide smoothing", columns(WIDE, wide) if wide else []),
    ):
        if body:
            lines += ["", f"## {title}", "", *body]
    lines += ["", "## Machine", ""]
    lines += [f"- {name}: {value}" for name, value in {"date": day, **machine}.items()]
    lines += [
        "",
        "## Limits",
        "",
        "Wall times of a shared machine vary with its load; CPU times less so. One thread."
        " Compiling the kernels happens once a machine and is in the wall time (build) of the run"
        " that does it, not in its CPU time. Loading is rendering for the scenes; outside: flow,"
        " segmentation, start, weights, evaluation and output with every picture, point cloud"
        " and HDF5.",
    ]
    return "\n".join(lines) + "\n"


def _groups(records: Sequence[Row]) -> dict[tuple[str, int], list[Row]]:
    out: dict[tuple[str, int], list[Row]] = defaultdict(list)
    for r in records:
        out[r["spec"]["scene"], r["spec"]["neighbours"]].append(r)
    return dict(sorted(out.items()))


def plot_growth(path: Path, records: Sequence[Row]) -> None:
    """CPU seconds of NLP, reference solver and the rest, and peak memory over N, logarithmic."""
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
        lm = [(m, r["reference"]["same"]) for m, r in zip(n, group) if "same" in r["reference"]]
        if lm:
            left.loglog(
                [m for m, _ in lm], [y["cpu_seconds"] for _, y in lm], "x", color=colour, alpha=0.7
            )
        memory = np.array([r["peak_bytes"] for r in group]) / 2**30
        right.loglog(n[order], memory[order], "o-", color=colour)
    left.set(xlabel="superpixels N", ylabel="CPU s")
    left.set_title("NLP (o), reference solver (x), all stages outside (.)", fontsize=10)
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
    save(figure, path)


def plot_phases(path: Path, records: Sequence[Row]) -> None:
    """Stacked wall seconds by stage, a bar a run."""
    figure = Figure(figsize=(9, 0.32 * len(records) + 1.4))
    axes: Axes = figure.subplots()
    begin = np.zeros(len(records))
    for index, part in enumerate(p for p in PHASES if p not in ("load", "weights")):
        width = np.array([r["wall"].get(part, 0.0) for r in records])
        axes.barh(np.arange(len(records)), width, left=begin, label=part, color=f"C{index}")
        begin += width
    axes.set_yticks(np.arange(len(records)), [r["key"] for r in records], fontsize=7)
    axes.invert_yaxis()
    axes.set_xlabel("wall s")
    axes.legend(fontsize=7, ncols=4, loc="upper center", bbox_to_anchor=(0.4, -0.12))
    save(figure, path)


def plot_energy(path: Path, records: Sequence[Row], most: int = 12) -> None:
    """Exact energy over seconds: the reference solvers' history, Ipopt's end as a point.

    Args:
        path: PNG.
        records: Runs with a reference solver; the largest `most` of them are drawn.
        most: Panels.
    """
    have = [r for r in records if r["reference"]]
    have = sorted(have, key=lambda r: -r["sizes"]["superpixels"])[:most]
    if not have:
        return
    columns = min(4, len(have))
    rows = -(-len(have) // columns)
    figure = Figure(figsize=(3.4 * columns, 2.6 * rows))
    panels = np.atleast_1d(figure.subplots(rows, columns)).ravel()
    for panel, r in zip(panels, have):
        for kind, y in r["reference"].items():
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
    save(figure, path)
