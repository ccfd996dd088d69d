"""One odd input: given to the program in this process, and judged."""

from __future__ import annotations

import io
import signal
import traceback
import warnings
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

from helpers_odd_world import World

from soup_nlp.cli.main import main
from soup_nlp.errors import SoupError

LONGEST = 6000
"""Characters that an error message may have."""


@dataclass(frozen=True)
class Case:
    """An odd input.

    Attributes:
        group: Class of failure that it is an example of.
        name: Of the case, unique.
        do: Prepares the input and returns the words of a command line, or calls the Python API
            and returns None.
        codes: Exit codes that are right for a command line.
        quiet: Whether a call of the API may end without an error.
        solves: Whether it may get as far as a solve, which takes a second.
    """

    group: str
    name: str
    do: Callable[[World, Path], list[str] | None]
    codes: tuple[int, ...] = (2,)
    quiet: bool = False
    solves: bool = False


class EndlessError(BaseException):
    """The case does not end."""


def _alarm(*_: object) -> None:
    raise EndlessError


def fault(case: Case, world: World, folder: Path, seconds: int = 60) -> str | None:
    """What is wrong with the program's answer to an odd input; None where it is as promised.

    Args:
        case: The input.
        world: Good files.
        folder: Empty folder of the case.
        seconds: After which the case counts as endless.
    """
    out, err = (io.TextIOWrapper(io.BytesIO(), "utf-8", "strict", write_through=True) for _ in "12")
    err.reconfigure(errors="backslashreplace")
    # what a case makes, it makes once: not timed, and not judged
    before = signal.signal(signal.SIGALRM, _alarm)
    signal.alarm(seconds)
    try:
        with redirect_stdout(out), redirect_stderr(err), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            argv = case.do(world, folder)
            code = None if argv is None else main(argv)
    except SoupError as error:
        return _text_fault(str(error))
    except EndlessError:
        return "endless"
    except MemoryError:
        return "memory"
    except BaseException as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        place = f"{Path(where.filename).name}:{where.lineno}"
        return f"traceback: {type(error).__name__}: {str(error)[:100]!r} at {place}"
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
    if code is None:
        return None if case.quiet else "no error"
    said, complaint = (s.buffer.getvalue().decode("utf-8") for s in (out, err))
    if code not in case.codes:
        return f"exit {code}, expected {case.codes}: {complaint[-200:]!r}"
    if code == 2 and "error: " not in complaint:
        return f"exit 2 without a message: {complaint[-200:]!r}"
    return _text_fault(complaint) or _text_fault(said, longest=100_000)


def _text_fault(text: str, longest: int = LONGEST) -> str | None:
    if "Traceback (most recent call last)" in text:
        return "traceback printed"
    bad = {c for c in text if c not in "\n\t" and not c.isprintable()}
    if bad:
        return f"control characters {sorted(bad)[:3]!r}"
    if len(text) > longest:
        return f"{len(text)} characters of message"
    return None
