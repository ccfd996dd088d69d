"""The record of the other files in result.h5: their SHA-256 and a copy of summary.json."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from soup_nlp.storage.folders import staged
from soup_nlp.storage.h5_files import RECORD, read_h5
from soup_nlp.storage.mark import digest_of, files_in
from soup_nlp.storage.store import Array, Tree, replace_group


def record_of(folder: Path) -> Tree:
    """The record of the files in a folder, which must hold summary.json."""
    names = [name for name in files_in(folder) if name != "result.h5"]
    text = (folder / "summary.json").read_text(encoding="utf-8")
    return _record({name: digest_of(folder / name) for name in names}, text)


def _record(files: Mapping[str, str], summary: str) -> Tree:
    return {
        "files": Array(np.array(list(files)), "1", "names of the other files", "F"),
        "sha256": Array(np.array(list(files.values())), "1", "their SHA-256", "F"),
        "summary": Array(summary, "1", "summary.json"),
    }


@contextmanager
def extended(folder: Path, overwrite: bool = False) -> Iterator[Path]:
    """An empty folder whose files are added to the result in `folder` and to its record.

    Raises:
        DataError: a file cannot be written, or one of the user has the name of a new file and
            `overwrite` is not set.
    """
    with staged(folder, overwrite=overwrite) as new:
        yield new
        result = folder / "result.h5"
        tree = read_h5(result)
        files = recorded_files(tree)
        if files:
            files |= {name: digest_of(new / name) for name in files_in(new)}
            own = _record(files, str(tree[RECORD]["summary"]))
            replace_group(result, new / "result.h5", RECORD, own)


def recorded_files(tree: Mapping[str, Any]) -> dict[str, str]:
    """SHA-256 of the files of a result by name, from its record; {} without a record."""
    own = tree.get(RECORD, {})
    if not {"files", "sha256"} <= own.keys():
        return {}
    return dict(zip(map(str, own["files"]), map(str, own["sha256"]), strict=True))
