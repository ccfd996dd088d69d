"""Every option and argument of every command with odd values: read from the commands themselves."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from helpers_odd_run import Case
from helpers_odd_world import World, settings

from soup_nlp.cli.main import BENCH, COMMANDS, _load

ODD_VALUES = (
    *("", " ", "nan", "-1", "0", "1e300", "9" * 400, "2,2,", "²", "[1, 2]", "{a: 1}"),
    *("\x1b[31m", "a\0b", "\udcff", "x" * 10_000, "~nouser_zz", "/dev/full", "=", "a.b=1"),
)
"""A value for every kind of mistake: empty, no number, out of range, no name or path, too long."""

Base = Callable[[World, Path], list[str]]


def _taken(*words: str) -> Base:
    """A command that would run for minutes: its target is a file, which it must refuse first."""
    return lambda w, o: [*words, "-q", "-o", w.odd("garbage", "")]


def _files(*words: str) -> Base:
    """A command of the tiny problem file, with an output folder."""
    return lambda w, o: [words[0], str(w.good("p.yaml")), *words[1:], "-o", str(o / "out")]


BASES: dict[str, Base] = {
    "solve": _files("solve", "-q"),
    "demo": _taken("demo"),
    "view": lambda w, o: ["view", str(w.result), "--no-open"],
    "check": lambda w, o: ["check", str(w.exported / "soup.sol")],
    "chain": lambda w, o: [
        *("chain", str(w.good("a.png")), str(w.good("b.png")), *settings()),
        *("-q", "-o", str(o / "out")),
    ],
    "convert": lambda w, o: ["convert", str(w.result), "--to", "npy", "-o", str(o / "out")],
    "evaluate": lambda w, o: ["evaluate", str(w.result), "--depth", str(w.good("d.npy"))],
    "show": lambda w, o: ["show", str(w.good("p.yaml"))],
    "list": lambda w, o: ["list"],
    "export": _files("export", "-q"),
    "import": lambda w, o: [
        *("import", str(w.exported), str(w.exported / "soup.sol"), "-o", str(o / "out")),
    ],
    "family": lambda w, o: ["family", w.odd("garbage", ""), "--sizes=100", "--scenes=orbit"],
    "compare": _files("compare", "--solvers", "no_such_solver"),
    "bench accuracy": lambda w, o: [
        *("bench", "accuracy", "--suite=rendered", "--only=orbit", "--width=64", *settings()),
        *("-q", "-o", w.odd("garbage", "")),
    ],
    "bench search": _taken("bench", "search", "--suite=rendered", "--only=orbit", "--width=64"),
    "bench all": lambda w, o: ["bench", "all", "--dry", "-o", str(o / "out")],
    **{
        f"bench {name}": _taken("bench", name)
        for name in BENCH
        if name not in ("accuracy", "search", "all")
    },
}
"""A call of every command that ends soon."""


def option_cases(values: tuple[str, ...] = ODD_VALUES) -> Iterator[Case]:
    """A case for every option that takes a value, and for every argument."""
    for table, head in ((COMMANDS, ""), (BENCH, "bench ")):
        for name, (home, _) in table.items():
            for parameter in _load(name, home).params:
                if parameter.name == "help" or getattr(parameter, "is_flag", False):
                    continue
                option = parameter.param_type_name == "option"
                word = max(parameter.opts, key=len) if option else ""
                # a good folder would have them run to their end
                ends = head + name in ENDS or word != "--out"
                for value in values if ends else ("", "\x1b[31m", "/dev/full", "x" * 10_000):
                    if (word, value) == ("--serve", "0"):
                        # any free port, and it serves until it is stopped
                        continue
                    yield _case(head + name, word, parameter.name, value)


def _case(command: str, word: str, name: str, value: str) -> Case:
    """A command with a value of an option besides, or of an argument."""

    def words(w: World, o: Path) -> list[str]:
        base, own = BASES[command](w, o), value
        if word == "--out" and not value.startswith(("/", "~", "\0")):
            own = str(o / value) if value.strip() else value
        if word:
            return [*base, f"{word}={own}"]
        return [*base, own]

    text = value if len(value) < 12 else f"{value[:6]}... of {len(value)}"
    title = f"{command} {word or name.upper()} {text!r}"
    return Case("5 doors", f"option {title}", words, (0, 1, 2), solves=command in SOLVING)


ENDS = ("view", "check", "convert", "import", "export", "solve", "chain", "compare", "bench all")
"""Commands whose calls end with any folder."""
SOLVING = ("solve", "chain", "export", "import", "compare")
"""Commands that take a second where a value is good."""
