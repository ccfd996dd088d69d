"""Base class of every option record and of every section of a problem file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Self

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from soup_nlp.schema.explain import explain
from soup_nlp.schema.limits import LEAST, MAX_ROUNDS, MAX_SAMPLES, MAX_SEED, MOST

Finite = Annotated[float, Field(ge=-MOST, le=MOST, allow_inf_nan=False)]
Positive = Annotated[float, Field(ge=LEAST, le=MOST, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, le=MOST, allow_inf_nan=False)]
Tolerance = Annotated[float, Field(ge=1e-12, le=MOST, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]
Truncation = Annotated[float, Field(ge=LEAST)]
"""A truncation may be infinite: the untruncated norm."""
Count = Annotated[int, Field(ge=0, le=MAX_ROUNDS)]
Whole = Annotated[int, Field(ge=1, le=MAX_ROUNDS)]
Index = Annotated[int, Field(ge=0, le=MAX_SEED)]
Samples = Annotated[int, Field(ge=1, le=MAX_SAMPLES)]
Seed = Annotated[int, Field(ge=0, le=MAX_SEED)]


class Section(BaseModel):
    """Options with bounds and help on every field; unknown names and type conversions are errors.

    The docstring under a field is its help: it is the comment beside the key in a dumped problem.
    """

    model_config = ConfigDict(
        extra="forbid", strict=True, frozen=True, use_attribute_docstrings=True
    )

    def replace(self, **changes: Any) -> Self:
        """A copy with some values changed, checked again.

        Raises:
            ConfigError: a name is unknown, or a value is of the wrong type or out of range.
        """
        return self.make({**dict(self), **changes})

    @classmethod
    def make(cls, values: Mapping[str, Any]) -> Self:
        """A record of the values, the others at their defaults.

        Raises:
            ConfigError: a name is unknown, or a value is of the wrong type or out of range.
        """
        try:
            return cls(**values)
        except ValidationError as error:
            raise explain(error, cls, values, cls.__name__, {}) from None

    @classmethod
    def help(cls) -> dict[str, str]:
        """Description of every field, one line each."""
        fields = cls.model_fields.items()
        return {name: " ".join((field.description or "").split()) for name, field in fields}
