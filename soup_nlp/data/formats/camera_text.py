"""Names and words of a camera file: JSON, YAML, INI, lines of names and numbers, NumPy arrays.

Nothing is interpreted here: a word is a number only for `camera_files`, and a name that occurs
twice stays twice. In trees a mapping is a tuple of its pairs.
"""

import json
import re
from collections.abc import Iterator
from typing import Any, TypeAlias

import yaml

from soup_nlp.data.formats.map_files import read_arrays
from soup_nlp.storage.files import MOST_TEXT, PathLike, compose_yaml, read_bytes

Named: TypeAlias = list[tuple[str, list[str]]]
"""Names such as "cam0.intrinsics", empty for none, and the words of their values."""

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


def named_words(path: PathLike) -> Named:
    """The names and words of a camera file; ValueError for a content of none of these formats."""
    content = read_bytes(path, "camera file", most=MOST_TEXT)
    if content.startswith((b"\x93NUMPY", b"PK")):
        arrays = read_arrays(path, "camera file")
        return [(n, [repr(float(x)) for x in a.flat]) for n, a in arrays.items() if a.size < 1000]
    utf16 = content.startswith((b"\xff\xfe", b"\xfe\xff"))
    text = content.decode("utf-16" if utf16 else "utf-8-sig")
    if "\0" in text or text.lstrip().startswith("<"):
        raise ValueError("XML" if text.lstrip().startswith("<") else "binary content")
    brackets = text.lstrip().startswith(("{", "[")) and not _SECTION.match(text)
    try:
        tree = _json(text) if brackets else _yaml(text)
        return list(_lines(text) if tree is None else _leaves(tree))
    except RecursionError:
        raise ValueError("brackets are nested too deeply") from None


def _json(text: str) -> Any:
    """The tree of a JSON text, or of YAML in brackets."""
    try:
        return json.loads(
            text, object_pairs_hook=tuple, parse_float=str, parse_int=str, parse_constant=str
        )
    except ValueError as error:
        tree = _yaml(text)
        if tree is None:
            raise ValueError(f"damaged JSON ({error})") from None
        return tree


def _yaml(text: str) -> Any:
    """The tree of a YAML text, a mapping or a list; None for other text."""
    # OpenCV's header and tag are no YAML, and ROS prints a line behind every message
    text = text.replace("!!opencv-matrix", "")
    parts = re.split(r"^(?:%YAML.*|---|\.\.\.)\s*$", text, flags=re.MULTILINE)
    try:
        trees = [_tree(node) for node in map(compose_yaml, parts) if node is not None]
    except ValueError:
        return None
    if trees and all(isinstance(tree, tuple) for tree in trees):
        return sum(trees, ())
    return trees[0] if len(trees) == 1 and isinstance(trees[0], list) else None


def _tree(node: yaml.Node) -> Any:
    """All values as they are written."""
    if isinstance(node, yaml.MappingNode):
        return tuple((str(key.value), _tree(value)) for key, value in node.value)
    return [_tree(item) for item in node.value] if isinstance(node.value, list) else node.value


def _leaves(tree: Any, name: str = "") -> Iterator[tuple[str, list[str]]]:
    """The values of a tree; a list without names inside is one."""
    if isinstance(tree, list) and any(isinstance(item, tuple) for item in tree):
        tree = tuple((str(k), item) for k, item in enumerate(tree))
    if not isinstance(tree, tuple):
        yield name, words_of(str(tree))
        return
    # OpenCV and ROS have rows, cols and data
    matrix = {"rows", "data"} <= {key for key, _ in tree}
    for key, value in tree:
        if not matrix:
            yield from _leaves(value, f"{name}.{key}".lstrip("."))
        elif key == "data":
            yield name, words_of(str(value))


def words_of(text: str) -> list[str]:
    """Words between blanks, brackets, quotes and commas, which may also be decimal ones."""
    text = re.sub(r"[;\[\](){}\"']", " ", text)
    return re.findall(r"(?<!\S)[-+]?\d+,\d+,?(?!\S)|[^\s,]+", text)


def _lines(text: str) -> Iterator[tuple[str, list[str]]]:
    """Values of lines such as `fx: 500`, `fx 500 fy 500`, names above their numbers, numbers."""
    found: list[tuple[str, list[str], list[str]]] = [("", [], [])]
    section = ""
    for line in text.splitlines():
        line = re.sub(r"(?:#|//|%).*", "", line).strip()
        if head := _SECTION.fullmatch(line):
            section = f"{head.group(1)}."
            found.append((section, [], []))
        elif row := _COLMAP_ROW.fullmatch(line):
            yield from _colmap(row[1], row[2], words_of(row[3]))
        else:
            words = words_of(re.sub(r"[:=]", " ", line))
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
        if len(names) > 1 and len(names) == len(values):
            yield from ((section + name, [value]) for name, value in zip(names, values))
        elif names or values:
            yield (section + "_".join(names)).rstrip("."), values


def _colmap(camera: str, model: str, words: list[str]) -> Iterator[tuple[str, list[str]]]:
    """A row of cameras.txt; the centre of COLMAP's first pixel is (0.5, 0.5), here (0, 0)."""
    names = _COLMAP.get(model, "").split()
    if names and len(words) != len(names):
        raise ValueError(f"{len(words)} parameters of a camera {model} of COLMAP, not {len(names)}")
    yield f"camera {camera}.camera_model", [model]
    for name, word in zip(names, words):
        yield f"camera {camera}.{name}", [repr(float(word) - 0.5) if name[0] == "c" else word]
