"""Files: checked reading, JSON and YAML with limits of size and nesting, and writing.

What cannot be read is a SoupError of the type that the caller asks for, with the name `what` of the
file; what cannot be written is a DataError.
"""

import json
import os
import stat
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import TypeAdapter, ValidationError
from pydantic_core import to_jsonable_python

from soup_nlp.errors import DataError, SoupError, printable

PathLike = str | os.PathLike[str]
Kind = TypeVar("Kind")

MOST_BYTES = 2 << 30
"""Size limit of files of images or numbers, bytes."""
MOST_TEXT = 64 << 20
"""Size limit of text files, bytes."""
MOST_YAML = 1 << 20
"""Size limit of YAML texts, characters."""


def as_path(
    name: object, what: str = "file", *, error: type[SoupError] = DataError, home: bool = False
) -> Path:
    """A name as a path; `~` stands for the home folder if `home` is set."""
    try:
        path: Any = name
        if b"\0" in os.fsencode(path):
            raise ValueError("a NUL character")
        return Path(path).expanduser() if home else Path(path)
    except (TypeError, ValueError, RuntimeError) as problem:
        raise error(
            f"{what} is not named by a path",
            found=f"{type(name).__name__} {printable(name, 60)}: {problem}",
            expected="text or a pathlib.Path, of characters that file systems have",
        ) from None


is_file: Callable[[PathLike], bool] = os.path.isfile
"""Whether the path is a regular file; False for an impossible path."""
is_folder: Callable[[PathLike], bool] = os.path.isdir
"""Whether the path is a folder; False for an impossible path."""


def require_file(path: PathLike, what: str, *, error: type[SoupError] = DataError) -> Path:
    """The path, if it is a regular file."""
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
        found = "a folder" if stat.S_ISDIR(mode) else "a pipe, socket or device"
        raise error(f"{what} cannot be read", where=path, found=found, expected="a readable file")
    return path


def read_bytes(
    path: PathLike, what: str, *, error: type[SoupError] = DataError, most: int = MOST_BYTES
) -> bytes:
    """The content of a regular file, of 1 to `most` bytes; pipes, which may never end, are none."""
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


def read_text(path: PathLike, what: str, *, error: type[SoupError] = DataError) -> str:
    """The content of a UTF-8 text file, see `read_bytes`."""
    try:
        return read_bytes(path, what, error=error, most=MOST_TEXT).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise error(
            f"{what} is not text", where=path, found="binary content", expected="UTF-8 text"
        ) from None


# --- JSON and YAML --------------------------------------------------------------------------------


def parse_json(text: str) -> Any:
    """The value of a JSON text; its strings are made printable on one line.

    ValueError if it is not JSON, is nested too deeply, or has a number that is no float64.
    """
    try:
        return _printable(json.loads(text, parse_constant=_constant))
    except RecursionError:
        raise ValueError("brackets are nested too deeply") from None


_adapter: Callable[[Any], TypeAdapter[Any]] = lru_cache(TypeAdapter)
"""Validator of a type; making one takes tens of milliseconds."""


def fits(value: object, kind: Any) -> bool:
    """Whether a value of JSON has a type, such as a TypedDict; further entries stay."""
    try:
        _adapter(kind).validate_python(value, strict=True)
    except ValidationError:
        return False
    return True


def read_json(
    path: PathLike, what: str, kind: type[Kind], *, error: type[SoupError] = DataError
) -> Kind:
    """The value of a JSON file, see `parse_json`, which must have a type, see `fits`."""
    try:
        value: Kind = parse_json(read_text(path, what, error=error))
        _adapter(kind).validate_python(value, strict=True)
    except ValidationError as problem:
        first = problem.errors()[0]
        raise error(
            f"{what} lacks an entry, or has one that cannot be used",
            where=f"{path}, {'.'.join(map(str, first['loc'])) or 'top'}",
            found=first["input"] if first["type"] != "missing" else None,
            expected=first["msg"],
            hint="it may be damaged, or of another version: make it again",
        ) from None
    except ValueError as problem:
        raise error(f"{what} is not JSON", where=path, found=problem) from None
    return value


def _constant(word: str) -> float:
    raise ValueError(f"{word} is no number of JSON")


def _printable(value: Any) -> Any:
    if isinstance(value, str):
        return printable(value)
    if isinstance(value, Mapping):
        return {printable(key): _printable(item) for key, item in value.items()}
    return [_printable(item) for item in value] if isinstance(value, list) else value


def compose_yaml(text: str) -> yaml.Node | None:
    """The nodes of a YAML text without aliases and tags; None for an empty one.

    ValueError if it is not YAML (its cause is the YAML error), too long, nested too deeply, or has
    an alias, by which a short text may have many values, or a tag.
    """
    if len(text) > MOST_YAML:
        raise ValueError(f"{len(text)} characters, at most {MOST_YAML} are read")
    try:
        for token in yaml.scan(text) if "*" in text or "!" in text else ():
            if isinstance(token, yaml.AliasToken | yaml.TagToken):
                line = token.start_mark.line + 1
                raise ValueError(f"an alias (*name) or a tag (!name) in line {line}")
        return yaml.compose(text, yaml.SafeLoader)
    except (yaml.YAMLError, RecursionError) as problem:
        raise ValueError(printable(problem)) from problem


# --- writing ------------------------------------------------------------------------------------


def write_bytes(path: PathLike, data: bytes) -> None:
    """Write a file; commands do so in a folder of `folders.staged`."""
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

    Dataclasses become mappings; tuples and arrays become lists; other types are a DataError.
    """
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
    """Write an object as JSON, see `plain`; two-space indent, UTF-8."""
    text = json.dumps(plain(obj), indent=2, ensure_ascii=False, allow_nan=False)
    write_text(path, text + "\n")
