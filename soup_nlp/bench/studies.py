"""Studies of parts of the program: one row for each setting, and a table of the rows.

Every row is measured in a process of its own with one thread, so that time and peak memory are
those of the row alone. Rows are stored, so that an interrupted study can be continued.
"""

from __future__ import annotations

import platform
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

from soup_nlp.bench.processes import alone
from soup_nlp.bench.tables import columns, failures, page_text
from soup_nlp.storage.atomic import write_text
from soup_nlp.storage.folders import claim, staged
from soup_nlp.storage.rows import Job, Row, Say, failed, measure_all

Settings = Mapping[str, Any]
Cells = Mapping[str, Callable[[Row], str]]


@dataclass(frozen=True)
class Study:
    """A measurement for many settings, and its table.

    Attributes:
        name: Stem of the file of the table.
        note: First paragraph of the page; {KEY} stands for a value of the first settings.
        measure: Makes a row from keyword arguments; another process imports this function.
        cells: Columns of the table; a row has "settings" beside the measured entries.
        summary: Makes more lines of the table from all rows, or None.
    """

    name: str
    note: str
    measure: Callable[..., Row]
    cells: Cells
    summary: Callable[[Sequence[Row]], list[str]] | None = None

    @property
    def files(self) -> tuple[str, ...]:
        """Names of the files that `write` makes."""
        return (f"{self.name}.md",)

    def write(self, out: Path, rows: Sequence[Row]) -> None:
        """Write the page of the rows; failed rows are listed at its end."""
        good = [r for r in rows if not failed(r)]
        note = self.note.format(**rows[0]["settings"])
        lines = [f"{note} {date.today()}, {platform.machine()}.", "", *columns(self.cells, good)]
        lines += self.summary(good) if self.summary else []
        with staged(out) as new:
            write_text(new / f"{self.name}.md", page_text([*lines, *failures(list(rows))]))


def grid(**values: Sequence[Any]) -> list[Settings]:
    """Settings of every combination; the first key varies most slowly."""
    return [dict(zip(values, own, strict=True)) for own in product(*values.values())]


def setting(name: str) -> Callable[[Row], str]:
    """Cell with the value of a setting."""
    return lambda row: str(row["settings"][name])


def number(name: str, form: str = "") -> Callable[[Row], str]:
    """Cell with a measured number."""
    return lambda row: format(row[name], form)


def run_study(
    study: Study,
    out: Path,
    settings: Sequence[Settings],
    say: Say | None = None,
    page: bool = True,
    overwrite: bool = False,
) -> list[Row]:
    """Measure every setting; rows go to OUT/NAME.jsonl."""
    claim(out, study.files if page else (), overwrite)
    jobs = []
    for own in settings:
        key = f"{study.name} {' '.join(str(v) for v in own.values() if v != [])}"
        work = partial(alone, partial(study.measure, **own))
        jobs.append(Job({"key": key, "settings": own}, work))
    path = out / f"{study.name}.jsonl"
    after = partial(study.write, out) if page else None
    return measure_all(jobs, path, say=say, after=after)
