"""A batch: every pair solved into a folder of its own, a row of a table as soon as it ends."""

import csv
import io
import os
import socket
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import psutil

from soup_nlp.batches.page import page
from soup_nlp.batches.sources import Source, problems_of
from soup_nlp.config.problem import Problem
from soup_nlp.errors import DataError, SoupError
from soup_nlp.report import pairs as stored
from soup_nlp.storage.each import Row, Say, append_row, each, failed, failure, reason
from soup_nlp.storage.files import as_path, write_text
from soup_nlp.storage.folders import claim, staged

FILES = ("table.csv", "index.html")
COLUMNS = (
    *("pair", "exit_code", "reason", "mre", "constant", "drawn", "seconds", "cpu_seconds"),
    *("peak_bytes", "superpixels", "seed", "code", "identity"),
)
"""Columns of table.csv; seconds are wall seconds, drawn is the share of the image."""
BEAT, STALE = 10.0, 120.0
"""Seconds between the signs of life of a run, and without one after which its pairs are free."""
PAUSE = 1.0
"""Seconds between looks at pairs that another run solves."""


@dataclass(frozen=True)
class Batch:
    """The rows of a batch, in the order of the pairs, and its folder."""

    rows: list[Row]
    folder: Path

    @property
    def good(self) -> bool:
        """Whether every pair was solved, whatever its exit code."""
        return not any(failed(row) for row in self.rows)

    def __repr__(self) -> str:
        bad = sum(failed(row) for row in self.rows)
        return f"Batch({len(self.rows)} pairs, {bad} failed, {self.folder})"


def batch(
    pairs: Source,
    out: str | Path,
    *,
    overrides: Sequence[str] = (),
    workers: int = 1,
    cluster: str | None = None,
    retry_failed: bool = False,
    overwrite: bool = False,
    say: Say | None = None,
) -> Batch:
    """Solve many pairs, each in a process of its own, into `out/pairs/NAME`.

    `table.csv` and `index.html` are written after every pair. A later call keeps the pairs whose
    inputs (by content), options and code are the same; two calls with one folder, also on machines
    that share it, do not solve a pair twice.

    Args:
        pairs: See `Source`.
        out: Folder of the batch.
        overrides: Keys of every problem, such as `["segmentation.superpixels=500"]`.
        workers: Processes of this machine; fewer run where their memory would not suffice.
        cluster: Address of the scheduler of a Dask cluster instead, tcp://HOST:PORT.
        retry_failed: Also solve pairs again that failed with the same input.
        overwrite: Overwrite files of your own.
        say: Called with (done, total, row) after every pair.

    Raises:
        ConfigError: a key is wrong, or Dask is not installed.
        DataError: there is no pair, or the folder cannot be written.
    """
    folder = as_path(out, "output folder")
    problems = problems_of(pairs, overrides)
    claim(folder, [*FILES, *stored.places(problems)], overwrite, journal=stored.ROWS)
    rows: dict[str, Row] = {}
    heads: dict[str, Row] = {}
    for name, problem in problems.items():
        try:
            heads[name] = stored.head(problem)
        except SoupError as error:
            rows[name] = {"key": name, "pair": name, "seed": problem.seed}
            rows[name] |= failure(f"{type(error).__name__}: {error}")
    left = [name for name in problems if name not in rows]
    workers = stored.fitting(workers, [problems[name] for name in left])
    token = f"{socket.gethostname()} {os.getpid()} {time.time_ns()}"
    told = [0.0]

    def tell(last: bool = False, tries: int = 20) -> None:
        begin = time.monotonic()
        if begin < told[0] and not last:
            return
        known = [rows[name] for name in problems if name in rows]
        try:
            with staged(folder, overwrite=overwrite) as new:
                write_text(new / FILES[0], table(known))
                write_text(new / FILES[1], page(known, len(problems)))
        except DataError:
            # another run may write its own at the same time
            if not tries:
                raise
            time.sleep(PAUSE / 10)
            tell(last, tries - 1)
        # tables of many pairs are not written all the time
        told[0] = time.monotonic() + 10 * (time.monotonic() - begin)

    with _alive(folder, token):
        while left:
            known = stored.kept_rows(folder, {name: heads[name] for name in left})
            rows |= {k: row for k, row in known.items() if not (retry_failed and failed(row))}
            todo = [name for name in left if name not in rows]
            home = folder.absolute()
            works = {
                name: partial(_solve, problems[name], home, heads[name], token, known.get(name))
                for name in todo
            }
            tell()
            left = []
            with closing(each(works, workers, cluster=cluster, fresh=True)) as ended:
                for name, result in ended:
                    if result.get("claimed"):
                        left.append(name)
                        continue
                    rows[name] = {**heads[name], **result}
                    append_row(folder / stored.ROWS, rows[name])
                    # only now, so that another run that takes the mark finds the row
                    _mark(folder, name).unlink(missing_ok=True)
                    tell()
                    if say:
                        say(len(rows), len(problems), rows[name])
            # a failed pair is not tried again by the same call
            retry_failed = False
            time.sleep(PAUSE * bool(left))
    tell(last=True)
    return Batch([rows[name] for name in problems], folder)


def _mark(folder: Path, name: str) -> Path:
    """File that exists while a run solves a pair."""
    return folder / stored.PAIRS / f"{name}.claim"


def _solve(problem: Problem, folder: Path, own: Row, token: str, before: Row | None) -> Row:
    """Solve a pair into its folder, unless another run does or did: then the row says "claimed".

    `own` is the head of its row, `before` its row when this run looked.
    """
    mark = _mark(folder, problem.name)
    if _claimed(mark, token):
        if stored.kept_rows(folder, {problem.name: own}).get(problem.name) == before:
            return stored.solve_into(problem, folder)
        mark.unlink(missing_ok=True)
    return {"claimed": True}


def _claimed(mark: Path, token: str) -> bool:
    """Whether the run of a token now has a pair; one that gives no sign of life loses it."""
    mark.parent.mkdir(parents=True, exist_ok=True)
    with suppress(OSError):
        # another run may have made it, and not yet written the token
        host, _, rest = mark.read_text().partition(" ")
        dead = host == socket.gethostname() and not psutil.pid_exists(int(rest.split()[0]))
        if dead or time.time() - mark.stat().st_mtime > STALE:
            mark.unlink()
    try:
        with mark.open("x") as file:
            file.write(token)
    except FileExistsError:
        return mark.read_text() == token
    return True


@contextmanager
def _alive(folder: Path, token: str) -> Iterator[None]:
    """Context in which the marks of a run show that it lives; its last ones are removed."""
    stop = threading.Event()

    def marks() -> Iterator[Path]:
        for mark in (folder / stored.PAIRS).glob("*.claim"):
            with suppress(OSError):
                if mark.read_text() == token:
                    yield mark

    def beat() -> None:
        while not stop.wait(BEAT):
            for mark in marks():
                with suppress(OSError):
                    os.utime(mark)

    thread = threading.Thread(target=beat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
        for mark in marks():
            mark.unlink(missing_ok=True)


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """table.csv of rows; a failed pair has exit code 2 and its reason."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for row in rows:
        bad = {"exit_code": 2, "reason": reason(row)} if failed(row) else {}
        writer.writerow({**row, **bad})
    return text.getvalue()
