"""Strict models for problem files, made from the records that own the defaults."""

from __future__ import annotations

import inspect
import re
import typing
from collections.abc import Callable, Mapping
from dataclasses import MISSING, fields
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, create_model

from soup_nlp.data import flow_options


class Strict(BaseModel):
    """Base of every section: unknown keys and conversions between types are errors."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True)


UNLIMITED = (None, None)

RANGES: Mapping[str, tuple[float | None, float | None]] = {
    **dict.fromkeys(("eps", "tol", "presolve_tol", "max_seconds"), (1e-12, None)),
    **dict.fromkeys(("leak_arap", "theta", "occluded_confidence"), (0, 1)),
    **dict.fromkeys(("samples", "dominant", "pieces", "piece_size"), (1, None)),
    "presolve_iterations": (1, None),
    "depth_ratio": (1, None),
    "min_facing": (0, 0.5),
    **flow_options.RANGES,
    "tau": (1e-6, None),
    "limit": (1e-6, None),
    "support": (1, None),
    "particles": (2, None),
    "keep": (0, 0.9),
    "depth_reach": (1, None),
    "trws_iterations": (1, None),
}
"""Smallest and largest value by name; a number that is not named here is at least 0."""


def mirror(
    source: type | Callable[..., Any],
    name: str,
    *,
    module: str,
    leave_out: tuple[str, ...] = (),
    choices: Mapping[str, tuple[str, ...]] | None = None,
    defaults: Mapping[str, float] | None = None,
) -> type[Strict]:
    """Strict model with the fields, defaults and descriptions of a dataclass or a function.

    Args:
        source: Dataclass, or function whose parameters with a default are taken.
        name: Of the model.
        module: Where the model stands under this name, so that what holds it can be pickled.
        leave_out: Fields that a problem file does not set.
        choices: Allowed words of fields that are plain strings in the source.
        defaults: Other defaults than the source's; a problem file that sets one field of the
            section keeps those of the others.
    """
    hints = typing.get_type_hints(source)
    made: dict[str, Any] = {}
    for key, default in {**_defaults(source), **(defaults or {})}.items():
        if key not in leave_out:
            words = (choices or {}).get(key)
            kind = Literal.__getitem__(words) if words else _kind(key, hints[key], default)
            made[key] = (kind, _plain(default))
    return create_model(
        name, __base__=Strict, __doc__=inspect.getdoc(source), __module__=module, **made
    )


def _defaults(source: type | Callable[..., Any]) -> dict[str, Any]:
    if not isinstance(source, type):
        parameters = inspect.signature(source).parameters.values()
        return {p.name: p.default for p in parameters if p.default is not p.empty}
    out = {}
    for f in fields(source):
        factory: Any = f.default_factory
        out[f.name] = factory() if f.default is MISSING else f.default
    return out


def _plain(value: Any) -> Any:
    """A default as YAML has it: lists for tuples, dicts for mappings."""
    if isinstance(value, tuple):
        return list(value)
    return dict(value) if isinstance(value, Mapping) else value


def _kind(key: str, hint: Any, default: Any) -> Any:
    """The type of a field with its range."""
    if isinstance(default, tuple):
        positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
        return Annotated[list[positive], Field(min_length=1)]
    if isinstance(default, Mapping):
        return dict[str, bool | int | float | str]
    if key.startswith("sigma"):
        # a truncation may be .inf: the untruncated norm
        return Annotated[float, Field(gt=0)]
    if hint in (float, int):
        low, high = RANGES.get(key, (0, None))
        return Annotated[
            hint, Field(ge=low, le=high, allow_inf_nan=False if hint is float else None)
        ]
    return hint


def attribute_docs(text: str | None) -> dict[str, str]:
    """What a docstring says of each attribute or argument, one line each.

    Args:
        text: Docstring with an `Attributes:` or `Args:` section.
    """
    lines = inspect.cleandoc(text or "").splitlines()
    heads = [k for k, line in enumerate(lines) if line.rstrip() in ("Attributes:", "Args:")]
    out: dict[str, str] = {}
    names: list[str] = []
    for line in lines[heads[0] + 1 :] if heads else []:
        entry = re.match(r" {4}(\w+(?:, \w+)*): (.*)", line)
        if entry:
            names = entry[1].split(", ")
            out.update(dict.fromkeys(names, entry[2].strip()))
        elif line.startswith(" " * 8) and names:
            out.update({n: f"{out[n]} {line.strip()}" for n in names})
        elif line.strip():
            break
    return out
