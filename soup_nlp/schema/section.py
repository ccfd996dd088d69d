"""Base class of every option record and section of a problem file, its limits, and its errors.

A validation error becomes a message: where, found, expected, nearest spelling. Larger inputs than
the limits are of no use and would take all memory or time.
"""

import difflib
import re
import reprlib
from collections.abc import Mapping
from typing import Annotated, Any, Self, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic._internal._model_construction import ModelMetaclass

from soup_nlp.errors import ConfigError, DataError, printable

Keys = tuple[str, ...]
"""Keys that lead to a value, from the top."""
_SHORT = reprlib.Repr()
"""Prints values of any size on a short line."""
_SHORT.maxstring = _SHORT.maxother = 80


def explain(
    error: ValidationError,
    model: type[BaseModel],
    tree: Mapping[str, Any],
    source: str,
    lines: Mapping[Keys, str],
) -> ConfigError:
    """The first mistake of a validation as a ConfigError, with the number of further ones.

    `tree` is the problem before validation, overrides included; `source` and `lines`, the origin of
    a key by its path such as "line 7" or "--set", tell where a key is.
    """
    by_key: dict[Keys, list[Any]] = {}
    for item in error.errors():
        by_key.setdefault(_keys_of(item["loc"], tree, item["type"]), []).append(item)
    path, mistakes = next(iter(by_key.items()))
    kind, value = mistakes[0]["type"], mistakes[0]["input"]
    if kind.startswith("union_tag"):
        path, value = (*path, "kind"), value.get("kind") if isinstance(value, Mapping) else value
    key = ".".join(path) or "(top)"
    origins = (lines[path[:k]] for k in range(len(path), 0, -1) if path[:k] in lines)
    where = ", ".join(x for x in (source, next(origins, ""), f"key {key}") if x)
    others = len(by_key) - 1
    suffix = f" (and {others} more {'mistake' if others == 1 else 'mistakes'})" if others else ""
    if kind == "extra_forbidden":
        sections = _sections(model, tree).items()
        keys = {p: [k for k in s.model_fields if k != "base"] for p, s in sections}
        allowed = sorted(keys.get(path[:-1], []))
        homes = [".".join((*p, path[-1])) for p, names in keys.items() if path[-1] in names]
        return ConfigError(
            "unknown key" + suffix,
            where=where,
            found=path[-1],
            expected="one of " + ", ".join(allowed),
            hint=nearest(path[-1], allowed) or (f"did you mean {homes[0]}?" if homes else None),
        )
    if kind in ("missing", "union_tag_not_found"):
        hint = None if kind == "missing" else "every input has a kind; soup-nlp list names examples"
        return ConfigError("missing key" + suffix, where=where, expected=key, hint=hint)
    hint = nearest(printable(value, 60), [word for item in mistakes for word in _words(item)])
    if kind == "string_type" and isinstance(value, int | float):
        hint = "write it in quotes"
    return ConfigError(
        "value does not fit" + suffix,
        where=where,
        found=_SHORT.repr(value),
        expected=", or ".join(dict.fromkeys(map(_expected, mistakes))),
        hint=hint,
    )


def _keys_of(loc: tuple[int | str, ...], tree: Any, kind: str) -> Keys:
    """Keys of the file that a location names; names of types and tags are left out."""
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


def _sections(model: type[BaseModel], tree: Mapping[str, Any]) -> dict[Keys, type[BaseModel]]:
    """Model of every section, by its path of keys."""
    out: dict[Keys, type[BaseModel]] = {(): model}
    for key, info in model.model_fields.items():
        section: Any = info.annotation
        below = tree.get(key)
        below = below if isinstance(below, Mapping) else {}
        if info.discriminator:
            kind = below.get("kind")
            tagged = {m: m.model_fields["kind"].annotation for m in get_args(section)}
            section = next((m for m, tags in tagged.items() if kind in get_args(tags)), None)
        if isinstance(section, type) and issubclass(section, BaseModel):
            out |= {(key, *path): part for path, part in _sections(section, below).items()}
    return out


def nearest(word: str, allowed: list[str]) -> str | None:
    """The hint "did you mean ...?" with the nearest allowed word; None if no word is similar."""
    near = difflib.get_close_matches(word.lower(), allowed, 1, 0.6)
    return f"did you mean {near[0]}?" if near else None


def _words(item: Mapping[str, Any]) -> list[str]:
    """Allowed words of a mistake in a choice of words."""
    context = item.get("ctx", {})
    text = context.get("expected", "") if item["type"] == "literal_error" else ""
    return re.findall(r"'([^']*)'", str(context.get("expected_tags", text)))


def _expected(item: Mapping[str, Any]) -> str:
    """The allowed values of a mistake, without pydantic's `Input should be`."""
    if words := _words(item):
        return ("one of " if len(words) > 1 else "") + ", ".join(words)
    if item["type"] in ("model_type", "model_attributes_type", "dict_type"):
        return "a section with keys of its own"
    if item["type"] == "too_short":
        return f"a list of {item['ctx']['min_length']} or more"
    if item["type"] == "too_long":
        return f"a list of {item['ctx']['max_length']} or fewer"
    return str(item["msg"]).removeprefix("Input should be ").removeprefix("Value error, ")


# --- limits ---------------------------------------------------------------------------------------

MAX_SIDE = 20_000
"""Largest width or height of an image, flow or depth, pixels."""
MAX_PIXELS = 64_000_000
"""Most pixels of an image; an 8K picture has half as many."""
MAX_ASPECT = 32
"""Largest ratio of the sides of an image; that of a panorama is up to 10."""
MAX_SEED = 2**31 - 1
"""OpenCV's random generator takes signed integers of 32 bits."""
LEAST, MOST = 1e-9, 1e9
"""Magnitude of real numbers: products and squares of them stay far from overflow."""

Finite = Annotated[float, Field(ge=-MOST, le=MOST, allow_inf_nan=False)]
Positive = Annotated[float, Field(ge=LEAST, le=MOST, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, le=MOST, allow_inf_nan=False)]
Tolerance = Annotated[float, Field(ge=1e-12, le=MOST, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]
Truncation = Annotated[float, Field(ge=LEAST)]
"""A truncation may be infinite: the untruncated norm."""
Count = Annotated[int, Field(ge=0, le=10_000)]
Whole = Annotated[int, Field(ge=1, le=10_000)]
Index = Annotated[int, Field(ge=0, le=MAX_SEED)]
Seed = Annotated[int, Field(ge=0, le=MAX_SEED)]


def check_image_size(width: int, height: int, what: str, where: object) -> None:
    """Raise DataError unless an image of `width` x `height` pixels is within the limits."""
    size = f"{width} x {height} (width x height)"
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE and width * height <= MAX_PIXELS):
        raise DataError(
            f"{what} has an impossible size",
            where=where,
            found=size,
            expected=f"1 to {MAX_SIDE} on each side, at most {MAX_PIXELS} pixels",
            hint="scale the images and their intrinsics down; or the file is damaged",
        )
    if max(width, height) > MAX_ASPECT * min(width, height):
        raise DataError(
            f"{what} is too long for its width",
            where=where,
            found=size,
            expected=f"sides of a ratio from 1 to {MAX_ASPECT}",
        )


class _Checked(ModelMetaclass):
    """Classes whose calls raise ConfigError; as a part of a larger record pydantic checks them."""

    def __call__(cls, *args: Any, **values: Any) -> Any:  # noqa: N805
        try:
            return super().__call__(*args, **values)
        except ValidationError as error:
            model: Any = cls
            raise explain(error, model, values, cls.__name__, {}) from None


class Section(BaseModel, metaclass=_Checked):
    """Options with bounds and help on every field; unknown names and type conversions are errors.

    The docstring under a field is its help: it is the comment beside the key in a dumped problem.
    """

    model_config = ConfigDict(
        extra="forbid", strict=True, frozen=True, use_attribute_docstrings=True
    )

    def replace(self, **changes: Any) -> Self:
        """A copy with some values changed, checked again."""
        return type(self)(**{**dict(self), **changes})
