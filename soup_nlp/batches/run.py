"""A batch: every pair solved into a folder of its own, its row in a table and a page at once."""

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
from html import escape
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import psutil

from soup_nlp.batches.sources import Source, problems_of
from soup_nlp.config.problem import Problem
from soup_nlp.errors import DataError, SoupError
from soup_nlp.report import folder as stored
from soup_nlp.report.result import PAGE
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
HEADS = ("", "pair", "MRE", "constant", "drawn", "seconds", "MB", "exit", "reason")
NUMBERS = {"mre": ".4f", "constant": ".4f", "drawn": ".0%", "seconds": ".0f"}
DRAWS = 2000
"""Draws of the bootstrap."""
HTML = """<!doctype html>
<html lang="en"><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>Batch</title>
<style>
body {{ font: 15px/1.4 system-ui, sans-serif; margin: 1.5em; color: #222; background: #fff }}
table {{ border-collapse: collapse }}
th, td {{ padding: .3em .7em; border-bottom: 1px solid #ddd; text-align: right }}
th {{ cursor: pointer; position: sticky; top: 0; background: #fff }}
td:nth-child(2), td:last-child {{ text-align: left }}
img {{ height: 60px; display: block }}
.bad {{ color: #a00 }}
</style>
<h1>Batch</h1>
<p>{summary}</p>
<table><thead><tr>{heads}</tr></thead><tbody>
{rows}
</tbody></table>
<script>
document.querySelectorAll("th").forEach((head, k) => head.onclick = () => {{
  const body = document.querySelector("tbody"), up = head.dataset.up !== "1";
  head.dataset.up = up ? "1" : "0";
  const key = row => row.cells[k].dataset.value ?? row.cells[k].textContent;
  [...body.rows].sort((a, b) => (up ? 1 : -1) *
    key(a).localeCompare(key(b), undefined, {{numeric: true}})).forEach(row => body.append(row));
}});
</script>
"""


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
    rows, heads = dict[str, Row](), dict[str, Row]()
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
            for mark in (_mark(folder, name) for name in known):
                # of a run that was killed just after it wrote the row
                if mark.exists() and _claimed(mark, token):
                    mark.unlink()
            home = folder.absolute()
            works = {
                name: partial(_solve, problems[name], home, heads[name], token, known.get(name))
                for name in left
                if name not in rows
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


def interval(values: Sequence[float], statistic: Any) -> tuple[float, float, float]:
    """A statistic of values and its 95 % bootstrap interval."""
    x = np.asarray(values, float)
    draws = np.random.default_rng(0).integers(0, len(x), (DRAWS, len(x)))
    low, high = np.quantile(statistic(x[draws], axis=1), [0.025, 0.975])
    return float(statistic(x)), float(low), float(high)


def summary(rows: Sequence[Mapping[str, Any]], total: int) -> str:
    """Number of pairs, and mean and median of the MRE with intervals, where truth is known."""
    bad = sum(failed(row) for row in rows)
    parts = [f"{len(rows)} of {total} pairs" + (f", {bad} failed" if bad else "")]
    known = [float(row["mre"]) for row in rows if row.get("mre") is not None]
    if known:
        for name, statistic in (("mean", np.mean), ("median", np.median)):
            value, low, high = interval(known, statistic)
            parts.append(f"MRE {name} {value:.4f} ({low:.4f} to {high:.4f})")
        parts.append(f"{len(known)} pairs with truth; in brackets 95 % intervals (bootstrap)")
    return "; ".join(parts)


def page(rows: Sequence[Mapping[str, Any]], total: int) -> str:
    """The page of the rows so far, of `total` pairs."""
    lines = []
    for row in rows:
        place, bad = f"pairs/{quote(str(row['pair']))}", failed(row)
        name = escape(str(row["pair"]))
        shown = "" if bad else f'<img loading="lazy" alt="" src="{place}/depth_ref_colour.png">'
        size = row.get("peak_bytes")
        cells = [
            *(_number(row.get(name), form) for name, form in NUMBERS.items()),
            _number(size and size / 2**20, ".0f"),
            f"<td>{2 if bad else row.get('exit_code')}</td>",
            f"<td>{escape(reason(row) if bad else str(row.get('reason')))}</td>",
        ]
        label = name if bad else f'<a href="{place}/{PAGE}">{name}</a>'
        first = f'<tr class="{"bad" if bad else ""}"><td>{shown}</td>'
        lines.append("".join([first, f'<td data-value="{name}">{label}</td>', *cells, "</tr>"]))
    heads = "".join(f"<th>{head}</th>" for head in HEADS)
    return HTML.format(summary=escape(summary(rows, total)), heads=heads, rows="\n".join(lines))


def _number(value: float | None, form: str) -> str:
    if value is None:
        return '<td data-value="">-</td>'
    return f'<td data-value="{value:.9f}">{format(value, form)}</td>'
