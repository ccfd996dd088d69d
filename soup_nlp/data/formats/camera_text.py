"""Names and words of a camera file: JSON, YAML, INI, lines of names and numbers, NumPy arrays.

Nothing is interpreted here: a word is a number only for `camera_files`, and a name that occurs
twice stays twice.
"""

import contextlib
import json
import re
from collections.abc import Iterator
from typing import Any, TypeAlias

import yaml

from soup_nlp.data.formats.map_files import npy_array, read_npz
from soup_nlp.errors import DataError
from soup_nlp.storage.files import MOST_TEXT, PathLike, parse_yaml, read_bytes

Leaf: TypeAlias = tuple[tuple[str, ...], list[str]]
"""Names from the outermost to the innermost, and the words of the value."""

_SECTION = re.compile(r"\s*\[([^\[\],]*[A-Za-z][^\[\],]*)\]\s*")
_LIKE_NUMBER = re.compile(r"[-+.\d]|(?:nan|inf)\b", re.IGNORECASE)
_COLMAP_ROW = re.compile(r"(\d+)\s+([A-Z][A-Z_]+)\s+\d+\s+\d+\s+(.*)")
_COLMAP = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
}
"""Parameters of the models of COLMAP that have OpenCV's distortion."""


class _Pairs(list[tuple[str, Any]]):
    """A mapping that keeps a name that occurs twice."""


def leaves(path: PathLike) -> list[Leaf]:
    """The names and words of a camera file; ValueError for a content of none of these formats."""
    content = read_bytes(path, "camera file", most=MOST_TEXT)
    if content.startswith((b"\x93NUMPY", b"PK")):
        return list(_flat(_arrays(path, content)))
    utf16 = content.startswith((b"\xff\xfe", b"\xfe\xff"))
    text = content.decode("utf-16" if utf16 else "utf-8-sig")
    if "\0" in text:
        raise ValueError("binary content")
    if text.lstrip().startswith("<"):
        raise ValueError("XML")
    brackets = text.lstrip().startswith(("{", "[")) and not _SECTION.match(text)
    try:
        tree = _json(text) if brackets else _yaml(text)
        return list(_flat(tree) if isinstance(tree, list) else _lines(text))
    except RecursionError:
        raise ValueError("brackets are nested too deeply") from None


def _arrays(path: PathLike, content: bytes) -> Any:
    """The array of a .npy file, or the arrays of a .npz file by name."""
    try:
        one = content.startswith(b"\x93")
        stored = {"": npy_array(content, path, "")} if one else read_npz(path, "")
    except DataError as error:
        raise ValueError(f"a NumPy file that{error.what}: {error.found}") from None
    small = {name: values for name, values in stored.items() if values.size < 1000}
    tree = _Pairs((name, [repr(float(x)) for x in a.ravel()]) for name, a in small.items())
    return tree[0][1] if one and tree else tree


def _json(text: str) -> Any:
    """The tree of a JSON text, or of YAML in brackets."""
    try:
        return json.loads(
            text, object_pairs_hook=_Pairs, parse_float=str, parse_int=str, parse_constant=str
        )
    except ValueError as error:
        tree = _yaml(text)
        if not isinstance(tree, list):
            raise ValueError(f"damaged JSON ({error})") from None
        return tree


def _yaml(text: str) -> Any:
    """The tree of a YAML text with all values as written; None for other text."""
    trees: list[Any] = []
    # OpenCV's header and tag are no YAML, and ROS prints a line behind every message
    text = text.replace("!!opencv-matrix", "")
    parts = re.split(r"^(?:%YAML.*|---|\.\.\.)\s*$", text, flags=re.MULTILINE)
    try:
        for part in parts:
            parse_yaml(part, see=lambda node: trees.append(_tree(node)))
    except ValueError:
        return None
    if trees and all(isinstance(tree, _Pairs) for tree in trees):
        return _Pairs(pair for tree in trees for pair in tree)
    return trees[0] if len(trees) == 1 else None


def _tree(node: yaml.Node) -> Any:
    if isinstance(node, yaml.MappingNode):
        return _Pairs((str(key.value), _tree(value)) for key, value in node.value)
    return [_tree(item) for item in node.value] if isinstance(node.value, list) else node.value


def _flat(tree: Any, path: tuple[str, ...] = ()) -> Iterator[Leaf]:
    """The leaves of a tree; a list without names inside is one leaf."""
    if isinstance(tree, _Pairs):
        # OpenCV and ROS have rows, cols and data
        matrix = {"rows", "data"} <= {name for name, _ in tree}
        for name, value in tree:
            if not matrix:
                yield from _flat(value, (*path, *name.split(".")))
            elif name == "data":
                yield path, list(_split(str(value)))
    elif isinstance(tree, list) and _has_names(tree):
        for number, value in enumerate(tree):
            yield from _flat(value, (*path, str(number)))
    else:
        yield path, list(_split(str(tree)))


def _has_names(tree: list[Any]) -> bool:
    return any(
        isinstance(item, _Pairs) or (isinstance(item, list) and _has_names(item)) for item in tree
    )


def _split(text: str) -> Iterator[str]:
    """Words between blanks, brackets, quotes and commas, which may also be decimal ones."""
    for chunk in re.split(r"[\s;\[\](){}\"']+", text):
        decimal = re.fullmatch(r"[-+]?\d+,\d+,?", chunk)
        yield from (word for word in ([chunk] if decimal else chunk.split(",")) if word)


def _lines(text: str) -> Iterator[Leaf]:
    """Leaves of lines such as `fx: 500`, `fx 500 fy 500`, names above their numbers, numbers."""
    found: list[tuple[str, list[str], list[str]]] = [("", [], [])]
    section = ""
    for line in text.splitlines():
        line = re.sub(r"(?:#|//|%).*", "", line).strip()
        if head := _SECTION.fullmatch(line):
            section = head.group(1)
            found.append((section, [], []))
        elif row := _COLMAP_ROW.fullmatch(line):
            yield from _colmap(*row.groups())
        else:
            words = list(_split(re.sub(r"[:=]", " ", line)))
            last = max((k for k, word in enumerate(words) if _LIKE_NUMBER.match(word)), default=-1)
            for k, word in enumerate(words):
                _, names, values = found[-1]
                # a unit behind the last number belongs to the value
                if (k <= last and _LIKE_NUMBER.match(word)) or 0 <= last < k:
                    values.append(word)
                elif values or (names and k == 0):
                    found.append((section, [word], []))
                else:
                    names.append(word)
    for section, names, values in found:
        path = (section,) if section else ()
        if len(names) > 1 and len(names) == len(values):
            yield from (((*path, name), [value]) for name, value in zip(names, values))
        elif names or values:
            yield (*path, *"_".join(names).split(".")) if names else path, values


def _colmap(camera: str, model: str, values: str) -> Iterator[Leaf]:
    """A row of cameras.txt; the centre of COLMAP's first pixel is (0.5, 0.5), here (0, 0)."""
    path, words = (f"camera {camera}",), list(_split(values))
    yield (*path, "camera_model"), [model]
    names = _COLMAP.get(model, "").split()
    if names and len(words) != len(names):
        raise ValueError(f"{len(words)} parameters of a camera {model} of COLMAP, not {len(names)}")
    for name, word in zip(names, words):
        if name[0] == "c":
            with contextlib.suppress(ValueError):
                word = repr(float(word) - 0.5)
        yield (*path, name), [word]
