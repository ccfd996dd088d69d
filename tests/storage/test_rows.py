"""Rows of numbers: stored as JSON lines, measured once."""

import json
from functools import partial

import pytest

from soup_nlp.errors import DataError
from soup_nlp.storage.rows import Job, append_row, measure_all, read_rows
from soup_nlp.storage.versions import code_version


def fake_row(scene: str) -> dict:
    """A row without a solve; that of the sheet fails."""
    ok = scene != "sheet"
    return {"ok": ok, "error": None if ok else "no", "seconds": 0.0}


def fake_jobs(seed: int = 0, function=fake_row) -> list[Job]:
    scenes = ("orbit", "street", "sheet", "room")
    return [({"key": s, "seed": seed}, partial(function, s)) for s in scenes]


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
    # another name is another row
    measure_all(jobs(1)[:1], path)
    assert seen[5:] == ["orbit"]
    append_row(path, read_rows(path)[-1] | {"number": 7})
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
