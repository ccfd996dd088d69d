"""Numbers beyond any use, and solves at the edge of what is allowed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
from helpers_odd_run import Case
from helpers_odd_world import CAMERA, SIZE, World, problem_case, solve

from soup_nlp.cli.main import main
from soup_nlp.config.problem import Problem
from soup_nlp.schema.section import Section


def numeric_fields(model: type[Section], place: str = "") -> Iterator[tuple[str, bool]]:
    """Names of options that are numbers, and whether they are whole."""
    for key, info in model.model_fields.items():
        kind = info.annotation
        if place == "" and key == "input":
            continue
        if isinstance(kind, type) and issubclass(kind, Section):
            yield from numeric_fields(kind, f"{place}{key}.")
        elif "float" in str(kind):
            yield f"{place}{key}", False
        elif "int" in str(kind):
            yield f"{place}{key}", True


def number_cases() -> Iterator[Case]:
    for name, whole in numeric_fields(Problem):
        listed = name == "solver.presolve_eps"
        for value in (
            ("1" + "0" * 30, "1000000000", "-1")
            if whole
            else ("1e300", "1e9", "1e-300", "-1", ".nan")
        ):
            text = f"[{value}]" if listed else value
            if name == "solver.ipopt":
                text = f"{{tol: {value}}}"

            def extreme(w: World, o: Path, name=name, text=text) -> list[str]:
                more = ["--set", "solver.presolve=true"] if name.startswith("solver.pre") else []
                if name.startswith("refine"):
                    more = [
                        "--set",
                        "refine.enabled=true",
                        "--set",
                        "refine.from_start=true",
                        "--set",
                        "refine.rounds=1",
                        "--set",
                        "refine.particles=4",
                    ]
                if name.startswith("flow.dis"):
                    more = ["--set", "flow.source=dis"]
                return solve(w, o, *more, "--set", f"{name}={text}")

            free = value in ("1e9", "1e-300") or "sigma" in name or name == "solver.ipopt"
            yield Case("2 numbers", f"number {name}={text}", extreme, (0, 1, 2), solves=free)
    for key, values in {
        "width": ("63", "1" + "0" * 30, "1000000", "-5"),
        "height": ("47", "1" + "0" * 30, "1000000"),
        "seed": ("1" + "0" * 30, "-1", "5000000000"),
    }.items():
        for value in values:

            def scene(w: World, o: Path, key=key, value=value) -> list[str]:
                own = {"width": "64", "height": "48", "seed": "0"} | {key: value}
                text = ", ".join(f"{k}: {v}" for k, v in own.items())
                path = problem_case(w, o, f"input: {{kind: scene, scene: street, {text}}}\n")
                more = [
                    "flow.source=truth",
                    "segmentation.superpixels=12",
                    "segmentation.neighbours=4",
                    "refine.enabled=false",
                    "solver.presolve=false",
                    "solver.max_iter=1",
                ]
                return [
                    "solve",
                    str(path),
                    "-o",
                    str(o / "out"),
                    "-q",
                    *(x for m in more for x in ("--set", m)),
                ]

            yield Case("5 doors", f"scene {key}={value}", scene, (0, 1, 2))
    for number in ("nan", "inf", "1e300", "1e-300", "-60", "0", "1e9", "1e5"):
        for at in range(4):

            def camera(w: World, o: Path, number=number, at=at) -> list[str]:
                words = CAMERA.split(",")
                words[at] = number
                return solve(w, o, f"--intrinsics={','.join(words)}")

            free = number in ("1e9", "1e5", "0", "-60", "1e-300")
            yield Case("2 numbers", f"intrinsics {at} {number}", camera, (0, 1, 2), solves=free)
    for number in ("nan", "inf", "1e300", "1e-300", "-1", "0"):
        for option in ("--depth-scale", "--cap"):

            def score(w: World, o: Path, number=number, option=option) -> list[str]:
                depth = o / "d.png"
                cv2.imwrite(str(depth), np.full(SIZE, 2000, np.uint16))
                return ["evaluate", str(w.result), "--depth", str(depth), f"{option}={number}"]

            yield Case("2 numbers", f"evaluate {option}={number}", score, (0, 2))
    for option, verb in {
        "--seconds": "compare",
        "--iterations": "compare",
        "--tol": "compare",
        "--memory": "compare",
    }.items():
        for number in ("nan", "inf", "1e300", "0", "-1", "x"):

            def limit(w: World, o: Path, number=number, option=option, verb=verb) -> list[str]:
                return [
                    verb,
                    str(w.good("p.yaml")),
                    "--solvers",
                    "no_such_solver",
                    f"{option}={number}",
                    "-o",
                    str(o / "out"),
                ]

            yield Case("2 numbers", f"{verb} {option}={number}", limit, (2,))


SOLVES: dict[str, tuple[str, ...]] = {
    "min_facing 0.5": ("formulation.min_facing=0.5",),
    "min_facing 0.3": ("formulation.min_facing=0.3", "solver.presolve=true"),
    "min_facing 0.5 presolved": ("formulation.min_facing=0.5", "solver.presolve=true"),
    **{
        f"unit-translation {norm}": (
            "formulation.gauge=unit-translation",
            f"formulation.norm={norm}",
            "solver.presolve=true",
            "solver.max_iter=10",
        )
        for norm in ("smooth", "epigraph")
    },
    "depth_ratio 1": ("formulation.depth_ratio=1",),
    "depth_ratio 1 presolved": ("formulation.depth_ratio=1", "solver.presolve=true"),
    "no weight": tuple(
        f"energy.weights.{k}=0" for k in ("arap", "proj", "cont", "orient", "prior")
    ),
    "no weight presolved": (
        *(f"energy.weights.{k}=0" for k in ("arap", "proj", "cont", "orient", "prior")),
        "solver.presolve=true",
    ),
    "no weight refined": (
        *(f"energy.weights.{k}=0" for k in ("arap", "proj", "cont", "orient", "prior")),
        "refine.enabled=true",
        "refine.from_start=true",
        "refine.rounds=1",
    ),
    "seed 2^31": ("seed=2147483648",),
    "seed 2^32": ("seed=4294967296",),
    "seed 2^63": ("seed=9223372036854775808",),
    "one superpixel": ("segmentation.superpixels=1",),
    "two superpixels": ("segmentation.superpixels=2", "segmentation.neighbours=1"),
    "more neighbours than superpixels": ("segmentation.neighbours=12",),
    "all boundary samples": ("segmentation.boundary_samples=all",),
    "all pixels": ("energy.pixel_samples=all",),
    "no iterations": ("solver.max_iter=0",),
    "unknown ipopt option": ("solver.ipopt={no_such: 1}",),
    "wrong ipopt value": ("solver.ipopt={max_iter: word}",),
    "paper units": ("energy.units=paper", "solver.presolve=true"),
}
"""Settings of solves; what ends with 0 or 1 is checked afterwards."""


def solve_cases() -> Iterator[Case]:
    for name, items in SOLVES.items():
        yield Case("2 results", f"solve {name}", checked(*items), (0, 2), solves=True)
    for focal in ("1e5", "1e7", "1e9"):
        yield Case(
            "2 results",
            f"solve focal {focal}",
            checked(camera=f"{focal},{focal},32,24"),
            (0, 2),
            solves=True,
        )
    for scale in ("1e-300", "1e300", "1e-30"):
        yield Case(
            "2 results", f"solve depth_scale {scale}", checked(scale=scale), (0, 2), solves=True
        )


def checked(
    *items: str, camera: str = CAMERA, scale: str | None = None
) -> Callable[[World, Path], list[str]]:
    """A solve whose result is checked; what is refused is run again as the case."""

    def do(w: World, o: Path) -> list[str]:
        words = [x for item in items for x in ("--set", item)]
        if scale is None:
            argv = solve(w, o, *words, intrinsics=camera)
        else:
            cv2.imwrite(str(o / "d.png"), np.full(SIZE, 2000, np.uint16))
            text = w.problem(depth=str(o / "d.png")).replace(
                "  kind: files", f"  kind: files\n  depth_scale: {scale}"
            )
            argv = ["solve", str(problem_case(w, o, text)), *words, "-o", str(o / "out"), "-q"]
        code = main(argv)
        if code == 2:
            return argv
        assert code in (0, 1), code
        # what is not claimed need not hold, but the check ends well all the same
        if code == 1:
            assert main(["check", str(o / "out")]) in (0, 1)
            return ["show", str(w.good("p.yaml"))]
        return ["check", str(o / "out")]

    return do
