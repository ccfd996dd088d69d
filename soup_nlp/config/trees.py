"""Trees of options: read from YAML with the line of every key, merged over presets, overridden.

Numbers and booleans are those of YAML 1.2: 1e-3 is a number, `no` is a word. A number that starts
with further zeros, such as 000138, is text: it names something.
"""

import copy
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from soup_nlp.errors import ConfigError
from soup_nlp.schema.section import Keys
from soup_nlp.storage.files import compose_yaml

Tree = dict[str, Any]

_WORDS = {"": None, "~": None, "null": None, "true": True, "false": False}
_INT = re.compile(r"[-+]?(0|[1-9]\d{0,99})")
_FLOAT = re.compile(
    r"[-+]?(\.\d+|(0|[1-9]\d*)(\.\d*)?)(e[-+]?\d+)?|[-+]?\.inf|\.nan", re.IGNORECASE
)


class Dumper(yaml.SafeDumper):
    """Quotes strings that YAML 1.1 or 1.2 would read as another type."""


Dumper.add_implicit_resolver(
    "tag:yaml.org,2002:float", re.compile(rf"(?i:{_FLOAT.pattern})\Z"), list("-+.0123456789")
)


def parse(text: str, source: str) -> tuple[Any, dict[Keys, str]]:
    """The content of a YAML text, and the line of every key."""
    lines: dict[Keys, str] = {}
    try:
        node = compose_yaml(text)
    except ValueError as error:
        mark = getattr(error.__cause__, "problem_mark", None)
        raise ConfigError(
            "text is not YAML of a problem file",
            where=f"{source}, line {mark.line + 1}" if mark else source,
            found=getattr(error.__cause__, "problem", None) or error,
        ) from error
    return None if node is None else _value(node, (), lines, source), lines


def _value(node: yaml.Node, path: Keys, lines: dict[Keys, str], source: str) -> Any:
    """The value of a node; fills in the line of every key, which may not be given twice."""
    if isinstance(node, yaml.SequenceNode):
        return [_value(item, path, lines, source) for item in node.value]
    if isinstance(node, yaml.MappingNode):
        out = {}
        for key, value in node.value:
            here = (*path, str(key.value))
            line = f"line {key.start_mark.line + 1}"
            if here in lines:
                where, found = f"{source}, {line}", ".".join(here)
                raise ConfigError("key is given twice", where=where, found=found)
            lines[here] = line
            out[here[-1]] = _value(value, here, lines, source)
        return out
    text = str(node.value)
    if isinstance(node, yaml.ScalarNode) and node.style is not None:
        # in quotes
        return text
    if text.lower() in _WORDS:
        return _WORDS[text.lower()]
    if _INT.fullmatch(text):
        return int(text)
    word = text.lower().replace(".inf", "inf").replace(".nan", "nan")
    return float(word) if _FLOAT.fullmatch(text) else text


PRESET_FILES: Mapping[str, Path] = {"paper": Path(__file__).with_name("paper.yaml")}
PRESETS: Mapping[str, Tree] = {
    name: parse(path.read_text("utf-8"), str(path))[0] for name, path in PRESET_FILES.items()
}
"""Options below the keys of a problem, by name: `preset: paper` is the method as printed."""


def merged(below: Mapping[str, Any], above: Mapping[str, Any]) -> Tree:
    """Both trees merged section by section; where a key is in both, `above` has the value."""
    out: Tree = copy.deepcopy(dict(below))
    for key, value in above.items():
        both = isinstance(value, Mapping) and isinstance(out.get(key), Mapping)
        out[key] = merged(out[key], value) if both else value
    return out


def override(tree: Tree, item: str) -> Keys:
    """Put the value of `a.b=value` into a tree, and return its keys."""
    key, eq, value = item.partition("=")
    path = tuple(key.strip().split("."))
    if not eq or not all(path):
        what, expected = "override is not key=value", "solver.max_iter=200"
        raise ConfigError(what, where="--set", found=item, expected=expected)
    node: Any = tree
    for part in path[:-1]:
        node = node.setdefault(part, {})
        if not isinstance(node, dict):
            what, expected = "override goes below a value", f"{part} is a section"
            raise ConfigError(what, where="--set", found=item, expected=expected)
    node[path[-1]] = parse(value, f"--set {item}")[0]
    return path
