"""Results of a few text files in an output folder."""

from collections.abc import Mapping
from pathlib import Path

from soup_nlp.storage.folders import MARK, staged


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
