"""Named sets of options below the keys of a problem; `preset: paper` is the method as printed."""

import copy
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from soup_nlp.config.yaml_text import parse

Tree = dict[str, Any]
_FILES = {"paper": Path(__file__).with_name("paper.yaml")}
PRESETS: Mapping[str, Tree] = {k: parse(p.read_text("utf-8"), str(p))[0] for k, p in _FILES.items()}
"""Options by name."""


def with_preset(tree: Mapping[str, Any]) -> Tree:
    """The tree of a problem merged over the options of its preset; unchanged without a preset.

    An unknown name is rejected later, by the validation of the problem.
    """
    name = tree.get("preset")
    return _over(PRESETS.get(name, {}) if isinstance(name, str) else {}, tree)


def _over(below: Mapping[str, Any], above: Mapping[str, Any]) -> Tree:
    """Both trees merged section by section; where a key is in both, `above` has the value."""
    out: Tree = copy.deepcopy(dict(below))
    for key, value in above.items():
        both = isinstance(value, Mapping) and isinstance(out.get(key), Mapping)
        out[key] = _over(out[key], value) if both else value
    return out


def leaves(tree: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted key and value of every option."""
    for key, value in tree.items():
        if isinstance(value, Mapping):
            yield from leaves(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def as_override(key: str, value: Any) -> str:
    """An option as `a.b=value`, as `--set` takes it."""
    return f"{key}={'.inf' if value == float('inf') else json.dumps(value)}"


def overrides_of(name: str) -> tuple[str, ...]:
    """The options of a preset as `--set` takes them."""
    return tuple(as_override(key, value) for key, value in leaves(PRESETS[name]))


def dump_preset(name: str) -> str:
    """The options of a preset as YAML."""
    return _FILES[name].read_text("utf-8")
