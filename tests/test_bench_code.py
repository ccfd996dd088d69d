"""Code versions: whatever a stored number depends on is in the hash that it is stored under."""

from __future__ import annotations

import ast
from collections.abc import Sequence
from pathlib import Path

from soup_nlp.bench import accuracy, machine
from soup_nlp.bench.accuracy import code_version, measure
from soup_nlp.bench.analyses import ANALYSES


def imported(*begin: str) -> set[str]:
    """Modules of the package that some of its modules import, themselves and theirs included."""
    root = Path(accuracy.__file__).parents[1]
    found, to_read = set(), {root / name for name in begin}
    while to_read:
        path = to_read.pop()
        found.add(path.relative_to(root).as_posix())
        files = set()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                assert node.level == 0
                names = [str(node.module), *(f"{node.module}.{a.name}" for a in node.names)]
            own = [n.split(".")[1:] for n in names if n.startswith("soup_nlp.")]
            files |= {root.joinpath(*n).with_suffix(".py") for n in own}
        to_read |= {f for f in files if f.is_file() and f.relative_to(root).as_posix() not in found}
    return found


DECIDES_NOTHING = (
    # settings are a row's own hash, the pair its key
    *("config*.py", "bench/suites*.py"),
    # written or printed from what is measured
    *(f"report/{name}.py" for name in ("atomic", "colour", "figures", "folder", "pointcloud")),
    *("report/store.py", "report/tree.py", "bench/accuracy_table.py", "bench/published.py"),
    "errors.py",
)
"""What measuring imports without a number depending on it."""


def matched(patterns: Sequence[str]) -> set[str]:
    root = Path(accuracy.__file__).parents[1]
    return {f.relative_to(root).as_posix() for pattern in patterns for f in root.glob(pattern)}


def test_code_version_knows_every_source():
    root = Path(accuracy.__file__).parents[1]
    assert all(list(root.glob(p)) for p in (*accuracy.CODE, *machine.CODE, *DECIDES_NOTHING))
    assert code_version().startswith("0.")
    # every function that measures a row for an analysis
    measures = {a.function.__module__ for a in ANALYSES.values()} | {measure.__module__}
    begin = [m.removeprefix("soup_nlp.").replace(".", "/") + ".py" for m in measures]
    hashed = matched(accuracy.CODE)
    assert not matched(DECIDES_NOTHING) & hashed
    assert imported("pipeline.py", *begin) - matched(DECIDES_NOTHING) <= hashed
    # a timed run ends with the NLP: of the refinement it only reads the options
    unused = matched((*DECIDES_NOTHING, "refine/*.py"))
    assert imported("cases.py", "solve/soup.py") - unused <= matched(machine.CODE)


def test_imports_are_followed_to_the_end():
    found = imported("pipeline.py")
    assert {
        "pipeline.py",
        "cases.py",
        "start/choice.py",
        "mrf/trws.py",
        "mrf/trws_order.py",
    } <= found
    assert "cli.py" not in found
