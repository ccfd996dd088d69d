"""Files: checked reading, JSON and YAML with limits of size and nesting, and writing."""

import json
import os
import stat
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import yaml

from soup_nlp.errors import DataError, SoupError, printable

PathLike = str | os.PathLike[str]

MOST_BYTES = 2 << 30
"""Size limit of files of images or numbers, bytes."""
MOST_TEXT = 64 << 20
"""Size limit of text files, bytes."""
MOST_YAML = 1 << 20
"""Size limit of YAML texts, characters."""
MOST_NODES = 100_000
"""Limit of the values in a YAML text with expanded aliases."""
DEEPEST = 64
"""Limit of nesting in JSON and YAML."""
KINDS = {
    stat.S_ISDIR: "a folder",
    stat.S_ISFIFO: "a named pipe",
    stat.S_ISSOCK: "a socket",
    stat.S_ISCHR: "a device",
    stat.S_ISBLK: "a device",
}


def as_path(
    name: object, what: str = "file", *, error: type[SoupError] = DataError, home: bool = False
) -> Path:
    """A name as a path.

    `~` stands for the home folder if `home` is set.

    Raises:
        SoupError: it is no path, no name of a file, or names the home of an unknown user.
    """
    if not isinstance(name, str | os.PathLike) or isinstance(os.fspath(name), bytes):
        raise error(
            f"{what} is not named by a path",
            found=f"{type(name).__name__} {printable(name, 60)}",
            expected="text or a pathlib.Path",
        )
    try:
        bad = b"\0" in os.fsencode(name)
    except UnicodeEncodeError:  # half a surrogate pair
        bad = True
    if bad:
        raise error(
            f"name of {what} is no name of a file",
            where=name,
            expected="characters that file systems have, without NUL",
        )
    path = Path(name)
    if not home:
        return path
    try:
        return path.expanduser()
    except RuntimeError as problem:
        raise error(f"home folder of {what} is not known", where=name, found=problem) from None


is_file: Callable[[PathLike], bool] = os.path.isfile
"""Whether the path is a regular file; False for an impossible path."""
is_folder: Callable[[PathLike], bool] = os.path.isdir
"""Whether the path is a folder; False for an impossible path."""


def require_file(path: PathLike, what: str, *, error: type[SoupError] = DataError) -> Path:
    """The path, if it is a regular file.

    Raises:
        SoupError: it is not.
    """
    path = as_path(path, what, error=error)
    try:
        mode = os.stat(path).st_mode
    except FileNotFoundError:
        raise error(
            f"{what} is missing", where=path, expected="an existing file", hint=_neighbours(path)
        ) from None
    except OSError as problem:
        raise error(f"{what} cannot be read", where=path, found=problem.strerror) from None
    if not stat.S_ISREG(mode):
        kind = next((word for test, word in KINDS.items() if test(mode)), None)
        raise error(f"{what} cannot be read", where=path, found=kind, expected="a readable file")
    return path


def read_bytes(
    path: PathLike, what: str, *, error: type[SoupError] = DataError, most: int = MOST_BYTES
) -> bytes:
    """The content of a regular file.

    Pipes and devices, which may never end, are not opened, and the size is checked first.

    Raises:
        SoupError: the file is missing, not a regular one, empty, too large, or not readable.
    """
    path = require_file(path, what, error=error)
    try:
        size = path.stat().st_size
        content = b"" if size > most else path.read_bytes()
    except OSError as problem:
        raise error(f"{what} cannot be read", where=path, found=problem.strerror) from problem
    if not 0 < size <= most:
        raise error(
            f"{what} is {'too large' if size else 'empty'}",
            where=path,
            found=f"{size} bytes",
            expected=f"1 to {most} bytes",
        )
    return content


def _neighbours(path: Path) -> str:
    """Hint with the contents of the folder of a missing file."""
    if path.is_symlink():
        return "it is a symbolic link whose target is missing"
    try:
        names = sorted(os.listdir(path.parent))
    except OSError:
        return f"the folder {path.parent} does not exist; check the path"
    shown = ", ".join(names[:6]) + (" ..." if len(names) > 6 else "")
    return f"check the name; the folder holds: {shown or 'nothing'}"


def read_text(
    path: PathLike, what: str, *, error: type[SoupError] = DataError, most: int = MOST_TEXT
) -> str:
    """The content of a UTF-8 text file, see `read_bytes`."""
    try:
        return read_bytes(path, what, error=error, most=most).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise error(
            f"{what} is not text", where=path, found="binary content", expected="UTF-8 text"
        ) from None


# --- JSON and YAML --------------------------------------------------------------------------------


def parse_json(text: str) -> Any:
    """The value of a JSON text; its strings are made printable on one line.

    Raises:
        ValueError: it is not JSON, is nested too deeply, or has a number that is no float64.
    """
    try:
        return _plain(json.loads(text, parse_constant=_constant, parse_int=_whole), 0)
    except RecursionError:
        raise ValueError(f"brackets are nested more than {DEEPEST} deep") from None


def read_json(path: PathLike, what: str, *, error: type[SoupError] = DataError) -> Any:
    """The value of a JSON file, see `parse_json`.

    Raises:
        SoupError: the file cannot be read, or is not such JSON.
    """
    try:
        return parse_json(read_text(path, what, error=error))
    except ValueError as problem:
        raise error(f"{what} is not JSON", where=path, found=problem) from None


def _constant(word: str) -> float:
    raise ValueError(f"{word} is no number of JSON")


def _whole(text: str) -> int:
    if len(text) > 19:
        raise ValueError(f"number of {len(text)} digits")
    return int(text)


def _plain(value: Any, level: int) -> Any:
    """The value with its strings on one line each, control characters escaped.

    Raises:
        ValueError: it is nested too deeply.
    """
    if level > DEEPEST:
        raise ValueError(f"brackets are nested more than {DEEPEST} deep")
    if isinstance(value, str):
        return printable(value)
    if isinstance(value, Mapping):
        return {printable(key): _plain(item, level + 1) for key, item in value.items()}
    if isinstance(value, list):
        return [_plain(item, level + 1) for item in value]
    return value


def _check_node(node: yaml.Node) -> None:
    """Raise ValueError for a YAML document with too many values or nested too deeply."""
    sizes: dict[int, int] = {}

    def size(node: yaml.Node, level: int) -> int:
        """Number of values of a node with expanded aliases."""
        if level > DEEPEST:
            raise ValueError(f"brackets are nested more than {DEEPEST} deep")
        if not isinstance(node, yaml.CollectionNode):
            return 1
        if id(node) not in sizes:
            pairs = node.value if isinstance(node, yaml.MappingNode) else [node.value]
            sizes[id(node)] = 1 + sum(size(item, level + 1) for pair in pairs for item in pair)
        if sizes[id(node)] > MOST_NODES:
            raise ValueError(f"more than {MOST_NODES} values")
        return sizes[id(node)]

    size(node, 0)


def parse_yaml(
    text: str,
    kind: type[yaml.SafeLoader] = yaml.SafeLoader,
    see: Callable[[yaml.Node], None] = lambda node: None,
) -> Any:
    """The value of a YAML text.

    Args:
        text: The text.
        kind: Loader.
        see: Called with the document before its values are constructed.

    Raises:
        ValueError: it is not YAML (its cause is the YAML error), too long, nested too deeply, or
            has too many values.
    """
    if len(text) > MOST_YAML:
        raise ValueError(f"{len(text)} characters, at most {MOST_YAML} are read")
    try:
        loader = kind(text)
        try:
            node = loader.get_single_node()
            if node is None:
                return None
            _check_node(node)
            see(node)
            return loader.construct_document(node)
        finally:
            loader.dispose()
    except (yaml.YAMLError, RecursionError) as problem:
        raise ValueError(printable(problem)) from problem
    except (TypeError, AttributeError, LookupError) as problem:
        # PyYAML does not check what has a tag: `!!bool 5`, `!!timestamp x`, `!!int [1]`
        raise ValueError(f"a value does not fit its tag: {printable(problem)}") from problem


# --- writing ------------------------------------------------------------------------------------


def write_bytes(path: PathLike, data: bytes) -> None:
    """Write a file.

    Commands write into a folder of `folders.staged`, so that results appear whole or not at all.

    Raises:
        DataError: the folder is missing or cannot be written, or the disk is full.
    """
    target = Path(path)
    try:
        target.write_bytes(data)
    except OSError as error:
        reason = error.strerror or error
        raise DataError("file cannot be written", where=target, found=reason) from error


def write_text(path: PathLike, text: str) -> None:
    """Write a text file in UTF-8, see `write_bytes`."""
    # names of files may contain bytes that are not UTF-8
    write_bytes(path, text.encode("utf-8", "backslashreplace"))


def plain(obj: object) -> Any:
    """An object as JSON types: NumPy becomes Python, NaN and infinities None, paths text.

    Dataclasses become mappings; tuples and arrays become lists.

    Raises:
        DataError: a type that JSON does not have.
    """
    # imported on use, as NumPy is: processes that only move files need neither
    from pydantic_core import to_jsonable_python

    return to_jsonable_python(obj, inf_nan_mode="null", fallback=_builtin)


def _builtin(obj: object) -> Any:
    """An object of a type that pydantic does not know as one that it knows."""
    if hasattr(obj, "tolist"):
        return obj.tolist()
    if isinstance(obj, Mapping):
        return dict(obj)
    raise DataError(
        "value cannot be written as JSON",
        found=type(obj).__name__,
        expected="numbers, text, mappings, lists, arrays or dataclasses",
    )


def write_json(path: PathLike, obj: object) -> None:
    """Write an object as JSON (see `plain`); two-space indent, UTF-8.

    Raises:
        DataError: the object holds a type that JSON does not have, or the file cannot be written.
    """
    text = json.dumps(plain(obj), indent=2, ensure_ascii=False, allow_nan=False)
    write_text(path, text + "\n")
