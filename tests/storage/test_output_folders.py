"""Output folders are written whole or not at all, and never overwrite files of the user."""

import json
import os
import stat
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from soup_nlp.cli.main import main
from soup_nlp.errors import DataError
from soup_nlp.report.folder import write_failure
from soup_nlp.storage.folders import (
    MARK,
    claim,
    default_folder,
    digest_of,
    files_in,
    mark_of,
    staged,
)


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
    """Texts by name of a folder's files, without the mark."""
    return {p.name: p.read_text() for p in folder.iterdir() if p.name != MARK}


NAMES = st.sets(st.sampled_from(["a", "b", "c/x", "c/d/y"]), min_size=1)
ENDS = st.sampled_from([None, None, None, RuntimeError, KeyboardInterrupt, OSError, DataError])


@settings(max_examples=40)
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
                assert mark_of(target).files.keys() == listed
            found = {name: (target / name).read_text() for name in files_in(target)}
            assert found == made | mine
            assert all(any(p.iterdir()) for p in target.rglob("*") if p.is_dir())
            assert os.listdir(home) == ["out"] * bool(made or mine)


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


@pytest.mark.parametrize("name", ["link", "real", "."])
def test_the_folder_itself_is_kept(name, tmp_path, monkeypatch):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to("real")
    monkeypatch.chdir(tmp_path / "real" if name == "." else tmp_path)
    before = os.stat(name).st_ino
    for text in "12":
        write(claim(name, ["a"]), a=text)
    assert content(tmp_path / "real") == {"a": "2"}
    assert os.stat(name).st_ino == before
    assert (tmp_path / "link").is_symlink()


def test_a_failure_log_overwrites_only_where_allowed(tmp_path):
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
def test_files_of_the_user_are_refused_before_anything_is_computed(
    command, name, tmp_path, monkeypatch, capsys
):
    for begin in ("data.pair.Pair.__post_init__", "storage.rows._measured"):
        monkeypatch.setattr(f"soup_nlp.{begin}", None)
    (tmp_path / name).write_text("mine")
    assert main([*command.split(), "-o", str(tmp_path)]) == 2
    error = " ".join(capsys.readouterr().err.split())
    assert "that this program did not make" in error
    assert f"found: {name}" in error
    assert [path.read_text() for path in tmp_path.iterdir()] == ["mine"]


def test_permissions_are_those_of_the_old_files(tmp_path):
    target = tmp_path / "out"
    target.mkdir(0o750)
    write(target, a="1")
    (target / "a").chmod(0o604)
    write(target, a="2")
    assert stat.S_IMODE((target / "a").stat().st_mode) == 0o604
    assert stat.S_IMODE(target.stat().st_mode) == 0o750
