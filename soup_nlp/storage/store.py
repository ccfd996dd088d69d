"""Results as HDF5, with units for every array.

Reading rejects links and checks sizes before it allocates memory.
"""

import json
import platform
from collections.abc import Mapping
from fnmatch import fnmatchcase
from io import BytesIO
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias

import h5py
import numpy as np
from numpy.typing import NDArray

from soup_nlp.errors import DataError
from soup_nlp.storage.files import PathLike, plain, require_file, write_bytes
from soup_nlp.storage.system import require_memory
from soup_nlp.storage.versions import versions

SCHEMA = 1
"""Version of the layout of result files; changes when readers have to change."""

FORMAT = ("v110", "v110")
"""Version of the HDF5 format: the oldest one with checksums of all parts."""

Tree: TypeAlias = Mapping[str, Any]
"""Numbers, texts and arrays of them by name, in nested mappings."""

COMPRESS_ABOVE = 64 * 1024
"""Arrays with more bytes are compressed (gzip level 1 after a byte shuffle)."""


class Row(NamedTuple):
    """Unit ("1" for none), axes ("N,3"; "" for a number) and description of an array."""

    unit: str = "1"
    axes: str = ""
    text: str = ""


def parse_table(table: str) -> dict[str, Row]:
    """Rows by the path of an array, "group/name".

    Every line of a table has paths, unit, axes ("-" for a number) and description. "|" separates
    groups with the same arrays, "*" stands for any name.
    """
    out = {}
    for line in filter(None, table.strip().splitlines()):
        paths, unit, axes, text = line.split(maxsplit=3)
        groups, slash, name = paths.rpartition("/")
        for group in groups.split("|"):
            out[f"{group}{slash}{name}"] = Row(unit, axes.strip("-"), text)
    return out


def row_of(rows: Mapping[str, Row], path: str) -> Row | None:
    """The row of a path; None if there is none. In a description "*" becomes the name."""
    if path in rows:
        return rows[path]
    for pattern, row in rows.items():
        if fnmatchcase(path, pattern):
            start = pattern.partition("*")[0]
            return row._replace(text=row.text.replace("*", path.removeprefix(start)))
    return None


def write_h5(
    path: PathLike,
    tree: Tree,
    attrs: Mapping[str, object],
    rows: Mapping[str, Row] = MappingProxyType({}),
) -> None:
    """Write a result file.

    Args:
        path: File to write; its folder must exist.
        tree: The arrays. Each becomes a dataset with the attributes `units`, `description` and
            `shape_letters`, each mapping a group.
        attrs: Root attributes, without None, beside `schema`, `versions` and `machine`; what has no
            type of HDF5 is JSON text.
        rows: Descriptions of the arrays, see `parse_table`.
    """
    about = {"schema": SCHEMA, "versions": json.dumps(versions()), "machine": platform.platform()}
    try:
        # written in memory, since HDF5 would end the process on a full disk
        image = BytesIO()
        with h5py.File(image, "w", track_order=True, libver=FORMAT) as file:
            for key, value in (dict(attrs) | about).items():
                if value is not None:
                    _write_attribute(file, key, value)
            _write_group(file, tree, rows)
    except (OSError, TypeError, ValueError, RuntimeError) as error:
        raise DataError("cannot write the HDF5 file", where=path, found=error) from error
    write_bytes(path, image.getvalue())


def _write_group(group: h5py.Group, tree: Tree, rows: Mapping[str, Row]) -> None:
    for name, item in tree.items():
        if isinstance(item, Mapping):
            _write_group(group.require_group(name), item, rows)
            continue
        data = np.asarray(item)
        if data.dtype.kind == "U":
            data = np.char.encode(data, "utf-8")
            data = data.astype(h5py.string_dtype(length=max(1, data.dtype.itemsize)))
        array = _write_array(group, name, data)
        row = row_of(rows, array.name.removeprefix("/")) or Row()
        described = {"units": row.unit, "description": row.text, "shape_letters": row.axes}
        array.attrs.update(described)


def _write_attribute(file: h5py.File, key: str, value: object) -> None:
    if isinstance(value, bool | int | float | np.generic):
        file.attrs[key] = value
        return
    text = (value if isinstance(value, str) else json.dumps(plain(value))).encode()
    # text of fixed length, since HDF5 has no checksum for variable length
    file.attrs.create(key, text, dtype=h5py.string_dtype(length=max(1, len(text))))


def _write_array(group: h5py.Group, name: str, data: NDArray[Any]) -> h5py.Dataset:
    """Write an array with a checksum."""
    if data.ndim and data.size:
        options: dict[str, Any] = {"fletcher32": True, "chunks": True}
        if data.nbytes > COMPRESS_ABOVE:
            options |= {"compression": "gzip", "compression_opts": 1, "shuffle": True}
        return group.create_dataset(name, data=data, **options)
    # scalars and empty arrays are stored in the header, which has a checksum
    layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    layout.set_layout(h5py.h5d.COMPACT)
    return group.create_dataset(name, data=data, dcpl=layout)


# --- reading --------------------------------------------------------------------------------------

ReadTree: TypeAlias = dict[str, Any]
"""Nested dict of numpy arrays, as `read_h5` returns it."""
DEEPEST = 16
"""Largest number of nested groups."""
LARGE = 16 << 20
"""Bytes of an array from which the free memory is looked at, which takes milliseconds."""
MOST_COMPRESSION, MOST_OF_FILE = 1100, 100
"""Largest ratio of an array's bytes to its stored ones, as deflate reaches 1032; of all arrays to
the file, whose pictures, unlike masks, compress little."""
BROKEN = (OSError, RuntimeError, KeyError, TypeError, ValueError, AttributeError)
"""Exceptions that h5py raises for damaged files."""


def read_h5(path: PathLike) -> ReadTree:
    """All arrays of a result file, as nested dicts of numpy arrays (text as str or object arrays).

    A file that is damaged, holds a link or a type that no result has, or does not fit into memory
    is a DataError.
    """
    require_file(path, "result file")
    try:
        # file systems of clusters often have no locks
        with h5py.File(path, "r", locking=False) as file:
            return _read_group(file, {})
    except BROKEN as error:
        what, expected = "file is not a readable HDF5 file", "a result file written by soup_nlp"
        raise DataError(what, where=path, found=error, expected=expected) from error


def _read_group(group: h5py.Group, seen: dict[object, int], level: int = 0) -> ReadTree:
    """Arrays of a group; `seen` are bytes by the place of the objects that were read."""
    out: ReadTree = {}
    for name in group:
        link: Any = group.get(name, getlink=True)
        item: Any = None
        odd = "" if isinstance(link, h5py.HardLink) else type(link).__name__
        if not odd:
            item = group[name]
            odd = "groups within groups" if level > DEEPEST else _odd(item, seen)
        where = f"{group.file.filename}, {group.name.rstrip('/')}/{name}"
        if odd:
            raise DataError(
                "result holds what no result has",
                where=where,
                found=odd,
                expected=f"numbers or text under one name, in at most {DEEPEST} levels of groups",
            )
        if isinstance(item, h5py.Group):
            out[name] = _read_group(item, seen, level + 1)
        else:
            if item.nbytes > LARGE:
                require_memory(item.nbytes, "an array", where, "the file may be damaged")
            text = h5py.check_string_dtype(item.dtype)
            out[name] = np.asarray((item.asstr() if text else item)[()])
    return out


def _odd(item: Any, seen: dict[object, int]) -> str:
    """What no result has of an object; empty for nothing."""
    place = h5py.h5o.get_info(item.id).addr
    if place in seen:
        return "an object under two names"
    seen[place] = 0
    if isinstance(item, h5py.Group):
        return ""
    if not isinstance(item, h5py.Dataset):
        return type(item).__name__
    if item.shape is None or item.external or item.is_virtual:
        return "an array without values of its own"
    if item.dtype.kind not in "fiub" and not h5py.check_string_dtype(item.dtype):
        return f"type {item.dtype}"
    stored, whole = item.id.get_storage_size(), item.file.id.get_filesize()
    seen[place] = item.nbytes
    if item.nbytes > MOST_COMPRESSION * stored:
        return f"{item.nbytes} bytes of which {stored} are stored"
    arrays = sum(seen.values())
    return f"arrays of {arrays} bytes in {whole}" if arrays > MOST_OF_FILE * whole else ""


def require(tree: Mapping[str, Any], name: str) -> NDArray[Any]:
    """The array at "a/b" of a tree that was read; the error lists the existing ones."""
    here: Any = tree
    for key in name.split("/"):
        if not isinstance(here, Mapping) or key not in here:
            names = sorted(here) if isinstance(here, Mapping) else "an array, not a group"
            hint = "the file may come from another version, or the run ended early"
            raise DataError(f"result has no {name!r}", found=names, expected=repr(key), hint=hint)
        here = here[key]
    if isinstance(here, Mapping):
        raise DataError(f"{name!r} is a group, not an array", found=sorted(here))
    return np.asarray(here)
