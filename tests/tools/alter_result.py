"""Which random changes of a result `check` notices: `tests/tools/alter_result.py --count 200`.

A result of a rendered pair is written in all formats. Every alteration changes one byte of one of
its files, or one value: an entry of summary.json, an element of an array or an attribute of
result.h5 (written by HDF5, so that its checksums are right). The result is checked and restored.
"""

import argparse
import json
import random
import shutil
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from soup_nlp.cli.main import main
from soup_nlp.errors import SoupError
from soup_nlp.report.check import check_folder

SMALL = [
    "input.width=128", "input.height=96", "flow.source=truth", "segmentation.superpixels=40",
    "segmentation.neighbours=6", "refine.rounds=1", "refine.particles=8",
]  # fmt: skip
FORMATS = "glb,colmap,npy,pfm,png,motions"
LEFT = (".soup_nlp",)
"""Files without a claim: the list of the others. Damage that makes it no list is noticed."""


def leaves(tree: Any, place: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Places of all plain values of a JSON tree."""
    if not isinstance(tree, dict | list):
        return [place]
    keys = tree.items() if isinstance(tree, dict) else enumerate(tree)
    return [found for key, value in keys for found in leaves(value, (*place, key))]


def other(value: Any) -> Any:
    """Another value of the same kind."""
    if isinstance(value, bool | np.bool_):
        return not value
    if isinstance(value, str | bytes):
        return value + ("x" if isinstance(value, str) else b"x")
    if value is None:
        return 1.0
    if isinstance(value, int | np.integer):
        return value + 1 if value < 255 else value - 1
    # rounding errors are as good as any other of their size
    return 1.0 if not np.isfinite(value) or abs(value) < 1e-9 else value * 1.001


def alter_byte(path: Path, rng: random.Random) -> str:
    """One byte of a file."""
    data = bytearray(path.read_bytes())
    at = rng.randrange(len(data))
    data[at] ^= rng.randrange(1, 256)
    path.write_bytes(data)
    return f"byte {at} of {len(data)}"


def alter_entry(path: Path, rng: random.Random) -> str:
    """One value of a JSON file, changed or, one time in four, removed."""
    tree = json.loads(path.read_text())
    *above, last = rng.choice(leaves(tree))
    here = tree
    for key in above:
        here = here[key]
    if isinstance(here, dict) and rng.random() < 0.25:
        del here[last]
    else:
        here[last] = other(here[last])
    path.write_text(json.dumps(tree, indent=2))
    return " ".join(map(str, (*above, last)))


def alter_array(path: Path, rng: random.Random) -> str:
    """One element of an array, or one attribute."""
    with h5py.File(path, "a") as file:
        names: list[str] = []
        file.visititems(lambda name, item: names.append(name) if hasattr(item, "shape") else None)
        if rng.random() < 0.15:
            key = rng.choice(sorted(file.attrs))
            file.attrs[key] = other(file.attrs[key])
            return f"attribute {key}"
        name = rng.choice(sorted(names))
        item = file[name]
        if item.dtype.kind not in "biuf" or not item.size:
            value = item[()]
            text = value if item.shape == () else value.ravel()[0]
            del file[name]
            file[name] = other(text)
            return name
        at = tuple(rng.randrange(n) for n in item.shape)
        item[at] = other(item[at])
        return f"{name} {at}"


def noticed(folder: Path) -> str:
    """What the check says: names of rows that fail, or the error; empty where nothing is wrong."""
    try:
        bad = [row.name for row in check_folder(folder).rows if not row.ok]
    except SoupError as error:
        return str(error).splitlines()[0]
    return ", ".join(bad[:3])


def run(count: int, seed: int) -> Counter[tuple[str, str]]:
    """Alter and check; counts by kind of file and "noticed", "not noticed", "left"."""
    rng, found = random.Random(seed), Counter[tuple[str, str]]()
    with tempfile.TemporaryDirectory() as place:
        good, folder = Path(place) / "good", Path(place) / "altered"
        sets = [word for text in SMALL for word in ("--set", text)]
        assert main(["solve", "orbit", "-q", *sets, "--out", str(good)]) in (0, 1)
        assert main(["convert", str(good), "--to", FORMATS]) == 0
        assert not noticed(good)
        files = sorted(p.relative_to(good) for p in good.rglob("*") if p.is_file())
        for k in range(count):
            shutil.copytree(good, folder)
            kind = ("byte", "entry", "array")[k % 4 % 3]
            name = Path({"entry": "summary.json", "array": "result.h5"}.get(kind, ""))
            name = rng.choice(files) if kind == "byte" else name
            change = {"byte": alter_byte, "entry": alter_entry, "array": alter_array}[kind]
            what = change(folder / name, rng)
            said = noticed(folder)
            word = "noticed" if said else "not noticed"
            if not said and str(name) in LEFT:
                word = "left"
            found[f"{kind} of {name if kind == 'byte' else 'any'}", word] += 1
            if not said:
                print(f"{word}: {kind} of {name}: {what}", flush=True)
            shutil.rmtree(folder)
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    counts = run(options.count, options.seed)
    for (kind, word), number in sorted(counts.items()):
        print(f"{kind:<40} {word:<12} {number:>4}")
    total = Counter({w: sum(n for (_, x), n in counts.items() if x == w) for _, w in counts})
    print(", ".join(f"{number} {word}" for word, number in sorted(total.items())))
    sys.exit(bool(total["not noticed"]))
