"""Tables of `bench speed`: conclusion first, limits last."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from soup_nlp.bench.speed_fit import ALL, COSTS, growth, outside

Record = Mapping[str, Any]
Cell = Callable[[Record], str]


def _yard(record: Record, kind: str = "same") -> Mapping[str, Any] | None:
    found: Mapping[str, Any] | None = record["yardstick"].get(kind)
    return found


def _number(value: float | None, form: str) -> str:
    return "-" if value is None else format(value, form)


COLUMNS: dict[str, Cell] = {
    "pair": lambda r: r["spec"]["scene"],
    "seed": lambda r: str(r["spec"]["seed"]),
    "N": lambda r: str(r["sizes"]["superpixels"]),
    "K": lambda r: str(r["spec"]["neighbours"]),
    "CPU s": lambda r: f"{r['cpu']['nlp']:.1f}",
    "presolve CPU s": lambda r: _number(r["cpu"].get("presolve"), ".1f"),
    "wall s": lambda r: f"{r['wall']['nlp']:.1f}",
    "its": lambda r: str(r["iterations"]),
    "E start": lambda r: f"{r['energy_start']['total']:.2f}",
    "E": lambda r: f"{r['energy']['total']:.3f}",
    "E LM": lambda r: _number((_yard(r) or {}).get("energy", {}).get("total"), ".3f"),
    "E / LM": lambda r: (
        f"{r['energy']['total'] / y['energy']['total']:.4f}" if (y := _yard(r)) else "-"
    ),
    "CPU / LM": lambda r: f"{r['cpu']['nlp'] / y['cpu_seconds']:.2f}" if (y := _yard(r)) else "-",
    "LM its": lambda r: str(y["iterations"]) if (y := _yard(r)) else "-",
    "MRE start": lambda r: _number(r["mre"].get("start"), ".4f"),
    "MRE": lambda r: _number(r["mre"].get("solution"), ".4f"),
    "MRE LM": lambda r: _number((_yard(r) or {}).get("mre"), ".4f"),
    "dual inf.": lambda r: f"{r['residuals']['dual_infeasibility']:.1e}",
    "constraints": lambda r: f"{r['residuals']['nlp_infeasibility']:.1e}",
    "GB": lambda r: f"{r['peak_bytes'] / 2**30:.2f}",
    "status": lambda r: r["status"].replace("_", " "),
}
"""The main table."""

IDENTITY = {name: COLUMNS[name] for name in ("pair", "seed", "N", "K")}
PHASES = (
    "load",
    "flow",
    "segmentation",
    "start",
    "weights",
    "build",
    "functions",
    "linear algebra",
    "evaluation",
    "output",
)
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


def markdown(columns: Mapping[str, Cell], records: Sequence[Record]) -> list[str]:
    """A table, a line a record."""
    lines = ["| " + " | ".join(columns) + " |", "|" + "---|" * len(columns)]
    lines += ["| " + " | ".join(cell(r) for cell in columns.values()) + " |" for r in records]
    return lines


def stage_lines(records: Sequence[Record]) -> list[str]:
    """A table of every phase of every run."""
    lines = ["| run | stage | iterations | s | dual inf. | status |", "|---|---|---|---|---|---|"]
    for r in records:
        for s in r["stages"]:
            cells = (
                r["key"],
                s["name"],
                str(s["iterations"]),
                f"{s['seconds']:.2f}",
                _number(s["inf_du"], ".1e"),
                s["status"].replace("_", " "),
            )
            lines.append("| " + " | ".join(cells) + " |")
    return lines


def growth_lines(records: Sequence[Record], least: int = 0) -> list[str]:
    """A table of exponents; empty where no size changes."""
    found = growth(records, least)
    if not found:
        return []
    # all pairs: one exponent, a factor for each
    lines = ["| pair | K | N | " + " | ".join(COSTS) + " |", "|---|---|---|" + "---|" * len(COSTS)]
    for (scene, k), fits in sorted(found.items(), key=lambda item: (item[0][0] == ALL, item[0])):
        one = next(iter(fits.values()))
        cells = [scene, str(k), f"{one.low:.0f} to {one.high:.0f}"]
        cells += [str(fits.get(name, "-")) for name in COSTS]
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def wide_lines(records: Sequence[Record]) -> list[str]:
    """A table of the yardstick that starts from a wide smoothing; empty where it did not run."""
    have = [r for r in records if _yard(r, "wide")]
    if not have:
        return []
    lines = [
        "| run | E | E wide | MRE | MRE wide | wide its | wide CPU s |",
        "|---|---|---|---|---|---|---|",
    ]
    for r in have:
        y = r["yardstick"]["wide"]
        cells = (
            r["key"],
            f"{r['energy']['total']:.3f}",
            f"{y['energy']['total']:.3f}",
            _number(r["mre"].get("solution"), ".4f"),
            _number(y["mre"], ".4f"),
            str(y["iterations"]),
            f"{y['cpu_seconds']:.1f}",
        )
        lines.append("| " + " | ".join(cells) + " |")
    return lines


def conclusion(records: Sequence[Record]) -> str:
    """What the table says, in sentences made of its numbers."""
    good = [r for r in records if "error" not in r]
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
    ratios = [r["energy"]["total"] / y["energy"]["total"] for r in good if (y := _yard(r))]
    if ratios:
        times = [r["cpu"]["nlp"] / y["cpu_seconds"] for r in good if (y := _yard(r))]
        text.append(
            f"Its energy is {min(ratios):.4f} to {max(ratios):.4f} times that of"
            f" Levenberg-Marquardt on the same smoothing, its CPU time"
            f" {min(times):.2f} to {max(times):.2f} times."
        )
    return " ".join(text)


def report(records: Sequence[Record], machine: Mapping[str, str], day: str) -> str:
    """results/speed/table.md.

    Args:
        records: Of `measure_all`, failures included.
        machine: Of `machine.machine`.
        day: Date of the measurement.
    """
    good = [r for r in records if "error" not in r]
    lines = ["# Speed and growth", "", conclusion(records), ""]
    lines += markdown(COLUMNS, good)
    lines += [
        "",
        "CPU s and wall s: the whole NLP (presolve, build, constrained NLP). its: of the presolve"
        " and of Ipopt. E: exact energy, LM: on-manifold Levenberg-Marquardt with reweighting from"
        " the same start on the same smoothing widths, in the same process. MRE after median"
        " scale, no cap. dual inf., constraints: recomputed at Ipopt's answer. GB: peak of the"
        " process before the yardstick runs.",
    ]
    for r in records:
        if "error" in r:
            lines.append(f"\n{r['key']} failed: {r['error']}")
    for title, body in (
        ("Growth: cost = factor N^p", growth_lines(good)),
        ("Growth from N = 500", growth_lines(good, 500)),
        ("Wall seconds by stage", markdown(STAGES, good)),
        ("Phases of the presolve, and Ipopt's call", stage_lines(good)),
        ("Sizes and residuals of the delivered soup", markdown(SIZES, good)),
        ("A yardstick from a wide smoothing", wide_lines(good)),
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
