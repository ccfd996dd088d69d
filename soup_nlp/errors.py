"""Errors that a user can act on: what, where, found, expected, what to try."""

import reprlib
from importlib import import_module
from typing import Any

LONGEST = 1000
"""Characters of a text from outside that a message repeats."""


def printable(value: object, longest: int = LONGEST) -> str:
    """A text from outside on one line: control characters escaped, the end cut off.

    Control characters, also those for right-to-left text, would change the output of a terminal.
    """
    try:
        text = str(value)
    except (ValueError, RecursionError) as error:
        # an integer of more digits than Python prints, or a list that contains itself
        text = f"{type(value).__name__} ({error})"
    head = " ".join(text[: longest + 1].splitlines())
    safe = "".join(c if c.isprintable() else ascii(c)[1:-1] for c in head)
    return safe if len(safe) <= longest else f"{safe[:longest]} ... ({len(text)} characters)"


class SoupError(Exception):
    """Base of every error that soup_nlp raises on purpose (exit code 2 on the command line).

    Args:
        what: One sentence that names the problem.
        where: File, key, array or stage concerned.
        found: The actual value.
        expected: The accepted values.
        hint: What to try next.
    """

    def __init__(
        self,
        what: str,
        *,
        where: object = None,
        found: object = None,
        expected: object = None,
        hint: str | None = None,
    ) -> None:
        self.what, self.where = what, where
        self.found, self.expected, self.hint = found, expected, hint
        facts = {"where": where, "found": found, "expected": expected, "try": hint}
        lines = [f"  {k}: {printable(fact)}" for k, fact in facts.items() if fact is not None]
        super().__init__("\n".join([printable(what), *lines]))


class ConfigError(SoupError, ValueError):
    """A problem file or an option is wrong; a ValueError, as pydantic's are."""


class DataError(SoupError):
    """An input image, flow, camera or truth file is wrong."""


class FrameError(DataError, IndexError):
    """A chain has no frame of this number."""


class ModelError(SoupError):
    """The model cannot be built from these inputs."""


class SolverError(SoupError):
    """A solver cannot be set up (a solve that merely fails is a result, not an error)."""


class ExportError(SoupError):
    """A file for, or from, another solver is wrong."""


class StoppedError(SoupError):
    """A run was told to stop before it had a start, so that there is nothing to keep."""


def one_line(value: object, what: str, where: str) -> str:
    """A text of 1 to 100 printable characters, for one line of a terminal; else DataError."""
    if not (isinstance(value, str) and 0 < len(value) <= 100 and value.isprintable()):
        raise DataError(
            f"{what} is no short text",
            where=where,
            found=printable(repr_of(value), 60),
            expected="1 to 100 printable characters on one line",
            hint="leave out line ends and control characters",
        )
    return value


def expect(value: object, kinds: type | tuple[type, ...], what: str, make: str) -> None:
    """Raise DataError unless an argument, called `what`, has an accepted type.

    `make` says how to make such an argument.
    """
    if not isinstance(value, kinds):
        names = kinds if isinstance(kinds, tuple) else (kinds,)
        raise DataError(
            f"{what} is of another kind",
            found=f"{type(value).__name__} {printable(repr_of(value), 60)}",
            expected=" or ".join(k.__name__ for k in names),
            hint=make,
        )


def repr_of(value: object) -> str:
    """repr() of anything, short and without exceptions."""
    try:
        return reprlib.repr(value)
    except Exception as error:  # of a class of the user's own
        return f"({type(error).__name__})"


def optional(package: str, extra: str) -> Any:
    """An optional package by its name for `import`; without it ConfigError names the extra."""
    try:
        return import_module(package)
    except ModuleNotFoundError as error:
        raise ConfigError(
            "an optional package is missing",
            where=package,
            found=error,
            hint=f"pip install 'soup-nlp[{extra}]'",
        ) from error
