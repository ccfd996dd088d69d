"""The engine of all benchmarks: a study is a list of cells with a measure, its result a data frame.

A cell is a pair with a flow, under overrides. `measure_cells` measures cells that the file of rows
does not hold yet, so that an interrupted study can be continued. Nested entries of a row become
columns with dotted names, such as `metrics.paper.solution.mre`. A table is a pivot of the frame.
"""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from soup_nlp.config.problem import Problem, make_problem
from soup_nlp.storage.rows import Job, MeasureRows, Row, attempt, measure_all, reason

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Item:
    """A pair of a suite with one flow source.

    Attributes:
        suite: Name of the suite.
        sequence: Sequence or family, over which tables average first.
        name: Name, unique in the suite.
        flow: Flow source.
        input: Section `input` of the problem.
        needs: Files that must exist.
        true_flow: Whether the pair has a true flow that it may be solved with.
    """

    suite: str
    sequence: str
    name: str
    flow: str
    input: Mapping[str, Any] = field(repr=False)
    needs: tuple[Path, ...] = field(default=(), repr=False)
    true_flow: bool = True

    @property
    def key(self) -> str:
        """Identifies the pair and its flow among all suites."""
        return f"{self.suite}/{self.name}/{self.flow}"

    def problem(self, overrides: Sequence[str] = ()) -> Problem:
        """The problem of the pair with default options and overrides.

        Raises:
            ConfigError: an override is wrong.
        """
        raw = {"name": self.name, "input": dict(self.input), "flow": {"source": self.flow}}
        return make_problem(raw, overrides, where=self.key)


Overrides = tuple[str, ...]


@dataclass(frozen=True)
class Cell:
    """A pair under overrides.

    Attributes:
        item: Pair and flow.
        overrides: Overrides of the problem.
        variant: Name of the overrides in a study; empty for the defaults.
        keep: File or folder that the measurement writes; a stored row without it is stale.
    """

    item: Item
    overrides: Overrides = ()
    variant: str = ""
    keep: Path | None = field(default=None, compare=False)

    def identity(self) -> Row:
        """Entries that identify the row together with the code version.

        Raises:
            ConfigError: an override is wrong.
        """
        problem = self.item.problem(self.overrides)
        return {
            "key": f"{self.item.key} {self.variant}".strip(),
            "suite": self.item.suite,
            "sequence": self.item.sequence,
            "pair": self.item.name,
            "flow": self.item.flow,
            "variant": self.variant,
            "overrides": list(self.overrides),
            "settings": _hash(problem, NOT_SETTINGS),
            "input": _hash(problem.input, PATHS),
        }

    def job(self, measure: Measure) -> Job:
        """The job of the cell; it can be sent to another process."""
        stale = self.keep is not None and not self.keep.exists()
        return Job(self.identity(), partial(attempt, partial(measure, self)), stale)


Measure = Callable[[Cell], Row]
"""Makes the row of a cell."""
NOT_SETTINGS = {"name", "base", "preset", "input", "expected"}
"""Keys of a problem that its hash leaves out, so that it is the same for every pair and folder."""
PATHS = {"root", "path", "ref", "next", "depth", "depth_next", "intrinsics"}
"""Keys of an input that its hash leaves out, so that it is the same for a pair in every folder."""


def _hash(section: Any, exclude: set[str]) -> str:
    tree = section.model_dump(mode="json", exclude=exclude)
    return hashlib.sha256(json.dumps(tree, sort_keys=True).encode()).hexdigest()[:12]


def measure_cells(
    cells: Sequence[Cell],
    measure: Measure,
    path: Path,
    measure_rows: MeasureRows = measure_all,
) -> pd.DataFrame:
    """The frame of the rows of cells, which a JSON-lines file holds or which are measured.

    `measure_rows` is `storage.rows.measure_all` with its options.
    """
    return frame_of(measure_rows([cell.job(measure) for cell in cells], path))


def frame_of(rows: Sequence[Row]) -> pd.DataFrame:
    """A line for each row; dotted names for nested entries, `title` for the pair and its flow.

    `mre` and `constant` are the mean relative errors of the solution and of a constant depth.
    """
    frame = pd.json_normalize(list(rows))
    suites = frame.groupby("pair")["suite"].transform("nunique")
    name = np.where(suites > 1, frame["suite"] + " " + frame["pair"], frame["pair"])
    frame["title"] = [f"{pair}, {flow}" for pair, flow in zip(name, frame["flow"], strict=True)]
    frame["mre"], frame["constant"] = metric(frame), metric(frame, "constant")
    return frame


def metric(frame: pd.DataFrame, method: str = "solution", name: str = "mre") -> pd.Series:
    """A metric of every row; NaN where it is not known."""
    column = f"metrics.{method}.{name}"
    return frame[column].astype(float) if column in frame else pd.Series(np.nan, frame.index)


def pivot(
    frame: pd.DataFrame,
    values: str = "mre",
    index: str = "title",
    columns: str = "variant",
    average: bool = True,
) -> pd.DataFrame:
    """A line for each pair, a column for each variant; then the mean of the complete lines."""
    table = frame.pivot(index=index, columns=columns, values=values)
    table = table.reindex(index=frame[index].unique(), columns=frame[columns].unique())
    table = table.astype(float)
    whole = table.dropna()
    if average and len(whole) > 1:
        table.loc[f"mean of {len(whole)}"] = whole.mean()
    return table.rename_axis(index="pair, flow" if index == "title" else index)


def show(value: Any, form: str = ".4f") -> str:
    """A value as text: numbers in a format, a dash for an unknown value."""
    if value is None or (isinstance(value, float) and np.isnan(value)):
        return "-"
    number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    return format(value, form) if number else str(value)


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
    return markdown(
        shown.set_axis([t for t, _ in columns.values()], axis=1), dict(columns.values())
    )


def provenance(frame: pd.DataFrame) -> str:
    """Date, machine, CPU time, code versions and common overrides of the rows, as one sentence."""
    code = ", ".join(sorted(frame["code"].dropna().astype(str).unique()))
    seconds = frame["cpu_seconds"].astype(float).sum()
    where = f"{date.today()}, {platform.machine()}"
    first, *others = frame.get("overrides", pd.Series([[]])).tolist() or [[]]
    # of two overrides of a key the later one counts
    last = {o.partition("=")[0]: o for o in first}.values()
    common = [f"`{o}`" for o in last if all(o in overrides for overrides in others)]
    changes = f"overrides of every row: {', '.join(common) or 'none'}"
    return f"{where}, {seconds:.0f} CPU seconds in all; code {code}; {changes}"


def page_text(blocks: Sequence[str], frame: pd.DataFrame | None = None) -> str:
    """Text of a page: headings, paragraphs and tables that are not empty, then failed rows."""
    blocks = [*blocks]
    failed = [] if frame is None else frame[frame["ok"].ne(True)].to_dict("records")
    if failed:
        blocks += ["## Failed", "\n".join(f"- {r['key']}: {reason(r)}" for r in failed)]
    return "\n\n".join(filter(None, blocks)) + "\n"


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
