"""Reading of answers of solvers in the .sol text format of AMPL."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np

from soup_nlp.arrays import Float, Int
from soup_nlp.errors import ExportError, printable
from soup_nlp.storage.files import as_path, read_bytes

T = TypeVar("T")

OPTIONS = "Options"
"""Line after the message."""
MOST_BYTES = 256 << 20
"""Size limit of a .sol file, enough for millions of variables."""
CLASSES = ("solved", "uncertain", "infeasible", "unbounded", "limit", "failure")


@dataclass(frozen=True)
class Sol:
    """Answer of a solver in the order of the NLP, not of the file.

    Attributes:
        message: Message of the solver.
        code: solve_result_num of AMPL, -1 if the file has none.
        x: (nx,) point.
        lam_g: (ng,) multipliers in CasADi's sign (positive at upper bounds), or None.
    """

    message: str
    code: int
    x: Float = field(repr=False)
    lam_g: Float | None = field(repr=False)

    def __str__(self) -> str:
        return f"solver      {self.headline or 'no message'} ({self.status}, code {self.code})"

    @property
    def headline(self) -> str:
        """First line of the message, or ""."""
        return self.message.partition("\n")[0]

    @property
    def solved(self) -> bool:
        """Whether the solver claims success."""
        return 0 <= self.code < 100

    @property
    def status(self) -> str:
        """Meaning of solve_result_num in a word."""
        return CLASSES[self.code // 100] if 0 <= self.code < 600 else "unknown"


def read_sol(path: str | Path, variables: Int, rows: Int, lifted: int = 0) -> Sol:
    """Read a .sol file.

    `variables` (nx,), `rows` (ng,) and `lifted` are those of the .nl file, see `NLFile`.

    Raises:
        ExportError: the file is missing, is not a .sol in text format, has no point, or belongs to
            a problem of another size.
    """
    path = as_path(path, "solution file", error=ExportError)
    content = read_bytes(path, "solution file", error=ExportError, most=MOST_BYTES)
    lines = content.decode("utf-8", errors="replace").rstrip("\n").split("\n")
    at = 0

    def wrong(found: str, expected: str) -> ExportError:
        return ExportError(
            "solution file is not in AMPL's text format",
            where=f"{path}, line {at}",
            found=found[:60],
            expected=expected,
        )

    def take(count: int, expected: str, kind: Callable[[str], T]) -> list[T]:
        """The next lines, of which each holds a value of a kind."""
        nonlocal at
        out = []
        for _ in range(count):
            if at >= len(lines):
                raise ExportError(
                    "solution file ends early",
                    where=f"{path}, line {at}",
                    expected=expected,
                    hint="was the solver stopped before its end?",
                )
            text, at = lines[at].strip(), at + 1
            try:
                out.append(kind(text))
            except ValueError:
                raise wrong(text, expected) from None
        return out

    message = []
    while (line := take(1, OPTIONS, str)[0]) != OPTIONS:
        # the file may contain control characters
        message.append(printable(line))
    said = [line for line in message if line]
    (count,) = take(1, "number of options", int)
    # a count above 4 announces a tolerance
    tolerance = count > 4
    take(count - 2 * tolerance, "an option", str)
    sizes = take(4, "number of constraints, duals, variables, values", int)
    take(int(tolerance), "tolerance", float)
    wanted = len(rows) + lifted, len(variables) + lifted
    if (sizes[0], sizes[2]) != wanted:
        raise ExportError(
            "solution is for another problem",
            where=path,
            found=f"{sizes[2]} variables, {sizes[0]} constraints",
            expected=f"{wanted[1]} variables, {wanted[0]} constraints",
        )
    if sizes[1] not in (0, wanted[0]) or sizes[3] != wanted[1]:
        raise ExportError(
            "solution holds no point",
            where=path,
            found=f"{sizes[3]} of {wanted[1]} values, {sizes[1]} duals",
            hint="; ".join(said) or None,
        )
    y = np.array(take(sizes[1], "a dual value", float))
    z = np.array(take(sizes[3], "a value of a variable", float))
    if not (np.isfinite(y).all() and np.isfinite(z).all()):
        raise ExportError("solution is not finite", where=path, hint="; ".join(said) or None)
    code = -1
    # suffixes are ignored: multipliers of the bounds are computed from the point
    for line in lines[at:]:
        words = line.split()
        if words[:1] == ["objno"]:
            try:
                code = int(words[2])
            except (IndexError, ValueError):
                raise wrong(line, "objno, objective, code") from None
    lam_g = -y[lifted:][np.argsort(rows)] if sizes[1] else None
    return Sol("\n".join(said), code, z[lifted:][np.argsort(variables)], lam_g)
