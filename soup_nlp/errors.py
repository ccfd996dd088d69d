"""Errors that a user can act on: what, where, found, expected, what to try."""

from __future__ import annotations


class SoupError(Exception):
    """Base of every error that soup_nlp raises on purpose (exit code 2 on the command line).

    Args:
        what: One sentence that names the problem.
        where: File, key, array or stage concerned.
        found: What was there.
        expected: What was needed.
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
        self.what = what
        self.where = where
        self.found = found
        self.expected = expected
        self.hint = hint
        parts = [what]
        for label, value in (
            ("where", where),
            ("found", found),
            ("expected", expected),
            ("try", hint),
        ):
            if value is not None:
                parts.append(f"  {label}: {value}")
        super().__init__("\n".join(parts))


class ConfigError(SoupError):
    """A problem file or an option is wrong."""


class DataError(SoupError):
    """An input image, flow, camera or truth file is wrong."""


class ModelError(SoupError):
    """The model cannot be built from these inputs."""


class SolverError(SoupError):
    """A solver cannot be set up (a solve that merely fails is a result, not an error)."""


class ExportError(SoupError):
    """A file for, or from, another solver is wrong."""


class StoppedError(SoupError):
    """A run was told to stop before it had a start, so that there is nothing to keep."""
