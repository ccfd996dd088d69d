"""YAML of problem files: numbers as in version 1.2, the line of every key."""

import re
from typing import Any

import yaml

from soup_nlp.errors import ConfigError
from soup_nlp.schema.section import Keys
from soup_nlp.storage.files import parse_yaml


class _Loader(yaml.SafeLoader):
    """YAML with the numbers and booleans of version 1.2: 1e-3 is a number, `no` is a word."""


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
