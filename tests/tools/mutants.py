"""Which bugs the tests do not see: a seeded sample of mutants, by the operators of cosmic-ray.

pip install cosmic-ray
python tests/tools/mutants.py --rooms mrf,export --count 250 --seed 0 --minutes 25

A room is a folder of the package or of one of its rooms (data/formats); its tests are in the folder
of tests with the room's name. Every mutant runs the fast ones of them until one fails. Annotations
and decorators are not mutated. The report has a row per mutant that survives, and counts by room.
"""

import argparse
import ast
import difflib
import random
import re
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import cosmic_ray.plugins
from constraint_mutants import copied, killer
from cosmic_ray.ast import ast_nodes, get_ast_from_path
from cosmic_ray.mutating import mutate_code

SKIPPED = ("NoOp", "RemoveDecorator", *(f"_{o}" for o in ("BitAnd", "BitOr", "BitXor")))
SKIPPED += ("_LShift", "_RShift")
"""Operators that are left out: bits of floats are a TypeError, which any test sees."""


class Mutant(NamedTuple):
    """One changed place: a module from the root, its line, cosmic-ray's operator, which of its
    places."""

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


def mutated(root: Path, mutant: Mutant) -> str:
    """The text of the module with the change."""
    operator = cosmic_ray.plugins.get_operator(f"core/{mutant.operator}")()
    text = (root / mutant.path).read_text()
    return mutate_code(text, operator, mutant.occurrence) or text


def main() -> None:
    """Print a line per mutant that survives, and the counts."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rooms", default="mrf,model,solve,export,evaluate,report")
    parser.add_argument("--count", type=int, default=250)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--minutes", type=float, default=25, help="the rest of the sample is left")
    options = parser.parse_args()
    rooms, end = options.rooms.split(","), time.monotonic() + 60 * options.minutes
    killed, alive = Counter[str](), Counter[str]()
    with tempfile.TemporaryDirectory(prefix="soup_mutants_") as place:
        root = copied(Path(place))
        for mutant in sample(root, rooms, options.count, options.seed):
            if time.monotonic() > end:
                break
            module = root / mutant.path
            room = next(r for r in rooms if mutant.path.startswith(f"soup_nlp/{r}/"))
            text = mutated(root, mutant)
            if killer(root, module, text, f"tests/{room.split('/')[0]}"):
                killed[room] += 1
                continue
            alive[room] += 1
            before = module.read_text().splitlines()
            lines = difflib.unified_diff(before, text.splitlines(), lineterm="", n=0)
            change = [line for line in lines if not line.startswith(("---", "+++", "@@"))]
            print(f"{mutant.path}:{mutant.line}  {' '.join(change)}", flush=True)
    print("\nroom          killed  survived")
    for room in rooms:
        print(f"{room:<12}{killed[room]:>8}{alive[room]:>10}")


if __name__ == "__main__":
    main()
