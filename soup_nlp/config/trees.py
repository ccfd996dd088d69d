"""Trees of options: read from YAML with the line of every key, merged over presets, overridden.

Numbers and booleans are those of YAML 1.2: 1e-3 and 010 are numbers, `no` is a word.
"""

import copy
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from soup_nlp.errors import ConfigError
from soup_nlp.schema.section import Keys
from soup_nlp.storage.files import parse_yaml

Tree = dict[str, Any]


class _Loader(yaml.SafeLoader):
    """Reads numbers and booleans of version 1.2."""


class Dumper(yaml.SafeDumper):
    """Quotes strings that YAML 1.1 or 1.2 would read as another type."""


_Loader.yaml_implicit_resolvers = {
    first: [(tag, rule) for tag, rule in rules if tag.split(":")[-1] in ("null", "merge")]
    for first, rules in yaml.SafeLoader.yaml_implicit_resolvers.items()
}
_FLOAT = r"[-+]?(\.\d+|\d+(\.\d*)?)([eE][-+]?\d+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)"
for _tag, _rule, _first in (
    ("bool", r"true|false|True|False|TRUE|FALSE", "tTfF"),
    ("int", r"[-+]?\d+", "-+0123456789"),
    ("float", _FLOAT, "-+.0123456789"),
):
    for _class in (_Loader, Dumper):
        _class.add_implicit_resolver(
            f"tag:yaml.org,2002:{_tag}", re.compile(rf"(?:{_rule})\Z"), list(_first)
        )
# 010 is ten, not eight
_Loader.add_constructor("tag:yaml.org,2002:int", lambda loader, node: int(node.value))
_Loader.add_constructor(
    "tag:yaml.org,2002:float",
    lambda loader, node: float(node.value.lower().replace(".inf", "inf").replace(".nan", "nan")),
)


def parse(text: str, source: str) -> tuple[Any, dict[Keys, str]]:
    """The content of a YAML text, and the line of every key."""
    lines: dict[Keys, str] = {}
    try:
        return parse_yaml(text, _Loader, lambda node: _locate(node, (), lines, source)), lines
    except ValueError as error:
        mark = getattr(error.__cause__, "problem_mark", None)
        raise ConfigError(
            "text is not YAML",
            where=f"{source}, line {mark.line + 1}" if mark else source,
            found=getattr(error.__cause__, "problem", None) or error,
        ) from error


def _locate(node: yaml.Node, path: Keys, lines: dict[Keys, str], source: str) -> None:
    """Fill in the line of every key; a key that is given twice is an error."""
    if not isinstance(node, yaml.MappingNode):
        return
    for key, value in node.value:
        here = (*path, str(key.value))
        line = f"line {key.start_mark.line + 1}"
        if here in lines:
            raise ConfigError("key is given twice", where=f"{source}, {line}", found=".".join(here))
        lines[here] = line
        _locate(value, here, lines, source)


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
        raise ConfigError(
            "override is not key=value", where="--set", found=item, expected="solver.max_iter=200"
        )
    node: Any = tree
    for part in path[:-1]:
        node = node.setdefault(part, {})
        if not isinstance(node, dict):
            raise ConfigError(
                "override goes below a value",
                where="--set",
                found=item,
                expected=f"{part} is a section",
            )
    node[path[-1]] = parse(value, f"--set {item}")[0]
    return path
