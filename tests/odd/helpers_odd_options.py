"""Useless numbers, solves at the limits of options, and odd values of every option."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from helpers_odd_run import ANY, DOORS, Case, cases, words, write
from helpers_odd_world import SIZE, World

from soup_nlp.cli.main import COMMANDS, _load, main
from soup_nlp.config.problem import Problem
from soup_nlp.schema.section import Section


def numeric_fields(model: type[Section], prefix: str = "") -> Iterator[tuple[str, bool]]:
    """Names of options that are numbers, and whether they are whole."""
    for key, info in model.model_fields.items():
        kind = info.annotation
        if prefix == "" and key == "input":
            continue
        if isinstance(kind, type) and issubclass(kind, Section):
            yield from numeric_fields(kind, f"{prefix}{key}.")
        elif "float" in str(kind):
            yield f"{prefix}{key}", False
        elif "int" in str(kind):
            yield f"{prefix}{key}", True


WITH = {
    "solver.pre": "--set solver.presolve=true",
    "refine": "--set refine.enabled=true --set refine.from_start=true --set refine.rounds=1"
    " --set refine.particles=4",
}
"""Settings without which an option has no effect, by the beginning of its name."""
LARGE = "1" + "0" * 30
NUMBERS = {
    "intrinsics 0 {}": "{solve} --intrinsics={x},60,32,24",
    "intrinsics 1 {}": "{solve} --intrinsics=60,{x},32,24",
    "intrinsics 2 {}": "{solve} --intrinsics=60,60,{x},24",
    "intrinsics 3 {}": "{solve} --intrinsics=60,60,32,{x}",
}
SCENE = (
    "solve {x} -q -o {out} --set flow.source=truth --set segmentation.superpixels=12"
    " --set segmentation.neighbours=4 --set refine.enabled=false --set solver.presolve=false"
    " --set solver.max_iter=1"
)


def _scene(w: World, o: Path, text: str) -> str:
    options = {"width": "64", "height": "48", "seed": "0"} | dict([text.split("=")])
    inside = ", ".join(f"{k}: {v}" for k, v in options.items())
    write(o / "p.yaml", f"input: {{kind: scene, scene: street, {inside}}}\n")
    return str(o / "p.yaml")


def number_cases() -> Iterator[Case]:
    for name, whole in numeric_fields(Problem):
        settings = next((text for begin, text in WITH.items() if name.startswith(begin)), "")
        values = (LARGE, "1000000000", "-1") if whole else ("1e300", "1e9", "1e-300", "-1", ".nan")
        form = {"solver.presolve_eps": "[{}]", "solver.ipopt": "{{tol: {}}}"}.get(name, "{}")
        good = ("1000000000",) if name == "seed" else ("1e9", "1e-300")
        free = {form.format(v) for v in good}
        texts = [form.format(v) for v in values]
        solves = texts if "sigma" in name or name == "solver.ipopt" else free
        line = f"{{solve}} {settings} --set {name}={{x}}"
        yield from cases("2 numbers", f"number {name}={{}}", line, texts, ANY, solves=solves)
    scenes = [
        *(f"width={v}" for v in ("63", LARGE, "1000000", "-5")),
        *(f"height={v}" for v in ("47", LARGE, "1000000")),
        *(f"seed={v}" for v in (LARGE, "-1", "5000000000")),
    ]
    yield from cases(DOORS, "scene {}", SCENE, scenes, ANY, make=_scene)
    free = ("1e9", "1e5", "0", "-60", "1e-300")
    for title, line in NUMBERS.items():
        numbers = ("nan", "inf", "1e300", *free)
        yield from cases("2 numbers", title, line, numbers, ANY, solves=free)
    for option in ("--depth-scale", "--cap"):
        line = f"evaluate {{result}} --depth {{o}}/d.png {option}={{x}}"
        numbers = ("nan", "inf", "1e300", "1e-300", "-1", "0")
        make = lambda w, o, x: depth_png(o) and x  # noqa: E731
        yield from cases("2 numbers", f"evaluate {option}={{}}", line, numbers, (0, 2), make=make)
    for option in ("--seconds", "--iterations"):
        line = f"compare {{p}} --solvers no_such_solver {option}={{x}} -o {{out}}"
        numbers = ("nan", "inf", "1e300", "0", "-1", "x")
        yield from cases("2 numbers", f"compare {option}={{}}", line, numbers)
    shown = ("-0.1", "1.1", ".nan", "word", "[]", "null")
    line = "show {p} --set output.min_confidence={x}"
    yield from cases("2 numbers", "min_confidence {}", line, shown)


def depth_png(o: Path) -> Path:
    """A depth map of 16 bits."""
    cv2.imwrite(str(o / "d.png"), np.full(SIZE, 2000, np.uint16))
    return o / "d.png"


NO_WEIGHT = " ".join(f"energy.weights.{k}=0" for k in ("arap", "proj", "cont", "orient", "prior"))
SOLVES = {
    "min_facing 0.5": "formulation.min_facing=0.5",
    "min_facing 0.3": "formulation.min_facing=0.3 solver.presolve=true",
    "min_facing 0.5 presolved": "formulation.min_facing=0.5 solver.presolve=true",
    **{
        f"unit-translation {norm}": f"formulation.gauge=unit-translation formulation.norm={norm}"
        " solver.presolve=true solver.max_iter=10"
        for norm in ("smooth", "epigraph")
    },
    "depth_ratio 1": "formulation.depth_ratio=1",
    "depth_ratio 1 presolved": "formulation.depth_ratio=1 solver.presolve=true",
    "no weight": NO_WEIGHT,
    "no weight presolved": f"{NO_WEIGHT} solver.presolve=true",
    "no weight refined": f"{NO_WEIGHT} refine.enabled=true refine.from_start=true refine.rounds=1",
    **{f"seed 2^{k}": f"seed={2**k}" for k in (31, 32, 63)},
    "one superpixel": "segmentation.superpixels=1",
    "two superpixels": "segmentation.superpixels=2 segmentation.neighbours=1",
    "more neighbours than superpixels": "segmentation.neighbours=12",
    "all boundary samples": "segmentation.boundary_samples=all",
    "all pixels": "energy.pixel_samples=all",
    "no iterations": "solver.max_iter=0",
    "unknown ipopt option": "solver.ipopt={no_such:1}",
    "wrong ipopt value": "solver.ipopt={max_iter:word}",
    "paper units": "energy.units=paper solver.presolve=true",
}
"""Settings of solves; a result with exit code 0 or 1 is checked afterwards."""


def _checked(w: World, o: Path, argv: list[str]) -> list[str]:
    """Solve, and return the check of the result; where the solve is refused, the solve."""
    code = main(argv)
    if code == 2:
        return argv
    assert code in (0, 1), code
    if code == 0:
        return ["check", str(o / "out")]
    # a result that did not converge may fail the check, but the check must end without error
    assert main(["check", str(o / "out")]) in (0, 1)
    return words("show {p}", w, o)


def _scaled(w: World, o: Path, scale: str) -> list[str]:
    text = w.problem(depth=str(depth_png(o)), depth_scale=float(scale))
    write(o / "p.yaml", text)
    return _checked(w, o, words("solve {o}/p.yaml -q -o {out}", w, o))


def solve_cases() -> Iterator[Case]:
    def settings(w: World, o: Path, text: str) -> list[str]:
        line = " ".join(f"--set {item}" for item in text.replace(":", ":\t").split(" "))
        return _checked(w, o, [x.replace(":\t", ": ") for x in words(f"{{solve}} {line}", w, o)])

    def focal(w: World, o: Path, x: str) -> list[str]:
        return _checked(w, o, words(f"{{solve}} --intrinsics={x},{x},32,24", w, o))

    for title, do, values in (
        ("solve {}", settings, SOLVES),
        ("solve focal {}", focal, ("1e5", "1e7", "1e9")),
        ("solve depth_scale {}", _scaled, ("1e-300", "1e300", "1e-30")),
    ):
        yield from cases("2 results", title, do, values, (0, 2), solves=True)


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
                # --serve 0 takes any free port, and serves until it is stopped
                if (word, value) != ("--serve", "0"):
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
    return Case(DOORS, title, run, ANY, solves=command in SOLVING)


PRESETS = ("", "Paper", "../paper", "paper,paper", "[paper]", "{a: 1}", "\x1b[31m", "3", "~")


def preset_cases() -> Iterator[Case]:
    yield from cases(DOORS, "preset {}", "show {p} --preset={x}", PRESETS, other={"~": (0,)})
    fine = {"~": (0,), "": (0,)}
    yield from cases(DOORS, "preset of a file {}", "show {p} --set preset={x}", PRESETS, other=fine)
