"""Reading of HDF5 files, which rejects links and checks sizes before it allocates memory."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TypeAlias

import h5py
import numpy as np

from soup_nlp.errors import DataError
from soup_nlp.storage.files import PathLike, parse_json, require_file
from soup_nlp.storage.system import require_memory

ReadTree: TypeAlias = dict[str, Any]
"""Nested dict of numpy arrays, as `read_h5` returns it."""

RECORD = "record"
"""Group of hashes of other files; `convert` rewrites it, so `contents_digest` leaves it out."""
DIGEST = "contents_sha256"
"""Root attribute with the result of `contents_digest`."""
DEEPEST = 16
"""Largest number of nested groups."""
BROKEN = (OSError, RuntimeError, KeyError, TypeError, ValueError, AttributeError)
"""Exceptions that h5py raises for damaged files."""


def read_h5(path: PathLike) -> ReadTree:
    """All arrays of a result file, as nested dicts of numpy arrays (text as str or object arrays).

    Raises:
        DataError: the file is missing, damaged or not HDF5, holds a link or a type that no result
            has, or does not fit into memory.
    """
    with _opened(path) as file:
        items = list(_items(file, "", {h5py.h5o.get_info(file["/"].id).addr}, path))
        size = sum(i.size * i.dtype.itemsize for _, i in items if isinstance(i, h5py.Dataset))
        require_memory(size, "the arrays of the result", path, "the file may be damaged")
        out: ReadTree = {}
        for name, item in items:
            *groups, last = name.split("/")
            node = out
            for group in groups:
                node = node.setdefault(group, {})
            if isinstance(item, h5py.Group):
                node[last] = {}
            elif h5py.check_string_dtype(item.dtype):
                node[last] = np.asarray(item.asstr()[()])
            else:
                node[last] = np.asarray(item[()])
        return out


def _items(
    group: h5py.Group, prefix: str, seen: set[Any], path: PathLike
) -> Iterator[tuple[str, h5py.Group | h5py.Dataset]]:
    """Names, groups and datasets below a group.

    Raises:
        DataError: there is a link, or an object that is neither a group nor an array.
    """

    def wrong(name: str, actual: object, expected: str) -> DataError:
        return DataError(
            "result holds what no result has", where=f"{path}, {name}", found=actual,
            expected=expected,
        )  # fmt: skip

    if prefix.count("/") > DEEPEST:
        raise wrong(prefix, "groups within groups", f"at most {DEEPEST} levels")
    for key in group:
        name = f"{prefix}{key}"
        link = group.get(key, getlink=True)
        if not isinstance(link, h5py.HardLink):
            raise wrong(name, type(link).__name__, "an array or a group, no link")
        item = group[key]
        address = h5py.h5o.get_info(item.id).addr
        if address in seen:
            raise wrong(name, "an object under two names", "a tree")
        seen.add(address)
        if isinstance(item, h5py.Group):
            yield name, item
            yield from _items(item, f"{name}/", seen, path)
        elif not isinstance(item, h5py.Dataset):
            raise wrong(name, type(item).__name__, "an array or a group")
        elif item.shape is None or item.external or item.is_virtual:
            raise wrong(name, "an array without values of its own", "numbers or text")
        elif item.dtype.kind not in "fiub" and not h5py.check_string_dtype(item.dtype):
            raise wrong(name, f"type {item.dtype}", "numbers or text")
        else:
            yield name, item


def read_attrs(path: PathLike) -> dict[str, Any]:
    """Root attributes of a result file.

    `versions` is returned as a dict, other JSON texts as they were stored.

    Raises:
        DataError: the file is missing or is not HDF5, or is damaged.
    """
    with _opened(path) as file:
        out = dict(file.attrs)
        out = {k: v.item() if isinstance(v, np.generic) else v for k, v in out.items()}
        out = {k: v.decode() if isinstance(v, bytes) else v for k, v in out.items()}
        if isinstance(out.get("versions"), str):
            out["versions"] = parse_json(out["versions"])
    return out


def contents_digest(file: h5py.File) -> str:
    """SHA-256 of all arrays and attributes of an open result, independent of their storage."""
    seen = {h5py.h5o.get_info(file["/"].id).addr}
    items = [(n, i) for n, i in _items(file, "", seen, file.filename) if n.split("/")[0] != RECORD]
    sha = hashlib.sha256()

    def add(name: str, data: Any) -> None:
        value = np.asarray(data)
        sha.update(f"{name}\0{value.dtype.str}\0{value.shape}\0".encode(errors="surrogateescape"))
        sha.update(repr(value.tolist()).encode() if value.dtype == object else value.tobytes())

    for name, item in sorted([("", file), *items], key=lambda pair: pair[0]):
        for key in sorted(item.attrs):
            if (name, key) != ("", DIGEST):
                add(f"{name}@{key}", item.attrs[key])
        add(name, item[()] if isinstance(item, h5py.Dataset) else 0)
    return sha.hexdigest()


def read_digest(path: PathLike) -> str:
    """The digest of the present contents of a result file, see `contents_digest`.

    Raises:
        DataError: see `read_h5`, which must be called before, since it checks the sizes.
    """
    with _opened(path) as file:
        return contents_digest(file)


@contextmanager
def _opened(path: PathLike) -> Iterator[h5py.File]:
    """An open file; errors of h5py in the block become DataErrors."""
    require_file(path, "result file")
    try:
        with h5py.File(path, "r") as file:
            yield file
    except BROKEN as error:
        raise DataError(
            "file is not a readable HDF5 file",
            where=path,
            found=error,
            expected="a result file written by soup_nlp",
        ) from error
