"""Rows of numbers: stored as JSON lines, measured once, here or by worker processes."""

import json
import os
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from helpers_rows import fake_row, square, threads

from soup_nlp.errors import DataError
from soup_nlp.storage.rows import ONE_THREAD, Job, append_row, attempt, measure_all, read_rows
from soup_nlp.storage.versions import code_version


def test_a_row_is_plain_json(monkeypatch):
    clock = iter([10.0, 12.5])
    monkeypatch.setattr("time.process_time", lambda: next(clock))
    row = attempt(lambda: {"a": np.float64(np.nan), "b": [np.int64(3), float("inf")], "c": (1.5,)})
    assert (row["a"], row["b"], row["c"], row["ok"]) == (None, [3, None], [1.5], True)
    assert row["cpu_seconds"] == 2.5
    json.dumps(row, allow_nan=False)


def fake_jobs(seed: int = 0, function=fake_row, **options) -> list[Job]:
    scenes = ("orbit", "street", "sheet", "room")
    return [Job({"key": s, "seed": seed}, partial(function, s, **options)) for s in scenes]


def test_rows_are_kept_and_failed_ones_measured_again(tmp_path):
    path = tmp_path / "rows.jsonl"
    seen: list[str] = []

    def counted(scene):
        seen.append(scene)
        return fake_row(scene) | {"number": len(seen)}

    def jobs(seed=0):
        return fake_jobs(seed, counted)

    rows = measure_all(jobs()[:2], path)
    assert [r["key"] for r in rows] == ["orbit", "street"]
    said: list[tuple[int, int]] = []
    tables: list[int] = []
    measure_all(
        jobs(),
        path,
        say=lambda done, total, row: said.append((done, total)),
        after=lambda rows: tables.append(len(rows)),
    )
    assert seen == ["orbit", "street", "sheet", "room"]
    assert said == [(3, 4), (4, 4)]
    assert tables == [3, 4]
    measure_all(jobs(), path)
    assert seen[4:] == ["sheet"]
    # another name is another row; a stale job is measured again
    measure_all(jobs(1)[:1], path)
    assert seen[5:] == ["orbit"]
    measure_all([replace(jobs(1)[0], stale=True)], path)
    assert seen[6:] == ["orbit"]
    # of several rows of a name the last one counts
    assert [row["number"] for row in measure_all(jobs(1)[:1], path)] == [7]


def test_truncated_lines_and_rows_of_other_code_are_ignored(tmp_path):
    path = tmp_path / "rows.jsonl"
    measure_all(fake_jobs()[:2], path)
    lines = path.read_text().splitlines()
    old = {**json.loads(lines[0]), "code": "older"}
    path.write_text(json.dumps(old) + "\n" + lines[1][:40])
    assert len(read_rows(path)) == 1
    rows = measure_all(fake_jobs()[:2], path)
    assert [r["code"] for r in rows] == [code_version()] * 2
    # the new rows were not appended to the truncated line
    assert len(read_rows(path)) == 3
    with pytest.raises(DataError, match="cannot be written"):
        append_row(tmp_path / "rows.jsonl" / "x.jsonl", {})


@pytest.fixture
def found_by_children(monkeypatch):
    """The functions of rows, in the processes that measure them."""
    monkeypatch.setenv("PYTHONPATH", str(Path(square.__code__.co_filename).parent), os.pathsep)


@pytest.mark.slow
@pytest.mark.usefixtures("found_by_children")
def test_rows_of_new_processes(tmp_path, monkeypatch):
    for name in ONE_THREAD:
        monkeypatch.delenv(name, raising=False)
    numbers = {2: False, 3: False, 4: True}
    works = [partial(attempt, partial(square, n, breaks=b)) for n, b in numbers.items()]
    jobs = [Job({"key": k}, work) for k, work in enumerate(works)]
    *rows, failed = measure_all(jobs, tmp_path / "rows.jsonl", fresh=True)
    assert [row["square"] for row in rows] == [4, 9]
    assert len({os.getpid(), *(row["process"] for row in rows)}) == 3
    assert [row["threads"] for row in rows] == [["1"] * 4] * 2
    assert threads() == [None] * 4
    assert all(row["peak_bytes"] > 1e6 for row in rows)
    assert "out of numbers" in failed["error"]


@pytest.mark.slow
@pytest.mark.usefixtures("found_by_children")
def test_parallel_processes_and_a_process_that_dies(tmp_path):
    path = tmp_path / "rows.jsonl"
    rows = measure_all(fake_jobs(dies=True), path, workers=2)
    assert [r["key"] for r in rows] == ["orbit", "street", "sheet", "room"]
    assert [r["ok"] for r in rows] == [True, True, False, False]
    assert rows[2]["error"] == "no"
    assert "process died" in rows[3]["error"]
    assert len(read_rows(path)) == 4
    # without the job that dies, no job runs twice
    rows = measure_all(fake_jobs(1)[:2], path, workers=2)
    assert [r["ok"] for r in rows] == [True, True]
