"""Output folders are written whole or not at all, and what is the user's stays."""

import os
import resource
import shutil
import signal
import subprocess
from collections.abc import Mapping
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from kill_table import full_disks, table

from soup_nlp.errors import DataError
from soup_nlp.report.folder import write_failure
from soup_nlp.storage.folders import (
    SUMS,
    UNFINISHED,
    Sums,
    claim,
    default_folder,
    digest_of,
    files_in,
    read_sums,
    staged,
    write_sums,
)
from soup_nlp.storage.store import write_h5
from soup_nlp.storage.system import deferred_signals, scratch

pytestmark = pytest.mark.usefixtures("simple_starts")


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


def content(folder: Path) -> dict[str, str]:
    """Texts by name of a folder's files, without the list."""
    return {p.name: p.read_text() for p in folder.iterdir() if p.name != SUMS}


NAMES = st.sets(st.sampled_from(["a", "b", "c/x", "c/d/y"]), min_size=1)
ENDS = st.sampled_from([None, None, None, RuntimeError, KeyboardInterrupt, OSError, DataError])


@settings(max_examples=12)
@given(st.lists(st.tuples(NAMES, st.sampled_from(["whole", "part", "user"]), ENDS), max_size=6))
def test_results_and_files_of_the_user_share_a_folder(steps):
    """Results that are written, or fail, and files of the user, against two dicts of files."""
    with TemporaryDirectory() as home:
        target, made, mine, listed = Path(home) / "out", {}, {}, set()
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
                # what the user changed stays listed until the next whole result
                listed = set(files) if whole else listed | files.keys()
                made = files if whole else made | files
                assert read_sums(target).files.keys() == listed
            found = {name: (target / name).read_text() for name in files_in(target)}
            assert found == made | mine
            assert all(any(p.iterdir()) for p in target.rglob("*") if p.is_dir())
            assert os.listdir(home) == ["out"] * bool(made or mine)


def foreign(folder: Path, kind: str, name: str = "a") -> Path:
    path = folder / name
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
    target = default_folder("a", "frames 0 and 1")
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
    assert default_folder("a", "frames 0 and 1") == target
    assert default_folder("a", "frames 1 and 2") == Path("out/a-2")
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


@pytest.mark.parametrize("kind", ["file", "link", "dangling link"])
def test_a_list_of_the_user_is_kept(kind, tmp_path):
    target, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    target.mkdir()
    foreign(target, kind, SUMS)
    # the list of another folder, to which a link leads
    write_sums(tmp_path, Sums({}))
    text = (tmp_path / SUMS).rename(elsewhere).read_text()
    with pytest.raises(DataError, match=f"found: {SUMS}"):
        claim(target, ["a"])
    write(target, overwrite=True, a="1")
    assert elsewhere.read_text() == text
    assert not (target / SUMS).is_symlink()
    assert read_sums(target).files.keys() == {"a"}


@pytest.mark.parametrize("kind", ["file", "link", "folder"])
def test_a_journal_of_the_user_is_not_continued(kind, tmp_path):
    target = tmp_path / "out"
    target.mkdir()
    foreign(target, kind, "rows")
    for overwrite in (False, True):
        with pytest.raises(DataError, match="rows"):
            claim(target, ["a"], overwrite, "s", "rows")
    if kind == "file":
        # in a folder of the program it is the program's
        write(target, a="1")
        claim(target, ["a"], False, "s", "rows")


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


def test_a_list_owns_nothing_outside_its_folder(tmp_path):
    (tmp_path / "victim").write_text("1")
    write(tmp_path / "out", a="1")
    listed = read_sums(tmp_path / "out").files
    for name in ("../victim", str(tmp_path / "victim")):
        listed[name] = digest_of(tmp_path / "victim")
    write_sums(tmp_path / "out", Sums(listed))
    write(tmp_path / "out", b="2")
    assert (tmp_path / "victim").read_text() == "1"
    assert content(tmp_path / "out") == {"b": "2"}


@pytest.mark.parametrize(
    ("command", "name"),
    [
        ("compare orbit", "README.md"),
        ("solve orbit", "depth_ref.png"),
        ("solve orbit", "config.yaml"),
        ("export orbit", "manifest.json"),
        ("export orbit", "problem.yaml"),
        ("chain scene:orbit", "chain.json"),
    ],
)
def test_files_of_the_user_are_refused_before_anything_is_computed(
    command, name, tmp_path, monkeypatch, refused
):
    for begin in ("data.pair.Pair.__init__", "storage.each.each"):
        monkeypatch.setattr(f"soup_nlp.{begin}", None)
    (tmp_path / name).write_text("mine")
    error = " ".join(refused(*command.split(), "-o", tmp_path).split())
    assert "that this program did not make" in error
    assert f"found: {name}" in error
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]


# --- kills, signals, several processes and full disks ---------------------------------------------


@pytest.mark.parametrize("full", ["file", "late", "limit"])
def test_a_file_that_cannot_be_written_ends_in_an_error(full, tmp_path, monkeypatch):
    """A disk is full at a file, or says so only when all are written; a limit of sizes."""
    target, (soft, hard) = tmp_path / "out", resource.getrlimit(resource.RLIMIT_FSIZE)
    write(target, a="1")

    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    where = target if full == "late" else target / "r.h5"
    found = "File too large" if full == "limit" else "No space left"
    words = rf"cannot be written\n  where: {where}\n  found: {found}"
    if full == "limit":
        resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, hard))
    else:
        monkeypatch.setattr(*((os, "fsync") if full == "late" else (Path, "write_bytes")), refuse)
    try:
        with pytest.raises(DataError, match=words), staged(target, True) as new:
            write_h5(new / "r.h5", {"x": np.random.default_rng(0).random(20_000)}, {})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert content(target) == {"a": "1"}
    assert os.listdir(tmp_path) == ["out"]


def killed(moves: int, target: Path, whole: bool, **files: str) -> None:
    """Write a result in a process that is killed after some of its moves."""
    if child := os.fork():
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == -signal.SIGKILL
        return
    left = iter(range(moves))

    def killing(move):
        def moved(*args, **options):
            if next(left, None) is None:
                os.kill(os.getpid(), signal.SIGKILL)
            move(*args, **options)

        return moved

    os.rename, os.replace, shutil.rmtree = map(killing, (os.rename, os.replace, shutil.rmtree))
    try:
        write(target, whole, **files)
    finally:
        os._exit(0)


@pytest.mark.parametrize("moves", range(5))
def test_a_kill_leaves_the_old_or_the_new_result(moves, tmp_path):
    """Killed before a move: old folder aside, new one in its place, the user's file, clean up."""
    target = tmp_path / "out"
    write(target, a="1", b="1")
    put(target, {"mine": "mine"})
    killed(moves, target, True, a="2", c="2", d="2")
    (aside,) = tmp_path.glob(f"{UNFINISHED}*")
    (mine,) = tmp_path.rglob("mine")
    assert mine.read_text() == "mine"
    assert mine.parent == (aside / "old" if moves in (1, 2) else target)
    found = content(aside / "old" if moves == 1 else target)
    found.pop("mine", None)
    assert found == ({"a": "1", "b": "1"} if moves < 2 else {"a": "2", "c": "2", "d": "2"})


@pytest.mark.parametrize("moves", range(5))
def test_a_kill_between_files_leaves_them_the_programs(moves, tmp_path):
    """In a folder that goes on: before the list of both, files a and b, the list, clean up."""
    target = tmp_path / "out"
    write(target, a="1", c="1")
    killed(moves, target, False, a="2", b="2")
    there = content(target)
    assert there == {"a": "12"[moves > 1], "c": "1"} | ({"b": "2"} if moves > 2 else {})
    assert read_sums(target).files == {name: digest_of(target / name) for name in there}
    claim(target, ["a", "b", "c"])
    write(target, False, a="3")
    assert read_sums(target).files == {name: digest_of(target / name) for name in there}


def test_processes_that_write_into_one_folder_lose_no_files(tmp_path):
    target = tmp_path / "out"

    def work(name: str) -> None:
        for k in range(8):
            write(target, False, **{f"{name}{k}": "1", name: str(k)})

    workers = [get_context("fork").Process(target=work, args=(name,)) for name in "abc"]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()
    expected = {f"{name}{k}": "1" for name in "abc" for k in range(8)} | dict.fromkeys("abc", "7")
    assert content(target) == expected
    assert read_sums(target).files == {name: digest_of(target / name) for name in expected}


def test_scratch_folders_of_other_processes_stay(tmp_path, monkeypatch):
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    (tmp_path / "soup_nlp-x").mkdir()
    with scratch() as first, scratch() as second:
        assert first != second
        assert first.is_dir()
    assert os.listdir(tmp_path) == ["soup_nlp-x"]


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
        # SIGKILL leaves its temporary folder
        assert not row.get("left") or row.get("killed"), row
        assert row.get("earlier kept") or row.get("disk") != "taken", row


def test_sha256sum_reads_the_list(tmp_path):
    write(tmp_path / "out", a="1", **{"b/c": "2"})
    check = partial(subprocess.run, ["sha256sum", "--strict", "-c", SUMS], cwd=tmp_path / "out")
    assert check().returncode == 0
    (tmp_path / "out" / "b" / "c").write_text("3")
    assert check().returncode == 1


@pytest.mark.parametrize("name", ["link", "real", "."])
def test_a_folder_may_be_a_link_or_the_working_folder(name, tmp_path, monkeypatch):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    monkeypatch.chdir(tmp_path / "real" if name == "." else tmp_path)
    for text in "12":
        write(claim(name, ["a"]), a=text)
    assert content(tmp_path / "real") == {"a": "2"}
    if name == ".":
        assert Path.cwd() == tmp_path / "real"
        assert os.listdir() == sorted(["a", SUMS], key=os.listdir().index)
    assert (tmp_path / "link").is_symlink()


def test_a_failure_log_overwrites_only_where_allowed(tmp_path):
    log, missing = tmp_path / "failed.log", tmp_path / "ipopt.log"
    log.write_text("mine")
    with pytest.raises(DataError, match="would be overwritten"):
        write_failure(tmp_path, "failed\n", missing)
    assert log.read_text() == "mine"
    write_failure(tmp_path, "failed\n", missing, overwrite=True)
    assert content(tmp_path) == {"failed.log": "failed\n"}
