"""Result files that are damaged or strange: an error of the file, and nothing else."""

import re
from collections.abc import Callable

import h5py
import numpy as np
import pytest
from helpers_odd_results import STRUCTURE

from soup_nlp.errors import DataError
from soup_nlp.storage.files import read_json
from soup_nlp.storage.store import read_attrs, read_h5, write_h5


@pytest.fixture(scope="module")
def image(tmp_path_factory) -> bytes:
    path = tmp_path_factory.mktemp("h5") / "r.h5"
    rng = np.random.default_rng(0)
    tree = {
        "a": {"x": rng.random((20, 3)), "s": 2.5},
        "big": rng.random((60, 200)),
        "text": ["ab", "cdé"],
        "none": np.zeros((0, 3)),
        "many": {str(k): rng.random(k + 1) for k in range(12)},
    }
    write_h5(path, tree, {"name": "x", "config": "a: 1\n" * 300, "seed": 3})
    return path.read_bytes()


def same(a, b) -> bool:
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(same(a[k], b[k]) for k in a)
    return bool(np.array_equal(a, b))


def test_flipped_bits_are_noticed(image, tmp_path):
    """Everything that is read is under a checksum: an error, or the numbers that were written."""
    path, rng = tmp_path / "r.h5", np.random.default_rng(1)
    path.write_bytes(image)
    tree, attrs, noticed = read_h5(path), read_attrs(path), 0
    for at in rng.integers(0, len(image), 120):
        data = bytearray(image)
        data[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(data)
        try:
            assert same(read_h5(path), tree)
            assert read_attrs(path) == attrs
        except DataError:
            noticed += 1
    # what is not read is free space between the parts
    assert noticed > 96


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
KINDS = "cycle|soft|external|huge|many|deep|named|empty|compound|reference|complex|vlen"
REFUSED: dict[str, Callable[[h5py.File], object]] = {
    **{name: damage for name, damage in STRUCTURE.items() if re.match(KINDS, name)},
    "two names": lambda file: file.__setitem__("again", file["depth/ref"]),
    "external storage": lambda file: file.create_dataset("far", (4,), "f8", external=FAR),
    "virtual": virtual,
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


@pytest.mark.parametrize(
    "text", ["", "{", '{"a": 1' + "0" * 5000 + "}", "[" * 100_000, "\x00", '{"a": nan}']
)
def test_json_that_is_none_is_an_error_of_the_file(text, tmp_path):
    path = tmp_path / "summary.json"
    path.write_text(text)
    with pytest.raises(DataError, match=r"summary\.json"):
        read_json(path, "summary.json")
    path.write_bytes(b"\xff\xfe{}")
    with pytest.raises(DataError, match="not text"):
        read_json(path, "summary.json")
