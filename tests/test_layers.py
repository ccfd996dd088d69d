"""Each room imports only the rooms before it, as docs/architecture.md says."""

import ast
import re
import sys
from collections.abc import Iterator
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "soup_nlp"

_ROOMS = (PACKAGE.parent / "docs/architecture.md").read_text(encoding="utf-8").split("## Rooms")[1]
ALLOWED = {
    room: {name.strip() for name in names.split(",")} - {""}
    for room, names in re.findall(
        r"^\| `(\w+)` \|[^|]*\|([^|]*)\|$", _ROOMS.split("\n## ")[0], re.MULTILINE
    )
}
"""Rooms in their order, and what each may import: the table of docs/architecture.md."""

DOORS = {
    # records cross the door, readers of files do not
    ("model", "data"): {"data.pair"},
    ("start", "data"): {"data.pair"},
    ("start", "model"): {"model.energy_data"},
    ("solve", "data"): {"data.pair"},
    ("refine", "data"): {"data.pair", "data.census"},
}
"""Where one room may enter another only through some of its modules."""

LIBRARIES = {
    "casadi": {"model", "solve", "export"},
    "joblib": {"storage"},
    "h5py": {"storage", "data"},
    "typer": {"cli"},
    "rich": {"cli", "report"},
    "yaml": {"storage", "config", "data", "report", "cli"},
    "cv2": {"data", "start", "report", "sequence"},
    "skimage": {"data", "geometry"},
    "trimesh": {"report"},
    "rerun": {"report"},
}
"""Which rooms may import a library; `importlib.metadata` names versions without importing."""

BENCHMARKS = {"config", "data", "evaluation", "export", "geometry", "sequence", "storage"}
"""Rooms that `benchmarks` enters; the SOUP set builds its NLPs, and enters those below too."""
FAMILY = {"model", "pipeline", "start"}

COMMON = {"arrays", "errors"}
"""Modules beside the rooms that every room may import."""
TOP = {"", "__main__", *COMMON}
"""All modules beside the rooms."""

NUMBERS_ONLY = ("model.formulas", "model.energy_data", "model.layout", "model.reweighting")
"""Modules that must not reach casadi, not even through others: the terms in numpy share nothing
with those in symbols."""


def modules() -> dict[str, Path]:
    """Module name inside the package ("model.nlp", "errors") to file."""
    out = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        if parts[-1] == "__init__":
            parts = parts[:-1]
        out[".".join(parts)] = path
    return out


MODULES = modules()


def called(node: ast.expr) -> str:
    """The last part of a dotted name; "" for any other expression."""
    return getattr(node, "attr", getattr(node, "id", ""))


def imports(path: Path) -> Iterator[tuple[str, bool]]:
    """Names that a file imports, also inside functions and by `import_module`.

    With each name comes whether it is imported for types alone, under `if TYPE_CHECKING:`.
    """
    tree = ast.parse(path.read_text(encoding="utf-8"))
    left = [(tree, False)]
    while left:
        node, typed = left.pop()
        if isinstance(node, ast.If) and called(node.test) == "TYPE_CHECKING":
            left += [(line, True) for line in node.body] + [(line, typed) for line in node.orelse]
            continue
        left += [(inner, typed) for inner in ast.iter_child_nodes(node)]
        if isinstance(node, ast.Call) and called(node.func) == "import_module":
            yield from ((a.value, typed) for a in node.args if isinstance(a, ast.Constant))
        elif isinstance(node, ast.Import):
            yield from ((a.name, typed) for a in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, f"{path} has a relative import"
            yield from ((f"{node.module}.{a.name}", typed) for a in node.names)


def own(name: str) -> str | None:
    """The package's module that an imported name is, or is in; None for a foreign one."""
    if name != "soup_nlp" and not name.startswith("soup_nlp."):
        return None
    inner = name.removeprefix("soup_nlp").lstrip(".")
    while inner and inner not in MODULES:
        inner = inner.rpartition(".")[0]
    return inner


INSIDE: dict[str, set[str]] = {module: set() for module in MODULES}
"""Own modules that every module imports, those for types alone left out."""
WITH_TYPES: dict[str, set[str]] = {module: set() for module in MODULES}
"""The same with those for types alone."""
OUTSIDE: dict[str, set[str]] = {module: set() for module in MODULES}
"""Foreign libraries that every module imports, those for types alone left out."""
for importer, file in MODULES.items():
    for name, for_types in imports(file):
        target = own(name)
        if target is None:
            if not for_types:
                OUTSIDE[importer].add(name.partition(".")[0])
        elif target != importer:
            WITH_TYPES[importer].add(target)
            if not for_types:
                INSIDE[importer].add(target)


def room(module: str) -> str:
    return module.partition(".")[0]


def test_every_room_has_its_place_in_the_order():
    rooms = {room(m) for m, p in MODULES.items() if p.parent != PACKAGE} - {""}
    assert rooms <= ALLOWED.keys(), "a new room: say in docs/architecture.md what it may import"
    order = list(ALLOWED)
    for here, known in ALLOWED.items():
        later = {r for r in known & ALLOWED.keys() if order.index(r) >= order.index(here)}
        assert not later, f"{here} is placed before {later}"


def test_benchmarks_enter_few_rooms_and_the_package_does_not_know_them():
    entered: dict[bool, set[str]] = {True: set(), False: set()}
    folder = PACKAGE.parent / "benchmarks"
    for path in folder.rglob("*.py"):
        names = [own(name) for name, _ in imports(path)]
        entered["family" in path.parts] |= {room(n) for n in names if n} - COMMON
    assert entered[False] == BENCHMARKS
    assert entered[True] <= BENCHMARKS | FAMILY
    assert not any("benchmarks" in names for names in OUTSIDE.values())


def test_nothing_else_stands_beside_the_rooms():
    assert {m for m, p in MODULES.items() if p.parent == PACKAGE} == TOP


def test_no_room_imports_a_later_room():
    wrong = [
        f"{module} imports {target}"
        for module, targets in WITH_TYPES.items()
        if room(module) in ALLOWED
        for target in sorted(targets)
        # "" is the package itself: its version
        if target and room(target) not in {room(module), *COMMON, *ALLOWED[room(module)]}
    ]
    assert not wrong


def test_rooms_are_entered_through_their_doors():
    wrong = [
        f"{module} imports {target}"
        for module, targets in WITH_TYPES.items()
        for target in sorted(targets)
        if target not in DOORS.get((room(module), room(target)), {target})
    ]
    assert not wrong


def test_common_modules_import_nothing_of_the_house():
    assert not any(INSIDE[module] for module in COMMON)
    assert OUTSIDE["errors"] <= set(sys.stdlib_module_names)
    assert OUTSIDE["arrays"] <= {"numpy", *sys.stdlib_module_names}


def test_message_passing_knows_labels_and_costs_only():
    own = [m for m in MODULES if room(m) == "mrf"]
    assert "mrf.trws" in own
    for module in own:
        assert OUTSIDE[module] <= {"numpy", "scipy", *sys.stdlib_module_names}


@pytest.mark.parametrize("library", LIBRARIES)
def test_a_library_stays_in_its_rooms(library):
    wrong = {m for m, names in OUTSIDE.items() if library in names} - {
        m for m in MODULES if room(m) in LIBRARIES[library]
    }
    assert not wrong


def reached(module: str) -> set[str]:
    """Every module that one needs, itself included; the package's front door is left out."""
    seen, todo = set(), [module]
    while todo:
        here = todo.pop()
        if here not in seen:
            seen.add(here)
            todo += INSIDE[here] - {""}
    return seen


@pytest.mark.parametrize("module", NUMBERS_ONLY)
def test_numbers_do_not_reach_symbols(module):
    with_symbols = {m for m in reached(module) if "casadi" in OUTSIDE[m]}
    assert not with_symbols


def test_modules_do_not_import_in_circles():
    # raises an error that names the modules of a circle
    TopologicalSorter({module: INSIDE[module] - {""} for module in MODULES}).prepare()
