"""Rows of numbers, measured once and stored as JSON lines."""

import json
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from soup_nlp.errors import DataError
from soup_nlp.storage.each import Row, Work, each
from soup_nlp.storage.files import is_file, parse_json, plain, read_bytes
from soup_nlp.storage.versions import code_version

Say = Callable[[int, int, Row], None]
Job = tuple[Mapping[str, Any], Work]
"""Entries of a row that identify it together with the code version, and what measures the row."""


def reason(row: Mapping[str, Any]) -> str:
    """The reason of a failure on one line: first line of the error, its place and actual value."""
    # a stored row has its lines on one
    first, *details = re.split(r"\n *| {3,}", str(row.get("error") or "no reason"))
    return ", ".join([first, *(d for d in details if d.startswith(("where: ", "found: ")))])


def failed(row: Mapping[str, Any]) -> bool:
    """Whether a row holds an error instead of numbers."""
    return bool(row.get("error"))


def read_rows(path: Path) -> list[Row]:
    """Rows of a JSON-lines file in order, without lines that a crash cut off."""
    if not os.path.lexists(path) or (is_file(path) and not path.stat().st_size):
        return []
    out = []
    for line in read_bytes(path, "file of rows").decode("utf-8", errors="replace").split("\n"):
        try:
            row = parse_json(line)
        except ValueError:
            continue
        if isinstance(row, dict):
            out.append(row)
    return out


def append_row(path: Path, row: Mapping[str, Any]) -> None:
    """Append a row and wait until it is on disk; terminate a line that a crash cut off first."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab+") as file:
            if file.tell():
                file.seek(-1, os.SEEK_END)
                if file.read(1) != b"\n":
                    file.write(b"\n")
            file.write((json.dumps(row, allow_nan=False) + "\n").encode())
            file.flush()
            os.fsync(file.fileno())
    except OSError as error:
        raise DataError("rows cannot be written", where=path, found=error.strerror) from error


def measure_all(
    jobs: Sequence[Job],
    path: Path,
    workers: int = 1,
    *,
    say: Say | None = None,
    after: Callable[[list[Row]], None] | None = None,
    **options: Any,
) -> list[Row]:
    """The row of every job, from the JSON-lines file or else measured by `each` with its options.

    A stored row is used for a job of the same name and code version unless the row failed. Every
    new row is appended as soon as it is measured, so that an interrupted run can be continued.
    `say` is called with (done, total, row) after every new row, and `after` with all rows so far,
    in the order of the jobs, after every new row and at the end.
    """
    code = code_version()
    job_of = {_identity(entries, entries): (entries, work) for entries, work in jobs}
    row_of: dict[str, Row] = {}
    stored = [r for r in read_rows(path) if r.get("code") == code and not failed(r)]
    for name, (entries, _) in job_of.items():
        for row in stored:
            if _identity(row, entries) == name:
                row_of[name] = row
    todo = {name: work for name, (_, work) in job_of.items() if name not in row_of}

    def so_far() -> list[Row]:
        return [row_of[name] for name in job_of if name in row_of]

    with closing(each(todo, workers, **options)) as ended:
        for name, result in ended:
            row_of[name] = {**plain(job_of[name][0]), "code": code, **result}
            append_row(path, row_of[name])
            if say:
                say(len(row_of), len(job_of), row_of[name])
            if after:
                after(so_far())
    if after and not todo:
        after(so_far())
    return so_far()


def _identity(row: Mapping[str, Any], keys: Iterable[str]) -> str:
    return json.dumps(plain({k: row.get(k) for k in keys}), sort_keys=True)
