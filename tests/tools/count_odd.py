"""Counts odd inputs that are not answered as promised, each in its own process.

python tests/tools/count_odd.py [WORD ...]     # only cases whose name holds one of the words
"""

import sys
import tempfile
import time
from functools import partial
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "helpers"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "odd"))

from helpers_odd_run import Case, fault
from helpers_odd_world import World
from test_odd_inputs import CASES

from soup_nlp.storage.each import each

SECONDS = 120


def row_of(case: Case, world: World, folder: Path) -> dict[str, str | None]:
    """The row of a case."""
    return {"fault": fault(case, world, folder, SECONDS)}


def main() -> None:
    words = sys.argv[1:]
    cases = [c for c in CASES if not words or any(word in c.name for word in words)]
    bad = 0
    with tempfile.TemporaryDirectory() as scratch:
        world = World(Path(scratch))
        _ = world.result, world.exported
        for k, case in enumerate(cases):
            folder = Path(scratch) / f"case_{k}"
            folder.mkdir()
            begin = time.perf_counter()
            work = partial(row_of, case, world, folder)
            ((_, row),) = each({case.name: work}, fresh=True, seconds=SECONDS)
            if found := row.get("fault", row["error"]):
                bad += 1
                print(f"{case.name}  {time.perf_counter() - begin:.1f} s  {found}", flush=True)
    print(f"\n{len(cases)} cases, {bad} not as promised")


if __name__ == "__main__":
    main()
