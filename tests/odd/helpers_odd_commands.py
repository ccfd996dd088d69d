"""Odd files and texts as inputs of all commands."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from helpers_odd_run import ANY, Case, cases, changed, write, written
from helpers_odd_world import NO_FOLDER, ODD, World

# --- files ---------------------------------------------------------------------------------------

READ = {
    **{
        f"solve --{option} {suffix}": f"{{solve}} --{option} {{odd.{suffix}}}"
        for option, suffixes in {
            "intrinsics": "txt",
            "flow": "flo npy png onnx",
            "flow-confidence": "npy",
            "flow-backward": "npy",
            "depth": "npy dpt pfm png",
        }.items()
        for suffix in suffixes.split()
    },
    "solve REF": "solve {odd.png} {b} -q -o {out}",
    "solve NEXT": "solve {a} {odd.png} -q -o {out}",
    "solve PROBLEM": "solve {odd.yaml} -o {out}",
    "view": "view {odd} --no-open",
    "convert": "convert {odd} --to glb -o {out}",
    "chain": "chain {odd} -q -o {out}",
    "chain image": "chain {odd.png} {odd.png} -q -o {out}",
    "chain video": "chain {odd.mp4} -q -o {out}",
    "show": "show {odd.yaml}",
    "export": "export {odd.yaml} -o {out}",
    "compare": "compare {odd.yaml} --solvers ipopt -o {out}",
    "check": "check {odd}",
    "check .sol": "check {odd.sol} --export {exported}",
    "check --export": "check {sol} --export {odd}",
    "evaluate": "evaluate {odd} --depth {d}",
    "evaluate --depth": "evaluate {result} --depth {odd.npy}",
    "import DIR": "import {odd} {sol} -o {out}",
    "import .sol": "import {exported} {odd.sol} -o {out}",
}
"""Commands that read a file or folder."""

DATASETS = {
    "folder": "path: {}",
    "tum": "path: {}",
    "sintel": "root: {}, scene: alley_1, frame: 1",
    "kitti2012": 'root: {}, index: "000001"',
    "kitti2015": 'root: {}, index: "000001"',
    "vkitti1": 'root: {}, scene: "0001", frame: 0',
    "vkitti2": "root: {}, scene: Scene01, frame: 0",
}
WRITE = {
    "solve": "{solve} -o {odd}",
    "export": "export {p} -q -o {odd}",
    "compare": "compare {p} --solvers ipopt -o {odd}",
    "import": "import {exported} {sol} -o {odd}",
    "chain": "chain {a} {b} {tiny} -q -o {odd}",
    "convert": "convert {result} --to npy -o {odd}",
    "demo": "demo -o {odd}",
}
KINDS = tuple(ODD)
INSTEAD = ("pipe", "zero", "null", "random", "socket", "folder", "dangling", "loop", "empty")
"""Kinds of odd files that replace a file of a result."""


def _instead(path: Path, kind: str) -> None:
    path.unlink(missing_ok=True)
    ODD[kind](path)


def _dataset(name: str, text: str) -> Any:
    def make(w: World, o: Path, kind: str) -> str:
        root = text.format(json.dumps(w.odd(kind), ensure_ascii=True))
        write(o / "p.yaml", f"input: {{kind: {name}, {root}}}\n")
        return str(o / "p.yaml")

    return make


def path_cases() -> Iterator[Case]:
    for door, line in READ.items():
        yield from cases(f"{door} {{}}", line, KINDS)
    for name, text in DATASETS.items():
        make = _dataset(name, text)
        yield from cases(f"dataset {name} {{}}", "solve {x} -o {out}", KINDS, make=make)
    for door, line in WRITE.items():
        yield from cases(f"{door} -o {{}}", line, NO_FOLDER)
    for name in ("depth_ref.png", "points_next.ply", "overview.png", "result.h5", "summary.json"):
        codes = (2,) if name in ("result.h5", "summary.json") else (1,)
        make = changed("result", name, _instead)
        yield from cases(f"check {name} {{}}", "check {x}", INSTEAD, codes, make=make)
    page = changed("result", "report.html", _instead)
    yield from cases("view page {}", "view {x} --no-open", INSTEAD, (0, 2), make=page)


# --- texts ---------------------------------------------------------------------------------------

TEXTS: dict[str, str | bytes] = {
    "deep JSON": "[" * 100_000,
    "deep mapping": '{"a":' * 100_000,
    "deep YAML": "- " * 5_000 + "a",
    "huge integer": '{"schema": 1' + "0" * 400 + "}",
    "very huge integer": '{"schema": 1' + "0" * 10_000 + "}",
    "number for text": "3",
    "null": "null",
    "list": "[1, 2]",
    "text": '"word"',
    "NaN": "NaN",
    "binary": bytes(range(256)) * 8,
    "latin": b'{"name": "caf\xe9"}',
    "utf-16": '{"name": "x"}'.encode("utf-16"),
    "nul bytes": b"\0" * 5000,
    "control characters": '{"name": "\\u001b[31mred"}',
    "bomb": "a: &a [1,1]\n"
    + "".join(
        f"{b}: &{b} [{','.join([f'*{a}'] * 9)}]\n" for a, b in zip("abcdefghijkl", "bcdefghijklm")
    ),
    "self": "&a [*a]",
    "tag": "!!python/object/apply:os.abort []",
    "lone surrogate": '{"name": "\\ud800"}',
    "one line": "a" * 2_000_000,
    "empty": "",
    "keys": "{[1, 2]: 3}",
    "unhashable": "? {a: 1}\n: 2\n",
    "binary tag": "name: !!binary 'aGVsbG8='",
    "date": "2020-01-01",
    "set": "!!set {a, b}",
}
FEW = ("deep JSON", "very huge integer", "binary", "control characters", "nul bytes")
"""Texts that are tried where a case takes a second; count_odd.py tries the others."""
USES: dict[str, tuple[str, Any, tuple[int, ...]]] = {
    "summary": ("check {x}", changed("result", "summary.json"), (2,)),
    "config": ("check {x}", changed("result", "config.yaml"), (1, 2)),
    "manifest": ("import {x} {sol} -o {out}", changed("exported", "manifest.json"), (2,)),
    "over manifest": ("export {p} -q -o {x}", changed("exported", "manifest.json"), (0, 2)),
    "problem": ("check {x}/soup.sol", changed("exported", "problem.yaml"), (2,)),
    "show": ("show {x}", written("p.yaml"), (2,)),
}
"""Commands that read a text, by the file or argument that has it."""


def text_cases() -> Iterator[Case]:
    for use, (line, make, codes) in USES.items():
        solves = TEXTS.keys() - FEW if use in ("config", "over manifest") else False
        title = f"text {use} {{}}"
        yield from cases(title, line, TEXTS, codes, make=make, solves=solves)
    spoken = {
        name: text if isinstance(text, str) else text.decode("utf-8", "surrogateescape")
        for name, text in TEXTS.items()
    }
    spoken = {k: v for k, v in spoken.items() if "\0" not in v and len(v) < 100_000}
    yield from cases("text --set {}", "show {p} --set name={x}", spoken, (0, 2))
    # the command ends with an error after it has read the rows
    line = "compare {p} --solvers no_such_solver -o {o}"
    yield from cases("rows {}", line, TEXTS, ANY, make=written("runs.jsonl"))


UNTRUSTED = {
    "escape": "\x1b[31mred\x1b]0;title\x07\x9b5m\u202e\r\x08",
    "long": "x" * 100_000,
    "lines": "a\n" * 5000,
}


def _named(line: str) -> Any:
    """Writes the tiny problem with a first line, in which {} stands for the value in JSON."""

    def make(w: World, o: Path, text: str) -> str:
        write(o / "p.yaml", line.replace("{}", json.dumps(text)) + "\n" + w.problem())
        return str(o / "p.yaml")

    return make


def _answer(w: World, o: Path, text: str) -> str:
    """An answer whose message is the text."""
    old = (w.exported / "soup.sol").read_text().partition("\n")[2]
    (o / "soup.sol").write_text(f"{text}\n{old}", encoding="utf-8", newline="")
    return str(o / "soup.sol")


def _manifest(path: Path, text: str) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | {"name": text}))


def _status(path: Path, text: str) -> None:
    summary = json.loads(path.read_text())
    summary["status"] = summary["metrics"]["solution"]["scale_rule"] = text
    summary["metrics"][text] = summary["metrics"]["solution"]
    path.write_text(json.dumps(summary))


UNTRUSTING: dict[str, tuple[str, Any, tuple[int, ...]]] = {
    "sol message": ("check {x} --export {exported}", _answer, (1,)),
    "sol message imported": ("import {exported} {x} -o {out}", _answer, (1, 2)),
    "manifest": ("check {x}/soup.sol", changed("exported", "manifest.json", _manifest), (1,)),
    "problem name": ("solve {x} -o {out}", _named("name: {}"), ANY),
    "problem name exported": (
        "export {x} --superpixels 12", _named("name: {}"), (0, 2)
    ),
    "unknown key": ("show {x}", _named("{}: 1"), (2,)),
    "wrong value": ("show {x}", _named("seed: {}"), (2,)),
    "option": ("solve --{x}", None, (2,)),
    "verb": ("{x}", None, (2,)),
    "override": ("show {p} --set {x}", None, (2,)),
    "solver": ("compare {p} --solvers {x} -o {out}", None, (2,)),
    "coordinates": ("export {p} --coordinates {x} -o {out}", None, (2,)),
    "scale": ("evaluate {result} --depth {d} --scale {x}", None, (2,)),
    "flow": ("{solve} --flow {x}", None, (2,)),
    "summary": ("check {x}", changed("result", "summary.json", _status), (1, 2)),
}  # fmt: skip
"""Commands with an untrusted text in a file or argument."""


def untrusted_cases() -> Iterator[Case]:
    for use, (line, make, codes) in UNTRUSTING.items():
        yield from cases(f"{use} {{}}", line, UNTRUSTED, codes, make=make)
