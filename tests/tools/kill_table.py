"""Kill commands at random times and look at what is left: `tests/tools/kill_table.py --kills 84`.

Every command first runs undisturbed. Then it runs again and again and gets a signal: half of the
times at any moment, half of the times while its files are being written. Afterwards the folder
must hold the old result or the new one, whole, and only SIGKILL may leave a temporary folder.

`tests/tools/kill_table.py --disk` runs every command on file systems of its own instead (tmpfs,
which needs the right to mount): as large as its files and the space that they take while they are
replaced, then with every free byte taken, then on a disk of half the size from the beginning.
"""

import argparse
import contextlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from multiprocessing import get_context
from multiprocessing.context import ForkProcess
from pathlib import Path
from unittest.mock import patch

import cv2
import numpy as np

from benchmarks.family.sol import write_sol
from soup_nlp.cli.main import main
from soup_nlp.config.problem import load_problem
from soup_nlp.export.program import file_orders
from soup_nlp.pipeline.case import prepare
from soup_nlp.storage.folders import SUMS, UNFINISHED, digest_of, read_sums

TINY = [
    "input.width=64", "input.height=48", "flow.source=truth", "segmentation.superpixels=12",
    "segmentation.neighbours=4", "refine.rounds=1", "refine.particles=6", "output.page=false",
]  # fmt: skip
NAMES = ("solve", "convert", "export", "import", "compare", "chain", "batch")
SIGNALS: Mapping[str, Sequence[int]] = {
    "SIGKILL": [signal.SIGKILL],
    "SIGTERM": [signal.SIGTERM],
    "SIGINT": [signal.SIGINT],
    "2 SIGINT": [signal.SIGINT, signal.SIGINT],
}


def commands(root: Path, names: Sequence[str]) -> dict[str, list[str]]:
    """The commands of the table, which write into folders of their names."""
    overrides = [word for text in TINY for word in ("--set", text)]
    export = ["export", "orbit", "-q", *overrides]
    out = {name: root / name for name in NAMES}
    words = {
        "solve": ["solve", "orbit", "-q", *overrides, "--out", str(out["solve"])],
        "export": [*export, "--out", str(out["export"])],
        "import": ["import", str(root / "exported"), str(root / "a.sol"), "-o", str(out["import"])],
        "compare": f"compare orbit --solvers ipopt --seconds 20 -o {out['compare']}".split()
        + overrides,
        # a pair that is solved again ends the chain that it was part of
        "chain": f"chain {clip(root)} --fov=50 -q --overwrite -o {out['chain']}".split()
        + overrides[6:],
        "batch": f"batch {problem_files(root)} -q -o {out['batch']}".split() + overrides[4:],
        "convert": f"convert {root / 'solved'} --to glb,colmap,npy -o {out['convert']}".split(),
    }
    if "convert" in names:
        run([*words["solve"][:-1], str(root / "solved")])
    if "import" in names:
        run([*export, "--out", str(root / "exported")])
        problem = load_problem(root / "exported" / "problem.yaml")
        case = prepare(problem)
        nlp, _ = case.nlp(case.formulation(hessian="exact"))
        write_sol(root / "a.sol", nlp.x0, None, *file_orders(nlp))
    return {name: words[name] for name in names}


def problem_files(root: Path) -> Path:
    """A folder of two problem files."""
    folder = root / "problems"
    folder.mkdir(exist_ok=True)
    for scene in ("orbit", "street"):
        text = f"input: {{kind: scene, scene: {scene}, width: 64, height: 48}}\n"
        (folder / f"{scene}.yaml").write_text(text)
    return folder


def clip(root: Path) -> Path:
    """A folder of three frames of noise: a wall, and a box in front that moves twice as far."""
    folder = root / "clip"
    if not folder.is_dir():
        folder.mkdir()
        noise = np.random.default_rng(0).integers(0, 255, (2, 64, 96, 3)).astype(np.uint8)
        wall, box = (cv2.GaussianBlur(n, (0, 0), 1.5) for n in noise)
        for k in range(3):
            frame = wall[8:56, 8 + 2 * k : 72 + 2 * k].copy()
            frame[12:36, 20:44] = box[12:36, 20 + 4 * k : 44 + 4 * k]
            cv2.imwrite(str(folder / f"{k}.png"), frame)
    return folder


def start(words: Sequence[str]) -> ForkProcess:
    """Run a command in a process and session of its own, which need not import the package."""
    process = get_context("fork").Process(target=_command, args=(words,))
    process.start()
    return process


def _command(words: Sequence[str]) -> None:
    os.setsid()
    nothing = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(nothing, stream)
    # TMPDIR may have changed
    tempfile.tempdir, code = None, 1
    try:
        code = main([*words])
    finally:
        # without the exit handlers of the parent
        os._exit(code)


def run(words: Sequence[str]) -> tuple[int, float]:
    """Exit code and seconds of an undisturbed run."""
    begin, process = time.perf_counter(), start(words)
    process.join()
    return int(process.exitcode or 0), time.perf_counter() - begin


def disturbed(
    words: Sequence[str], folder: Path, numbers: Sequence[int], delay: float, writing: bool
) -> tuple[str, float]:
    """Run a command and send signals after a delay, which begins with the writing if asked.

    Returns:
        How it ended, "before" where that was before the first signal; the seconds that it ran.
    """
    for path in folder.glob("*.jsonl"):
        # rows that are stored are not measured again
        path.unlink()
    process = start(words)
    begin = time.perf_counter()
    waiting, until = writing, begin + delay
    while waiting or time.perf_counter() < until:
        # at other moments than those of writing, nobody has to look often
        time.sleep(0.0005 if writing else 0.01)
        if waiting and unfinished(folder.parent, folder / "pairs"):
            waiting, until = False, time.perf_counter() + delay
        if not process.is_alive():
            return "before", time.perf_counter() - begin
    for number in numbers:
        os.kill(process.pid, number)
        time.sleep(0.02)
    process.join()
    code, spent = int(process.exitcode or 0), time.perf_counter() - begin
    return signal.Signals(-code).name if code < 0 else f"exit {code}", spent


def broken(folder: Path) -> list[str]:
    """Files of a folder's list that are missing or are not the listed ones."""
    if not folder.is_dir():
        return []
    listed = files_of(folder)
    wrong = [
        n for n, d in listed.items() if not (folder / n).is_file() or digest_of(folder / n) != d
    ]
    inner = [p for p in (folder / "pairs").glob("[!u]*") if p.is_dir()]
    wrong += [f"pairs/{p.name}/{name}" for p in inner for name in broken(p)]
    there = (p.relative_to(folder) for p in folder.rglob("*") if p.is_file())
    own = {str(p) for p in there if p.parts[0] != "pairs" and p.suffix != ".jsonl"}
    return wrong + sorted(own - listed.keys() - {SUMS})


def files_of(folder: Path) -> dict[str, str]:
    """The list of files of a folder."""
    sums = read_sums(folder)
    return sums.files if sums else {}


Rows = list[dict[str, object]]


def told(rows: Rows, **row: object) -> None:
    """Add a row and print it."""
    rows.append(row)
    print(json.dumps(row), flush=True)


def unfinished(*folders: Path) -> list[Path]:
    """Temporary folders of the program in some folders."""
    there = [path for folder in folders if folder.is_dir() for path in folder.iterdir()]
    return [path for path in there if path.name.startswith((UNFINISHED, "soup_nlp-"))]


def table(kills: int, names: Sequence[str], seed: int = 0) -> Rows:
    """One row per kill, and one per command for the run after all of its kills."""
    rng, rows = random.Random(seed), Rows()
    with tempfile.TemporaryDirectory() as place:
        root = Path(place)
        (root / "tmp").mkdir()
        with patch.dict(os.environ, TMPDIR=str(root / "tmp")):
            for number, (name, words) in enumerate(commands(root, names).items()):
                folder, (_, seconds) = root / name, run(words)
                share = kills // len(names) + (number == 0) * (kills % len(names))
                for k in range(share):
                    word = list(SIGNALS)[k % len(SIGNALS)]
                    writing, how = k % 8 >= 4, "before"
                    while how == "before":
                        delay = rng.uniform(0, 0.1 if writing else seconds)
                        how, spent = disturbed(words, folder, SIGNALS[word], delay, writing)
                        seconds = spent if how == "before" and not writing else seconds
                    time.sleep(0.3)
                    when = f"writing + {delay:.3f} s" if writing else f"{delay:.2f} s"
                    row = {"command": name, "signal": word, "when": when, "ended": how}
                    row["broken"] = broken(folder)
                    # SIGKILL leaves a temporary folder
                    left = unfinished(root / "tmp", root, folder / "pairs")
                    told(rows, **row, left=[] if how == "SIGKILL" else [*map(str, left)])
                    for path in left:
                        shutil.rmtree(path)
                ended, bad = f"exit {run(words)[0]}", broken(folder)
                told(rows, command=name, signal="none", ended=ended, broken=bad)
    return rows


@contextlib.contextmanager
def disk(place: Path, size: int) -> Iterator[None]:
    """A file system of so many bytes."""
    place.mkdir()
    words = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(place)]
    subprocess.run(words, check=True, capture_output=True)
    try:
        yield
    finally:
        subprocess.run(["umount", str(place)], check=True)
        place.rmdir()


def listed(folder: Path) -> dict[str, dict[str, str]]:
    """The list of files of a folder and of the results in it."""
    places = [folder, *(folder / "pairs").glob("*")]
    return {str(p): files_of(p) for p in places if p.is_dir()}


def fill(folder: Path) -> None:
    """Take every free byte; rows of earlier runs go, so that there is something to write."""
    for path in folder.rglob("*.jsonl"):
        path.unlink()
    with contextlib.suppress(OSError), (folder / "rest").open("wb") as file:
        while True:
            file.write(bytes(4096))
            file.flush()


def full_disks(names: Sequence[str]) -> Rows:
    """One row per command and state of a file system of its own."""
    rows = Rows()
    with tempfile.TemporaryDirectory() as place:
        root = Path(place)
        for name, words in commands(root, names).items():
            run(words)
            files = [p for p in (root / name).rglob("*") if p.is_file()]
            # whole pages, and the folders
            size = sum(-(-p.stat().st_size // 4096) * 4096 + 4096 for p in files)
            shutil.rmtree(root / name)
            target = root / "disk" / name
            words = [w.replace(str(root / name), str(target)) for w in words]
            spaces = {("free", "taken"): 2 * size + (1 << 18), ("small",): size // 2}
            for states, space in spaces.items():
                with disk(root / "disk", space):
                    for state in states:
                        before = listed(target)
                        if state == "taken":
                            fill(root / "disk")
                        row = {"command": name, "disk": state, "size": space}
                        row |= {"exit": run(words)[0], "broken": broken(target)}
                        kept, left = listed(target) == before, unfinished(root / "disk", target)
                        told(rows, **row, left=[*map(str, left)], **{"earlier kept": kept})
    return rows


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=60)
    parser.add_argument("--only", default=",".join(NAMES))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--disk", action="store_true", help="full disks instead of kills")
    options = parser.parse_args()
    if options.disk:
        rows = full_disks(options.only.split(","))
        lost = [r for r in rows if r["disk"] == "taken" and not r["earlier kept"]]
        sys.exit(bool(lost) or any(r["broken"] or r["left"] for r in rows))
    found = table(options.kills, options.only.split(","), options.seed)
    bad = [row for row in found if row["broken"] or row.get("left")]
    done = sum(row["signal"] != "none" for row in found)
    print(f"{done} kills, {len(bad)} folders that are not whole or hold temporary files")
    sys.exit(bool(bad))
