"""Full disks and kills: an earlier result is kept, and no temporary file."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from soup_nlp.errors import DataError
from soup_nlp.storage.folders import digest_of, mark_of, staged
from soup_nlp.storage.store import write_h5, write_json


@pytest.fixture
def small_disk(tmp_path) -> Iterator[Path]:
    """A file system of 1 MB."""
    mount_point = tmp_path / "disk"
    mount_point.mkdir()
    words = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(mount_point)]
    try:
        done = subprocess.run(words, capture_output=True, check=False)
    except OSError:
        pytest.skip("there is no command mount")
    if done.returncode:
        pytest.skip("file systems cannot be mounted here")
    try:
        yield mount_point
    finally:
        subprocess.run(["umount", str(mount_point)], check=True)


def write(folder: Path, size: int) -> None:
    """Write a result with an incompressible array of `size` bytes."""
    with staged(folder, whole=True) as new:
        write_json(new / "summary.json", {"size": size})
        values = np.random.default_rng(0).integers(0, 255, size, np.uint8)
        write_h5(new / "result.h5", {"x": values}, {})


def whole(folder: Path) -> bool:
    listed = mark_of(folder).files
    return bool(listed) and all(digest_of(folder / n) == d for n, d in listed.items())


@pytest.mark.parametrize("below", ["", "out"])
def test_an_earlier_result_outlives_a_full_disk(below, small_disk):
    """At the root of the file system and below it."""
    target = small_disk / below
    for size, fits in ((300_000, True), (900_000, False), (400_000, True), (5_000_000, False)):
        if fits:
            write(target, size)
        else:
            before = (target / "summary.json").read_bytes()
            with pytest.raises(DataError, match="cannot be written"):
                write(target, size)
            assert (target / "summary.json").read_bytes() == before
        assert whole(target)
        assert set(os.listdir(target)) == {".soup_nlp", "summary.json", "result.h5"}
        assert len(os.listdir(small_disk)) == (1 if below else 3)


def test_a_disk_without_any_room(small_disk):
    write(small_disk / "out", 300_000)
    with pytest.raises(OSError, match="space"), (small_disk / "ballast").open("wb") as file:
        file.write(bytes(2_000_000))
    for _ in range(2):
        with pytest.raises(DataError, match="cannot be written"):
            write(small_disk / "out", 100_000)
    assert whole(small_disk / "out")
    (small_disk / "ballast").unlink()
    write(small_disk / "out", 100_000)
    assert whole(small_disk / "out")
    assert os.listdir(small_disk) == ["out"]


# --- kills; `tests/tools/kill_table.py --kills 60` makes the whole table ----------------------


@pytest.mark.slow
def test_killed_exports_leave_whole_folders():
    script = Path(__file__).parents[1] / "tools" / "kill_table.py"
    words = [sys.executable, str(script), "--kills", "3", "--only", "export"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    rows = [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
    assert len(rows) == 4, done.stderr
    for row in rows:
        assert not row["broken"], row
        assert not row.get("left"), row
    assert done.returncode == 0, done.stdout
