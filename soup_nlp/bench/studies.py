"""Studies of parts of the program: each has settings, one row per setting, and a table.

Every row is measured in a process of its own with one thread, so that its peak memory and its time
are its own, and is stored, so that a study that was stopped goes on where it was.
"""

from __future__ import annotations

import platform
import tempfile
from collections.abc import Callable, Mapping, Sequence
from datetime import date
from functools import partial
from pathlib import Path
from typing import Any

from soup_nlp.bench.processes import alone
from soup_nlp.bench.rows import Job, Row, Say, failed, measure_all
from soup_nlp.bench.tables import failures, joined, table
from soup_nlp.storage.atomic import write_text

Settings = Mapping[str, Any]
Text = Callable[[Sequence[Row]], list[str]]


def made_on() -> str:
    """Date and machine of a table."""
    return f"{date.today()}, {platform.machine()}."


def run_study(
    page: Path,
    settings: Sequence[Settings],
    measure: Callable[..., Row],
    text: Text,
    say: Say | None = None,
) -> list[Row]:
    """Measure every setting and write the table after every row.

    Args:
        page: Markdown file; rows go to the .jsonl beside it.
        settings: Keyword arguments of `measure`, plain JSON values.
        measure: A function of a module, which another process can import.
        text: Lines of the page from the rows that are there.
        say: Called after every new row.

    Returns:
        The rows; those that failed are listed at the end of the page.
    """

    def work(own: Settings) -> Row:
        with tempfile.TemporaryDirectory() as folder:
            return alone(partial(measure, **own), Path(folder))

    def write(rows: list[Row]) -> None:
        good = [r for r in rows if not failed(r)]
        write_text(page, joined([*text(good), *failures(rows)]))

    page.parent.mkdir(parents=True, exist_ok=True)
    jobs = [
        Job(
            {"key": f"{page.stem} {' '.join(map(str, s.values()))}", "settings": s},
            partial(work, s),
        )
        for s in settings
    ]
    return measure_all(jobs, page.with_suffix(".jsonl"), say=say, after=write)


def settings_table(note: str, head: Sequence[str], cells: Callable[[Row], Sequence[str]]) -> Text:
    """A page of one note and one table with a line per row."""
    return lambda rows: [note, "", *table(head, [cells(r) for r in rows])]
