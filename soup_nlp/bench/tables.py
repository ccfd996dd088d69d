"""What all reports share: Markdown tables, numbers or dashes, headers, failures, pictures."""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from soup_nlp.bench.rows import Row, failed
from soup_nlp.storage.atomic import atomic_path

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Number = float | None


def table(head: Sequence[str], lines: Iterable[Sequence[str]]) -> list[str]:
    """A Markdown table."""
    rule = ["---"] + ["---:"] * (len(head) - 1)
    return ["| " + " | ".join(cells) + " |" for cells in [head, rule, *lines]]


def columns(cells: Mapping[str, Callable[[Any], str]], rows: Iterable[Any]) -> list[str]:
    """A Markdown table with one line per row and one column per named cell."""
    return table(list(cells), [[cell(r) for cell in cells.values()] for r in rows])


def show(value: Number, form: str = ".4f") -> str:
    """A number, or a dash."""
    return "-" if value is None else format(value, form)


def mean(values: Iterable[Number]) -> Number:
    """Mean of the known values; None where there are none."""
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known else None


def get(row: Row, convention: str, method: str = "solution", name: str = "mre") -> Number:
    """A metric of a row; None where it is not known."""
    if not row.get("ok"):
        return None
    value = row["metrics"].get(convention, {}).get(method, {}).get(name)
    return None if value is None else float(value)


def main_metric(row: Row, name: str = "mre", method: str = "solution") -> Number:
    """A metric under the row's main convention."""
    return get(row, row["presets"][0], method, name)


def energy_ratio(row: Row, soup: str = "truth") -> Number:
    """E(truth) / E(solution); None where the truth has no soup."""
    energy: Mapping[str, Mapping[str, float]] = row["energy"]
    if soup not in energy or not energy["solution"]["total"]:
        return None
    return energy[soup]["total"] / energy["solution"]["total"]


def pair_names(rows: Sequence[Row]) -> list[str]:
    """The pair of every row; with its suite where another suite has a pair of that name."""
    suites: dict[str, set[str]] = {}
    for row in rows:
        suites.setdefault(row["pair"], set()).add(row["suite"])
    return [r["pair"] if len(suites[r["pair"]]) == 1 else f"{r['suite']} {r['pair']}" for r in rows]


def titles(rows: Sequence[Row]) -> list[str]:
    """Pair and flow of every row."""
    return [f"{name}, {row['flow']}" for name, row in zip(pair_names(rows), rows, strict=True)]


def codes(rows: Sequence[Row]) -> str:
    """Code versions of the rows."""
    return ", ".join(sorted({str(r.get("code")) for r in rows}))


def made(rows: Sequence[Row]) -> str:
    """Date, machine, CPU time and code of the rows."""
    cpu = sum(float(r.get("cpu_seconds") or 0) for r in rows)
    return f"{date.today()}, {platform.machine()}, {cpu:.0f} CPU seconds in all; code {codes(rows)}"


def reason(row: Row) -> str:
    """Why a row failed, on one line: what was wrong, where it was and what was found there."""
    first, *more = str(row.get("error")).splitlines() or ["no reason"]
    told = (line.strip() for line in more)
    return ", ".join([first, *(t for t in told if t.startswith(("where: ", "found: ")))])


def failures(rows: Sequence[Row]) -> list[str]:
    """A section that lists the rows that failed; empty where none did."""
    lines = [f"- {r['key']}: {reason(r)}" for r in rows if failed(r) or r.get("ok") is False]
    return ["", "## Failed", "", *lines] if lines else []


def joined(lines: Sequence[str]) -> str:
    """Lines as the text of a file."""
    return "\n".join(lines).rstrip() + "\n"


def figure(width: float, height: float) -> Figure:
    """A figure with constrained layout that needs no display."""
    # half a second, which commands without pictures need not wait
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), dpi=120, layout="constrained")


def save(out: Figure, path: Path) -> None:
    """Write a figure as PNG, whole or not at all."""
    with atomic_path(path) as temporary:
        out.savefig(temporary, format="png", metadata={"Software": ""})
