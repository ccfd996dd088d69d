"""Useless numbers, and odd values of every option."""

import re
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from helpers_odd_run import ANY, Case, cases, words
from helpers_odd_world import SIZE, World

from soup_nlp.cli.main import COMMANDS, _load
from soup_nlp.config.problem import Problem
from soup_nlp.schema.section import Section


def fields(model: type[Section], prefix: str = "") -> Iterator[tuple[str, str]]:
    """Names of the keys of a problem file with their types; those of sections are empty."""
    for key, info in model.model_fields.items():
        kind = info.annotation
        section = isinstance(kind, type) and issubclass(kind, Section)
        yield f"{prefix}{key}", "" if section else str(kind)
        if section:
            yield from fields(kind, f"{prefix}{key}.")


WITH = {
    "solver.pre": "--set solver.presolve_iterations=60",
    "refine": "--set refine.enabled=true --set refine.from_start=true --set refine.rounds=1"
    " --set refine.particles=4",
}
"""Settings without which an option has no effect, by the beginning of its name."""
LARGE = "1" + "0" * 30
NUMBERS = {
    f"intrinsics {k} {{}}": "{solve} --intrinsics="
    + ",".join(["60"] * k + ["{x}"] + ["24"] * (3 - k))
    for k in range(4)
}


def number_cases() -> Iterator[Case]:
    for name, kind in fields(Problem):
        if name == "input" or not re.search("float|int", kind):
            continue
        whole = "float" not in kind
        settings = next((text for begin, text in WITH.items() if name.startswith(begin)), "")
        values = (LARGE, "1000000000", "-1") if whole else ("1e300", "1e9", "1e-300", "-1", ".nan")
        form = {"solver.presolve_eps": "[{}]", "solver.ipopt": "{{tol: {}}}"}.get(name, "{}")
        good = ("1000000000",) if name == "seed" else ("1e9", "1e-300")
        free = {form.format(v) for v in good}
        texts = [form.format(v) for v in values]
        solves = texts if "sigma" in name or name == "solver.ipopt" else free
        line = f"{{solve}} {settings} --set {name}={{x}}"
        yield from cases(f"number {name}={{}}", line, texts, ANY, solves=solves)
    free = ("1e9", "1e5", "0", "-60", "1e-300")
    for title, line in NUMBERS.items():
        numbers = ("nan", "inf", "1e300", *free)
        yield from cases(title, line, numbers, ANY, solves=free)
    for option in ("--depth-scale", "--cap"):
        line = f"evaluate {{result}} --depth {{o}}/d.png {option}={{x}}"
        numbers = ("nan", "inf", "1e300", "1e-300", "-1", "0")
        make = lambda w, o, x: depth_png(o) and x  # noqa: E731
        yield from cases(f"evaluate {option}={{}}", line, numbers, (0, 2), make=make)
    for option in ("--seconds", "--iterations"):
        line = f"compare {{p}} --solvers no_such_solver {option}={{x}} -o {{out}}"
        numbers = ("nan", "inf", "1e300", "0", "-1", "x")
        yield from cases(f"compare {option}={{}}", line, numbers)
    shown = ("-0.1", "1.1", ".nan", "word", "[]", "null")
    line = "show {p} --set energy.leak_arap={x}"
    yield from cases("leak_arap {}", line, shown)


def depth_png(o: Path) -> Path:
    """A depth map of 16 bits."""
    cv2.imwrite(str(o / "d.png"), np.full(SIZE, 2000, np.uint16))
    return o / "d.png"


# --- options -------------------------------------------------------------------------------------

ODD_VALUES = (
    *("", " ", "nan", "-1", "0", "1e300", "9" * 400, "2,2,", "²", "[1, 2]", "{a: 1}"),
    *("\x1b[31m", "a\0b", "\udcff", "x" * 10_000, "~nouser_zz", "/dev/full", "=", "a.b=1"),
)
"""A value for every kind of mistake: empty, no number, out of range, no name or path, too long."""
BASES = {
    "solve": "solve {p} -q -o {out}",
    "view": "view {result} --no-open",
    "check": "check {sol}",
    "chain": "chain {a} {b} {tiny} -q -o {out}",
    "convert": "convert {result} --to npy -o {out}",
    "evaluate": "evaluate {result} --depth {d}",
    "show": "show {p}",
    "list": "list",
    "export": "export {p} -q -o {out}",
    "import": "import {exported} {sol} -o {out}",
    "compare": "compare {p} --solvers no_such_solver -o {out}",
    # commands that would run for minutes: their target is a file, which they must reject first
    "demo": "demo -q -o {odd}",
}
"""A call of every command that ends soon."""
ENDS = ("view", "check", "convert", "import", "export", "solve", "chain", "compare")
"""Commands whose calls end with any folder."""
SOLVING = ("solve", "chain", "export", "import", "compare")
"""Commands that take a second where a value is good."""


def option_cases(values: tuple[str, ...] = ODD_VALUES) -> Iterator[Case]:
    """A case for every option that takes a value, and for every argument."""
    for name, home in COMMANDS.items():
        for parameter in _load(name, home).params:
            if parameter.name == "help" or getattr(parameter, "is_flag", False):
                continue
            option = parameter.param_type_name == "option"
            word = max(parameter.opts, key=len) if option else ""
            # with a valid folder these commands would run to their end
            ends = name in ENDS or word != "--out"
            for value in values if ends else ("", "\x1b[31m", "/dev/full", "x" * 10_000):
                yield _option_case(name, word, parameter.name, value)


def _option_case(command: str, word: str, name: str, value: str) -> Case:
    """A command with a value of an option besides, or of an argument."""
    line = BASES.get(command, f"{command} -q -o {{odd}}")

    def run(w: World, o: Path) -> list[str]:
        argument = value
        if word == "--out" and value.strip() and not value.startswith(("/", "~", "\0")):
            argument = str(o / value)
        return [*words(line, w, o, "garbage"), f"{word}={argument}" if word else argument]

    text = value if len(value) < 12 else f"{value[:6]}... of {len(value)}"
    title = f"option {command} {word or name.upper()} {text!r}"
    return Case(title, run, ANY, solves=command in SOLVING)
