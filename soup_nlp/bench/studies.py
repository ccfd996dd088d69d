"""Studies of parts of the program: one row per setting, and a table of the rows.

Every row is measured in a process of its own with one thread, so that its peak memory and its time
are its own, and is stored, so that a study that was stopped goes on where it was.
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
from soup_nlp.bench.rows import Job, Row, Say, failed, measure_all
from soup_nlp.bench.tables import columns, failures, joined
from soup_nlp.storage.atomic import write_text
from soup_nlp.storage.folders import claim, scratch, staged

Settings = Mapping[str, Any]
Cells = Mapping[str, Callable[[Row], str]]


@dataclass(frozen=True)
class Study:
    """What is measured and how it is told.

    Attributes:
        name: Name of the table's file, without its suffix.
        note: First paragraph of the page; {KEY} is a value of the first settings.
        measure: Row of keyword arguments; a function of a module, which another process imports.
        cells: Columns of the table; a row has its "settings" beside what was measured.
        summary: More lines for the table, made of all rows, or None.
    """

    name: str
    note: str
    measure: Callable[..., Row]
    cells: Cells
    summary: Callable[[Sequence[Row]], list[str]] | None = None

    @property
    def files(self) -> tuple[str, ...]:
        """Names of the files that are written of all rows."""
        return (f"{self.name}.md",)

    def write(self, out: Path, rows: Sequence[Row]) -> None:
        """Write the page of the rows that are there; those that failed are listed at its end."""
        good = [r for r in rows if not failed(r)]
        note = self.note.format(**rows[0]["settings"])
        lines = [f"{note} {date.today()}, {platform.machine()}.", "", *columns(self.cells, good)]
        lines += self.summary(good) if self.summary else []
        with staged(out) as new:
            write_text(new / f"{self.name}.md", joined([*lines, *failures(list(rows))]))


def grid(**values: Sequence[Any]) -> list[Settings]:
    """Settings of every combination; the first key varies most slowly."""
    return [dict(zip(values, own, strict=True)) for own in product(*values.values())]


def setting(name: str) -> Callable[[Row], str]:
    """A cell: the value of a setting."""
    return lambda row: str(row["settings"][name])


def number(name: str, form: str = "") -> Callable[[Row], str]:
    """A cell: a measured number."""
    return lambda row: format(row[name], form)


def run_study(
    study: Study,
    out: Path,
    settings: Sequence[Settings],
    say: Say | None = None,
    page: bool = True,
    overwrite: bool = False,
) -> list[Row]:
    """Measure every setting; rows go to OUT/NAME.jsonl.

    Args:
        study: What is measured.
        out: Folder.
        settings: Keyword arguments of `study.measure`, plain JSON values.
        say: Called after every new row.
        page: Write OUT/NAME.md after every row.
        overwrite: Overwrite files that the program did not make.
    """
    claim(out, study.files if page else (), overwrite)
    jobs = []
    for own in settings:
        key = f"{study.name} {' '.join(str(v) for v in own.values() if v != [])}"
        jobs.append(Job({"key": key, "settings": own}, partial(run_alone, study, own)))
    path = out / f"{study.name}.jsonl"
    after = partial(study.write, out) if page else None
    return measure_all(jobs, path, say=say, after=after)


def run_alone(study: Study, settings: Settings, seconds: float = 7200.0) -> Row:
    """The row of one setting, or why it failed."""
    with scratch() as folder:
        return alone(partial(study.measure, **settings), folder, seconds)
