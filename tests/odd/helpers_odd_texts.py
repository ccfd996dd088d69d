"""Odd JSON, YAML and rows, and text that nobody should trust."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

from helpers_odd_run import Case
from helpers_odd_world import ODD, World, problem_case, solve

from soup_nlp.storage.rows import append_row, read_rows

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
        f"{chr(98 + k)}: &{chr(98 + k)} [{','.join(['*' + chr(97 + k)] * 9)}]\n" for k in range(12)
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
"""What is tried where a case takes a second: the others are left to count_odd.py."""


def _write(path: Path, text: str | bytes) -> None:
    path.write_bytes(text.encode() if isinstance(text, str) else text)


Use = tuple[Callable[[World, Path, str | bytes, str], list[str]], tuple[int, ...], bool]
"""Command line of a world, a folder, a text and its name; exit codes; whether it may solve."""


def replaced(w: World, which: str, file: str, text: str | bytes, name: str) -> Path:
    """A copy of a folder in which a file holds a text."""
    copy = w.root / "copies" / f"{file} {name}"
    if not copy.exists():
        _write(w.copy(which, copy.name) / file, text)
    return copy


def manifest(w: World, text: str | bytes, name: str) -> str:
    return str(replaced(w, "exported", "manifest.json", text, name))


USES: dict[str, Use] = {
    "summary": (
        lambda w, o, t, n: ["check", str(replaced(w, "result", "summary.json", t, n))], (2,), False,
    ),
    "config": (
        lambda w, o, t, n: ["check", str(replaced(w, "result", "config.yaml", t, n))], (1, 2), True,
    ),
    "manifest": (
        lambda w, o, t, n: [
            "import", manifest(w, t, n), str(w.exported / "soup.sol"), "-o", str(o / "out"),
        ],
        (2,), False,
    ),
    "over manifest": (
        lambda w, o, t, n: [
            "export", str(w.good("p.yaml")), "-o", manifest(w, t, f"{n} over"), "-q",
        ],
        (0, 2), True,
    ),
    "problem": (
        lambda w, o, t, n: [
            "check", str(replaced(w, "exported", "problem.yaml", t, n) / "soup.sol"),
        ],
        (2,), False,
    ),
    "show": (lambda w, o, t, n: ["show", str(problem_case(w, o, t))], (2,), False),
    "list": (lambda w, o, t, n: ["list", str(problem_case(w, o, t).parent)], (0, 2), False),
    "baseline": (
        lambda w, o, t, n: [
            "bench", "speed", "--check", str(problem_case(w, o, t)), "-o", str(o / "out"),
        ],
        (2,), False,
    ),
}  # fmt: skip
"""Commands that read a text, by what it stands for."""


def text_cases() -> Iterator[Case]:
    for name, text in TEXTS.items():
        for use, (words, codes, solves) in USES.items():
            yield Case(
                "5 doors", f"text {use} {name}",
                lambda w, o, t=text, n=name, f=words: f(w, o, t, n),
                codes, solves=solves and name not in FEW,
            )  # fmt: skip
        word = text if isinstance(text, str) else text.decode("utf-8", "surrogateescape")
        if "\0" not in word and len(text) < 100_000:
            yield Case(
                "5 doors", f"text --set {name}",
                lambda w, o, t=word: ["show", str(w.good("p.yaml")), "--set", f"name={t}"],
                (0, 2),
            )  # fmt: skip
    for kind in ODD:

        def odd_in_list(w: World, o: Path, kind=kind) -> list[str]:
            name = w.odd(kind, ".yaml")
            if (
                Path(name).parent == w.root / "odd"
                and "\0" not in name
                and len(name) < 250
                and kind not in ("newline", "escape")
            ):
                (o / "link.yaml").symlink_to(name)
            elif kind in ("newline", "escape"):
                (o / Path(name).name).write_text("# fine\n")
            return ["list", str(o)]

        yield Case("5 doors", f"list of {kind}", odd_in_list, (0, 2))


ROWS: dict[str, bytes] = {
    "binary": bytes(range(256)) * 8,
    "one line": b"a" * 2_000_000,
    "deep": b"[" * 100_000 + b"\n",
    "latin": b'{"key": "caf\xe9"}\n',
    "huge integer": b'{"seconds": 1' + b"0" * 400 + b"}\n",
    "very huge integer": b'{"seconds": 1' + b"0" * 10_000 + b"}\n",
    "other keys": b'{"a": 1}\n{"b": [1]}\n',
    "no mapping": b'3\n"x"\n[1]\nnull\n',
    "nul bytes": b"\0" * 4096,
    "NaN": b'{"key": NaN, "ok": NaN}\n',
    "control": b'{"key": "\\u001b[31m", "error": "\\u001b]0;t\\u0007"}\n',
    "cut": b'{"key": "a", "val',
}


def row_cases() -> Iterator[Case]:
    small = ["--scenes", "street", "--sizes", "12", "--neighbours", "4", "--seeds", "0"]
    size = ["--width", "64", "--height", "48"]
    for name, data in ROWS.items():
        for verb, file in (("compare", "runs.jsonl"), ("speed", "table.jsonl")):

            def rows(w: World, o: Path, data=data, verb=verb, file=file) -> list[str]:
                (o / file).write_bytes(data)
                if verb == "compare":
                    # no such limit of time is enough for a run: the rows are read before
                    words = ["compare", str(w.good("p.yaml")), "--solvers", "no_such_solver"]
                    return [*words, "-o", str(o)]
                wrong = ["--set", "segmentation.superpixels=x"]
                return ["bench", "speed", *small, *size, *wrong, "-o", str(o)]

            yield Case("5 doors", f"rows {verb} {name}", rows, (0, 1, 2))

        def read(w: World, o: Path, data=data) -> None:
            (o / "rows.jsonl").write_bytes(data)
            for row in read_rows(o / "rows.jsonl"):
                assert isinstance(row, dict)
            append_row(o / "rows.jsonl", {"new": 1})
            assert read_rows(o / "rows.jsonl")[-1] == {"new": 1}

        yield Case("5 doors", f"rows read {name}", read, quiet=True)
    for kind in ODD:

        def odd_rows(w: World, o: Path, kind=kind) -> None:
            read_rows(Path(w.odd(kind, ".jsonl")))

        yield Case("5 doors", f"rows read file {kind}", odd_rows, quiet=True)


RED = "\x1b[31mred\x1b]0;title\x07\x9b5m\u202e\r\x08"
LONG = "x" * 100_000


def export_of(w: World, o: Path, *words: str) -> list[str]:
    return ["export", str(w.good("p.yaml")), *words, "-o", str(o / "out")]


def named(w: World, o: Path, line: str) -> str:
    """The tiny problem with a first line."""
    return str(problem_case(w, o, f"{line}\n{w.problem()}"))


UNTRUSTED: dict[str, tuple[Callable[[World, Path, str], list[str]], tuple[int, ...]]] = {
    "problem name exported": (
        lambda w, o, t: [
            "export", named(w, o, f"name: {json.dumps(t)}"), "-o", str(o / "out"),
            "--superpixels", "12", "--superpixels", "13",
        ],
        (0, 2),
    ),
    "unknown key": (lambda w, o, t: ["show", named(w, o, f"{json.dumps(t)}: 1")], (2,)),
    "wrong value": (lambda w, o, t: ["show", named(w, o, f"seed: {json.dumps(t)}")], (2,)),
    "first line": (lambda w, o, t: problem_case(w, o, f"# {t}\n") and ["list", str(o)], (0,)),
    "option": (lambda w, o, t: ["solve", f"--{t}"], (2,)),
    "verb": (lambda w, o, t: [t], (2,)),
    "override": (lambda w, o, t: ["show", str(w.good("p.yaml")), "--set", t], (2,)),
    "solver": (
        lambda w, o, t: [
            "compare", str(w.good("p.yaml")), "--solvers", t, "-o", str(o / "out"),
        ],
        (2,),
    ),
    "formulation": (lambda w, o, t: export_of(w, o, "--formulation", t), (2,)),
    "scale": (
        lambda w, o, t: [
            "evaluate", str(w.result), "--depth", str(w.good("d.npy")), "--scale", t,
        ],
        (2,),
    ),
    "suite": (
        lambda w, o, t: ["bench", "accuracy", "--suite", t, "-o", str(o / "out")], (2,)
    ),
    "flow": (lambda w, o, t: solve(w, o, flow=t), (2,)),
}  # fmt: skip
"""Commands that are given a text that nobody should trust."""


def untrusted_cases() -> Iterator[Case]:
    for name, text in {"escape": RED, "long": LONG, "lines": "a\n" * 5000}.items():

        def sol(w: World, o: Path, text=text, verb="check") -> list[str]:
            path = o / "soup.sol"
            old = (w.exported / "soup.sol").read_text().partition("\n")[2]
            path.write_text(f"{text}\n{old}", encoding="utf-8", newline="")
            if verb == "check":
                return ["check", str(path), "--export", str(w.exported)]
            return ["import", str(w.exported), str(path), "-o", str(o / "out")]

        yield Case("6 untrusted", f"sol message {name}", sol, (1,))
        yield Case(
            "6 untrusted",
            f"sol message {name} imported",
            lambda w, o, f=sol: f(w, o, verb="import"),
            (1, 2),
        )

        def best(w: World, o: Path, text=text, name=name) -> list[str]:
            copy = w.copy("exported", f"best {name}")
            own = json.loads((copy / "manifest.json").read_text())
            own["best_known"] = {"exact_energy": 1e-9, "found_by": text, "objective": 0.0}
            own["name"] = text
            (copy / "manifest.json").write_text(json.dumps(own))
            return ["check", str(copy / "soup.sol")]

        yield Case("6 untrusted", f"best known {name}", best, (1,))

        def title(w: World, o: Path, text=text) -> list[str]:
            path = problem_case(w, o, f"name: {json.dumps(text)}\n" + w.problem())
            return ["solve", str(path), "-o", str(o / "out")]

        yield Case("6 untrusted", f"problem name {name}", title, (0, 1, 2))
        for use, (words, codes) in UNTRUSTED.items():
            yield Case(
                "6 untrusted", f"{use} {name}", lambda w, o, t=text, f=words: f(w, o, t), codes
            )

        def status(w: World, o: Path, text=text, name=name) -> list[str]:
            copy = w.copy("result", f"status {name}")
            own = json.loads((copy / "summary.json").read_text())
            own["status"] = own["metrics"]["solution"]["scale_rule"] = text
            own["metrics"][text] = own["metrics"]["solution"]
            (copy / "summary.json").write_text(json.dumps(own))
            return ["check", str(copy)]

        yield Case("6 untrusted", f"summary {name}", status, (1, 2))
