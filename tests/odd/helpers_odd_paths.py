"""Odd names and kinds of files at every door."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

from helpers_odd_run import Case
from helpers_odd_world import ODD, World, problem_case, settings, solve

Words = Callable[[World, Path, str], list[str]]

READ: dict[str, tuple[str, Words]] = {
    "solve --ref": (".png", lambda w, o, x: solve(w, o, ref=x)),
    "solve --ref alone": (
        ".png",
        lambda w, o, x: [
            *("solve", "--ref", x, "--next", str(w.good("b.png"))),
            "-o",
            str(o / "out"),
            "-q",
        ],
    ),
    "view": ("", lambda w, o, x: ["view", x, "--no-open"]),
    "convert": ("", lambda w, o, x: ["convert", x, "--to", "glb", "-o", str(o / "out")]),
    "chain": ("", lambda w, o, x: ["chain", x, "-q", "-o", str(o / "out")]),
    "chain image": (".png", lambda w, o, x: ["chain", x, x, "-q", "-o", str(o / "out")]),
    "solve --next": (".png", lambda w, o, x: solve(w, o, next=x)),
    "solve --intrinsics": (".txt", lambda w, o, x: solve(w, o, intrinsics=x)),
    "solve --flow flo": (".flo", lambda w, o, x: solve(w, o, flow=x)),
    "solve --flow npy": (".npy", lambda w, o, x: solve(w, o, flow=x)),
    "solve --flow png": (".png", lambda w, o, x: solve(w, o, flow=x)),
    "solve --flow onnx": (".onnx", lambda w, o, x: solve(w, o, flow=x)),
    "solve --depth npy": (".npy", lambda w, o, x: solve(w, o, depth=x)),
    "solve --depth dpt": (".dpt", lambda w, o, x: solve(w, o, depth=x)),
    "solve --depth pfm": (".pfm", lambda w, o, x: solve(w, o, depth=x)),
    "solve --depth png": (".png", lambda w, o, x: solve(w, o, depth=x)),
    "solve PROBLEM": (".yaml", lambda w, o, x: ["solve", x, "-o", str(o / "out")]),
    "show": (".yaml", lambda w, o, x: ["show", x]),
    "export": (".yaml", lambda w, o, x: ["export", x, "-o", str(o / "out")]),
    "compare": (
        ".yaml",
        lambda w, o, x: ["compare", x, "-o", str(o / "out"), "--solvers", "ipopt"],
    ),
    "check": ("", lambda w, o, x: ["check", x]),
    "check .sol": (".sol", lambda w, o, x: ["check", x, "--export", str(w.exported)]),
    "check --export": ("", lambda w, o, x: ["check", str(w.exported / "soup.sol"), "--export", x]),
    "evaluate": ("", lambda w, o, x: ["evaluate", x, "--depth", str(w.good("d.npy"))]),
    "evaluate --depth": (".npy", lambda w, o, x: ["evaluate", str(w.result), "--depth", x]),
    "import DIR": (
        "",
        lambda w, o, x: ["import", x, str(w.exported / "soup.sol"), "-o", str(o / "out")],
    ),
    "import .sol": (".sol", lambda w, o, x: ["import", str(w.exported), x, "-o", str(o / "out")]),
    "bench speed --check": (
        ".json",
        lambda w, o, x: ["bench", "speed", "--check", x, "-o", str(o / "out")],
    ),
    "list": ("", lambda w, o, x: ["list", x]),
    "bench accuracy --data": (
        "",
        lambda w, o, x: [
            "bench",
            "accuracy",
            "--suite",
            "sintel",
            "--data",
            x,
            "-o",
            str(o / "out"),
        ],
    ),
}
"""Doors through which a file or folder is read: its suffix and the command."""

DATASETS = {
    "folder": "path: {}",
    "tum": "path: {}",
    "sintel": "root: {}, scene: alley_1, frame: 1",
    "kitti2015": 'root: {}, index: "000001"',
    "vkitti2": "root: {}, scene: Scene01, frame: 0",
}
WRITE: dict[str, Words] = {
    "solve": lambda w, o, x: ["solve", *w.pair(), *settings(), "-q", "-o", x],
    "export": lambda w, o, x: ["export", str(w.good("p.yaml")), "-q", "-o", x],
    "compare": lambda w, o, x: ["compare", str(w.good("p.yaml")), "--solvers", "ipopt", "-o", x],
    "import": lambda w, o, x: ["import", str(w.exported), str(w.exported / "soup.sol"), "-o", x],
    "bench speed": lambda w, o, x: [
        "bench",
        "speed",
        "--scenes",
        "street",
        "--sizes",
        "12",
        "--neighbours",
        "4",
        "--seeds",
        "0",
        "--width",
        "64",
        "--height",
        "48",
        "-o",
        x,
    ],
}
NO_FOLDER = ("pipe", "zero", "null", "socket", "nul", "long", "deep", "loop", "garbage")
"""Kinds that no output folder can be made at."""

INSTEAD = ("pipe", "zero", "null", "random", "socket", "folder", "dangling", "loop", "empty")
"""Kinds of which a file of a result is replaced."""
RESULT = ("depth_ref.png", "points_next.ply", "overview.png", "result.h5", "summary.json")

FOLDERS = ("check", "check --export", "evaluate", "import DIR", "list", "bench accuracy --data")
"""Doors of folders."""


def path_cases() -> Iterator[Case]:
    for door, (suffix, words) in READ.items():
        for kind in ODD:
            # an empty folder lists no problem, which is no mistake
            codes = (0,) if (door, kind) == ("list", "folder") else (2,)

            def do(w: World, o: Path, words=words, kind=kind, suffix=suffix) -> list[str]:
                return words(w, o, w.odd(kind, suffix))

            yield Case("5 doors", f"{door} {kind}", do, codes)
    for dataset, text in DATASETS.items():
        for kind in ODD:

            def load(w: World, o: Path, dataset=dataset, text=text, kind=kind) -> list[str]:
                name = text.format(json.dumps(w.odd(kind, ""), ensure_ascii=True))
                path = problem_case(w, o, f"input: {{kind: {dataset}, {name}}}\n")
                return ["solve", str(path), "-o", str(o / "out")]

            yield Case("5 doors", f"dataset {dataset} {kind}", load)
    for door, write in WRITE.items():
        for kind in NO_FOLDER:
            yield Case(
                "5 doors", f"{door} -o {kind}", lambda w, o, d=write, k=kind: d(w, o, w.odd(k, ""))
            )
    for name in RESULT:
        for kind in INSTEAD:

            def replaced(w: World, o: Path, name=name, kind=kind) -> list[str]:
                copy = o / "copy"
                shutil.copytree(w.result, copy)
                (copy / name).unlink()
                ODD[kind](copy / name)
                return ["check", str(copy)]

            needed = name in ("result.h5", "summary.json")
            yield Case("3 check", f"check {name} {kind}", replaced, (2,) if needed else (1,))
