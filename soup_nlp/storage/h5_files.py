"""Reading of HDF5 files, which rejects links and checks sizes before it allocates memory."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NoReturn, TypeAlias

import h5py
import numpy as np

from soup_nlp.errors import DataError
from soup_nlp.storage.files import PathLike, require_file
from soup_nlp.storage.system import require_memory

ReadTree: TypeAlias = dict[str, Any]
"""Nested dict of numpy arrays, as `read_h5` returns it."""

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
        items = _items(file)
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


def _items(file: h5py.File) -> list[tuple[str, h5py.Group | h5py.Dataset]]:
    """Names, groups and arrays of an open file, which must be a tree without links.

    Raises:
        DataError: there is an object that no result has, a soft or external link, or an object
            under two names.
    """
    items: list[tuple[str, h5py.Group | h5py.Dataset]] = []
    links: dict[str, type] = {}

    def refuse(name: str, actual: str) -> NoReturn:
        raise DataError(
            "result holds what no result has",
            where=f"{file.filename}, {name}",
            found=actual,
            expected=f"numbers or text under one name, in at most {DEEPEST} levels of groups",
        )

    def see_link(name: str, link: Any) -> None:
        # an exception raised here becomes a SystemError in h5py
        links[name] = type(link)

    def see(name: str, item: Any) -> None:
        if name.count("/") > DEEPEST:
            refuse(name, "groups within groups")
        if not isinstance(item, h5py.Group | h5py.Dataset):
            refuse(name, type(item).__name__)
        if isinstance(item, h5py.Dataset):
            if item.shape is None or item.external or item.is_virtual:
                refuse(name, "an array without values of its own")
            if item.dtype.kind not in "fiub" and not h5py.check_string_dtype(item.dtype):
                refuse(name, f"type {item.dtype}")
        items.append((name, item))

    # neither visit follows a soft or external link, and `see` gets every object once
    file.visititems(see)
    file.visititems_links(see_link)
    for name in sorted(links.keys() - {name for name, _ in items}):
        hard = links[name] is h5py.HardLink
        refuse(name, "an object under two names" if hard else links[name].__name__)
    return items


def read_attrs(path: PathLike) -> dict[str, Any]:
    """Root attributes of a result file, numbers and texts.

    Raises:
        DataError: the file is missing or is not HDF5, or is damaged.
    """
    with _opened(path) as file:
        out = {k: v.item() if isinstance(v, np.generic) else v for k, v in file.attrs.items()}
        return {k: v.decode() if isinstance(v, bytes) else v for k, v in out.items()}


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
