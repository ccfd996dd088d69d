"""AMPL's .sol text format: a solver's answer read back, and written."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from soup_nlp.errors import ExportError
from soup_nlp.export.opcodes import number
from soup_nlp.storage.atomic import write_text

Float = NDArray[np.float64]
Int = NDArray[np.int64]

COUNT_LIMIT = 2**31
"""No count in a file is as large as this."""
OPTIONS = "Options"
"""Line that ends the message."""
KINDS = ("variable", "constraint", "objective", "problem")
CLASSES = ("solved", "uncertain", "infeasible", "unbounded", "limit", "failure")
LOWER, UPPER = "ipopt_zL_out", "ipopt_zU_out"
"""Suffixes in which solvers of Ipopt's family return the multipliers of the bounds."""


@dataclass(frozen=True)
class Sol:
    """A solver's answer in the order of the NLP (not of the file).

    Attributes:
        message: What the solver says.
        code: AMPL's solve_result_num, -1 where the file has none.
        x: (nx,) point.
        lam_g: (ng,) multipliers in CasADi's sign (positive at upper bounds), or None.
        lam_x: (nx,) multipliers of the bounds in that sign, or None.
        suffixes: Entries by (kind, name); indices are those of the file.
    """

    message: str
    code: int
    x: Float = field(repr=False)
    lam_g: Float | None = field(repr=False)
    lam_x: Float | None = field(repr=False)
    suffixes: Mapping[tuple[str, str], dict[int, float]] = field(repr=False)

    @property
    def solved(self) -> bool:
        """The solver claims success."""
        return 0 <= self.code < 100

    @property
    def status(self) -> str:
        """solve_result_num in a word."""
        return CLASSES[self.code // 100] if 0 <= self.code < 600 else "unknown"


class _Lines:
    """Lines of a file with their number for messages."""

    def __init__(self, path: Path) -> None:
        self.path, self.at = path, 0
        try:
            self.lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
        except OSError as error:
            raise ExportError(
                "solution file cannot be read", where=path, found=error.strerror
            ) from error

    def next(self, expected: str) -> str:
        if self.at >= len(self.lines):
            raise ExportError(
                "solution file ends early",
                where=f"{self.path}, line {self.at}",
                expected=expected,
                hint="did the solver reach its end?",
            )
        self.at += 1
        return self.lines[self.at - 1].strip()

    def numbers(self, count: int, expected: str) -> Float:
        out = np.empty(count)
        for k in range(count):
            text = self.next(expected)
            try:
                out[k] = float(text)
            except ValueError:
                raise self.wrong(text, expected) from None
        return out

    def integers(self, count: int, expected: str) -> list[int]:
        values = self.numbers(count, expected)
        for value in values:
            if not (value >= 0 and value == np.floor(value) and value < COUNT_LIMIT):
                raise self.wrong(repr(float(value)), f"{expected}: a whole number, not negative")
        return [int(v) for v in values]

    def whole(self, word: str, expected: str) -> int:
        """A whole number of the line that was read last."""
        try:
            return int(word)
        except ValueError:
            raise self.wrong(word, expected) from None

    def wrong(self, found: str, expected: str) -> ExportError:
        return ExportError(
            "solution file is not in AMPL's text format",
            where=f"{self.path}, line {self.at}",
            found=found[:60],
            expected=expected,
        )


def read_sol(path: str | Path, variables: Int, rows: Int) -> Sol:
    """Read a .sol file.

    Args:
        path: The file.
        variables: (nx,) variable of the NLP that each one of the .nl file is, see `NLFile`.
        rows: (ng,) the same for constraints.

    Raises:
        ExportError: the file is missing, not a .sol in text format, holds no point, or is for a
            problem of another size.
    """
    lines = _Lines(Path(path))
    message = []
    while (line := lines.next(OPTIONS)) != OPTIONS:
        message.append(line)
    (count,) = lines.integers(1, "number of options")
    # two more options say that a tolerance follows
    tolerance = count > 4
    for _ in range(count - 2 * tolerance):
        lines.next("an option")
    sizes = lines.integers(4, "number of constraints, duals, variables, values")
    if tolerance:
        lines.numbers(1, "tolerance")
    if (sizes[0], sizes[2]) != (len(rows), len(variables)):
        raise ExportError(
            "solution is for another problem",
            where=path,
            found=f"{sizes[2]} variables, {sizes[0]} constraints",
            expected=f"{len(variables)} variables, {len(rows)} constraints",
        )
    if sizes[1] not in (0, len(rows)) or sizes[3] != len(variables):
        raise ExportError(
            "solution holds no point",
            where=path,
            found=f"{sizes[3]} of {len(variables)} values, {sizes[1]} duals",
            hint="; ".join(m for m in message if m) or None,
        )
    y = lines.numbers(sizes[1], "a dual value")
    z = lines.numbers(sizes[3], "a value of a variable")
    for values, what in ((z, "a value"), (y, "a dual")):
        if not np.isfinite(values).all():
            raise ExportError(
                "solution is not finite",
                where=path,
                found=f"{what} is not a number or infinite",
                hint="; ".join(m for m in message if m) or None,
            )
    code = -1
    suffixes: dict[tuple[str, str], dict[int, float]] = {}
    while lines.at < len(lines.lines):
        words = lines.next("objno or suffix").split()
        if words[:1] == ["objno"] and len(words) >= 3:
            code = lines.whole(words[2], "objno, objective, code")
        elif words[:1] == ["suffix"] and len(words) >= 6:
            suffixes.update(_suffix(lines, words, sizes))
        elif words:
            raise lines.wrong(" ".join(words), "objno or suffix")
    x = np.empty(len(variables))
    x[variables] = z
    lam_g = None
    if sizes[1]:
        lam_g = np.empty(len(rows))
        lam_g[rows] = -y
    return Sol(
        message="\n".join(m for m in message if m),
        code=code,
        x=x,
        lam_g=lam_g,
        lam_x=_bounds(suffixes, variables),
        suffixes=suffixes,
    )


def _suffix(
    lines: _Lines, words: list[str], sizes: list[int]
) -> Iterator[tuple[tuple[str, str], dict[int, float]]]:
    expected = "suffix, kind, entries, name length, table length, table lines"
    kind, count, _, _, table = (lines.whole(w, expected) for w in words[1:6])
    # rows and variables; there is one objective and one problem
    owners = {0: sizes[2], 1: sizes[0]}.get(kind & 3, 1)
    if min(kind, count, table) < 0 or count > owners:
        raise lines.wrong(" ".join(words), f"{expected}; entries for {owners} at most")
    name = lines.next("name of a suffix")
    for _ in range(table):
        lines.next("table of a suffix")
    entries = {}
    for _ in range(count):
        pair = lines.next("entry of a suffix").split()
        expected = f"entry of a suffix: index below {owners}, value"
        if len(pair) != 2 or not 0 <= (index := lines.whole(pair[0], expected)) < owners:
            raise lines.wrong(" ".join(pair), expected)
        try:
            entries[index] = float(pair[1])
        except ValueError:
            raise lines.wrong(" ".join(pair), expected) from None
    yield (KINDS[kind & 3], name), entries


def _bounds(suffixes: Mapping[tuple[str, str], dict[int, float]], variables: Int) -> Float | None:
    """Multipliers of the bounds: Ipopt's suffixes hold -z at lower, +z at upper bounds, or |z|."""
    parts = [(s, suffixes.get(("variable", name))) for name, s in ((LOWER, -1.0), (UPPER, 1.0))]
    if all(p is None for _, p in parts):
        return None
    lam = np.zeros(len(variables))
    for sign, entries in parts:
        for k, v in (entries or {}).items():
            lam[variables[k]] += sign * abs(v)
    return lam


def write_sol(
    path: str | Path,
    x: Float,
    lam_g: Float | None,
    variables: Int,
    rows: Int,
    message: str = "",
    code: int = 0,
) -> None:
    """Write an answer as a .sol file, whole or not at all.

    Args:
        path: The file.
        x: (nx,) point, in the order of the NLP.
        lam_g: (ng,) multipliers in CasADi's sign, or None.
        variables: (nx,) order of the .nl file, see `NLFile`.
        rows: (ng,) order of the .nl file.
        message: First lines; empty lines are left out, and one that would end it is quoted.
        code: solve_result_num, 0 solved, 400 limit.
    """
    duals = [] if lam_g is None else [number(-v) for v in lam_g[rows].tolist()]
    head = [line for line in message.splitlines() if line.strip()]
    head = [f'"{line.strip()}"' if line.strip() == OPTIONS else line for line in head]
    sizes = (len(rows), len(duals), len(variables), len(variables))
    values = [number(v) for v in np.asarray(x, float)[variables].tolist()]
    lines = [*head, "", OPTIONS, "3", "0", "1", "0", *map(str, sizes), *duals, *values]
    write_text(path, "\n".join([*lines, f"objno 0 {code}"]) + "\n")
