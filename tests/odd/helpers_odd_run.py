"""Odd inputs: a generator of cases from tables, and the check of the program's answer."""

import io
import re
import shutil
import signal
import traceback
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
from helpers_odd_world import CAMERA, SET, World

from soup_nlp.cli.main import main

LONGEST = 6000
"""Characters that an error message may have."""
ANY = (0, 1, 2)
"""Exit codes of inputs that may be accepted or rejected."""


@dataclass(frozen=True)
class Case:
    """An odd input: `do` prepares it and returns a command line, of which `codes` are right."""

    name: str
    do: Callable[[World, Path], list[str]]
    codes: tuple[int, ...] = (2,)
    # it may get as far as a solve, which takes a second
    solves: bool = False


Make = Callable[[World, Path, Any], object]
"""Prepares the input of a case from a world, its folder and its value; returns what stands for the
value in the command line."""


def cases(
    title: str,
    do: str | Callable[[World, Path, Any], list[str]] | None,
    values: Collection[Any] | Mapping[str, Any],
    codes: tuple[int, ...] = (2,),
    *,
    make: Make | None = None,
    other: Mapping[str, tuple[int, ...]] | None = None,
    solves: bool | Collection[str] = False,
) -> Iterator[Case]:
    """A case for every value, by name or by its text, for which {} stands in the title.

    `do` is a command line (see `words`) or a function; None if the values are. `other` are exit
    codes of single values, `solves` may be the names of the values that may solve.
    """
    named = values if isinstance(values, Mapping) else {str(v): v for v in values}
    for name, value in named.items():

        def run(w: World, o: Path, value=value, do=do or value) -> list[str]:
            x = value if make is None else make(w, o, value)
            return words(do, w, o, str(x)) if isinstance(do, str) else do(w, o, x)

        right = (other or {}).get(name, codes)
        yield Case(title.format(name), run, right, solves is True or name in (solves or ()))


def words(line: str, w: World, o: Path, x: str = "") -> list[str]:
    """The words of a command line, separated by blanks, with these names replaced:

    {x} the value; {odd.png} an odd file of the kind x; {out} the output folder; {o} the folder of
    the case; {a} {b} the images, {f} the flow, {d} the depth, {p} the problem file; {result},
    {exported} and {sol}; {tiny} settings of a quick solve; {solve} the solve of the pair.
    """
    several = {"{solve}": ["solve", *w.pair, *SET, "-q", "-o", str(o / "out")], "{tiny}": SET}
    known = {"x": x, "o": o, "out": o / "out", "camera": CAMERA}

    def replaced(match: re.Match[str]) -> str:
        name, suffix = match.groups()
        if name == "odd":
            return w.odd(x, suffix or "")
        if name in FILES:
            return str(w.good(f"{name}.{FILES[name]}"))
        # what a world makes when it is asked for
        return str(known[name] if name in known else getattr(w, name))

    out: list[str] = []
    for word in line.split():
        out += several[word] if word in several else [NAME.sub(replaced, word)]
    return out


NAME = re.compile(r"\{(\w+)(\.\w+)?\}")
FILES = {"a": "png", "b": "png", "f": "npy", "d": "npy", "p": "yaml"}


def written(name: str) -> Make:
    """Writes the value to a file of the case's folder; a function of a value makes its bytes."""

    def make(w: World, o: Path, value: Any) -> str:
        write(o / name, value() if callable(value) else value)
        return str(o / name)

    return make


def write(path: Path, value: str | bytes) -> None:
    """Write a text or bytes."""
    path.write_bytes(value.encode("utf-8", "surrogateescape") if isinstance(value, str) else value)


def changed(which: str, name: str = "", damage: Callable[[Path, Any], object] = write) -> Make:
    """Copies the result or the export, and damages a file of the copy by the value."""

    def make(w: World, o: Path, value: Any) -> str:
        copy = shutil.copytree(getattr(w, which), o / "copy")
        damage(copy / name, value)
        return str(copy)

    return make


def h5_damage(path: Path, value: Callable[[h5py.File], object]) -> None:
    """Damage an HDF5 file by a function of it."""
    with h5py.File(path, "a") as file:
        value(file)


class EndlessError(BaseException):
    """The case does not end."""


def _alarm(*_: object) -> None:
    raise EndlessError


def fault(case: Case, world: World, folder: Path, seconds: int = 60) -> str | None:
    """The fault of the program's answer to an odd input, in an empty folder; None without."""
    out, err = (io.TextIOWrapper(io.BytesIO(), "utf-8", "strict", write_through=True) for _ in "12")
    err.reconfigure(errors="backslashreplace")
    # the time limit includes the preparation of the case
    before = signal.signal(signal.SIGALRM, _alarm)
    signal.alarm(seconds)
    try:
        with redirect_stdout(out), redirect_stderr(err), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            code = main(case.do(world, folder))
    except BaseException as error:
        where = traceback.extract_tb(error.__traceback__)[-1]
        origin = f"{Path(where.filename).name}:{where.lineno}"
        return f"traceback: {type(error).__name__}: {str(error)[:100]!r} at {origin}"
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
    said, complaint = (s.buffer.getvalue().decode("utf-8") for s in (out, err))
    if code not in case.codes:
        return f"exit {code}, expected {case.codes}: {complaint[-200:]!r}"
    if code == 2 and "error: " not in complaint:
        return f"exit 2 without a message: {complaint[-200:]!r}"
    for text, longest in ((complaint, LONGEST), (said, 100_000)):
        if "Traceback (most recent call last)" in text:
            return "traceback printed"
        if bad := {c for c in text if c not in "\n\t" and not c.isprintable()}:
            return f"control characters {sorted(bad)[:3]!r}"
        if len(text) > longest:
            return f"{len(text)} characters of message"
    return None
