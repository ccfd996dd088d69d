"""The engine of all benchmarks: pairs under overrides are measured to rows, rows make tables.

A row is stored as a line of JSON as soon as it is measured, so that a command that was stopped goes
on. Nested entries of a row become columns of a data frame with dotted names, such as
`metrics.solution.mre`.
"""

from __future__ import annotations

import hashlib
import json
import platform
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from soup_nlp import Problem, make_problem
from soup_nlp.storage.each import Row, measure_all, reason

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Overrides = tuple[str, ...]
PATHS = {"root", "path", "ref", "next", "depth", "depth_next", "intrinsics"}
"""Keys of an input that name files."""


@dataclass(frozen=True)
class Item:
    """A pair of a suite with one flow source.

    Attributes:
        family: Kind of pairs, over which tables average first.
        name: Name, unique in the suite.
        input: Section `input` of the problem.
        needs: Files that must exist.
        true_flow: Whether the pair has a true flow that it may be solved with.
        suite: Name of the suite, which `every_pair` of benchmarks/suites.py sets.
        flow: Flow source, set likewise.
    """

    family: str
    name: str
    input: Mapping[str, Any] = field(repr=False)
    needs: Sequence[Path] = field(default=(), repr=False)
    true_flow: bool = True
    suite: str = "rendered"
    flow: str = "dis"

    @property
    def key(self) -> str:
        """Identifies the pair and its flow among all suites."""
        return f"{self.suite}/{self.name}/{self.flow}"

    def problem(self, overrides: Sequence[str] = ()) -> Problem:
        """The problem of the pair with default options and overrides."""
        raw = {"name": self.name, "input": dict(self.input), "flow": {"source": self.flow}}
        return make_problem(raw, overrides, where=self.key)


@dataclass(frozen=True)
class Cell:
    """A pair under overrides, which have a name in a study ("" for the defaults)."""

    item: Item
    overrides: Overrides = ()
    variant: str = ""

    def identity(self) -> Row:
        """Entries that identify the row together with the code version."""
        item, problem = self.item, self.item.problem(self.overrides)
        return {
            "key": f"{item.key} {self.variant}".strip(),
            **{"suite": item.suite, "family": item.family, "pair": item.name, "flow": item.flow},
            "variant": self.variant,
            "overrides": list(self.overrides),
            "settings": _hash(problem, {"name", "base", "preset", "input", "expected"}),
            # the same for a pair in every folder
            "input": _hash(problem.input, PATHS),
        }


def _hash(section: Any, exclude: set[str]) -> str:
    tree = section.model_dump(mode="json", exclude=exclude)
    return hashlib.sha256(json.dumps(tree, sort_keys=True).encode()).hexdigest()[:12]


def measure(
    cells: Iterable[Cell], work: Callable[[Cell], Row], page: Path, workers: int = 1, **options: Any
) -> pd.DataFrame:
    """The frame of the rows of cells, which a file beside the page holds or which are measured.

    `workers` and `options` are those of `soup_nlp.storage.each.each`.
    """
    jobs = [(cell.identity(), partial(work, cell)) for cell in cells]
    rows = page.with_suffix(".jsonl")
    return frame_of(measure_all(jobs, rows, workers, say=say_row, **options))


def say_row(done: int, total: int, row: Row) -> None:
    """Print a new row."""
    mre = row.get("metrics", {}).get("solution", {}).get("mre")
    result = f"MRE {show(mre)}" if row["ok"] else f"failed: {reason(row)}"
    text = f"{done}/{total}  {row['key']}  {result}  {row['seconds']:.0f} s"
    print(text, file=sys.stderr, flush=True)


def frame_of(rows: Sequence[Row]) -> pd.DataFrame:
    """A line for each row, dotted names for nested entries; `title` has the pair and its flow."""
    frame = pd.json_normalize(list(rows))
    suites = frame.groupby("pair")["suite"].transform("nunique")
    name = np.where(suites > 1, frame["suite"] + " " + frame["pair"], frame["pair"])
    frame["title"] = [f"{pair}, {flow}" for pair, flow in zip(name, frame["flow"], strict=True)]
    return frame


def numbers(frame: pd.DataFrame, column: str) -> pd.Series:
    """A column as numbers; NaN where it is not known."""
    known = column in frame
    return frame[column].astype(float) if known else pd.Series(np.nan, frame.index, float)


def mre_of(frame: pd.DataFrame, method: str = "solution") -> pd.Series:
    """The MRE of every row; NaN where it is not known."""
    return numbers(frame, f"metrics.{method}.mre")


def geometric(values: pd.Series) -> float:
    """Geometric mean of positive values."""
    return float(np.exp(np.log(values.astype(float)).mean()))


# --- pages --------------------------------------------------------------------------------------


def show(value: Any, form: str = ".4f") -> str:
    """A value as text: numbers but whole ones in a format, a dash for an unknown value."""
    if value is None or (isinstance(value, float) and np.isnan(value)):
        return "-"
    return format(value, form) if isinstance(value, float) else str(value)


def markdown(frame: pd.DataFrame, forms: str | Mapping[str, str] = ".4f") -> str:
    """A frame as a Markdown table, its index first; one format, or one for each column."""
    flat = frame.reset_index()
    form = {c: forms if isinstance(forms, str) else forms.get(c, "") for c in flat.columns}
    columns = [[show(v, form[c]) for v in flat[c].tolist()] for c in flat.columns]
    rule = ["---"] + ["---:"] * (len(columns) - 1)
    lines = [map(str, flat.columns), rule, *zip(*columns, strict=True)]
    return "\n".join("| " + " | ".join(cells) + " |" for cells in lines)


def titled(frame: pd.DataFrame, columns: Mapping[str, tuple[str, str]]) -> str:
    """Columns of a frame as a Markdown table under other titles: (title, format) by column."""
    shown = frame.reindex(columns=list(columns))
    titles = [title for title, _ in columns.values()]
    return markdown(shown.set_axis(titles, axis=1), dict(columns.values()))


def provenance(frame: pd.DataFrame) -> str:
    """Date, machine, CPU time, code versions and common overrides of the rows, as one sentence."""
    code = ", ".join(sorted(frame["code"].dropna().astype(str).unique()))
    where = f"{date.today()}, {platform.machine()}"
    first, *others = frame["overrides"].tolist()
    # of two overrides of a key the later one counts
    last = {o.partition("=")[0]: o for o in first}.values()
    common = ", ".join(f"`{o}`" for o in last if all(o in overrides for overrides in others))
    seconds = f"{frame['cpu_seconds'].sum():.0f} CPU seconds in all"
    return f"{where}, {seconds}; code {code}; overrides of every row: {common or 'none'}"


def page_text(blocks: Iterable[str], frame: pd.DataFrame) -> str:
    """Text of a page: headings, paragraphs and tables that are not empty, then failed rows."""
    failed = frame[frame["ok"].ne(True)].to_dict("records")
    lines = "\n".join(f"- {r['key']}: {reason(r)}" for r in failed)
    return "\n\n".join(filter(None, [*blocks, "## Failed" if failed else "", lines])) + "\n"


def panels(
    rows: int, columns: int, width: float, height: float, **shared: Any
) -> tuple[Figure, NDArray[Any]]:
    """A figure and its (rows, columns) panels, each width by height inches; needs no display."""
    # the import takes half a second, which commands without pictures do not need
    from matplotlib.figure import Figure

    size = width * columns, height * max(1, rows)
    out = Figure(figsize=size, dpi=120, layout="constrained")
    return out, out.subplots(max(1, rows), columns, squeeze=False, **shared)


def save(out: Figure, path: Path) -> None:
    """Write a figure as PNG file."""
    out.savefig(path, format="png", metadata={"Software": ""})
