"""HDF5 and JSON: what is written is read; damaged or strange files are an error of the file."""

import errno
import fcntl
import json
import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from helpers_odd_results import STRUCTURE

from soup_nlp.errors import DataError
from soup_nlp.storage.files import read_json, write_json, write_text
from soup_nlp.storage.folders import staged
from soup_nlp.storage.store import parse_table, read_h5, require, write_h5
from soup_nlp.storage.versions import code_version, versions


def tree():
    rng = np.random.default_rng(0)
    return {
        "soup": {"R": rng.normal(size=(5, 3, 3)), "inner": {"ok": np.array([True, False])}},
        "depth": rng.normal(size=(100, 200)).astype(np.float32),
        "labels": np.arange(4, dtype=np.int32),
        "energy": 1.5,
        "none": np.zeros((0, 3)),
        "group": {},
    }


# --- HDF5 -----------------------------------------------------------------------------------


def test_h5_round_trip(tmp_path):
    path = tmp_path / "r.h5"
    source = tree()
    attrs = {"name": "pär", "config": ""}
    write_h5(path, source, attrs, parse_table("depth scene H,W z\n\na|soup/* m - length of *"))
    back = read_h5(path)
    assert set(back) == set(source)
    for name in ("soup/R", "soup/inner/ok", "depth", "labels", "none"):
        want, got = require(source, name), require(back, name)
        np.testing.assert_array_equal(got, want)
        assert got.dtype == want.dtype
    assert float(require(back, "energy")) == 1.5
    assert back["group"] == {}

    with h5py.File(path) as file:
        attrs = {k: v.decode() if isinstance(v, bytes) else v for k, v in file.attrs.items()}
    assert (attrs["name"], attrs["config"], attrs["schema"]) == ("pär", "", 1)
    assert json.loads(attrs["versions"]) == versions()
    assert os.uname().nodename not in attrs["machine"]
    with h5py.File(path) as file:
        depth, R, labels = (dict(file[name].attrs) for name in ("depth", "soup/R", "labels"))
    assert depth == {"units": "scene", "description": "z", "shape_letters": "H,W"}
    assert R == {"units": "m", "description": "length of R", "shape_letters": ""}
    assert labels == {"units": "1", "description": "", "shape_letters": ""}


def test_a_file_system_without_locks(tmp_path, monkeypatch):
    def flock(handle: int, what: int) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    path = tmp_path / "out" / "r.h5"
    with monkeypatch.context() as patch, staged(path.parent) as new:
        patch.setattr("fcntl.flock", flock)
        write_h5(new / path.name, {"x": 1.0}, {})
    # and reading wants no lock, which could not be had here
    with path.open() as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        assert read_h5(path)["x"] == 1


def full_disk(*args, **options):
    raise OSError("disk is full")


@pytest.mark.parametrize(
    ("write", "said"),
    [
        (lambda path: write_h5(path, {"good": np.zeros(3), "bad": [object()]}, {}), "cannot write"),
        (lambda path: write_h5(path, {"good": np.zeros(3), "bad": [[1], [1, 2]]}, {}), "cannot"),
        (lambda path: write_h5(path, tree(), {}), "disk is full"),
        (lambda path: write_json(path, {"a": object()}), "JSON"),
    ],
    ids=["object", "ragged", "full disk", "JSON"],
)
def test_what_cannot_be_written_leaves_the_old_file(write, said, tmp_path, monkeypatch):
    path = tmp_path / "old"
    path.write_bytes(b"old")
    if said == "disk is full":
        monkeypatch.setattr("soup_nlp.storage.store._write_array", full_disk)
    with pytest.raises(DataError, match=said):
        write(path)
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["old"]


def test_require_lists_what_is_there():
    tree = {"soup": {"R": np.eye(3), "t": np.zeros(3)}}
    np.testing.assert_array_equal(require(tree, "soup/R"), np.eye(3))
    with pytest.raises(DataError, match=r"\['R', 't'\]"):
        require(tree, "soup/lambda")
    with pytest.raises(DataError, match=r"\['soup'\]"):
        require(tree, "graph/edges")
    with pytest.raises(DataError, match="is a group"):
        require(tree, "soup")
    with pytest.raises(DataError, match="an array"):
        require(tree, "soup/R/x")


# --- damaged and strange files ----------------------------------------------------------------


@pytest.fixture(scope="module")
def image(tmp_path_factory) -> bytes:
    path = tmp_path_factory.mktemp("h5") / "r.h5"
    rng = np.random.default_rng(0)
    tree = {
        "a": {"x": rng.random((20, 3)), "s": 2.5},
        "big": rng.random((60, 200)),
        "none": np.zeros((0, 3)),
        "many": {str(k): rng.random(k + 1) for k in range(12)},
    }
    write_h5(path, tree, {"name": "x", "config": "a: 1\n" * 300})
    return path.read_bytes()


def same(a, b) -> bool:
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    return bool(np.array_equal(a, b))


def test_flipped_bits_are_noticed(image, tmp_path):
    """Everything that is read is under a checksum: an error, or the numbers that were written."""
    path, rng = tmp_path / "r.h5", np.random.default_rng(1)
    path.write_bytes(image)
    tree, noticed = read_h5(path), 0
    for at in rng.integers(0, len(image), 30):
        data = bytearray(image)
        data[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(data)
        try:
            assert same(read_h5(path), tree)
        except DataError:
            noticed += 1
    # what is not read is free space between the parts
    assert noticed > 24


@pytest.mark.parametrize("share", [0.0, 0.01, 0.5, 0.999])
def test_a_file_that_was_cut_off_is_noticed(share, image, tmp_path):
    (tmp_path / "r.h5").write_bytes(image[: int(share * len(image))])
    with pytest.raises(DataError, match="HDF5"):
        read_h5(tmp_path / "r.h5")


def virtual(file: h5py.File) -> None:
    layout = h5py.VirtualLayout((4,), "f8")
    layout[:] = h5py.VirtualSource("elsewhere.h5", "x", (4,))
    file.create_virtual_dataset("virtual", layout)


FAR = [("/etc/hostname", 0, 32)]
KINDS = "huge|many|deep|named|empty|text|latin|compound|reference|complex|vlen"
REFUSED: dict[str, Callable[[h5py.File], object]] = {
    **{name: damage for name, damage in STRUCTURE.items() if re.match(KINDS, name)},
    "external storage": lambda file: file.create_dataset("far", (4,), "f8", external=FAR),
    "virtual": virtual,
    "zeros": lambda file: file.create_dataset("z", data=np.zeros(1 << 22), compression="gzip"),
}
"""Structures that no result has, whatever they are in the place of."""


@pytest.mark.parametrize("name", REFUSED)
def test_what_no_result_holds_is_refused(name, tmp_path):
    path = tmp_path / "result.h5"
    write_h5(path, {"depth": {"ref": np.ones((4, 4))}}, {})
    with h5py.File(path, "a") as file:
        REFUSED[name](file)
    with pytest.raises(DataError, match=r"no result has|more memory"):
        read_h5(path)


LINKS: dict[str, Callable[[h5py.File], object]] = {
    **{name: damage for name, damage in STRUCTURE.items() if re.match("cycle|soft|ext", name)},
    "two names": lambda file: file.__setitem__("again", file["depth/ref"]),
}
HIDING = ("soft link dangling", "external link", "two names")
"""Links in the place of an array that is needed."""


@pytest.mark.parametrize("name", LINKS)
def test_links_are_left_out(name, tmp_path):
    path = tmp_path / "result.h5"
    source = {"depth": {"ref": np.ones((4, 4))}}
    write_h5(path, source, {})
    with h5py.File(path, "a") as file:
        LINKS[name](file)
    tree = read_h5(path)
    if name not in HIDING:
        assert same(tree, source)
        return
    with pytest.raises(DataError, match="result has no 'depth/ref'"):
        require(tree, "depth/ref")


# --- JSON -----------------------------------------------------------------------------------


@dataclass
class Record:
    a: np.float64
    b: tuple[int, ...]


STORED = [
    (np.float32(0.5), 0.5),
    (np.int64(2**63 - 1), 2**63 - 1),
    (np.bool_(True), True),
    (float("nan"), None),
    (np.float64(-np.inf), None),
    (np.array([[1.0, np.nan]]), [[1.0, None]]),
    (np.array(1.5), 1.5),
    (Record(np.float64(2), (1, 2)), {"a": 2.0, "b": [1, 2]}),
    (Path("a/b"), "a/b"),
    ({2, 1}, [1, 2]),
    ("ä", "ä"),
    ({3: None}, {"3": None}),
]


def test_json(tmp_path):
    write_json(tmp_path / "a.json", {"all": [value for value, _ in STORED]})
    back = read_json(tmp_path / "a.json", "file", dict[str, Any])
    assert back == {"all": [value for _, value in STORED]}


@pytest.mark.parametrize(
    "text", ["", "{", '{"a": 1' + "0" * 5000 + "}", "[" * 100_000, "\x00", '{"a": nan}']
)
def test_json_that_is_none_is_an_error_of_the_file(text, tmp_path):
    path = tmp_path / "summary.json"
    path.write_text(text)
    with pytest.raises(DataError, match=r"summary\.json"):
        read_json(path, "summary.json", dict[str, Any])
    path.write_bytes(b"\xff\xfe{}")
    with pytest.raises(DataError, match="not text"):
        read_json(path, "summary.json", dict[str, Any])


def test_the_code_version_is_that_of_every_source(tmp_path, monkeypatch):
    monkeypatch.setattr("soup_nlp.storage.versions.__file__", str(tmp_path / "room" / "a.py"))
    seen = {code_version.__wrapped__()}
    for name in ("a.py", "b.py", "room.py", "room/a.py"):
        (tmp_path / "room").mkdir(exist_ok=True)
        for text in ("1", "2"):
            (tmp_path / name).write_text(text)
            seen.add(code_version.__wrapped__())
    assert len(seen) == 9


def test_text_of_names_that_are_no_utf8_is_written(tmp_path):
    write_text(tmp_path / "log.txt", "folder \udcff")
    assert (tmp_path / "log.txt").read_text() == "folder \\udcff"


@pytest.mark.parametrize("name", ["", "no/a"])
def test_a_file_that_cannot_be_written_is_an_error(name, tmp_path):
    with pytest.raises(DataError, match="cannot be written"):
        write_text(tmp_path / name, "x")
    assert os.listdir(tmp_path) == []
