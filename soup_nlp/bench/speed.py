"""Speed: which runs there are, each in a process of its own, and the file that remembers them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from itertools import product
from pathlib import Path
from typing import Any

from soup_nlp.bench.machine import code_version
from soup_nlp.errors import DataError

Record = dict[str, Any]
YARDSTICKS = ("same", "wide")
"""Levenberg-Marquardt on the solver's own smoothing widths, or from a wide smoothing."""
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True)
class Spec:
    """One run.

    Attributes:
        scene: A rendered scene, or "motorcycle".
        superpixels: Wanted number N.
        neighbours: K of the K-NN graph.
        seed: Of the scene and of all draws.
        width: Columns of a rendered scene.
        height: Rows of a rendered scene.
        yardsticks: Of YARDSTICKS.
        overrides: Of the problem, e.g. "solver.max_iter=200".
    """

    scene: str
    superpixels: int
    neighbours: int
    seed: int = 0
    width: int = 1024
    height: int = 436
    yardsticks: tuple[str, ...] = ("same",)
    overrides: tuple[str, ...] = ()

    @property
    def key(self) -> str:
        """What identifies the run, whatever the code: street-N250-K10-s0-1024x436."""
        size = "" if self.scene == "motorcycle" else f"-{self.width}x{self.height}"
        own = "".join(f"-{text}" for text in self.overrides)
        name = f"{self.scene}-N{self.superpixels}-K{self.neighbours}-s{self.seed}"
        return name + size + own

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Spec:
        """The spec that `dataclasses.asdict` took apart."""
        known = {f.name for f in fields(cls)}
        own = {k: v for k, v in values.items() if k in known}
        for name in ("yardsticks", "overrides"):
            own[name] = tuple(own.get(name, ()))
        return cls(**own)


def plan(
    scenes: Sequence[str],
    sizes: Sequence[int],
    neighbours: Sequence[int],
    seeds: Sequence[int],
    **others: Any,
) -> list[Spec]:
    """Every combination, small ones first; the motorcycle is one pair, so it has the first seed."""
    out = []
    for n, k, scene, seed in product(sorted(sizes), sorted(neighbours), scenes, seeds):
        if scene != "motorcycle" or seed == seeds[0]:
            out.append(Spec(scene, n, k, seed, **others))
    return out


def read_records(path: Path) -> list[Record]:
    """Records of a JSON-lines file, in order; a line that was cut off is left out."""
    out = []
    if path.is_file():
        for line in path.read_text(encoding="utf-8").splitlines():
            try:
                out.append(json.loads(line))
            except json.JSONDecodeError:
                continue
    return out


def find(records: Sequence[Record], spec: Spec, code: str) -> Record | None:
    """The stored record of a spec by this code that has all its yardsticks, if there is one."""
    for record in reversed(records):
        same = record.get("key") == spec.key and record.get("code") == code
        if same and "error" not in record and set(spec.yardsticks) <= set(record["yardstick"]):
            return record
    return None


def run_alone(spec: Spec, seconds: float = 7200.0) -> Record:
    """Measure a spec in a process of its own, with one thread.

    Args:
        spec: The run.
        seconds: The process is ended after this.

    Returns:
        What `timed.measure` says; {"error": ...} where the process failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "spec.json", Path(folder) / "record.json"
        source.write_text(json.dumps(asdict(spec)), encoding="utf-8")
        command = [sys.executable, "-m", "soup_nlp.bench.timed", str(source), str(target)]
        env = {**os.environ, **dict.fromkeys(THREADS, "1")}
        try:
            done = subprocess.run(
                command, env=env, capture_output=True, text=True, timeout=seconds, check=False
            )
        except subprocess.TimeoutExpired:
            return {"error": f"no answer after {seconds:g} s"}
        if done.returncode or not target.is_file():
            lines = (
                done.stderr.split("\n") if done.returncode == 2 else done.stderr.splitlines()[-1:]
            )
            text = "; ".join(line.strip() for line in lines if line.strip())
            return {"error": text or f"exit code {done.returncode}"}
        record: Record = json.loads(target.read_text(encoding="utf-8"))
        return record


def _append(path: Path, line: str) -> None:
    """Add a line, after a line end where a crash left none."""
    with path.open("ab+") as file:
        if file.tell():
            file.seek(-1, os.SEEK_END)
            if file.read(1) != b"\n":
                line = "\n" + line
        file.write((line + "\n").encode())


def measure_all(
    specs: Sequence[Spec],
    path: Path,
    *,
    fresh: bool = False,
    measure: Callable[[Spec], Record] = run_alone,
    say: Callable[[str], None] | None = None,
) -> Iterator[Record]:
    """Measure what the file does not hold yet; every record is appended as soon as it is there.

    Args:
        specs: Runs.
        path: JSON-lines file; its folder must exist.
        fresh: Measure again what is there.
        measure: Measures one run.
        say: Called with a line before every run.

    Yields:
        A record a spec, in order: "spec", "key", "code", and the measurement or "error".

    Raises:
        DataError: the file cannot be written.
    """
    code = code_version()
    stored = [] if fresh else read_records(path)
    for count, spec in enumerate(specs, 1):
        record = find(stored, spec, code)
        if say:
            say(f"{count}/{len(specs)} {spec.key}{' (stored)' if record else ''}")
        if record is None:
            record = {"key": spec.key, "code": code, "spec": asdict(spec), **measure(spec)}
            try:
                _append(path, json.dumps(record))
            except OSError as error:
                raise DataError(
                    "measurements cannot be written", where=path, found=error.strerror
                ) from error
        yield record
