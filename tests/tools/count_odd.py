"""Counts odd inputs that are not answered as promised, by class, each in its own process.

python tests/tools/count_odd.py [WORD ...]     # only cases whose name holds one of the words
"""

from __future__ import annotations

import os
import resource
import signal
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "helpers"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "odd"))

from helpers_odd_cases import CASES
from helpers_odd_run import Case, fault
from helpers_odd_world import World

SECONDS = 120
MEMORY = 6 << 30


def isolated(case: Case, world: World, folder: Path) -> str | None:
    """The fault of a case, found in a child process with limited memory."""
    read, write = os.pipe()
    child = os.fork()
    if not child:
        os.close(read)
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        with open(os.devnull, "w") as nothing:
            os.dup2(nothing.fileno(), 2)
        os.write(write, (fault(case, world, folder, SECONDS) or "").encode(errors="replace")[:4000])
        os._exit(0)
    os.close(write)
    end = time.monotonic() + SECONDS + 5
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            break
        if time.monotonic() > end:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            os.close(read)
            return "endless (killed)"
        time.sleep(0.002)
    with os.fdopen(read) as pipe:
        text = pipe.read()
    if os.WIFSIGNALED(status):
        return f"crash: signal {os.WTERMSIG(status)}"
    return text or None


def main() -> None:
    words = sys.argv[1:]
    cases = [c for c in CASES if not words or any(w in f"{c.group} {c.name}" for w in words)]
    total, bad = Counter[str](), Counter[str]()
    with tempfile.TemporaryDirectory() as scratch:
        world = World(Path(scratch))
        _ = world.result, world.exported, world.run
        for k, case in enumerate(cases):
            folder = Path(scratch) / f"case_{k}"
            folder.mkdir()
            begin = time.perf_counter()
            found = isolated(case, world, folder)
            total[case.group] += 1
            if found:
                bad[case.group] += 1
                print(
                    f"{case.group}  {case.name}  {time.perf_counter() - begin:.1f} s  {found}",
                    flush=True,
                )
    print("\nclass                    cases   not as promised")
    for group in sorted(total):
        print(f"{group:<24} {total[group]:>5} {bad[group]:>8}")
    print(f"{'all':<24} {total.total():>5} {bad.total():>8}")


if __name__ == "__main__":
    main()
