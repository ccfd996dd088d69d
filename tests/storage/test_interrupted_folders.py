"""Kills, signals, several processes and full disks: a folder has the old result or the new one."""

import json
import os
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest
from kill_table import full_disks, table
from test_output_folders import content, write

from soup_nlp.errors import DataError
from soup_nlp.storage.folders import MARK, claim, digest_of, mark_of, recover, staged
from soup_nlp.storage.system import deferred_signals, scratch


@pytest.mark.parametrize("fits", [0, 1], ids=["file", "mark"])
def test_a_disk_that_reports_late_that_it_is_full(fits, tmp_path, monkeypatch):
    target, synced = tmp_path / "out", []
    write(target, a="1")

    def full(handle: int) -> None:
        synced.append(handle)
        if len(synced) > fits:
            raise OSError(28, "No space left on device")

    with monkeypatch.context() as m:
        m.setattr(os, "fsync", full)
        with pytest.raises(DataError, match=r"cannot be written[\s\S]*found: No space left"):
            write(target, a="2")
    recover(target)
    assert content(target) == {"a": "1"}
    assert sorted(os.listdir(target)) == [MARK, "a"]


KILLED = """
import os, shutil, signal, sys
from soup_nlp.storage.folders import staged
moves = int(sys.argv[2])
def killing(function):
    def wrapped(*args, **options):
        global moves
        if not moves:
            os.kill(os.getpid(), signal.SIGKILL)
        moves -= 1
        function(*args, **options)
    return wrapped
os.replace = killing(os.replace)
shutil.rmtree = killing(shutil.rmtree)
with staged(sys.argv[1], True) as new:
    for name in "acd":
        (new / name).write_text("2")
"""


def killed(target: Path, moves: int) -> None:
    ended = subprocess.run([sys.executable, "-c", KILLED, str(target), str(moves)])
    assert ended.returncode == -signal.SIGKILL


def test_the_next_run_removes_temporary_folders_of_a_kill(tmp_path):
    target = tmp_path / "out"
    write(target, a="1", b="1")
    for clean in (recover, lambda folder: None):
        killed(target, 0)
        assert len(os.listdir(target)) == 4
        clean(target)
        assert (len(os.listdir(target)) == 3) == (clean is recover)
    with staged(target) as new:
        assert {*os.listdir(target)} == {MARK, "a", "b", new.name}
        # a folder that is in use is not removed
        claim(target, ["a"])
        assert new.is_dir()
    assert content(target) == {"a": "1", "b": "1"}


@pytest.mark.parametrize("moves", [1, 2, 3, 4, 5])
def test_a_move_that_was_killed_is_finished(moves, tmp_path):
    target = tmp_path / "out"
    write(target, a="1", b="1")
    # the temporary folder is renamed first and removed last
    killed(target, moves)
    recover(target)
    assert content(target) == {"a": "2", "c": "2", "d": "2"}
    assert mark_of(target).files.keys() == {"a", "c", "d"}
    write(target, a="3")
    assert content(target) == {"a": "3"}


def test_a_move_that_fails_is_finished_later(tmp_path, monkeypatch):
    target, replace = tmp_path / "out", os.replace
    write(target, a="1", b="1")

    def failing(source, destination):
        if Path(destination) == target / "c":
            raise OSError(5, "Input/output error")
        replace(source, destination)

    with monkeypatch.context() as m:
        m.setattr(os, "replace", failing)
        with pytest.raises(DataError, match="cannot be written"):
            write(target, a="2", c="2")
    recover(target)
    assert content(target) == {"a": "2", "c": "2"}


def test_files_that_another_process_moves_first_are_not_lost(tmp_path, monkeypatch):
    replace = os.replace

    def moved_twice(source, destination):
        replace(source, destination)
        if Path(destination) == tmp_path / "a":
            replace(source, destination)

    monkeypatch.setattr(os, "replace", moved_twice)
    write(tmp_path, a="1", c="1")
    assert content(tmp_path) == {"a": "1", "c": "1"}


WRITER = """
import sys
from soup_nlp.storage.folders import staged
for k in range(20):
    with staged(sys.argv[1]) as new:
        (new / f"{sys.argv[2]}{k}").write_text("1")
        (new / sys.argv[2]).write_text(str(k))
"""


def test_processes_that_write_into_one_folder_lose_no_files(tmp_path):
    writers = [
        subprocess.Popen([sys.executable, "-c", WRITER, str(tmp_path), name]) for name in "abc"
    ]
    assert [writer.wait() for writer in writers] == [0, 0, 0]
    expected = {f"{name}{k}": "1" for name in "abc" for k in range(20)} | dict.fromkeys("abc", "19")
    assert content(tmp_path) == expected
    assert mark_of(tmp_path).files == {name: digest_of(tmp_path / name) for name in expected}


def test_scratch_folders_are_removed(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    left = tmp_path / f"soup_nlp-{os.getuid()}-{ended.pid}-x"
    left.mkdir()
    (left / "x").touch()
    with scratch() as first, scratch() as second:
        assert first != second
        assert not left.exists()
        assert first.is_dir()
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_waits(number):
    seen = []
    old = signal.signal(number, lambda *_: seen.append(True))
    try:
        with deferred_signals():
            signal.raise_signal(number)
            signal.raise_signal(number)
            assert not seen
        assert seen == [True]
    finally:
        signal.signal(number, old)


LIMITED = """
import resource, sys
from soup_nlp.cli.main import main
from soup_nlp.errors import DataError
from soup_nlp.storage.folders import staged
from soup_nlp.storage.files import write_json
from soup_nlp.storage.store import write_h5
import numpy as np
resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, 40_000))
try:
    with staged(sys.argv[1], True) as new:
        write_json(new / "small.json", {})
        write_h5(new / "r.h5", {"x": np.random.default_rng(0).random(20_000)}, {})
except DataError as error:
    print(error)
    sys.exit(2)
"""


def test_a_file_that_cannot_be_written_ends_in_an_error(tmp_path):
    target = tmp_path / "out"
    write(target, a="1")
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, str(target)], capture_output=True, text=True
    )
    assert done.returncode == 2, done.stderr
    assert "cannot be written" in done.stdout
    assert f"where: {target / 'r.h5'}\n" in done.stdout
    assert content(target) == {"a": "1"}
    assert os.listdir(tmp_path) == ["out"]
    assert json.loads((target / MARK).read_text())["files"].keys() == {"a"}


# --- kills and full disks; `tests/tools/kill_table.py --kills 60` makes the whole table --------


@pytest.mark.slow
@pytest.mark.parametrize("rows_of", [partial(table, 2), full_disks], ids=["kills", "full disks"])
def test_kills_and_full_disks_leave_whole_folders(rows_of):
    try:
        rows = rows_of(["export"])
    except subprocess.CalledProcessError as error:
        pytest.skip(f"file systems cannot be mounted here: {error}")
    # SIGKILL, SIGTERM and an undisturbed run; a disk with room, without any, and of half the size
    assert len(rows) == 3
    for row in rows:
        assert not row["broken"], row
        assert not row.get("left"), row
        assert row.get("earlier kept") or row.get("disk") != "taken", row
