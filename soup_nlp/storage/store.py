"""Results as HDF5, with units for every array.

Reading leaves links out and checks sizes before it allocates memory.
"""

import json
import platform
from collections.abc import Mapping
from fnmatch import fnmatchcase
from functools import reduce
from io import BytesIO
from operator import getitem
from types import MappingProxyType
from typing import Any, NamedTuple, TypeAlias

import h5py
import numpy as np
from numpy.typing import NDArray

from soup_nlp.errors import DataError
from soup_nlp.storage.files import PathLike, require_file, write_bytes
from soup_nlp.storage.system import require_memory
from soup_nlp.storage.versions import versions

SCHEMA = 1
"""Version of the layout of result files; changes when readers have to change."""

FORMAT = ("v110", "v110")
"""Version of the HDF5 format: the oldest one with checksums of all parts."""

Tree: TypeAlias = Mapping[str, Any]
"""Numbers and arrays of them by name, in nested mappings."""

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
    attrs: Mapping[str, str],
    rows: Mapping[str, Row] = MappingProxyType({}),
) -> None:
    """Write a result file.

    Args:
        path: File to write; its folder must exist.
        tree: The arrays. Each becomes a dataset with the attributes `units`, `description` and
            `shape_letters`, each mapping a group.
        attrs: Root attributes beside `schema`, `versions` and `machine`.
        rows: Descriptions of the arrays, see `parse_table`.
    """
    about = {"versions": json.dumps(versions()), "machine": platform.platform()}
    try:
        # written in memory, since HDF5 would end the process on a full disk
        image = BytesIO()
        with h5py.File(image, "w", track_order=True, libver=FORMAT) as file:
            file.attrs["schema"] = SCHEMA
            for key, text in {**attrs, **about}.items():
                # of fixed length, since HDF5 has no checksum for variable length
                data = text.encode()
                file.attrs.create(key, data, dtype=h5py.string_dtype(length=max(1, len(data))))
            _write_group(file, tree, rows)
    except (OSError, TypeError, ValueError, RuntimeError) as error:
        raise DataError("cannot write the HDF5 file", where=path, found=error) from error
    write_bytes(path, image.getvalue())


def _write_group(group: h5py.Group, tree: Tree, rows: Mapping[str, Row]) -> None:
    for name, item in tree.items():
        if isinstance(item, Mapping):
            _write_group(group.require_group(name), item, rows)
            continue
        array = _write_array(group, name, np.asarray(item))
        row = row_of(rows, array.name.removeprefix("/")) or Row()
        array.attrs.update(units=row.unit, description=row.text, shape_letters=row.axes)


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
    """All arrays of a result file, as nested dicts of numpy arrays.

    Links are left out, and an object with two names has one of them. A file that is damaged, holds
    a type that no result has, or does not fit into memory is a DataError.
    """
    require_file(path, "result file")
    out: ReadTree = {}
    sizes: list[int] = []

    def read(name: str, item: Any) -> None:
        """Read an object; h5py comes to each of them once, to groups before what is in them."""
        *above, last = name.split("/")
        place = reduce(getitem, above, out)
        if isinstance(item, h5py.Group) and len(above) < DEEPEST:
            place[last] = {}
            return
        where = f"{path}, /{name}"
        if odd := _odd(item, sizes):
            raise DataError(
                "result holds what no result has",
                where=where,
                found=odd,
                expected=f"numbers, in at most {DEEPEST} levels of groups",
            )
        if item.nbytes > LARGE:
            require_memory(item.nbytes, "an array", where, "the file may be damaged")
        place[last] = np.asarray(item[()])

    try:
        # file systems of clusters often have no locks
        with h5py.File(path, "r", locking=False) as file:
            file.visititems(read)
    except BROKEN as error:
        what, expected = "file is not a readable HDF5 file", "a result file written by soup_nlp"
        raise DataError(what, where=path, found=error, expected=expected) from error
    return out


def _odd(item: Any, sizes: list[int]) -> str:
    """What no result has of an object; empty for nothing. `sizes` are bytes of all arrays."""
    if isinstance(item, h5py.Group):
        return "groups within groups"
    if not isinstance(item, h5py.Dataset):
        return type(item).__name__
    if item.shape is None or item.external or item.is_virtual:
        return "an array without values of its own"
    if item.dtype.kind not in "fiub":
        return f"type {item.dtype}"
    stored, whole = item.id.get_storage_size(), item.file.id.get_filesize()
    sizes.append(item.nbytes)
    if item.nbytes > MOST_COMPRESSION * stored:
        return f"{item.nbytes} bytes of which {stored} are stored"
    return f"arrays of {sum(sizes)} bytes in {whole}" if sum(sizes) > MOST_OF_FILE * whole else ""


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
