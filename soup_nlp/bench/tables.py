"""Helpers of all report pages: Markdown tables, metrics of rows, headers, failures, figures."""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from soup_nlp.storage.atomic import atomic_path
from soup_nlp.storage.rows import Row, failed

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Number = float | None


def table(head: Sequence[str], lines: Iterable[Sequence[str]]) -> list[str]:
    """A Markdown table."""
    rule = ["---"] + ["---:"] * (len(head) - 1)
    return ["| " + " | ".join(cells) + " |" for cells in [head, rule, *lines]]


def columns(cells: Mapping[str, Callable[[Any], str]], rows: Iterable[Any]) -> list[str]:
    """A Markdown table with a line for each row; `cells` makes its cells, by title of a column."""
    return table(list(cells), [[cell(r) for cell in cells.values()] for r in rows])


def show(value: Number, form: str = ".4f") -> str:
    """A number as text; a dash where it is not known."""
    return "-" if value is None else format(value, form)


def mean(values: Iterable[Number]) -> Number:
    """Mean of the known values; None where there are none."""
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known else None


def metric(row: Row, convention: str, method: str = "solution", name: str = "mre") -> Number:
    """A metric of a row; None where it is not known."""
    if not row.get("ok"):
        return None
    value = row["metrics"].get(convention, {}).get(method, {}).get(name)
    return None if value is None else float(value)


def main_metric(row: Row, name: str = "mre", method: str = "solution") -> Number:
    """A metric under the row's main convention."""
    return metric(row, row["presets"][0], method, name)


def energy_ratio(row: Row, soup: str = "truth") -> Number:
    """E(truth) / E(solution); None where the row has no energy of the truth."""
    energy: Mapping[str, Mapping[str, float]] = row["energy"]
    if soup not in energy or not energy["solution"]["total"]:
        return None
    return energy[soup]["total"] / energy["solution"]["total"]


def pair_names(rows: Sequence[Row]) -> list[str]:
    """Name of the pair of every row, with the suite if two suites have a pair of that name."""
    suites: dict[str, set[str]] = {}
    for row in rows:
        suites.setdefault(row["pair"], set()).add(row["suite"])
    return [r["pair"] if len(suites[r["pair"]]) == 1 else f"{r['suite']} {r['pair']}" for r in rows]


def titles(rows: Sequence[Row]) -> list[str]:
    """Pair and flow of every row."""
    return [f"{name}, {row['flow']}" for name, row in zip(pair_names(rows), rows, strict=True)]


def code_versions(rows: Sequence[Row]) -> str:
    """Code versions of the rows."""
    return ", ".join(sorted({str(r.get("code")) for r in rows}))


def provenance(rows: Sequence[Row]) -> str:
    """Date, machine, CPU time and code version of the rows, as one sentence."""
    cpu = sum(float(r.get("cpu_seconds") or 0) for r in rows)
    where = f"{date.today()}, {platform.machine()}"
    return f"{where}, {cpu:.0f} CPU seconds in all; code {code_versions(rows)}"


def reason(row: Row) -> str:
    """Why a row failed, on one line: what was wrong, where, and what was found."""
    first, *more = str(row.get("error")).splitlines() or ["no reason"]
    details = (line.strip() for line in more)
    return ", ".join([first, *(d for d in details if d.startswith(("where: ", "found: ")))])


def failures(rows: Sequence[Row]) -> list[str]:
    """A section that lists the failed rows; no lines if none failed."""
    lines = [f"- {r['key']}: {reason(r)}" for r in rows if failed(r) or r.get("ok") is False]
    return ["", "## Failed", "", *lines] if lines else []


def page_text(lines: Sequence[str]) -> str:
    """Text of a page from its lines."""
    return "\n".join(lines).rstrip() + "\n"


def figure(width: float, height: float) -> Figure:
    """A figure with constrained layout that needs no display."""
    # the import takes half a second, which commands without pictures do not need
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), dpi=120, layout="constrained")


def grid_of_panels(
    count: int, across: int, width: float, height: float, margin: tuple[float, float] = (0.0, 0.0)
) -> tuple[Figure, list[Axes]]:
    """A figure of `count` panels of some inches, at most `across` in a row, and its panels."""
    columns = min(across, max(1, count))
    rows = max(1, -(-count // columns))
    out = figure(width * columns + margin[0], height * rows + margin[1])
    return out, [out.add_subplot(rows, columns, k + 1) for k in range(count)]


def save(out: Figure, path: Path) -> None:
    """Write a figure as PNG file, whole or not at all."""
    with atomic_path(path) as temporary:
        out.savefig(temporary, format="png", metadata={"Software": ""})
