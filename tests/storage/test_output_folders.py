"""Output folders are written whole or not at all, and never overwrite files of the user."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from soup_nlp.cli.main import main
from soup_nlp.errors import DataError
from soup_nlp.report.folder import write_failure
from soup_nlp.storage import folders
from soup_nlp.storage.folders import MARK, claim, digest_of, files_in, mark_of, recover, staged
from soup_nlp.storage.system import deferred_signals, scratch


def put(folder: Path, files: Mapping[str, str]) -> None:
    """Write files by name, with their folders."""
    for name, text in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def write(
    folder: Path,
    whole: bool = True,
    overwrite: bool = False,
    end: type[BaseException] | None = None,
    **files: str,
) -> None:
    """Write a result, or end with an exception after its files are written."""
    with staged(folder, whole, overwrite) as new:
        put(new, files)
        if end:
            raise end("ended")


def content_names(folder: Path) -> set[str]:
    return set(os.listdir(folder)) - {MARK}


def content(folder: Path) -> dict[str, str]:
    return {p.name: p.read_text() for p in folder.iterdir() if p.name != MARK}


NAMES = st.sets(st.sampled_from(["a", "b", "c/x", "c/d/y"]), min_size=1)
ENDS = st.sampled_from([None, None, None, RuntimeError, KeyboardInterrupt, OSError, DataError])


@settings(max_examples=40)
@given(st.lists(st.tuples(NAMES, st.sampled_from(["whole", "part", "user"]), ENDS), max_size=6))
def test_results_and_files_of_the_user_share_a_folder(steps):
    """Results that are written, or fail, and files of the user, against two dicts of files."""
    with TemporaryDirectory() as home:
        target, made, mine = Path(home) / "out", {}, {}
        for step, (names, writer, end) in enumerate(steps):
            files, whole = dict.fromkeys(names, str(step)), writer == "whole"
            refused = DataError if end in (None, OSError) else end
            if writer == "user":
                mine |= files
                made = {name: text for name, text in made.items() if name not in files}
                put(target, files)
            elif end or names & mine.keys():
                with pytest.raises(refused):
                    write(target, whole, end=end, **files)
            else:
                write(target, whole, **files)
                made = files if whole else made | files
                assert mark_of(target).files.keys() == made.keys()
            found = {name: (target / name).read_text() for name in files_in(target)}
            assert found == made | mine
            assert all(any(p.iterdir()) for p in target.rglob("*") if p.is_dir())
            assert os.listdir(home) == ["out"] * bool(made or mine)


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
        with pytest.raises(DataError, match="cannot be written"):
            write(target, a="2")
    recover(target)
    assert content(target) == {"a": "1"}
    assert sorted(os.listdir(target)) == [MARK, "a"]


def foreign(folder: Path, kind: str) -> Path:
    path = folder / "a"
    if kind == "file":
        path.write_text("precious")
    elif kind == "changed":
        write(folder, a="1")
        path.write_text("precious")
    elif kind == "folder":
        path.mkdir()
    else:
        (folder.parent / "elsewhere").write_text("precious")
        path.symlink_to(folder.parent / "elsewhere" if kind == "link" else "nowhere")
    return path


def identity(path: Path) -> tuple[int, ...]:
    """Identity and modification time of a file, without its access time."""
    state = os.lstat(path)
    return state.st_ino, state.st_mode, state.st_size, state.st_mtime_ns


def test_the_result_of_another_subject_is_kept(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    target = folders.default_folder("a", "frames 0 and 1")
    assert target == Path("out/a")
    with staged(claim(target, ["x"], subject="frames 0 and 1"), subject="frames 0 and 1") as new:
        (new / "x").write_text("1")
    claim(target, ["x"], subject="frames 0 and 1")
    with pytest.raises(
        DataError, match=r"(?s)something else.*found: frames 0 and 1\n.*--overwrite"
    ):
        claim(target, ["x"], subject="frames 1 and 2")
    # files without a subject do not change the subject of the folder
    write(target, whole=False, y="2")
    assert folders.default_folder("a", "frames 0 and 1") == target
    assert folders.default_folder("a", "frames 1 and 2") == Path("out/a-2")
    claim(target, ["x"], overwrite=True, subject="frames 1 and 2")


def test_a_folder_into_which_nothing_is_written_is_not_made(tmp_path):
    (tmp_path / "there").mkdir()
    claim(tmp_path / "there" / "a" / "b", ["x"])
    assert os.listdir(tmp_path / "there") == []
    for name in ("there", "there/a/b"):
        with pytest.raises(RuntimeError), staged(tmp_path / name):
            raise RuntimeError
    assert os.listdir(tmp_path / "there") == []
    with pytest.raises(DataError, match="cannot be written"):
        claim(__file__ + "/a", ["x"])


@pytest.mark.parametrize("kind", ["file", "changed", "folder", "link", "dangling link"])
def test_foreign_files_are_not_overwritten(kind, tmp_path):
    target = tmp_path / "out"
    target.mkdir()
    path = foreign(target, kind)
    before = identity(path)
    with pytest.raises(DataError, match=r"(?s)would be overwritten.*found: a\n.*--overwrite"):
        claim(target, ["a", "b"])
    with pytest.raises(DataError, match="would be overwritten"):
        write(target, a="2")
    assert identity(path) == before
    claim(target, ["b"])
    if kind == "folder":
        with pytest.raises(DataError, match="over a folder"):
            claim(target, ["a"], overwrite=True)
        return
    claim(target, ["a"], overwrite=True)
    # a command that fails afterwards has not made the file its own
    assert identity(path) == before
    with pytest.raises(DataError, match="would be overwritten"):
        write(target, a="2")
    write(target, overwrite=True, a="2")
    assert content(target) == {"a": "2"}
    assert not path.is_symlink()
    if kind == "link":
        assert (tmp_path / "elsewhere").read_text() == "precious"


def test_a_symbolic_mark_is_not_followed(tmp_path):
    target, victim = tmp_path / "out", tmp_path / "victim"
    target.mkdir()
    victim.write_text("{}")
    (target / MARK).symlink_to(victim)
    claim(target, ["a"])
    write(target, a="1")
    assert victim.read_text() == "{}"
    assert not (target / MARK).is_symlink()
    assert mark_of(target).files.keys() == {"a"}
    (target / MARK).unlink()
    (target / MARK).symlink_to("nowhere")
    write(target, False, b="1")
    assert sorted(os.listdir(tmp_path)) == ["out", "victim"]


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_link_on_the_way_leads_out_of_the_folder(overwrite, tmp_path):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "d").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "out" / "f").touch()
    for name in ("d/x", "f/x"):
        with pytest.raises(DataError, match=name):
            write(tmp_path / "out", overwrite=overwrite, **{name: "4"})
    assert os.listdir(tmp_path / "elsewhere") == []
    assert sorted(os.listdir(tmp_path / "out")) == ["d", "f"]


def test_a_mark_owns_nothing_outside_its_folder(tmp_path):
    (tmp_path / "victim").write_text("1")
    write(tmp_path / "out", a="1")
    listed = json.loads((tmp_path / "out" / MARK).read_text())
    for name in ("../victim", str(tmp_path / "victim")):
        listed["files"][name] = digest_of(tmp_path / "victim")
    (tmp_path / "out" / MARK).write_text(json.dumps(listed))
    write(tmp_path / "out", b="2")
    assert (tmp_path / "victim").read_text() == "1"
    assert content(tmp_path / "out") == {"b": "2"}


@pytest.mark.parametrize("text", ["", "x", "[]", '{"files": 3}', '{"files": {"a": {}}}', "\x00"])
def test_a_broken_mark_owns_nothing(text, tmp_path):
    (tmp_path / MARK).write_text(text)
    (tmp_path / "a").write_text("precious")
    with pytest.raises(DataError, match="overwritten"):
        claim(tmp_path, ["a"])


def test_a_link_to_a_folder_is_followed(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    for text in "12":
        claim(tmp_path / "link", ["a"])
        write(tmp_path / "link", a=text)
    assert content(tmp_path / "real") == {"a": "2"}
    assert (tmp_path / "link").is_symlink()


def test_the_working_folder_keeps_its_identity(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    before = tmp_path.stat().st_ino
    for text in "12":
        write(Path(), a=text)
    assert content(tmp_path) == {"a": "2"}
    assert tmp_path.stat().st_ino == before


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


def test_temporary_folders_of_a_kill_are_removed_by_the_next_run(tmp_path):
    target = tmp_path / "out"
    write(target, a="1", b="1")
    killed(target, 0)
    assert len(os.listdir(target)) == 4
    with staged(target) as new:
        assert content_names(target) == {"a", "b", new.name}
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
from soup_nlp.storage.store import write_h5, write_json
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


def test_the_log_of_a_failure_overwrites_one_of_the_user_only_where_allowed(tmp_path):
    log, missing = tmp_path / "failed.log", tmp_path / "ipopt.log"
    log.write_text("mine")
    with pytest.raises(DataError, match="would be overwritten"):
        write_failure(tmp_path, "failed\n", missing)
    assert log.read_text() == "mine"
    write_failure(tmp_path, "failed\n", missing, overwrite=True)
    assert content(tmp_path) == {"failed.log": "failed\n"}


@pytest.mark.parametrize(
    ("command", "name"),
    [
        ("bench paper", "README.md"),
        ("bench speed", "table.md"),
        ("bench accuracy --suite rendered", "rendered.md"),
        ("compare orbit", "README.md"),
        ("solve orbit", "depth_ref.png"),
        ("solve orbit", "config.yaml"),
        ("export orbit", "manifest.json"),
        ("export orbit", "problem.yaml"),
        ("chain scene:orbit", "chain.json"),
    ],
)
def test_files_of_the_user_are_refused_before_anything_is_computed(command, name, tmp_path, capsys):
    (tmp_path / name).write_text("mine")
    assert main([*command.split(), "-o", str(tmp_path)]) == 2
    error = " ".join(capsys.readouterr().err.split())
    assert "that this program did not make" in error
    assert f"found: {name}" in error
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]
