"""What is wrong with a problem, in words: file, line, key, found, allowed, nearest spelling."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ValidationError

from soup_nlp.errors import ConfigError

Place = tuple[str, ...]


def explain(
    error: ValidationError,
    model: type[BaseModel],
    tree: Mapping[str, Any],
    source: str,
    lines: Mapping[Place, str],
) -> ConfigError:
    """The first mistake as a ConfigError, with the number of further ones.

    Args:
        error: What validation found.
        model: Model of the whole problem.
        tree: The problem as it was given, overrides included.
        source: Name of the file, or "command line".
        lines: Where a key comes from, by its place: "line 7" or "--set".
    """
    by_place: dict[Place, list[Any]] = {}
    for item in error.errors():
        by_place.setdefault(_place(item["loc"], tree, item["type"]), []).append(item)
    place, found = next(iter(by_place.items()))
    first = found[0]
    key = ".".join(place) or "(top)"
    origin = lines.get(place) or next(
        (lines[place[:k]] for k in range(len(place) - 1, 0, -1) if place[:k] in lines), ""
    )
    where = ", ".join(x for x in (source, origin, f"key {key}") if x)
    others = len(by_place) - 1
    more = f" (and {others} more {'mistake' if others == 1 else 'mistakes'})" if others else ""
    if first["type"] == "extra_forbidden":
        allowed = _keys(model, place[:-1], tree)
        return ConfigError(
            "unknown key" + more,
            where=where,
            found=place[-1],
            expected="one of " + ", ".join(allowed),
            hint=_near(place[-1], allowed) or _elsewhere(model, place[-1], tree),
        )
    if first["type"] in ("missing", "union_tag_not_found"):
        kinds = first.get("ctx", {}).get("discriminator")
        missing = f"{key}.kind" if kinds else key
        return ConfigError(
            "missing key" + more,
            where=where,
            expected=missing,
            hint="every input has a kind, see problems/" if kinds else None,
        )
    allowed = [w for item in found for w in _words(item)]
    value = first["input"]
    if first["type"] == "union_tag_invalid":
        key, value = f"{key}.kind", value.get("kind") if isinstance(value, Mapping) else value
        where = ", ".join(
            x for x in (source, lines.get((*place, "kind"), origin), f"key {key}") if x
        )
    return ConfigError(
        "value does not fit" + more,
        where=where,
        found=repr(value),
        expected=", or ".join(dict.fromkeys(_expected(item) for item in found)),
        hint=_near(str(value), allowed) or _advice(first),
    )


def _place(loc: tuple[int | str, ...], tree: Any, kind: str) -> Place:
    """Keys of the file that a location means; names of types and tags are left out."""
    if len(loc) > 1 and loc[0] == "input":
        # the kind of input stands between its section and its key
        loc = (loc[0], *loc[2:])
    out: list[str] = []
    for k, part in enumerate(loc):
        inside = isinstance(tree, Mapping) and part in tree
        item = isinstance(tree, list) and isinstance(part, int) and part < len(tree)
        if inside or item:
            tree = tree[part]
            out.append(str(part))
        elif kind == "missing" and k == len(loc) - 1:
            out.append(str(part))
    return tuple(out)


def _models(model: type[BaseModel], tree: Mapping[str, Any]) -> dict[Place, list[str]]:
    """Keys of every section, by its place."""
    out: dict[Place, list[str]] = {(): [k for k in model.model_fields if k != "base"]}
    for key, info in model.model_fields.items():
        kind: Any = info.annotation
        below = tree.get(key)
        if info.discriminator:
            tag = below.get("kind") if isinstance(below, Mapping) else None
            members = [
                m for m in kind.__args__ if tag in m.model_fields["kind"].annotation.__args__
            ]
            kind = members[0] if members else None
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            inner = _models(kind, below if isinstance(below, Mapping) else {})
            out |= {(key, *place): names for place, names in inner.items()}
    return out


def _keys(model: type[BaseModel], place: Place, tree: Mapping[str, Any]) -> list[str]:
    return sorted(_models(model, tree).get(place, []))


def _near(word: str, allowed: list[str]) -> str | None:
    near = difflib.get_close_matches(word.lower(), allowed, 1, 0.6)
    return f"did you mean {near[0]}?" if near else None


def _elsewhere(model: type[BaseModel], key: str, tree: Mapping[str, Any]) -> str | None:
    """A section that does have the key."""
    places = [".".join((*p, key)) for p, names in _models(model, tree).items() if key in names]
    return f"did you mean {places[0]}?" if places else None


def _words(item: Mapping[str, Any]) -> list[str]:
    """Words that a choice allows."""
    context = item.get("ctx", {})
    text = context.get("expected", "") if item["type"] == "literal_error" else ""
    text = context.get("expected_tags", text)
    return re.findall(r"'([^']*)'", str(text))


def _expected(item: Mapping[str, Any]) -> str:
    """What was allowed, without the library's `Input should be`."""
    words = _words(item)
    if words:
        return ("one of " if len(words) > 1 else "") + ", ".join(words)
    if item["type"] in ("model_type", "model_attributes_type", "dict_type"):
        return "a section with keys of its own"
    if item["type"] in ("too_short", "too_long"):
        limits = item["ctx"]
        return f"a list of {limits.get('min_length', limits.get('max_length'))} or " + (
            "more" if item["type"] == "too_short" else "fewer"
        )
    return str(item["msg"]).removeprefix("Input should be ")


def _advice(item: Mapping[str, Any]) -> str | None:
    if item["type"] == "string_type" and isinstance(item["input"], int | float):
        return f'write it in quotes: "{item["input"]}" (YAML drops leading zeros)'
    return None
