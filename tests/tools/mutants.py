"""Which bugs the tests do not see: a seeded sample of mutants, by the operators of cosmic-ray.

pip install cosmic-ray coverage
python tests/tools/mutants.py --rooms mrf,export --count 250 --seed 0 --minutes 25

A room is a folder of the package; its tests are in the folder of tests with the same name. They run
once under coverage, with the tests that reach each line and their seconds. Then every mutant runs
the tests that reach its line, the shortest first, until one fails. Annotations and decorators are
not mutated. The report has a row per mutant and the counts by room.
"""

from __future__ import annotations

import argparse
import ast
import difflib
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cosmic_ray.plugins
import coverage
from cosmic_ray.ast import ast_nodes, get_ast_from_path
from cosmic_ray.mutating import mutate_code

ROOT = Path(__file__).resolve().parents[2]
SKIPPED = ("NoOp", "RemoveDecorator", *(f"_{o}" for o in ("BitAnd", "BitOr", "BitXor")))
SKIPPED += ("_LShift", "_RShift")
"""Operators that are left out: bits of floats are a TypeError, which any test sees."""
LONGEST = 6.0
"""Seconds of a test that still runs on mutants."""
ENOUGH = 20.0
"""Seconds of tests that a mutant has to outlive."""


@dataclass(frozen=True)
class Mutant:
    """One changed place.

    Attributes:
        path: Of the module, from the root.
        line: First line of the change.
        operator: Name of cosmic-ray's operator.
        occurrence: Which of its places.
    """

    path: str
    line: int
    operator: str
    occurrence: int


def not_code(text: str) -> list[tuple[int, int, int, int]]:
    """Places of annotations and decorators: begin line and column, end line and column."""
    nodes: list[ast.expr | None] = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            nodes += node.decorator_list
        if isinstance(node, ast.FunctionDef):
            nodes.append(node.returns)
        if isinstance(node, ast.arg | ast.AnnAssign):
            nodes.append(node.annotation)
    return [(n.lineno, n.col_offset, n.end_lineno or 0, n.end_col_offset or 0) for n in nodes if n]


def mutants(path: Path, root: Path) -> Iterator[Mutant]:
    """All mutants of a module."""
    places = not_code(path.read_text())
    tree = get_ast_from_path(path)
    for name in cosmic_ray.plugins.operator_names():
        operator_class = cosmic_ray.plugins.get_operator(name)
        if operator_class.arguments() or name.endswith(SKIPPED):
            continue
        operator = operator_class()
        found = [at for node in ast_nodes(tree) for at in operator.mutation_positions(node)]
        for k, (begin, _) in enumerate(found):
            if not any((a, b) <= begin < (c, d) for a, b, c, d in places):
                yield Mutant(str(path.relative_to(root)), begin[0], name.split("/")[-1], k)


def sample(root: Path, rooms: Sequence[str], count: int, seed: int) -> list[Mutant]:
    """Mutants drawn place by place, so that operators with many variants do not count more."""
    rng, by_place = random.Random(seed), defaultdict(list)
    for room in rooms:
        for path in sorted((root / "soup_nlp" / room).rglob("*.py")):
            for mutant in mutants(path, root):
                family = re.sub(r"_\w+$", "", mutant.operator)
                by_place[mutant.path, mutant.line, family].append(mutant)
    places = rng.sample(sorted(by_place), min(count, len(by_place)))
    return [rng.choice(by_place[place]) for place in places]


def reached(root: Path, rooms: Sequence[str]) -> tuple[dict[tuple[str, int], set[str]], dict]:
    """Tests that reach every line, and the seconds of every test."""
    config = root / "coverage.ini"
    config.write_text("[run]\ndynamic_context = test_function\nsource = soup_nlp\n")
    words = [sys.executable, "-m", "coverage", "run", f"--rcfile={config}", "-m", "pytest"]
    words += ["-p", "no:cacheprovider", "--durations=0", "-vv", "-W", "default"]
    places = {p.stem: str(p.relative_to(root)) for p in (root / "tests").rglob("test_*.py")}
    words += [f"tests/{room}" for room in rooms]
    done = subprocess.run(words, cwd=root, capture_output=True, text=True, check=False)
    seconds: dict[str, float] = defaultdict(float)
    for spent, name in re.findall(r"^([\d.]+)s (?:call|setup)\s+(\S+)", done.stdout, re.M):
        seconds[name.partition("[")[0]] += float(spent)
    print(done.stdout.strip().splitlines()[-1], file=sys.stderr)
    data = coverage.CoverageData(str(root / ".coverage"))
    data.read()
    found: dict[tuple[str, int], set[str]] = defaultdict(set)
    for file in data.measured_files():
        for line, contexts in data.contexts_by_lineno(file).items():
            key = str(Path(file).relative_to(root)), line
            for context in contexts:
                # module.function, or module.Class.function
                module, _, rest = context.partition(".")
                if rest and module in places:
                    found[key].add(f"{places[module]}::{rest.replace('.', '::')}")
    return found, seconds


def reaching(root: Path, mutant: Mutant, tests: Mapping[tuple[str, int], set[str]]) -> set[str]:
    """Tests that reach the statement of a mutant; those of its file where an import runs it."""
    inner = [
        node
        for node in ast.walk(ast.parse((root / mutant.path).read_text()))
        if isinstance(node, ast.stmt) and node.lineno <= mutant.line <= (node.end_lineno or 0)
    ]
    node = max(inner, key=lambda n: n.lineno)
    body = getattr(node, "body", None)
    last = min(node.end_lineno or 0, body[0].lineno - 1 if body else 10**9)
    lines = range(node.lineno, max(last, mutant.line) + 1)
    found = set().union(*(tests.get((mutant.path, line), set()) for line in lines))
    inside = any(isinstance(n, ast.FunctionDef) and n is not node for n in inner)
    if found or inside:
        return found
    return set().union(*(t for (path, _), t in tests.items() if path == mutant.path))


def outcome(root: Path, mutant: Mutant, tests: Sequence[str]) -> str:
    """killed, survived or endless: the tests in a child that has the large libraries."""
    path = root / mutant.path
    text, stamp = path.read_text(), path.stat()
    operator = cosmic_ray.plugins.get_operator(f"core/{mutant.operator}")()
    changed = mutate_code(text, operator, mutant.occurrence)
    if changed is None:
        return "no change"
    path.write_text(changed)
    os.utime(path, (1, 1))  # another time than that of the module's bytecode
    child = os.fork()
    if not child:
        resource.setrlimit(resource.RLIMIT_CPU, (90, 90))
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, 1)
        os.dup2(null, 2)
        os.chdir(root)
        import pytest

        words = ["-x", "-q", "-p", "no:cacheprovider", "--assert=plain", *tests]
        os._exit(int(pytest.main(words)))
    end, done, status = time.monotonic() + 900, 0, 0
    while not done:
        done, status = os.waitpid(child, os.WNOHANG)
        if not done and time.monotonic() > end:
            os.kill(child, signal.SIGKILL)
        time.sleep(0.01)
    path.write_text(text)
    os.utime(path, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))
    if os.WIFSIGNALED(status):
        return "crash" if os.WTERMSIG(status) == signal.SIGSEGV else "endless"
    return "survived" if os.waitstatus_to_exitcode(status) == 0 else "killed"


def children() -> float:
    """CPU seconds of child processes that have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def difference(root: Path, mutant: Mutant) -> str:
    """The changed lines, before and after."""
    text = (root / mutant.path).read_text()
    operator = cosmic_ray.plugins.get_operator(f"core/{mutant.operator}")()
    after = mutate_code(text, operator, mutant.occurrence) or text
    lines = difflib.unified_diff(text.splitlines(), after.splitlines(), lineterm="", n=0)
    return " ".join(line for line in lines if not line.startswith(("---", "+++", "@@")))


def tree(place: Path) -> Path:
    """A copy of the package and its tests, to be changed."""
    for name in ("soup_nlp", "tests", "problems"):
        shutil.copytree(ROOT / name, place / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", place)
    return place


def main() -> None:
    """Print a line per mutant that is not killed, and the counts."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rooms", default="mrf,model,solve,export,evaluate,report")
    parser.add_argument("--count", type=int, default=250)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=25, help="CPU minutes, the rest is left")
    options = parser.parse_args()
    rooms = options.rooms.split(",")
    counts: dict[str, Counter[str]] = {room: Counter() for room in rooms}
    with tempfile.TemporaryDirectory(prefix="soup_mutants_") as place:
        root = tree(Path(place))
        sys.path.insert(0, str(root))
        os.environ["PYTHONPATH"] = f"{root}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
        tests, seconds = reached(root, rooms)
        print(f"{children():.0f} CPU s of tests under coverage", file=sys.stderr)
        for mutant in sample(root, rooms, options.count, options.seed):
            if children() > 60 * options.minutes:
                break
            chosen, spent = [], 0.0
            for test in sorted(reaching(root, mutant, tests), key=lambda t: seconds[t]):
                spent += seconds[test]
                if seconds[test] <= LONGEST and spent <= ENOUGH:
                    chosen.append(test)
            found = outcome(root, mutant, chosen) if chosen else "not reached"
            counts[Path(mutant.path).parts[1]][found] += 1
            if found not in ("killed", "endless"):
                where = f"{mutant.path}:{mutant.line}"
                print(f"{found}  {where}  {difference(root, mutant)}", flush=True)
    kinds = sorted({kind for room in rooms for kind in counts[room]})
    print("\nroom        " + "".join(f"{kind:>13}" for kind in kinds))
    for room in rooms:
        print(f"{room:<12}" + "".join(f"{counts[room][kind]:>13}" for kind in kinds))
    print(f"{children():.0f} CPU s")


if __name__ == "__main__":
    main()
